//! How well a solved body meets what a camera saw, be it one that had no part in solving it.
//!
//! The pose at a frame's capture time is projected, the detected person that is nearest to it is
//! taken, and the distances of points are gathered.

use nalgebra::Vector2;
use serde::Serialize;

use crate::core::body::{Attachment, Pose, Skeleton};
use crate::core::camera::Camera;
use crate::core::detections::{Detections, Keypoint, KeypointFormat, Person};
use crate::core::time::Timestamp;
use crate::io::formats::trc::COMPARED;
use crate::metrics::statistics::median;

/// Detected points of at most this confidence are left out of reported errors.
pub const CONFIDENT: f64 = 0.3;

/// A solved pose as a method keeps it.
pub trait Kept {
    /// The time it is of.
    fn capture(&self) -> Timestamp;

    /// The pose; `None` if it is flagged and not to be used.
    fn usable(&self) -> Option<Pose>;
}

impl Kept for (Timestamp, Pose) {
    fn capture(&self) -> Timestamp {
        self.0
    }

    fn usable(&self) -> Option<Pose> {
        Some(self.1.clone())
    }
}

/// A person is the performer when the median distance of the limbs' points is below this part
/// of the performer's height in the image.
const GATE: f64 = 0.25;

/// The error in the camera that was held out.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HoldOut {
    /// The camera.
    pub camera: String,
    /// Median distance over the points, pixels; null if there were none.
    pub median_px: Option<f64>,
    /// Points of shoulders, elbows, wrists, hips, knees and ankles with confidence above 0.3.
    pub points: usize,
    /// Frames in which the performer was detected.
    pub frames: usize,
    /// Frames with detections but without the performer among them.
    pub frames_without_performer: usize,
}

/// The error in one camera, gathered frame by frame.
pub struct HeldOut<'a, P> {
    camera: &'a Camera,
    skeleton: &'a Skeleton,
    poses: &'a [P],
    errors: Vec<f64>,
    frames: usize,
    without: usize,
}

impl<'a, P: Kept> HeldOut<'a, P> {
    /// Of poses in order of capture time.
    pub fn new(camera: &'a Camera, skeleton: &'a Skeleton, poses: &'a [P]) -> Self {
        Self { camera, skeleton, poses, errors: Vec::new(), frames: 0, without: 0 }
    }

    /// Takes in a frame of the camera; frames without a pose are left out.
    pub fn add(&mut self, detections: &Detections) {
        let Some(pose) = pose_at(self.poses, detections.capture) else { return };
        match distances(self.camera, self.skeleton, &pose, detections, &COMPARED) {
            Some(found) => {
                self.frames += 1;
                self.errors.extend(found);
            }
            None => self.without += usize::from(!detections.people.is_empty()),
        }
    }

    /// The figures.
    pub fn finish(self) -> HoldOut {
        HoldOut {
            camera: self.camera.name.clone(),
            median_px: median(&self.errors),
            points: self.errors.len(),
            frames: self.frames,
            frames_without_performer: self.without,
        }
    }
}

/// The pose at a time between two that are usable: slerp of the rotations, lerp of the position.
/// `None` outside, and where one of the two is flagged.
pub fn pose_at<P: Kept>(poses: &[P], at: Timestamp) -> Option<Pose> {
    let next = poses.partition_point(|pose| pose.capture() < at);
    let after = poses.get(next)?;
    let b = after.usable()?;
    if after.capture() == at {
        return Some(b);
    }
    let before = poses.get(next.checked_sub(1)?)?;
    let a = before.usable()?;
    let s = (at - before.capture()) as f64 / (after.capture() - before.capture()) as f64;
    Some(a.interpolate(&b, s))
}

/// Distances of confident points of the person who is the performer, pixels: of those
/// `keypoints` that the format has. `None` if the performer is not among the persons, by the
/// limbs' points.
pub fn distances(
    camera: &Camera,
    skeleton: &Skeleton,
    pose: &Pose,
    detections: &Detections,
    keypoints: &[Keypoint],
) -> Option<Vec<f64>> {
    let posture = pose.posture(skeleton);
    let project =
        |keypoint: Keypoint| camera.project(&Attachment::of(keypoint).position(&posture, skeleton));
    let seen = posture.positions.iter().filter_map(|joint| camera.project(joint));
    let gate = GATE * height(seen)?;
    let to = |person, points: &[Keypoint]| to_person(&project, person, detections.format, points);
    let candidates = detections.people.iter().filter_map(|p| Some((median(&to(p, &COMPARED))?, p)));
    let (nearest, performer) = candidates.min_by(|a, b| a.0.total_cmp(&b.0))?;
    (nearest <= gate).then(|| to(performer, keypoints))
}

fn to_person(
    project: &impl Fn(Keypoint) -> Option<Vector2<f64>>,
    person: &Person,
    format: KeypointFormat,
    keypoints: &[Keypoint],
) -> Vec<f64> {
    let distances = keypoints.iter().filter_map(|&keypoint| {
        let detection = (*person.points.get(format.index_of(keypoint)?)?)?;
        let confident = detection.confidence > CONFIDENT;
        confident.then_some(project(keypoint)? - detection.pixel.coords)
    });
    distances.map(|difference| difference.norm()).collect()
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

    /// At a time and place, flagged or not.
    struct At(i64, f64, bool);

    impl Kept for At {
        fn capture(&self) -> Timestamp {
            Timestamp::from_ns(self.0)
        }

        fn usable(&self) -> Option<Pose> {
            let mut pose = Pose::rest();
            pose.root_position.x = self.1;
            self.2.then_some(pose)
        }
    }

    #[test]
    fn poses_are_interpolated_between_usable_ones_only() {
        let poses = [At(10, 1.0, true), At(20, 2.0, true), At(30, 9.0, false)];
        let x = |ns| pose_at(&poses, Timestamp::from_ns(ns)).map(|pose| pose.root_position.x);
        assert_eq!([x(9), x(10), x(15), x(20)], [None, Some(1.0), Some(1.5), Some(2.0)]);
        assert_eq!([x(25), x(30), x(31)], [None; 3]);
    }
}
