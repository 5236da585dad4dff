//! Compares replayed with recorded messages.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::core::time::Timestamp;
use crate::core::tracker::EventKind;
use crate::io::wire::{
    Event, HandOver, Journal, Keyframe, KeypointSet, Pose, Schema, Skeleton, StageStatus, Status,
    Topic, Topics, decode,
};

/// A message of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recorded {
    /// When it was recorded or published, on the node's clock.
    pub time: Timestamp,
    /// The capture time of its content.
    pub capture: Timestamp,
    /// Its topic.
    pub topic: Arc<str>,
    /// Full name of its schema.
    pub schema: Arc<str>,
    /// Its bytes.
    pub payload: Vec<u8>,
}

/// Comparison of replayed and recorded messages of one topic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Comparison {
    /// Messages in the recording.
    pub recorded: usize,
    /// Replayed messages.
    pub replayed: usize,
    /// Messages with the same bytes in the same order.
    pub equal: usize,
    /// Index of the first recorded message that was not replayed.
    pub differs_at: Option<usize>,
}

impl Comparison {
    /// Checks that every recorded message is replayed, in order. The recording may have lost
    /// messages, and may continue after the `end` of its journal. If the replay `is_cut`, messages
    /// that were captured after its last one are not checked.
    fn of(recorded: &[&Recorded], replayed: &[&Recorded], end: Timestamp, is_cut: bool) -> Self {
        let (mut rest, mut equal) = (replayed, 0);
        let mut differs_at = None;
        for (place, message) in recorded.iter().enumerate() {
            let is_after = replayed.last().is_none_or(|last| message.capture > last.capture);
            match rest.iter().position(|other| other.payload == message.payload) {
                Some(at) => {
                    rest = &rest[at + 1..];
                    equal += 1;
                }
                None if is_cut && is_after => break,
                None if rest.is_empty() && (!replayed.is_empty() || message.time > end) => break,
                None => {
                    differs_at = Some(place);
                    break;
                }
            }
        }
        Self { recorded: recorded.len(), replayed: replayed.len(), equal, differs_at }
    }

    /// Whether every recorded message was replayed with the same bytes.
    pub fn agrees(&self) -> bool {
        self.differs_at.is_none()
    }

    /// Replayed messages that the recording lost.
    pub fn unrecorded(&self) -> usize {
        self.replayed - self.equal
    }
}

/// A run, when it began, and when its journal ends.
pub(crate) struct At {
    pub(crate) begin: Timestamp,
    pub(crate) end: Timestamp,
    pub(crate) run: u64,
}

impl At {
    /// Whether a message belongs to the run. Events of older recordings name no run.
    ///
    /// `are_named`: whether other events of the recording name their runs. Then an event without a run happened before the
    /// run; the recorder got it later, from the bus's history.
    fn holds(&self, message: &Recorded, are_named: bool) -> bool {
        match run_of(message) {
            // No node has published it.
            None => false,
            Some(0) if always_names_run(message) || is_of_no_run(message) => false,
            Some(0) if are_named && *message.schema == *Event::FULL_NAME => false,
            Some(0) => message.time >= self.begin,
            Some(run) => run == self.run,
        }
    }
}

/// Whether a node always writes its run into such messages.
fn always_names_run(message: &Recorded) -> bool {
    [Status::FULL_NAME, StageStatus::FULL_NAME, Journal::FULL_NAME].contains(&&*message.schema)
}

/// Whether it is an event that is no output of a node's core.
fn is_of_no_run(message: &Recorded) -> bool {
    *message.schema == *Event::FULL_NAME
        && decode::<Event>(&message.payload)
            .is_ok_and(|event| event.event_kind() == Some(EventKind::SecondNode))
}

/// Whether it is an output of one of several performers of the stage in that run.
fn is_of_performer(message: &Recorded, stage: &str, run: u64) -> bool {
    let of_stage = match Topic::parse(&message.topic) {
        Ok(Topic::Actor { stage: other, .. }) => *other == *stage,
        _ => false,
    };
    of_stage && run_of(message) == Some(run)
}

fn run_of(message: &Recorded) -> Option<u64> {
    fn of<T: Schema>(message: &Recorded, run: fn(T) -> u64) -> Option<u64> {
        decode::<T>(&message.payload).ok().map(run)
    }
    match &*message.schema {
        Pose::FULL_NAME => of(message, |pose: Pose| pose.run_id),
        Keyframe::FULL_NAME => of(message, |keyframe: Keyframe| keyframe.run_id),
        Skeleton::FULL_NAME => of(message, |skeleton: Skeleton| skeleton.run_id),
        Event::FULL_NAME => of(message, |event: Event| event.run_id),
        Status::FULL_NAME => of(message, |status: Status| status.run_id),
        KeypointSet::FULL_NAME => of(message, |set: KeypointSet| set.run_id),
        HandOver::FULL_NAME => of(message, |state: HandOver| state.run_id),
        StageStatus::FULL_NAME => of(message, |status: StageStatus| status.run_id),
        Journal::FULL_NAME => of(message, |journal: Journal| journal.run_id),
        _ => None,
    }
}

/// Compares the outputs of a run, by topic. Calibrations are inputs too, and answers to slates come from
/// recorders too; neither is compared.
pub(crate) fn compare(
    recorded: &[Recorded],
    replayed: &[Recorded],
    topics: &Topics,
    at: &At,
    is_cut: bool,
) -> BTreeMap<String, Comparison> {
    let ours = topics.outputs();
    let is_ours = |message: &&Recorded| {
        ours.iter().any(|topic| **topic == *message.topic)
            || is_of_performer(message, &topics.stage, at.run)
    };
    let mut by_topic: BTreeMap<&str, [Vec<&Recorded>; 2]> = BTreeMap::new();
    for message in replayed.iter().filter(is_ours) {
        by_topic.entry(&message.topic).or_default()[1].push(message);
    }
    let names_run = |message: &Recorded| {
        *message.schema == *Event::FULL_NAME && run_of(message).is_some_and(|run| run != 0)
    };
    let are_named = recorded.iter().any(names_run);
    for message in recorded.iter().filter(is_ours).filter(|one| at.holds(one, are_named)) {
        by_topic.entry(&message.topic).or_default()[0].push(message);
    }
    let compare = |[recorded, replayed]: [Vec<&Recorded>; 2]| {
        Comparison::of(&recorded, &replayed, at.end, is_cut)
    };
    by_topic.into_iter().map(|(topic, sides)| (topic.to_owned(), compare(sides))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_after_the_end_of_the_journal_are_no_difference() {
        let at = |ms: i64| Timestamp::from_ns(ms * 1_000_000);
        let message = |ms: i64, payload: &[u8]| Recorded {
            time: at(ms),
            capture: at(ms),
            topic: "mocap/stage/status".into(),
            schema: StageStatus::FULL_NAME.into(),
            payload: payload.to_vec(),
        };
        let of = |recorded: &[Recorded], replayed: &[Recorded]| {
            let [recorded, replayed] =
                [recorded, replayed].map(|all| all.iter().collect::<Vec<_>>());
            Comparison::of(&recorded, &replayed, at(500), false).agrees()
        };
        let (early, late) = (message(400, b"a"), message(900, b"b"));
        // A take of half a second has no status of its own.
        assert!(of(std::slice::from_ref(&late), &[]));
        assert!(!of(std::slice::from_ref(&early), &[]));
        assert!(of(&[early.clone(), late], std::slice::from_ref(&early)));
        assert!(!of(&[early], &[message(400, b"c")]));
    }
}
