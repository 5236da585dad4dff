//! Frames that did not come, by the cameras' own numbers.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use crate::io::recording::RawEntry;
use crate::io::wire::{KeypointFrame, StageChannel, Topic, decode};

/// A frame comes late by at most as many numbers. At a longer way back the camera's program was started again.
const LATE: u64 = 64;
/// The same for a longer way ahead.
const LONGEST_GAP: u64 = 100_000;

/// The numbers of a camera since its program was started.
#[derive(Clone, Debug, PartialEq)]
struct Camera {
    first: u64,
    highest: u64,
    /// The smallest way ahead: some detectors use every second image.
    step: u64,
    came: u64,
    /// The last numbers; some frames come twice.
    recent: VecDeque<u64>,
}

impl Camera {
    fn new(frame: u64) -> Self {
        let recent = VecDeque::from([frame]);
        Self { first: frame, highest: frame, step: u64::MAX, came: 1, recent }
    }

    /// Whether it is a number of the same run.
    fn fits(&self, frame: u64) -> bool {
        (self.highest.saturating_sub(LATE)..=self.highest.saturating_add(LONGEST_GAP))
            .contains(&frame)
    }

    fn came(&mut self, frame: u64) {
        if self.recent.contains(&frame) {
            return;
        }
        if self.recent.len() as u64 == LATE {
            self.recent.pop_front();
        }
        self.recent.push_back(frame);
        self.came += 1;
        self.first = self.first.min(frame);
        if frame > self.highest {
            self.step = self.step.min(frame - self.highest);
            self.highest = frame;
        }
    }

    fn missing(&self) -> u64 {
        ((self.highest - self.first) / self.step + 1).saturating_sub(self.came)
    }
}

/// The numbers of the cameras, by topic.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Numbers(BTreeMap<Arc<str>, (Camera, u64)>);

impl Numbers {
    /// Notes a message.
    pub(super) fn came(&mut self, entry: &RawEntry) {
        let topic = Topic::parse(&entry.topic);
        if !matches!(topic, Ok(Topic::Stage { channel: StageChannel::Keypoints { .. }, .. })) {
            return;
        }
        let Ok(KeypointFrame { frame, .. }) = decode(&entry.payload) else { return };
        let new = || (Camera::new(frame), 0);
        let (camera, before) = self.0.entry(Arc::clone(&entry.topic)).or_insert_with(new);
        if camera.fits(frame) {
            camera.came(frame);
        } else {
            *before += camera.missing();
            *camera = Camera::new(frame);
        }
    }

    /// Number of frames that did not come from the camera of that topic.
    pub(crate) fn missing(&self, topic: &str) -> u64 {
        self.0.get(topic).map_or(0, |(camera, before)| before + camera.missing())
    }

    /// The cameras with such frames, and how many.
    pub(super) fn all_missing(&self) -> impl Iterator<Item = (&str, u64)> {
        let missing = self.0.keys().map(|topic| (&**topic, self.missing(topic)));
        let missing = missing.filter(|(_, missing)| *missing > 0);
        missing.filter_map(|(topic, missing)| Some((topic.split('/').rev().nth(1)?, missing)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::time::Timestamp;
    use crate::io::wire::{Topics, encode};

    /// The number of missing frames after these.
    fn missing(frames: impl IntoIterator<Item = u64>) -> u64 {
        let topic: Arc<str> = Topics::default().keypoints("a").into();
        let mut numbers = Numbers::default();
        for frame in frames {
            let payload = encode(&KeypointFrame { frame, ..KeypointFrame::default() });
            let topic = Arc::clone(&topic);
            numbers.came(&RawEntry {
                topic,
                schema: "".into(),
                encoding: "".into(),
                log_time: Timestamp::default(),
                publish_time: Timestamp::default(),
                payload,
            });
        }
        let missing = numbers.missing(&topic);
        assert_eq!(
            numbers.all_missing().collect::<Vec<_>>(),
            match missing {
                0 => vec![],
                _ => vec![("a", missing)],
            }
        );
        missing
    }

    #[test]
    fn gaps_are_counted_and_other_orders_and_steps_are_none() {
        assert_eq!(missing(7..100), 0);
        assert_eq!(missing((0..100).filter(|number| ![3, 50, 51].contains(number))), 3);
        assert_eq!(missing((0..100).filter(|number| number % 2 == 0)), 0);
        assert_eq!(missing((0..100).step_by(2).filter(|number| ![8, 50].contains(number))), 2);
        assert_eq!(missing([1, 0, 2, 2, 4, 3, 5, 4, 8]), 2, "late ones and copies");
        let begun_again = [200, 201, 203].into_iter().chain(0..9).chain([u64::MAX - 1, u64::MAX]);
        assert_eq!(missing(begun_again), 1);
        assert_eq!(missing([]), 0);
    }
}
