//! Distance to a reference: marker positions that another tool found for the same recording.

use nalgebra::Vector3;
use serde::Serialize;

use super::hold_out::{Kept, pose_at};
use crate::core::body::{Attachment, Posture, Skeleton};
use crate::core::detections::Keypoint;
use crate::core::time::Timestamp;
use crate::io::formats::{Trc, distance_to_reference};

/// When a camera took a frame of some number: the recording's clock by frame.
#[derive(Clone, Copy, Debug)]
pub struct FrameClock {
    /// Any frame of the recording ...
    pub frame: u64,
    /// ... and its capture time.
    pub capture: Timestamp,
}

impl FrameClock {
    /// The capture time of frame number `frame` at `fps`.
    fn time_of(self, frame: u64, fps: f64) -> Timestamp {
        let frames = frame as f64 - self.frame as f64;
        self.capture + (frames * 1e9 / fps).round() as i64
    }
}

/// How far the poses are from the reference.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reference {
    /// Frames compared.
    pub frames: usize,
    /// Mean distance of shoulders, elbows, wrists, hips, knees and ankles, millimetres.
    pub mean_mm: f64,
    /// Largest distance of the middle of the hips, millimetres.
    pub worst_mid_hip_mm: Option<f64>,
    /// The frame of the recording in which it is.
    pub worst_mid_hip_frame: Option<u64>,
}

/// Compares; `None` if no frame of the reference has a pose.
pub fn compare<P: Kept>(
    trc: &Trc,
    clock: FrameClock,
    skeleton: &Skeleton,
    poses: &[P],
) -> Option<Reference> {
    let tolerance = (0.25e9 / trc.frame_rate) as i64;
    let near = |at: Timestamp| {
        let next = poses.partition_point(|pose| pose.capture() + tolerance < at);
        poses.get(next).map(Kept::capture).filter(|&capture| capture - at <= tolerance)
    };
    let mut last: Option<(u64, Option<Posture>)> = None;
    let position = |frame: u64, keypoint: Keypoint| -> Option<Vector3<f64>> {
        if last.as_ref().is_none_or(|(known, _)| *known != frame) {
            let at = clock.time_of(frame, trc.frame_rate);
            let pose = near(at).and_then(|at| pose_at(poses, at));
            last = Some((frame, pose.map(|pose| pose.posture(skeleton))));
        }
        let posture = last.as_ref()?.1.as_ref()?;
        Some(Attachment::of(keypoint).position(posture, skeleton))
    };
    let distance = distance_to_reference(trc, position)?;
    Some(Reference {
        frames: distance.frames,
        mean_mm: distance.mean_mm,
        worst_mid_hip_mm: distance.worst_mid_hip.map(|(_, mm)| mm),
        worst_mid_hip_frame: distance.worst_mid_hip.map(|(frame, _)| frame),
    })
}
