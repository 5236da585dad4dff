//! Selects the performer among the detected people.
//!
//! A view may hold bystanders, several detections that are parts of the performer, or nobody.
//! While tracking, each view is followed from frame to frame: the detection nearest to the last
//! accepted one, where half of its points lie within a gate. Where several detections pass the
//! gate, each point is taken from the one that has it nearest.

use nalgebra::Vector2;

use super::config::Config;
use crate::core::body::{BodyPoint, Pose, Skeleton};
use crate::core::camera::{Camera, Rig};
use crate::core::cost::{FrameObservations, Observation};
use crate::core::detections::{Detections, Person};
use crate::core::points::{extent, median};
use crate::core::time::{Nanos, Timestamp};

/// Frames closer in time than this are merged: cameras on one clock differ by microseconds,
/// and at 5 m/s this is half a millimetre. Each capture time costs a decoding.
const SAME_TIME: Nanos = Nanos::new(100_000);

/// The expected pixel of each fitted keypoint of the performer in a view.
type Expected = Vec<Option<Vector2<f64>>>;

/// The performer's observations in `frames` (in order of capture time), grouped by capture time.
/// Each view is followed from its projection of `pose`.
pub fn follow<'d>(
    frames: impl Iterator<Item = &'d Detections>,
    points: &[BodyPoint],
    rig: &Rig,
    pose: &Pose,
    skeleton: &Skeleton,
    config: &Config,
) -> Vec<FrameObservations> {
    let posture = pose.posture(skeleton);
    let world: Vec<_> = points.iter().map(|p| p.attachment.position(&posture, skeleton)).collect();
    let view = |camera: &Camera| world.iter().map(|point| camera.project(point)).collect();
    Follower { points, config, expected: rig.cameras.iter().map(view).collect() }
        .observations(frames)
}

/// Follows the performer through the views.
#[derive(Clone, Debug)]
struct Follower<'a> {
    points: &'a [BodyPoint],
    config: &'a Config,
    /// Per camera.
    expected: Vec<Expected>,
}

impl Follower<'_> {
    /// The performer's observations in `frames` (in order of capture time), grouped by capture time
    /// within [`SAME_TIME`].
    fn observations<'d>(
        &mut self,
        frames: impl Iterator<Item = &'d Detections>,
    ) -> Vec<FrameObservations> {
        let mut groups: Vec<(Timestamp, Vec<Observation>)> = Vec::new();
        for frame in frames {
            let seen = self.observe(frame);
            match groups.last_mut() {
                Some((capture, group)) if frame.capture - *capture <= SAME_TIME => {
                    group.extend(seen);
                }
                _ => groups.push((frame.capture, seen)),
            }
        }
        groups.retain(|(_, group)| !group.is_empty());
        groups.into_iter().map(|(capture, group)| FrameObservations::new(capture, group)).collect()
    }

    fn observe(&mut self, frame: &Detections) -> Vec<Observation> {
        let expected = &self.expected[frame.camera];
        let gate = self.config.gate.follow * extent(expected.iter().flatten().copied());
        let accepted: Vec<&Person> = frame
            .people
            .iter()
            .filter(|person| {
                self.distance(person, expected).is_some_and(|distance| distance <= gate)
            })
            .collect();
        let seen: Vec<Observation> = (0..self.points.len())
            .filter_map(|point| self.nearest(point, &accepted, expected[point], frame.camera))
            .collect();
        for observation in &seen {
            self.expected[frame.camera][observation.point] = Some(observation.pixel);
        }
        seen
    }

    /// The median distance of a person's points from the expected ones, pixels.
    fn distance(&self, person: &Person, expected: &Expected) -> Option<f64> {
        let mut distances: Vec<f64> = self
            .points
            .iter()
            .zip(expected)
            .filter_map(|(point, expected)| {
                let seen = usable(person, point, self.config)?;
                Some((seen.pixel.coords - (*expected)?).norm())
            })
            .collect();
        median(&mut distances).filter(|_| distances.len() >= 3)
    }

    fn nearest(
        &self,
        point: usize,
        people: &[&Person],
        expected: Option<Vector2<f64>>,
        camera: usize,
    ) -> Option<Observation> {
        let seen =
            people.iter().filter_map(|person| usable(person, &self.points[point], self.config));
        let distance = |pixel: &Vector2<f64>| expected.map_or(0.0, |e| (pixel - e).norm());
        seen.map(|d| Observation { point, camera, pixel: d.pixel.coords, confidence: d.confidence })
            .min_by(|a, b| distance(&a.pixel).total_cmp(&distance(&b.pixel)))
    }
}

/// A person's detection of a point, if its confidence is sufficient.
pub(super) fn usable<'p>(
    person: &'p Person,
    point: &BodyPoint,
    config: &Config,
) -> Option<&'p crate::core::detections::Detection> {
    let seen = person.points.get(point.index)?.as_ref()?;
    (seen.confidence >= config.min_confidence).then_some(seen)
}
