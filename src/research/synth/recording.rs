//! A synthetic recording: detections in order of capture time, and the true poses.

use nalgebra::{Matrix3, Vector3};

use super::body::Places;
use super::detector::Detector;
use super::noise::Noise;
use crate::core::body::{Pose, Skeleton, StampedPose, TrackingState};
use crate::core::camera::{Camera, Rig};
use crate::core::detections::{Detections, KeypointFormat};
use crate::core::so3;
use crate::core::time::{Nanos, Timestamp};

/// A motion with its body, cameras and detectors. `M` maps seconds from the start to a pose.
#[derive(Clone, Debug)]
pub struct Recording<M> {
    /// The cameras.
    pub rig: Rig,
    /// The performer's true body.
    pub skeleton: Skeleton,
    /// Where detectors see its keypoints.
    pub places: Places,
    /// The true motion.
    pub motion: M,
    /// Frame rate of every camera, Hz.
    pub fps: f64,
    /// Number of frames of every camera.
    pub frames: u64,
    /// Keypoint format of the detectors.
    pub format: KeypointFormat,
    /// Noise of the detectors.
    pub noise: Noise,
    /// Capture time of frame 0.
    pub start: Timestamp,
    /// Spread of the cameras' shutter times as a share of the frame period, in \[0, 1); 0 is
    /// genlock.
    pub stagger: f64,
    /// When the last camera is [bumped](bumped), seconds from the start; the rig does not know.
    pub bump: Option<f64>,
    /// Seed of all random draws.
    pub seed: u64,
}

/// A camera that was bumped: turned by 3 degrees about an axis in its image plane, its centre moved by 10 cm
/// in the world.
pub fn bumped(camera: &Camera) -> Camera {
    let mut camera = camera.clone();
    let centre = camera.centre_in_world() + Vector3::new(0.06, -0.04, 0.069_282);
    camera.rotation =
        so3::exp(&(Vector3::new(0.6, 0.8, 0.0) * 3f64.to_radians())) * camera.rotation;
    camera.translation = -(camera.rotation * centre);
    camera
}

impl<M: Fn(f64) -> Pose> Recording<M> {
    /// 300 frames at 60 fps, BODY_25, the default noise, genlocked, seed 1.
    pub fn new(rig: Rig, skeleton: Skeleton, motion: M) -> Self {
        Self {
            rig,
            skeleton,
            places: Places::Own,
            motion,
            fps: 60.0,
            frames: 300,
            format: KeypointFormat::Body25,
            noise: Noise::default(),
            start: Timestamp::default(),
            stagger: 0.0,
            bump: None,
            seed: 1,
        }
    }

    /// The true poses at the nominal frame times, the capture times of camera 0.
    pub fn poses(&self) -> impl Iterator<Item = StampedPose> + '_ {
        (0..self.frames).map(|frame| {
            let since_start = Nanos::of_frames(frame, self.fps);
            let pose = (self.motion)(since_start.seconds());
            let stamped = StampedPose::new(self.start + since_start, pose, TrackingState::Tracking);
            StampedPose { rig_version: self.rig.version, ..stamped }
        })
    }

    /// The detections, ordered by capture time, then by camera.
    pub fn detections(&self) -> impl Iterator<Item = Detections> + '_ {
        let detector = |(index, camera): (usize, Camera)| {
            Detector::new(camera, index, self.format, &self.noise, self.places, self.seed)
        };
        let all = &self.rig.cameras;
        let detectors: Vec<Detector> = all.iter().cloned().enumerate().map(detector).collect();
        let cameras = detectors.len();
        let moved = all.last().map(|camera| detector((cameras - 1, bumped(camera))));
        (0..self.frames).flat_map(move |frame| {
            let at = frame as f64 / self.fps;
            let moved = moved.as_ref().filter(|_| self.bump.is_some_and(|bump| at >= bump));
            let frame_set: Vec<Detections> = (detectors.iter().enumerate())
                .map(|(camera, detector)| {
                    let detector = moved.filter(|_| camera + 1 == cameras).unwrap_or(detector);
                    self.frame(detector, camera, cameras, frame)
                })
                .collect();
            frame_set
        })
    }

    fn frame(&self, detector: &Detector, camera: usize, cameras: usize, frame: u64) -> Detections {
        let late = self.stagger / self.fps * camera as f64 / cameras as f64;
        let since_start = Nanos::of_frames(frame, self.fps) + Nanos::rounded(late * 1e9);
        let seconds = since_start.seconds();
        let posture = |at: f64| (self.motion)(at).posture(&self.skeleton);
        detector.detect(frame, self.start + since_start, seconds, &self.skeleton, &posture)
    }
}

/// Interpolates poses that are `1 / fps` apart: a Catmull-Rom cubic in the position and in the
/// rotation vectors relative to the pose before, constant beyond both ends. (Linear interpolation
/// would have a kink at each pose.) The rest pose if `poses` is empty.
pub fn through(poses: Vec<Pose>, fps: f64) -> impl Fn(f64) -> Pose + Clone {
    move |seconds| {
        let Some(last) = poses.len().checked_sub(1) else { return Pose::rest() };
        let at = (seconds * fps).clamp(0.0, last as f64);
        // Timestamps are rounded to the nanosecond; at a pose's own time, return it exactly.
        let at = if (at - at.round()).abs() < 1e-6 { at.round() } else { at };
        let (before, share) = (at.floor() as usize, at.fract());
        if share == 0.0 {
            return poses[before].clone();
        }
        let around = [before.saturating_sub(1), before, before + 1, (before + 2).min(last)];
        between(around.map(|k| &poses[k]), share)
    }
}

/// The pose at `share` of the way from the second pose to the third.
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

/// The Catmull-Rom cubic between the second and the third of four points.
fn cubic([p0, p1, p2, p3]: [Vector3<f64>; 4], s: f64) -> Vector3<f64> {
    let (slope1, slope2) = ((p2 - p0) * 0.5, (p3 - p1) * 0.5);
    let rise = s * s * (3.0 - 2.0 * s);
    p1.lerp(&p2, rise) + slope1 * (s * (1.0 - s) * (1.0 - s)) - slope2 * (s * s * (1.0 - s))
}
