//! SLAHMR on a short synthetic take, compared with a solve of each frame alone.

use std::sync::Arc;

use bundlemocap::core::body::{Pose, Posture, Skeleton, StampedPose};
use bundlemocap::core::manifold::Decoder;
use bundlemocap::core::time::Nanos;
use bundlemocap::metrics;
use bundlemocap::research::methods::{Solved, Take, named};
use bundlemocap::research::synth::{Motion, MotionStyle, Recording, ring_rig};

/// Mean joint error, mm, and acceleration error, m/s^2, against the true poses.
fn errors<M: Fn(f64) -> Pose>(recording: &Recording<M>, solved: &Solved) -> (f64, f64) {
    let truth: Vec<StampedPose> = recording.poses().collect();
    let times = solved.motion.times();
    let pairs = times.iter().enumerate().filter_map(|(frame, at)| {
        let truth = truth.iter().find(|truth| (truth.capture - *at).abs() < Nanos::from_ms(1))?;
        let found = solved.motion.frame(frame)?.posture()?.clone();
        Some((found, truth.pose.posture(&recording.skeleton)))
    });
    let (found, truth): (Vec<Posture>, Vec<Posture>) = pairs.unzip();
    assert!(found.len() > 40, "{} of 60 frames", found.len());
    let mpjpe = metrics::pose_errors(found.iter().zip(&truth)).unwrap().mpjpe_mm;
    (mpjpe, metrics::acceleration_error(&found, &truth, recording.fps).unwrap())
}

#[test]
fn slahmr_is_smoother_than_each_frame_alone_and_not_much_worse() {
    let decoder = Decoder::embedded().unwrap();
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut recording = Recording::new(rig.clone(), skeleton, |t| motion.pose(t));
    (recording.fps, recording.frames) = (50.0, 60);
    let frames = recording.detections().collect();
    let take = Take::new(Arc::new(rig), recording.format, recording.fps, frames);
    let solve = |name: &str| {
        let solved = named(name).unwrap().solve(&take, &decoder).unwrap();
        errors(&recording, &solved)
    };
    let (alone, staged) = (solve("muvs"), solve("slahmr"));
    assert!(staged.1 < 0.5 * alone.1, "{staged:?} against {alone:?}");
    assert!(staged.0 < 1.3 * alone.0, "{staged:?} against {alone:?}");
}
