//! Who is who in a synthetic recording: the performers' poses beside the truth of all actors.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::core::body::{Skeleton, StampedPose, TrackingState};
use crate::core::time::{Nanos, Timestamp};
use crate::metrics::{Positions, TrackingErrors, TrackingSums};

/// Poses are at most this long after the truth of their time.
const WAITING: Nanos = Nanos::from_ms(10_000);
/// A pose is of the truth that is at most this far from it.
const SAME_TIME: Nanos = Nanos::from_ms(2);

/// A time of the truth.
#[derive(Default)]
struct Frame {
    people: Vec<(usize, Positions)>,
    estimates: Vec<(usize, Positions)>,
}

/// Compares the poses of all performers with the truth of all actors in a stream. The truth of a time
/// comes before its poses; a frame counts when the truth is ten seconds ahead.
#[derive(Default)]
pub(super) struct Tracking {
    actors: Vec<(String, Skeleton)>,
    frames: BTreeMap<Timestamp, Frame>,
    sums: TrackingSums,
}

impl Tracking {
    /// An actor's true body; it comes before the poses.
    pub(super) fn set_body(&mut self, actor: &str, body: &Skeleton) {
        self.actors.push((actor.to_owned(), body.clone()));
    }

    /// An actor's true pose.
    pub(super) fn add_truth(&mut self, actor: &str, truth: &StampedPose) {
        let Some(number) = self.actors.iter().position(|(name, _)| name == actor) else { return };
        let positions = truth.pose.posture(&self.actors[number].1).positions;
        self.frames.entry(truth.capture).or_default().people.push((number, positions));
        while let Some(first) = self.frames.first_entry()
            && *first.key() + WAITING < truth.capture
        {
            let Frame { people, estimates } = first.remove();
            self.sums.add(&estimates, &people);
        }
    }

    /// A performer's pose; it counts if it is tracked.
    pub(super) fn add_pose(&mut self, performer: usize, pose: &StampedPose, body: &Arc<Skeleton>) {
        if pose.state != TrackingState::Tracking {
            return;
        }
        let near = pose.capture - SAME_TIME..=pose.capture + SAME_TIME;
        if let Some((_, frame)) = self.frames.range_mut(near).next() {
            // A pose of the same time replaces the one before.
            frame.estimates.retain(|(number, _)| *number != performer);
            frame.estimates.push((performer, pose.pose.posture(body).positions));
        }
    }

    /// The errors; `None` without truth.
    pub(super) fn finish(mut self) -> Option<TrackingErrors> {
        for Frame { people, estimates } in std::mem::take(&mut self.frames).into_values() {
            self.sums.add(&estimates, &people);
        }
        self.sums.errors()
    }
}
