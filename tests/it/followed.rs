//! What the cameras agree on is followed.

use std::sync::Arc;

use bundlemocap::core::body::{Joint, Pose, Skeleton};
use bundlemocap::core::camera::Rig;
use bundlemocap::core::detections::Detections;
use bundlemocap::core::manifold::Decoder;
use bundlemocap::core::so3;
use bundlemocap::core::tracker::{Config, EventKind, Output, Solver, Tracker, Verdict, run_to_end};
use bundlemocap::metrics::{FollowedSums, NotFollowed};
use bundlemocap::research::synth::{Noise, Recording, ring_rig};
use nalgebra::{Matrix3, Vector3};

const FPS: f64 = 60.0;

/// Somebody stands, raises the left leg forward by an angle, degrees, holds it for a second, and has put
/// it down in the next frame.
fn kick(seconds: f64, angle: f64) -> Pose {
    let s = ((seconds - 1.0) / 0.6).clamp(0.0, 1.0);
    let up = if seconds < 2.6 { s * s * (3.0 - 2.0 * s) } else { 0.0 };
    let raised = up * angle.to_radians();
    let mut pose = Pose::rest();
    pose.root_position = Vector3::new(0.0, 0.95, 0.0);
    let mut turn = |joint: Joint, by: Vector3<f64>| pose.local[joint.index() - 1] = so3::exp(&by);
    turn(Joint::LHip, Vector3::new(-raised, 0.0, 0.0));
    turn(Joint::LKnee, Vector3::new(0.15 * raised, 0.0, 0.0));
    turn(Joint::LShoulder, Vector3::new(0.0, 0.0, -1.2));
    turn(Joint::RShoulder, Vector3::new(0.0, 0.0, 1.2));
    pose
}

/// Somebody stands with bent elbows. After two seconds, in one frame, the left forearm swings from the outside to the
/// inside: the wrist moves along the x axis.
fn swing(seconds: f64, angle: f64) -> Pose {
    let side = if seconds < 2.0 { 1.0 } else { -1.0 };
    let mut pose = kick(0.0, 0.0);
    let mut turn = |joint: Joint, by: Matrix3<f64>| pose.local[joint.index() - 1] = by;
    let about_arm = so3::exp(&(Vector3::y() * side * angle.to_radians()));
    turn(Joint::LShoulder, about_arm * so3::exp(&(Vector3::z() * -1.4)));
    turn(Joint::LElbow, so3::exp(&(Vector3::y() * -1.5)));
    pose
}

/// The motion in front of some cameras of a ring of four.
fn detections(
    motion: impl Fn(f64) -> Pose + Send + Sync + 'static,
    cameras: usize,
    noise: Noise,
) -> (Rig, Vec<Detections>) {
    let mut rig = ring_rig(4, 4.0, 1.6).unwrap();
    rig.cameras.truncate(cameras);
    let mut recording = Recording::new(rig, Skeleton::default(), motion);
    (recording.frames, recording.fps, recording.noise) = (240, FPS, noise);
    let mut frames: Vec<_> = recording.detections().collect();
    frames.sort_by_key(|frame| frame.capture);
    (recording.rig, frames)
}

/// What was not followed, and the number of events that say so.
fn tracked(rig: Rig, frames: Vec<Detections>, config: Config) -> (NotFollowed, usize) {
    let mut tracker = Tracker::new(config, Arc::new(rig));
    let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
    let (mut sums, mut events) = (FollowedSums::default(), 0);
    run_to_end(&mut tracker, &mut solver, frames, |output| match output {
        Output::Window(report) => {
            assert_eq!(report.verdict, Verdict::Tracked);
            sums.add(&report);
        }
        Output::Event(event) if event.kind == EventKind::NotFollowed => events += 1,
        _ => {}
    });
    (sums.finish().unwrap(), events)
}

#[test]
fn a_limb_is_caught_within_three_frames_wherever_it_went() {
    let [none, clean, studio] = [Noise::none(), Noise::clean(), Noise::studio()];
    // Two views in studio noise agree on wrong places too.
    let cases = [(4, &none, 1), (4, &clean, 1), (4, &studio, 3), (2, &none, 2), (2, &clean, 2)];
    for (cameras, noise, most) in cases {
        for angle in [80.0, 100.0, 120.0] {
            let (rig, frames) = detections(move |s| kick(s, angle), cameras, noise.clone());
            let (found, _) = tracked(rig, frames, Config::default());
            println!("{cameras} cameras, {angle} degrees: {found:?}");
            assert!(found.longest_frames <= most, "{cameras} cameras, {angle} degrees: {found:?}");
        }
    }
}

/// One of two cameras looks along the offset, and sees the wrist near where the body has it.
#[test]
fn a_limb_that_moves_along_the_rays_of_a_camera_is_caught() {
    for noise in [Noise::none(), Noise::clean()] {
        for angle in [50.0, 60.0, 70.0] {
            let (rig, frames) = detections(move |s| swing(s, angle), 2, noise.clone());
            let (found, _) = tracked(rig, frames, Config::default());
            println!("{angle} degrees: {found:?}");
            assert!(found.longest_frames <= 3, "{angle} degrees: {found:?}");
        }
    }
}

/// A stiff path cannot follow: that is measured, and said.
#[test]
fn a_limb_that_is_left_behind_is_reported() {
    let (rig, frames) = detections(|s| kick(s, 100.0), 4, Noise::clean());
    let mut config = Config::default();
    config.cost.stiffness.latent *= 3000.0;
    config.cost.correction_prior = 0.0;
    let (found, events) = tracked(rig, frames, config);
    println!("{events} events, {found:?}");
    assert!(found.percent > 0.3 && found.longest_frames > 5 && events > 0, "{found:?}");
    let leg = &found.longest[0];
    assert!(leg.keypoint.starts_with("left ") && leg.distance_m > 0.1, "{leg:?}");
    assert!((2.0e9..3.4e9).contains(&(leg.capture_time_ns as f64)), "{leg:?}");
}
