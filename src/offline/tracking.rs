//! Who is who in a synthetic recording: the performers' poses beside the truth of all actors.

use std::collections::BTreeMap;

use crate::core::body::{Skeleton, StampedPose, TrackingState};
use crate::core::time::{Nanos, Timestamp};
use crate::metrics::{JointPositions, PerformerScores, PerformerSums};

/// Poses are at most this long after the truth of their time.
const WAITING: Nanos = Nanos::from_ms(10_000);
/// A pose is of the truth that is at most this far from it.
const SAME_TIME: Nanos = Nanos::from_ms(2);

type People = BTreeMap<String, JointPositions>;

/// Compares the poses of all performers with the truth of all actors in a stream. The truth of a time
/// comes before its poses; a time counts when the truth is ten seconds ahead.
#[derive(Default)]
pub(super) struct Tracking {
    bodies: BTreeMap<String, Skeleton>,
    /// By time: the truth, and the performers.
    times: BTreeMap<Timestamp, [People; 2]>,
    sums: PerformerSums,
}

impl Tracking {
    /// An actor's true body; it comes before the poses.
    pub(super) fn set_body(&mut self, actor: &str, body: Skeleton) {
        self.bodies.insert(actor.to_owned(), body);
    }

    /// An actor's true pose.
    pub(super) fn add_truth(&mut self, actor: &str, truth: &StampedPose) {
        let Some(body) = self.bodies.get(actor) else { return };
        let [truths, _] = self.times.entry(truth.capture).or_default();
        truths.insert(actor.to_owned(), truth.pose.posture(body).positions);
        while let Some(first) = self.times.first_entry()
            && *first.key() + WAITING < truth.capture
        {
            let [truths, performers] = first.remove();
            self.sums.add(&performers, &truths);
        }
    }

    /// A performer's pose; it counts if it is tracked. One of the same time replaces it.
    pub(super) fn add_pose(&mut self, performer: &str, pose: &StampedPose, body: &Skeleton) {
        let near = pose.capture - SAME_TIME..=pose.capture + SAME_TIME;
        let Some((_, [_, performers])) = self.times.range_mut(near).next() else { return };
        match pose.state {
            TrackingState::Tracking => {
                performers.insert(performer.to_owned(), pose.pose.posture(body).positions);
            }
            _ => {
                performers.remove(performer);
            }
        }
    }

    /// The scores; `None` without a match.
    pub(super) fn finish(mut self) -> Option<PerformerScores> {
        for [truths, performers] in std::mem::take(&mut self.times).into_values() {
            self.sums.add(&performers, &truths);
        }
        self.sums.scores()
    }
}
