//! Frames of cameras, and sets of performers' keypoints, that are missing by their own numbers.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use crate::io::recording::RawEntry;
use crate::io::wire::{ActorChannel, KeypointFrame, KeypointSet, StageChannel, Topic, decode};

/// A message may come late by at most so many numbers. After a longer step back, its publisher was started again.
const LATE: u64 = 64;
/// The same after a longer step ahead.
const LONGEST_GAP: u64 = 100_000;

/// The numbers on one topic since its publisher was started.
#[derive(Clone, Debug, PartialEq)]
struct Run {
    first: u64,
    highest: u64,
    count: u64,
    /// How often each step to the next number came. Some detectors use every second image.
    steps: BTreeMap<u64, u64>,
    /// The last numbers: some messages come twice.
    recent: VecDeque<u64>,
}

impl Run {
    fn new(number: u64) -> Self {
        let (steps, recent) = (BTreeMap::new(), VecDeque::from([number]));
        Self { first: number, highest: number, count: 1, steps, recent }
    }

    /// Whether it is a number of this run.
    fn fits(&self, number: u64) -> bool {
        let [from, to] =
            [self.highest.saturating_sub(LATE), self.highest.saturating_add(LONGEST_GAP)];
        (from..=to).contains(&number)
    }

    fn add(&mut self, number: u64) {
        if self.recent.contains(&number) {
            return;
        }
        if self.recent.len() as u64 > LATE {
            self.recent.pop_front();
        }
        self.recent.push_back(number);
        self.count += 1;
        self.first = self.first.min(number);
        if number > self.highest {
            *self.steps.entry(number - self.highest).or_default() += 1;
            self.highest = number;
        }
    }

    fn missing(&self) -> u64 {
        let usual = self.steps.iter().rev().max_by_key(|(_, count)| **count);
        let step = usual.map_or(1, |(step, _)| *step);
        ((self.highest - self.first) / step + 1).saturating_sub(self.count)
    }
}

/// The numbers by topic: of the present run, and how many were missing in those before.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Numbers(BTreeMap<Arc<str>, (Run, u64)>);

impl Numbers {
    /// Notes a message.
    pub(super) fn add(&mut self, entry: &RawEntry) {
        let number = match Topic::parse(&entry.topic) {
            Ok(Topic::Stage { channel: StageChannel::Keypoints { .. }, .. }) => {
                decode(&entry.payload).map(|KeypointFrame { frame, .. }| frame)
            }
            Ok(Topic::Actor { channel: ActorChannel::Keypoints, .. }) => {
                decode(&entry.payload).map(|KeypointSet { number, .. }| number)
            }
            _ => return,
        };
        let Ok(number) = number else { return };
        let new = || (Run::new(number), 0);
        let (run, before) = self.0.entry(Arc::clone(&entry.topic)).or_insert_with(new);
        if run.fits(number) {
            run.add(number);
        } else {
            *before += run.missing();
            *run = Run::new(number);
        }
    }

    /// Number of missing frames of the camera, or sets of the performer, of that topic.
    pub(crate) fn missing(&self, topic: &str) -> u64 {
        self.0.get(topic).map_or(0, |(run, before)| before + run.missing())
    }

    /// The cameras and performers with missing messages, and how many.
    pub(super) fn all_missing(&self) -> impl Iterator<Item = (&str, u64)> {
        let missing = self.0.keys().map(|topic| (&**topic, self.missing(topic)));
        let missing = missing.filter(|(_, missing)| *missing > 0);
        missing.filter_map(|(topic, missing)| Some((name_of(topic)?, missing)))
    }
}

/// The camera or the performer of a topic of keypoints.
fn name_of(topic: &str) -> Option<&str> {
    match Topic::parse(topic) {
        Ok(Topic::Stage { channel: StageChannel::Keypoints { camera }, .. }) => Some(camera),
        Ok(Topic::Actor { actor, .. }) => Some(actor),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::time::Timestamp;
    use crate::io::wire::{Topics, encode};

    fn entry(topic: &Arc<str>, payload: Vec<u8>) -> RawEntry {
        let topic = Arc::clone(topic);
        let (schema, encoding) = ("".into(), "".into());
        let [log_time, publish_time] = [Timestamp::default(); 2];
        RawEntry { topic, schema, encoding, log_time, publish_time, payload }
    }

    /// The number of missing frames after these.
    fn missing(frames: impl IntoIterator<Item = u64>) -> u64 {
        let topic: Arc<str> = Topics::default().keypoints("a").into();
        let mut numbers = Numbers::default();
        for frame in frames {
            let payload = encode(&KeypointFrame { frame, ..KeypointFrame::default() });
            numbers.add(&entry(&topic, payload));
        }
        let missing = numbers.missing(&topic);
        let all = if missing == 0 { vec![] } else { vec![("a", missing)] };
        assert_eq!(numbers.all_missing().collect::<Vec<_>>(), all);
        missing
    }

    #[test]
    fn gaps_are_counted_and_other_orders_and_steps_are_none() {
        assert_eq!(missing(7..100), 0);
        assert_eq!(missing((0..100).filter(|number| ![3, 50, 51].contains(number))), 3);
        assert_eq!(missing((0..100).filter(|number| number % 2 == 0)), 0);
        assert_eq!(missing((0..100).step_by(2).filter(|number| ![8, 50].contains(number))), 2);
        assert_eq!(missing([1, 0, 2, 2, 4, 3, 5, 4, 8]), 2, "late ones and copies");
        let slipped = (0..50).map(|k| 2 * k).chain((50..100).map(|k| 2 * k + 1));
        assert_eq!(missing(slipped), 0, "every second image, and once the next one");
        let begun_again = [200, 201, 203].into_iter().chain(0..9).chain([u64::MAX - 1, u64::MAX]);
        assert_eq!(missing(begun_again), 1);
        assert_eq!(missing([]), 0);
        let topic: Arc<str> = "mocap/stage/actor/p1/keypoints".into();
        let mut numbers = Numbers::default();
        for number in [1, 2, 4] {
            numbers.add(&entry(&topic, encode(&KeypointSet { number, ..KeypointSet::default() })));
        }
        assert_eq!(numbers.all_missing().collect::<Vec<_>>(), [("p1", 1)]);
    }
}
