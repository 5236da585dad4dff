//! What the core was told, in order, so that it can be told again.

use super::core::{Input, Settings};
use crate::msg::journal_entry::Input as Entry;
use crate::msg::{
    Journal as Message, JournalEntry, JournalMessage, JournalPlayed, JournalSolved, JournalStart,
};
use crate::time::Timestamp;

/// Entries that are written at once, whatever the time.
const MOST: usize = 4096;
/// While the node is busy entries are written this often, ns.
const PERIOD: i64 = 1_000_000_000;

/// FNV-1a, 64 bits.
pub fn hash(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

/// The kind of processor. All of one kind give the same bits, whatever instructions they have.
pub fn platform() -> &'static str {
    std::env::consts::ARCH
}

/// Entries that wait to be published.
#[derive(Clone, Debug, Default)]
pub(super) struct Journal {
    sequence: u64,
    entries: Vec<JournalEntry>,
    /// All entries so far.
    pub(super) count: u64,
    /// Whether something but ticks waits.
    is_busy: bool,
    written: Option<Timestamp>,
}

impl Journal {
    /// Notes an input, before it is handled. Nothing is noted before the first message: until then
    /// the core knows only `rig`, the calibration from a file.
    pub(super) fn note(&mut self, now: Timestamp, input: &Input, start: impl Fn() -> JournalStart) {
        if self.count == 0 {
            if !matches!(input, Input::Message { .. }) {
                return;
            }
            self.push(now, Entry::Start(start()));
            self.written = Some(now);
        }
        self.is_busy |= !matches!(input, Input::Tick);
        let entry = match input {
            Input::Message { topic, payload } => Entry::Message(JournalMessage {
                topic: topic.to_string(),
                hash: hash(payload),
                // A recorder that comes later gets the latest calibration only.
                payload: topic.ends_with("/rig").then(|| payload.clone()),
            }),
            Input::RigFile(payload) => Entry::Message(JournalMessage {
                topic: String::new(),
                hash: hash(payload),
                payload: Some(payload.clone()),
            }),
            Input::Solved { solution, took_ns } => {
                Entry::Solved(JournalSolved { job: solution.number, took_ns: *took_ns })
            }
            Input::Tick => Entry::Tick(true),
            Input::Dropped(count) => Entry::Dropped(*count),
            Input::Played(deviation_us) => {
                Entry::Played(JournalPlayed { deviation_us: deviation_us.clone() })
            }
            Input::End => Entry::End(true),
        };
        self.push(now, entry);
    }

    fn push(&mut self, now: Timestamp, input: Entry) {
        self.entries.push(JournalEntry { time_ns: now.ns(), input: Some(input) });
        self.count += 1;
    }

    /// A message, when it is time for one. While nothing but time passes there is none, so that who
    /// begins to record then still gets everything.
    pub(super) fn take(&mut self, now: Timestamp, is_last: bool) -> Option<Message> {
        let is_time = self.is_busy && self.written.is_none_or(|written| now - written >= PERIOD);
        if self.entries.is_empty() || !(is_last || is_time || self.entries.len() >= MOST) {
            return None;
        }
        let (sequence, entries) = (self.sequence, std::mem::take(&mut self.entries));
        (self.sequence, self.written, self.is_busy) = (sequence + 1, Some(now), false);
        Some(Message { sequence, entries })
    }
}

/// The first entry.
pub(super) fn start(settings: &Settings, rig: Option<&[u8]>) -> JournalStart {
    JournalStart {
        version: env!("CARGO_PKG_VERSION").into(),
        config: settings.toml.clone(),
        weights: settings.weights.clone(),
        platform: platform().into(),
        rig: rig.map(<[u8]>::to_vec),
    }
}
