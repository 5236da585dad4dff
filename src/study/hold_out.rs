//! Hold-out: how well the solved body meets a camera that had no part in solving it.
//!
//! The recording is read a second time; only the poses are in memory. For each frame of the
//! camera the pose at its capture time is projected, the detected person that is nearest to it
//! is taken, and the distances of the limbs' points are gathered.

use nalgebra::Vector2;
use serde::Serialize;

use super::driver::CONFIDENT;
use super::failure::Failure;
use super::input::{Item, Recording};
use super::kept::KeptPose;
use crate::body::{Attachment, Pose, Skeleton};
use crate::camera::{Camera, Rig};
use crate::detect::{Detections, KeypointFormat, Person};
use crate::eval::statistics::median;
use crate::eval::trc::COMPARED;
use crate::so3;
use crate::time::Timestamp;

/// A person is the performer when the median distance of the limbs' points is below this part
/// of the performer's height in the image.
const GATE: f64 = 0.25;

/// The error in the camera that was held out.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct HoldOut {
    /// The camera.
    pub(super) camera: String,
    /// Median distance over the points, pixels; null if there were none.
    pub(super) median_px: Option<f64>,
    /// Points of shoulders, elbows, wrists, hips, knees and ankles with confidence above 0.3.
    pub(super) points: usize,
    /// Frames in which the performer was detected.
    pub(super) frames: usize,
    /// Frames with detections but without the performer among them.
    pub(super) frames_without_performer: usize,
}

/// Measures the error in `camera`.
pub(super) fn measure(
    recording: &Recording,
    camera: &Camera,
    skeleton: &Skeleton,
    poses: &[KeptPose],
) -> Result<HoldOut, Failure> {
    // A rig has two cameras at least; only the first is looked at.
    let other = recording.rig.cameras.iter().find(|other| other.name != camera.name);
    let cameras = std::iter::once(camera).chain(other).cloned().collect();
    let rig = Rig::new(recording.rig.version, cameras)?;
    let mut errors = Vec::new();
    let (mut frames, mut without) = (0, 0);
    recording.stream(
        &rig,
        || {},
        |item| {
            let Item::Detections(detections) = item else { return Ok(()) };
            if detections.camera != 0 {
                return Ok(());
            }
            let Some(pose) = pose_at(poses, detections.capture) else { return Ok(()) };
            match distances(camera, skeleton, &pose, &detections) {
                Some(found) => {
                    frames += 1;
                    errors.extend(found);
                }
                None => without += usize::from(!detections.people.is_empty()),
            }
            Ok(())
        },
    )?;
    Ok(HoldOut {
        camera: camera.name.clone(),
        median_px: median(&errors),
        points: errors.len(),
        frames,
        frames_without_performer: without,
    })
}

/// The pose at a time between two that are tracked: slerp of the rotations, lerp of the
/// position. `None` outside, and where one of the two is flagged.
pub(super) fn pose_at(poses: &[KeptPose], at: Timestamp) -> Option<Pose> {
    let usable = |pose: &&KeptPose| pose.is_tracked();
    let next = poses.partition_point(|pose| pose.capture < at);
    let after = poses.get(next).filter(usable)?;
    if after.capture == at {
        return Some(after.pose());
    }
    let before = poses.get(next.checked_sub(1)?).filter(usable)?;
    let s = (at - before.capture) as f64 / (after.capture - before.capture) as f64;
    let (a, b) = (before.pose(), after.pose());
    Some(Pose {
        root_rotation: so3::slerp(&a.root_rotation, &b.root_rotation, s),
        root_position: a.root_position.lerp(&b.root_position, s),
        local: std::array::from_fn(|j| so3::slerp(&a.local[j], &b.local[j], s)),
    })
}

/// Distances of the limbs' confident points of the person who is the performer, pixels.
fn distances(
    camera: &Camera,
    skeleton: &Skeleton,
    pose: &Pose,
    detections: &Detections,
) -> Option<Vec<f64>> {
    let posture = pose.posture(skeleton);
    let projected = COMPARED.map(|keypoint| {
        camera.project(&Attachment::of(keypoint).position(&posture, skeleton.shape()))
    });
    let seen = posture.positions.iter().filter_map(|joint| camera.project(joint));
    let gate = GATE * height(seen)?;
    let candidates = detections.people.iter().filter_map(|person| {
        let distances = to_person(&projected, person, detections.format);
        Some((median(&distances)?, distances))
    });
    let nearest = candidates.min_by(|a, b| a.0.total_cmp(&b.0))?;
    (nearest.0 <= gate).then_some(nearest.1)
}

fn to_person(
    projected: &[Option<Vector2<f64>>; COMPARED.len()],
    person: &Person,
    format: KeypointFormat,
) -> Vec<f64> {
    let pairs = COMPARED.iter().zip(projected).filter_map(|(&keypoint, pixel)| {
        let detection = (*person.points.get(format.index_of(keypoint)?)?)?;
        let confident = detection.confidence > CONFIDENT;
        confident.then_some((*pixel)? - detection.pixel.coords)
    });
    pairs.map(|difference| difference.norm()).collect()
}

/// The larger side of the box around the pixels.
fn height(pixels: impl Iterator<Item = Vector2<f64>>) -> Option<f64> {
    let bounds = pixels.fold(None, |bounds, pixel| match bounds {
        None => Some((pixel, pixel)),
        Some((low, high)) => Some((pixel.inf(&low), pixel.sup(&high))),
    });
    bounds.map(|(low, high): (Vector2<f64>, Vector2<f64>)| (high - low).max())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{StampedPose, TrackingState};

    fn kept(ns: i64, x: f64, state: TrackingState) -> KeptPose {
        let mut pose = Pose::rest();
        pose.root_position.x = x;
        let capture = Timestamp::from_ns(ns);
        let (window, rig_version, provisional, revision) = (0, 1, false, 0);
        (&StampedPose { capture, pose, state, window, rig_version, provisional, revision }).into()
    }

    #[test]
    fn poses_are_interpolated_between_tracked_ones_only() {
        use TrackingState::{Lost, Tracking};
        let poses = [kept(10, 1.0, Tracking), kept(20, 2.0, Tracking), kept(30, 9.0, Lost)];
        let x = |ns| pose_at(&poses, Timestamp::from_ns(ns)).map(|pose| pose.root_position.x);
        assert_eq!([x(9), x(10), x(15), x(20)], [None, Some(1.0), Some(1.5), Some(2.0)]);
        assert_eq!([x(25), x(30), x(31)], [None; 3]);
    }
}
