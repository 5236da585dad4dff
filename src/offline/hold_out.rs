//! Reprojection error in one camera, for instance one that was held out of the solve.
//!
//! The body at the frame's capture time is projected and compared, point by point, with the nearest
//! detected person.

use std::collections::VecDeque;

use nalgebra::{Vector2, Vector3};
use serde::Serialize;

use crate::core::body::{Attachment, Pose, Posture, Skeleton};
use crate::core::camera::Camera;
use crate::core::detections::{Detections, Keypoint, KeypointFormat, Person};
use crate::core::points::CONFIDENT;
use crate::core::time::Timestamp;
use crate::metrics::statistics::median;
use crate::metrics::{COMPARED, Distribution};

/// A person is the performer if the median distance of the limbs' points is below this fraction of
/// the performer's height in the image.
const GATE: f64 = 0.25;
/// Most frames that wait for poses.
const WAITING: usize = 8192;

/// The error in one or more held-out cameras.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HoldOut {
    /// The camera, or all cameras, separated by commas.
    pub camera: String,
    /// Median distance over the points, pixels; null if there were none. The mean over the cameras
    /// that have one.
    pub median_px: Option<f64>,
    /// Points of shoulders, elbows, wrists, hips, knees and ankles with confidence above 0.3.
    pub points: usize,
    /// Frames with the performer detected.
    pub frames: usize,
    /// Frames with detections but without the performer.
    pub frames_without_performer: usize,
}

impl HoldOut {
    /// All cameras as one: the mean of the medians, and sums. `None` without cameras.
    pub fn of_all(cameras: &[Self]) -> Option<Self> {
        let names: Vec<&str> = cameras.iter().map(|held| held.camera.as_str()).collect();
        let medians: Vec<f64> = cameras.iter().filter_map(|held| held.median_px).collect();
        let mean = medians.iter().sum::<f64>() / medians.len() as f64;
        let sum = |of: fn(&Self) -> usize| cameras.iter().map(of).sum();
        (!names.is_empty()).then(|| Self {
            camera: names.join(","),
            median_px: (!medians.is_empty()).then_some(mean),
            points: sum(|held| held.points),
            frames: sum(|held| held.frames),
            frames_without_performer: sum(|held| held.frames_without_performer),
        })
    }
}

/// Compares the frames of a camera with poses in a stream; both are in order of time, either may
/// come first. At most 8,192 frames wait for poses; then the oldest are dropped.
pub struct HeldOut {
    camera: Camera,
    /// [`GATE`]; `None` if the frames show nobody but the performer.
    gate: Option<f64>,
    waiting: VecDeque<Detections>,
    /// The newest pose; `None` if it cannot be used.
    before: Option<(Timestamp, Option<Pose>)>,
    errors: Distribution,
    frames: usize,
    without: usize,
}

impl HeldOut {
    /// The camera of the frames.
    pub fn new(camera: Camera) -> Self {
        let (waiting, errors) = (VecDeque::new(), Distribution::default());
        Self { camera, gate: Some(GATE), waiting, before: None, errors, frames: 0, without: 0 }
    }

    /// The camera of frames that show nobody but the performer. A body counts at any distance, if it is in front of the
    /// camera.
    pub fn of_performer_alone(camera: Camera) -> Self {
        Self { gate: None, ..Self::new(camera) }
    }

    /// Adds a frame of the camera. Frames without a pose before and after are not counted.
    pub fn add_frame(&mut self, mut detections: Detections) {
        detections.capture = detections.capture + self.camera.time_offset;
        let after = |known: &Detections| known.capture <= detections.capture;
        let place = self.waiting.iter().rposition(after).map_or(0, |before| before + 1);
        self.waiting.insert(place, detections);
        if self.waiting.len() > WAITING {
            self.waiting.pop_front();
        }
    }

    /// Adds the next pose (`None` if it cannot be used) with the newest body, and compares the
    /// frames up to it.
    pub fn add_pose(&mut self, capture: Timestamp, pose: Option<Pose>, skeleton: &Skeleton) {
        while self.waiting.front().is_some_and(|frame| frame.capture <= capture) {
            let Some(frame) = self.waiting.pop_front() else { break };
            let at = frame.capture;
            let pose = match (&self.before, &pose) {
                (_, Some(pose)) if at == capture => pose.clone(),
                (Some((before, Some(a))), Some(b)) if at > *before => {
                    let s = at.fraction(*before, capture);
                    a.interpolate(b, s)
                }
                _ => continue,
            };
            self.compare(&frame, &(skeleton, &pose.posture(skeleton)));
        }
        self.before = Some((capture, pose));
    }

    /// Compares a frame with the body at its capture time.
    pub fn compare(&mut self, frame: &Detections, body: &impl Located) {
        match nearest(&self.camera, body, frame, &COMPARED, self.gate) {
            Some(found) => {
                self.frames += 1;
                found.points.iter().for_each(|(_, way)| self.errors.add(way.norm()));
            }
            None => self.without += usize::from(!frame.people.is_empty()),
        }
    }

    /// The result.
    pub fn finish(self) -> HoldOut {
        HoldOut {
            median_px: self.errors.median(),
            points: self.errors.count() as usize,
            camera: self.camera.name,
            frames: self.frames,
            frames_without_performer: self.without,
        }
    }
}

/// The pose at a time, from poses in order of time: slerp of the rotations, lerp of the position.
/// `None` outside their range.
pub fn pose_at(poses: &[(Timestamp, Pose)], at: Timestamp) -> Option<Pose> {
    let next = poses.partition_point(|(capture, _)| *capture < at);
    let (after, b) = poses.get(next)?;
    if *after == at {
        return Some(b.clone());
    }
    let (before, a) = poses.get(next.checked_sub(1)?)?;
    Some(a.interpolate(b, at.fraction(*before, *after)))
}

/// Something with keypoints in the world, metres.
pub trait Located {
    /// A keypoint; `None` if its place is not known.
    fn keypoint(&self, keypoint: Keypoint) -> Option<Vector3<f64>>;
    /// Points whose box in the image gives the performer's height.
    fn extent(&self) -> impl Iterator<Item = Vector3<f64>>;
}

impl Located for (&Skeleton, &Posture) {
    fn keypoint(&self, keypoint: Keypoint) -> Option<Vector3<f64>> {
        Some(Attachment::of(keypoint).position(self.1, self.0))
    }

    fn extent(&self) -> impl Iterator<Item = Vector3<f64>> {
        self.1.positions.iter().copied()
    }
}

/// Distances of the performer's confident points from the body, pixels, for the `keypoints` in the
/// format. `None` if the limbs' points show that no person is the performer.
pub fn distances(
    camera: &Camera,
    body: &impl Located,
    detections: &Detections,
    keypoints: &[Keypoint],
) -> Option<Vec<f64>> {
    let found = differences(camera, body, detections, keypoints)?;
    Some(found.points.iter().map(|(_, difference)| difference.norm()).collect())
}

/// The performer's detections in a frame beside the body's points.
pub struct Differences {
    /// The performer's height in the image, pixels.
    pub height_px: f64,
    /// The way from each confident point to the body's, pixels.
    pub points: Vec<(Keypoint, Vector2<f64>)>,
}

/// [`distances`] by keypoint and axis.
pub fn differences(
    camera: &Camera,
    body: &impl Located,
    detections: &Detections,
    keypoints: &[Keypoint],
) -> Option<Differences> {
    nearest(camera, body, detections, keypoints, Some(GATE))
}

/// The person who is nearest to the body. With a `gate`, the median distance of the limbs' points must be below this
/// fraction of the height in the image.
fn nearest(
    camera: &Camera,
    body: &impl Located,
    detections: &Detections,
    keypoints: &[Keypoint],
    gate: Option<f64>,
) -> Option<Differences> {
    let project = |keypoint: Keypoint| camera.project(&body.keypoint(keypoint)?);
    let seen = body.extent().filter_map(|point| camera.project(&point));
    let height_px = height(seen)?;
    let to = |person, points: &[Keypoint]| to_person(&project, person, detections.format, points);
    let candidates = detections.people.iter().filter_map(|person| {
        let limbs: Vec<f64> = to(person, &COMPARED).iter().map(|(_, way)| way.norm()).collect();
        Some((median(&limbs)?, person))
    });
    let (nearest, performer) = candidates.min_by(|a, b| a.0.total_cmp(&b.0))?;
    let is_near = gate.is_none_or(|gate| nearest <= gate * height_px);
    is_near.then(|| Differences { height_px, points: to(performer, keypoints) })
}

fn to_person(
    project: &impl Fn(Keypoint) -> Option<Vector2<f64>>,
    person: &Person,
    format: KeypointFormat,
    keypoints: &[Keypoint],
) -> Vec<(Keypoint, Vector2<f64>)> {
    let differences = keypoints.iter().filter_map(|&keypoint| {
        let detection = (*person.points.get(format.index_of(keypoint)?)?)?;
        let confident = detection.confidence > CONFIDENT;
        confident.then_some((keypoint, project(keypoint)? - detection.pixel.coords))
    });
    differences.collect()
}

/// The longer side of the bounding box of the pixels.
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

    fn at(ns: i64, x: f64) -> (Timestamp, Pose) {
        let mut pose = Pose::rest();
        pose.root_position.x = x;
        (Timestamp::from_ns(ns), pose)
    }

    #[test]
    fn poses_are_interpolated() {
        let poses = [at(10, 1.0), at(20, 2.0)];
        let x = |ns| pose_at(&poses, Timestamp::from_ns(ns)).map(|pose| pose.root_position.x);
        assert_eq!(
            [x(9), x(10), x(15), x(20), x(21)],
            [None, Some(1.0), Some(1.5), Some(2.0), None]
        );
    }
}
