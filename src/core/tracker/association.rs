//! Selects the performer among the detected people.
//!
//! A view may hold bystanders, several detections that are parts of the performer, or nobody.
//! While tracking, each view is followed from frame to frame: the detection nearest to the last
//! accepted one, where half of its points lie within a gate. Where several detections pass the
//! gate, each point is taken from the one that has it nearest.
//!
//! Each capture time costs a decoding. Cameras whose shutters are spread over a frame period share one:
//! the pixels of the later cameras are interpolated, between two of their own frames, to the time of the
//! first camera.

use nalgebra::Vector2;

use super::config::Config;
use crate::core::body::{BodyPoint, Pose, Skeleton};
use crate::core::camera::{Camera, Rig};
use crate::core::cost::{FrameObservations, Observation};
use crate::core::detections::{Detection, Detections, Person};
use crate::core::points::{extent, median};
use crate::core::time::{Nanos, Timestamp};

/// Frames closer in time than this are merged: cameras on one clock differ by microseconds,
/// and at 5 m/s this is half a millimetre.
const SAME_TIME: Nanos = Nanos::new(100_000);
/// A frame takes the time of another camera's earlier frame if that is nearer than this part of the spacing.
const SHARED: f64 = 0.9;
/// Pixels are interpolated between two frames of a camera if these are at most so many spacings apart.
const NEXT: f64 = 1.5;

/// The expected pixel of each fitted keypoint of the performer in a view.
type Expected = Vec<Option<Vector2<f64>>>;

/// The performer's observations in `frames` (in order of capture time), grouped by capture time.
/// Each view is followed from its projection of `pose`. `spacing` is the nominal time between the frames of a
/// camera.
pub fn follow<'d>(
    frames: impl Iterator<Item = &'d Detections>,
    spacing: Nanos,
    points: &[BodyPoint],
    rig: &Rig,
    pose: &Pose,
    skeleton: &Skeleton,
    config: &Config,
) -> Vec<FrameObservations> {
    let posture = pose.posture(skeleton);
    let world: Vec<_> = points.iter().map(|p| p.attachment.position(&posture, skeleton)).collect();
    let view = |camera: &Camera| world.iter().map(|point| camera.project(point)).collect();
    let expected: Vec<Expected> = rig.cameras.iter().map(view).collect();
    let last = vec![None; expected.len()];
    Follower { points, config, expected, last }.observations(frames, spacing)
}

/// Follows the performer through the views.
#[derive(Clone, Debug)]
struct Follower<'a> {
    points: &'a [BodyPoint],
    config: &'a Config,
    /// Per camera.
    expected: Vec<Expected>,
    /// Per camera, its last frame.
    last: Vec<Option<(Timestamp, Vec<Observation>)>>,
}

impl Follower<'_> {
    /// The performer's observations in `frames` (in order of capture time), grouped by capture time.
    fn observations<'d>(
        &mut self,
        frames: impl Iterator<Item = &'d Detections>,
        spacing: Nanos,
    ) -> Vec<FrameObservations> {
        let [shared, next] = [SHARED, NEXT].map(|part| Nanos::rounded(part * spacing.ns() as f64));
        let mut groups: Vec<(Timestamp, Vec<Observation>)> = Vec::new();
        for frame in frames {
            let seen = self.observe(frame);
            let last = self.last[frame.camera].replace((frame.capture, seen.clone()));
            let last = last.filter(|(before, _)| frame.capture - *before <= next);
            match (groups.last_mut(), last) {
                (Some((at, group)), _) if frame.capture - *at <= SAME_TIME => group.extend(seen),
                (Some((at, group)), Some((before, last)))
                    if before < *at
                        && frame.capture - *at < shared
                        && let share = at.fraction(before, frame.capture)
                        && let Some(moved) = between(&last, &seen, share) =>
                {
                    group.extend(moved);
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
        let observation = |d: &Detection| {
            let (pixel, confidence) = (d.pixel.coords, d.confidence);
            Observation { point, camera, pixel, confidence, scale_factor: 1.0 }
        };
        seen.map(observation).min_by(|a, b| distance(&a.pixel).total_cmp(&distance(&b.pixel)))
    }
}

/// A camera's observations between two of its frames, at `share` of the way from the first to the second.
/// Each frame's observations are in order of their points. A point that the first frame lacks moves by the
/// mean of the others. `None` if they have no point in common.
fn between(first: &[Observation], second: &[Observation], share: f64) -> Option<Vec<Observation>> {
    let before = |now: &Observation| {
        first.binary_search_by_key(&now.point, |old| old.point).ok().map(|at| first[at].pixel)
    };
    let moved: Vec<_> = second.iter().map(|now| Some(before(now)? - now.pixel)).collect();
    let common: Vec<_> = moved.iter().flatten().collect();
    let mean = common.iter().copied().sum::<Vector2<f64>>() / common.len() as f64;
    let at = |(now, moved): (&Observation, &Option<Vector2<f64>>)| Observation {
        pixel: now.pixel + moved.unwrap_or(mean) * (1.0 - share),
        ..*now
    };
    (!common.is_empty()).then(|| second.iter().zip(&moved).map(at).collect())
}

/// A person's detection of a point, if its confidence is sufficient.
pub(super) fn usable<'p>(
    person: &'p Person,
    point: &BodyPoint,
    config: &Config,
) -> Option<&'p Detection> {
    let seen = person.points.get(point.index)?.as_ref()?;
    (seen.confidence >= config.min_confidence).then_some(seen)
}
