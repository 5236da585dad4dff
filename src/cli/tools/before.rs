//! What came before a take: its file begins with it.

use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::RawEntry;
use crate::io::wire::{ActorChannel, StageChannel, Topic};

/// Inputs of this time before a take are in its file, and messages of this time after it.
pub(super) const MARGIN: Nanos = Nanos::SECOND;
/// Most topics of which the last hand-over is kept.
const MOST_HANDED: usize = 256;
/// Most inputs that are kept for the next take.
const MOST_RECENT: usize = 65_536;
/// Most bytes of their payloads.
const MOST_RECENT_BYTES: usize = 256 << 20;

/// The messages of a stage that the next take may need.
#[derive(Default)]
pub(super) struct Before {
    rig: Option<RawEntry>,
    /// By topic, what a solver told last of a performer: solvers that start later begin with it.
    handed: BTreeMap<Arc<str>, RawEntry>,
    /// The inputs of the last second.
    recent: VecDeque<RawEntry>,
    /// Bytes of their payloads.
    bytes: usize,
}

impl Before {
    /// Keeps a message, if a take may need it.
    pub(super) fn keep(&mut self, entry: RawEntry) {
        use ActorChannel::{HandOver, Keypoints, Status};
        match Topic::parse(&entry.topic) {
            Ok(Topic::Stage { channel: StageChannel::Rig, .. }) => {
                self.rig = Some(entry);
                return;
            }
            Ok(Topic::Actor { channel: HandOver, .. }) => self.hand_over(&entry),
            Ok(
                Topic::Stage { channel: StageChannel::Keypoints { .. }, .. }
                | Topic::Actor { channel: Keypoints | Status, .. },
            ) => {}
            _ => return,
        }
        let from = entry.log_time - MARGIN;
        self.bytes += entry.payload.len();
        self.recent.push_back(entry);
        while self.recent.len() > MOST_RECENT
            || self.bytes > MOST_RECENT_BYTES
            || self.recent.front().is_some_and(|first| first.log_time < from)
        {
            let first = self.recent.pop_front();
            self.bytes -= first.map_or(0, |first| first.payload.len());
        }
    }

    fn hand_over(&mut self, entry: &RawEntry) {
        self.handed.insert(Arc::clone(&entry.topic), entry.clone());
        if self.handed.len() > MOST_HANDED {
            let oldest = self.handed.iter().min_by_key(|(_, entry)| entry.log_time);
            let oldest = oldest.map(|(topic, _)| Arc::clone(topic));
            oldest.and_then(|oldest| self.handed.remove(&oldest));
        }
    }

    /// What the file of a take that begins at `slate` begins with. Messages that are older than [`MARGIN`] have the time of
    /// the file's begin.
    pub(super) fn take(&self, slate: Timestamp) -> impl Iterator<Item = Cow<'_, RawEntry>> {
        let begin = slate - MARGIN;
        let earlier = self.handed.values().filter(move |entry| entry.log_time < begin);
        let known = self.rig.iter().chain(earlier);
        let known = known.map(move |entry| RawEntry { log_time: begin, ..entry.clone() });
        let recent = self.recent.iter().filter(move |entry| entry.log_time >= begin);
        known.map(Cow::Owned).chain(recent.map(Cow::Borrowed))
    }
}
