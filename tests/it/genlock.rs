//! Cameras without genlock: the gain from each observation's own capture time.

use std::sync::Arc;

use bundlemocap::core::body::{Posture, Skeleton, TrackingState, fitted_points};
use bundlemocap::core::detections::{Detections, KeypointFormat};
use bundlemocap::core::manifold::Decoder;
use bundlemocap::core::time::{Grid, Nanos, Timestamp};
use bundlemocap::core::tracker::{self, Config, Output, Solver, Tracker, run_to_end};
use bundlemocap::metrics::pose_errors;
use bundlemocap::research::synth::{Motion, MotionStyle, Noise, Recording, ring_rig};

/// A walk seen by four genlocked cameras at twice the rate of the tested cameras, so that half a
/// frame can be taken from it.
struct Walk {
    /// Frame rate of the tested cameras.
    fps: f64,
    motion: Motion,
    skeleton: Skeleton,
    frames: Vec<Detections>,
    rig: Arc<bundlemocap::core::camera::Rig>,
}

impl Walk {
    fn new(fps: f64) -> Self {
        let skeleton = Skeleton::default();
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let rig = ring_rig(4, 4.0, 1.6).unwrap();
        let of_motion = motion.clone();
        let mut recording = Recording::new(rig, skeleton, move |s| of_motion.pose(s));
        (recording.fps, recording.frames) = (2.0 * fps, (12.0 * fps) as u64);
        recording.noise = Noise::jitter_only();
        let frames = recording.detections().collect();
        let rig = Arc::new(recording.rig);
        Self { fps, motion, skeleton: recording.skeleton, frames, rig }
    }

    /// Mean distance of the solved joints from the truth, mm, for the frames of the cameras: `of`
    /// selects and numbers them.
    fn error_mm(&self, of: impl Fn(&Detections) -> Option<Detections>) -> f64 {
        // Windows of a sixth of a second at any rate.
        let window_frames = (self.fps / 6.0).round() as usize;
        let config = Config { frame_rate_hz: self.fps, window_frames, ..Config::default() };
        let mut tracker = Tracker::new(config, Arc::clone(&self.rig));
        let mut solver = Solver::new(Decoder::embedded().unwrap(), config);
        let mut frames: Vec<Detections> = self.frames.iter().filter_map(of).collect();
        frames.sort_by_key(|frame| (frame.capture, frame.camera));
        let (mut skeleton, mut poses) = (None, Vec::new());
        run_to_end(&mut tracker, &mut solver, frames, |output| match output {
            Output::Skeleton(found) => skeleton = Some(found),
            Output::Pose(pose) => poses.push(pose),
            _ => {}
        });
        assert!(poses.iter().filter(|pose| pose.state == TrackingState::Tracking).count() > 160);
        let skeleton = skeleton.unwrap();
        let pairs = poses.iter().map(|pose| -> (Posture, Posture) {
            let truth = self.motion.pose(pose.capture.ns() as f64 * 1e-9);
            (pose.pose.posture(&skeleton), truth.posture(&self.skeleton))
        });
        pose_errors(pairs).unwrap().mpjpe_mm
    }
}

/// The frame at the cameras' grid time at or before its own.
fn snapped(frame: Detections, fps: f64) -> Detections {
    let grid = Grid { origin: Timestamp::default(), period_ns: 1e9 / fps };
    let capture = grid.time(grid.at_or_before(frame.capture + Nanos::new(1000)));
    Detections { capture, ..frame }
}

#[test]
fn own_capture_times_beat_a_common_grid_for_cameras_half_a_frame_apart() {
    let walk = Walk::new(30.0);
    let every_other = |frame: &Detections, phase: u64| {
        let number = frame.frame;
        (number % 2 == phase).then(|| Detections { frame: number / 2, ..frame.clone() })
    };
    let genlocked = walk.error_mm(|frame| every_other(frame, 0));
    let half_apart = |frame: &Detections| every_other(frame, u64::from(frame.camera >= 2));
    let own_times = walk.error_mm(half_apart);
    let on_a_grid = walk.error_mm(|frame| half_apart(frame).map(|frame| snapped(frame, walk.fps)));
    println!(
        "MPJPE: genlocked {genlocked:.2} mm; half a frame apart, at their own times \
         {own_times:.2} mm, snapped to frames {on_a_grid:.2} mm"
    );
    assert!(own_times < genlocked + 1.0, "{own_times} mm against {genlocked} mm");
    assert!(on_a_grid > own_times + 0.3, "{on_a_grid} mm against {own_times} mm");
}

#[test]
fn one_camera_at_half_the_rate_of_the_others_works() {
    let walk = Walk::new(60.0);
    let mixed = |frame: &Detections| {
        let step = if frame.camera == 0 { 4 } else { 2 };
        let number = frame.frame;
        number.is_multiple_of(step).then(|| Detections { frame: number / step, ..frame.clone() })
    };
    let all = walk.error_mm(|frame| {
        let number = frame.frame;
        (number % 2 == 0).then(|| Detections { frame: number / 2, ..frame.clone() })
    });
    let error = walk.error_mm(mixed);
    println!("MPJPE: four cameras at 60 {all:.2} mm, one at 30 and three at 60 {error:.2} mm");
    assert!(error < all + 2.0, "{error} mm against {all} mm");
}

#[test]
fn spread_shutters_share_decodings() {
    let (skeleton, format) = (Skeleton::default(), KeypointFormat::Halpe26);
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let of_motion = motion.clone();
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut recording = Recording::new(rig, skeleton, move |s| of_motion.pose(s));
    (recording.frames, recording.fps, recording.stagger) = (60, 60.0, 0.8);
    (recording.noise, recording.format) = (Noise::none(), format);
    let mut frames: Vec<Detections> = recording.detections().collect();
    frames.sort_by_key(|frame| frame.capture);
    let (points, skeleton) = (fitted_points(format), &recording.skeleton);
    let start = motion.pose(0.0);
    let period = Nanos::rounded(1e9 / 60.0);
    let (all, rig) = (frames.iter(), &recording.rig);
    let shared = tracker::follow(all, period, &points, rig, &start, skeleton, &Config::default());
    // The first frame of each camera has none before it.
    assert!(shared.len() <= 60 + 3, "{} times of 60 frame sets", shared.len());
    let mut errors = Vec::new();
    for frame in &shared {
        let pose = motion.pose(frame.capture.ns() as f64 * 1e-9);
        let posture = pose.posture(skeleton);
        for seen in frame.observations() {
            let at = points[seen.point].attachment.position(&posture, skeleton);
            let pixel = recording.rig.cameras[seen.camera].project(&at).unwrap();
            errors.push((pixel - seen.pixel).norm());
        }
    }
    assert_eq!(errors.len(), frames.len() * points.len());
    errors.sort_by(f64::total_cmp);
    let (median, most) = (errors[errors.len() / 2], errors[errors.len() - 1]);
    println!("{} times; off by {median:.3} px, at most {most:.2} px", shared.len());
    assert!(median < 0.05 && most < 2.0, "{median} px, {most} px");
    // A nominal period that is longer than the real one loses no frame.
    let longer = Nanos::rounded(1e9 / 60.0 / 0.85);
    let of_camera = || frames.iter().filter(|frame| frame.camera == 0);
    let (all, config) = (of_camera(), Config::default());
    let alone = tracker::follow(all, longer, &points, rig, &start, skeleton, &config);
    let times: Vec<_> = alone.iter().map(|frame| frame.capture).collect();
    assert_eq!(times, of_camera().map(|frame| frame.capture).collect::<Vec<_>>());
    // Every second frame of each camera.
    let second = frames.iter().filter(|frame| frame.frame % 2 == 0);
    let half = tracker::follow(second, period * 2, &points, rig, &start, skeleton, &config);
    assert!(half.len() <= 30 + 3, "{} times of 30 frame sets", half.len());
    // A camera whose frames have no point in common keeps their own times.
    let mut torn = frames.clone();
    for frame in torn.iter_mut().filter(|frame| frame.camera == 1) {
        let points = frame.people[0].points.iter_mut().enumerate();
        let hidden = points.filter(|(point, _)| point % 2 == frame.frame as usize % 2);
        hidden.for_each(|(_, detection)| *detection = None);
    }
    let torn = tracker::follow(torn.iter(), period, &points, rig, &start, skeleton, &config);
    let own = |at: Timestamp| frames.iter().any(|one| one.camera == 1 && one.capture == at);
    for frame in torn.iter().filter(|f| f.observations().iter().any(|seen| seen.camera == 1)) {
        assert!(own(frame.capture), "a frame of camera 1 was moved to {:?}", frame.capture);
    }
}
