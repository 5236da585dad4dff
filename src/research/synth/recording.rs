//! A recording of a motion: detections in order of capture time, and the true poses.

use nalgebra::{Matrix3, Vector3};

use super::detector::Detector;
use super::noise::Noise;
use crate::core::body::{Pose, Skeleton, StampedPose, TrackingState};
use crate::core::camera::Rig;
use crate::core::detections::{Detections, KeypointFormat};
use crate::core::so3;
use crate::core::time::Timestamp;

/// A motion, who makes it and what sees it. `M` maps seconds from the start to a pose.
#[derive(Clone, Debug)]
pub struct Recording<M> {
    /// The cameras.
    pub rig: Rig,
    /// The performer's true body.
    pub skeleton: Skeleton,
    /// The true motion.
    pub motion: M,
    /// Frames a second of every camera.
    pub fps: f64,
    /// Frames of every camera.
    pub frames: u64,
    /// What the detectors mark.
    pub format: KeypointFormat,
    /// How they err.
    pub noise: Noise,
    /// Capture time of frame 0.
    pub start: Timestamp,
    /// Share of a frame period, in \[0, 1), over which the cameras' shutters are spread;
    /// 0 is genlock.
    pub stagger: f64,
    /// Of all that is random.
    pub seed: u64,
}

impl<M: Fn(f64) -> Pose> Recording<M> {
    /// 300 frames at 60 fps, BODY_25, the default noise, genlocked, seed 1.
    pub fn new(rig: Rig, skeleton: Skeleton, motion: M) -> Self {
        Self {
            rig,
            skeleton,
            motion,
            fps: 60.0,
            frames: 300,
            format: KeypointFormat::Body25,
            noise: Noise::default(),
            start: Timestamp::default(),
            stagger: 0.0,
            seed: 1,
        }
    }

    /// The true poses at the nominal frame times, which are those of camera 0.
    pub fn poses(&self) -> impl Iterator<Item = StampedPose> + '_ {
        (0..self.frames).map(|frame| {
            let since_start = Timestamp::of_frame(frame, self.fps);
            StampedPose {
                capture: self.start + since_start.ns(),
                pose: (self.motion)(since_start.ns() as f64 * 1e-9),
                state: TrackingState::Tracking,
                window: 0,
                rig_version: self.rig.version,
                provisional: false,
                revision: 0,
            }
        })
    }

    /// What the detectors say, in order of capture time, then of camera.
    pub fn detections(&self) -> impl Iterator<Item = Detections> + '_ {
        let detectors: Vec<Detector> = (self.rig.cameras.iter().enumerate())
            .map(|(index, camera)| {
                Detector::new(camera, index, self.format, &self.noise, self.seed)
            })
            .collect();
        let cameras = detectors.len();
        (0..self.frames).flat_map(move |frame| {
            let frame_set: Vec<Detections> = (detectors.iter().enumerate())
                .map(|(camera, detector)| self.frame(detector, camera, cameras, frame))
                .collect();
            frame_set
        })
    }

    fn frame(&self, detector: &Detector, camera: usize, cameras: usize, frame: u64) -> Detections {
        let late = self.stagger / self.fps * camera as f64 / cameras as f64;
        let since_start = Timestamp::of_frame(frame, self.fps) + (late * 1e9).round() as i64;
        let seconds = since_start.ns() as f64 * 1e-9;
        let posture = (self.motion)(seconds).posture(&self.skeleton);
        let capture = self.start + since_start.ns();
        detector.detect(frame, capture, seconds, (&self.skeleton, &posture))
    }
}

/// The path through poses that are `1 / fps` apart: the cubic of Catmull and Rom in the position and
/// in the rotation vectors from the pose before, held at both ends. (Straight lines would have a kink
/// at each pose, and few between.) The rest pose if there are none.
pub fn through(poses: Vec<Pose>, fps: f64) -> impl Fn(f64) -> Pose + Clone {
    move |seconds| {
        let Some(last) = poses.len().checked_sub(1) else { return Pose::rest() };
        let at = (seconds * fps).clamp(0.0, last as f64);
        // A stamp is rounded to the nanosecond; a pose asked for at its own time is given exactly.
        let at = if (at - at.round()).abs() < 1e-6 { at.round() } else { at };
        let (before, share) = (at.floor() as usize, at.fract());
        if share == 0.0 {
            return poses[before].clone();
        }
        let around = [before.saturating_sub(1), before, before + 1, (before + 2).min(last)];
        between(around.map(|k| &poses[k]), share)
    }
}

/// Between the second and the third pose.
fn between(around: [&Pose; 4], share: f64) -> Pose {
    let position = |of: fn(&Pose) -> &Vector3<f64>| {
        let from = of(around[1]);
        from + cubic(around.map(|pose| of(pose) - from), share)
    };
    let rotation = |of: &dyn Fn(&Pose) -> Matrix3<f64>| {
        let from = of(around[1]);
        let turned = around.map(|pose| so3::log(&(from.transpose() * of(pose))));
        from * so3::exp(&cubic(turned, share))
    };
    Pose {
        root_rotation: rotation(&|pose| pose.root_rotation),
        root_position: position(|pose| &pose.root_position),
        local: std::array::from_fn(|j| rotation(&|pose| pose.local[j])),
    }
}

/// The cubic of Catmull and Rom between the second and the third of four.
fn cubic([p0, p1, p2, p3]: [Vector3<f64>; 4], s: f64) -> Vector3<f64> {
    let (slope1, slope2) = ((p2 - p0) * 0.5, (p3 - p1) * 0.5);
    let rise = s * s * (3.0 - 2.0 * s);
    p1.lerp(&p2, rise) + slope1 * (s * (1.0 - s) * (1.0 - s)) - slope2 * (s * s * (1.0 - s))
}
