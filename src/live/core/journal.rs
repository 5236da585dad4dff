//! Records the inputs of the core in order, so that a replay can repeat them.

use super::port::{Input, Loss, Settings, wire_known};
use crate::core::fnv::fnv1a;
use crate::core::time::{Nanos, Timestamp};
use crate::io::wire::journal_entry::Input as Entry;
use crate::io::wire::{
    Journal as Message, JournalDropped, JournalEntry, JournalLoss, JournalMessage, JournalPlayed,
    JournalSolved, JournalSolvers, JournalStart, StageChannel, Topic,
};

/// This many entries, or kept bytes, are written at once, at any time. With the largest rig more, a
/// part stays below the largest message of any bus.
const MOST: usize = 4096;
const MOST_KEPT: usize = 512 << 10;
/// Interval between messages while the node is busy.
const PERIOD: Nanos = Nanos::SECOND;

/// Id of a run: a hash of its start time, the configuration, the weights, the calibration from a file
/// and the given body. A replay has the same inputs and gets the same id. Never 0.
pub(super) fn run_id(start: Timestamp, settings: &Settings, rig: Option<&[u8]>) -> u64 {
    let time = start.ns().to_le_bytes();
    let (config, weights) = (settings.toml.as_bytes(), settings.weights.as_bytes());
    let body = settings.body.as_deref().unwrap_or_default();
    fnv1a(&[&time[..], config, weights, rig.unwrap_or_default(), body].concat()).max(1)
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
    /// Bytes of the payloads in `entries`.
    kept: usize,
    /// Number of entries so far.
    pub(super) count: u64,
    /// Whether an entry other than a tick waits.
    is_busy: bool,
    written: Option<Timestamp>,
}

impl Journal {
    /// Records an input before it is handled. Inputs before the first message are not recorded:
    /// until then the core knows only `rig`, the calibration from a file.
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
                hash: fnv1a(payload),
                // Rare and small, and a recorder that joins later gets the latest only.
                payload: is_order(topic).then(|| payload.clone()),
            }),
            Input::RigFile(payload) => Entry::Message(JournalMessage {
                topic: String::new(),
                hash: fnv1a(payload),
                payload: Some(payload.clone()),
            }),
            Input::Solved { performer, solution, took } => Entry::Solved(JournalSolved {
                performer: performer.0 as u32,
                job: solution.number,
                took_ns: took.ns().unsigned_abs(),
            }),
            Input::Solvers(names) => Entry::Solvers(JournalSolvers { names: names.clone() }),
            Input::Tick => Entry::Tick(true),
            Input::Dropped(losses) => {
                Entry::Dropped(JournalDropped { losses: losses.iter().map(loss).collect() })
            }
            Input::Played(deviation_us) => {
                Entry::Played(JournalPlayed { deviation_us: deviation_us.clone() })
            }
            Input::End => Entry::End(true),
        };
        self.push(now, entry);
    }

    fn push(&mut self, now: Timestamp, input: Entry) {
        if let Entry::Message(JournalMessage { payload: Some(payload), .. }) = &input {
            self.kept += payload.len();
        }
        self.entries.push(JournalEntry { time_ns: now.ns(), input: Some(input) });
        self.count += 1;
    }

    /// The next message, when it is due. There is none while only ticks arrive, so that a recorder
    /// that joins in that time still gets everything.
    pub(super) fn take(&mut self, now: Timestamp, is_last: bool, run_id: u64) -> Option<Message> {
        let is_time = self.is_busy && self.written.is_none_or(|written| now - written >= PERIOD);
        let is_full = self.entries.len() >= MOST || self.kept >= MOST_KEPT;
        if self.entries.is_empty() || !(is_last || is_time || is_full) {
            return None;
        }
        self.kept = 0;
        let (sequence, entries) = (self.sequence, std::mem::take(&mut self.entries));
        (self.sequence, self.written, self.is_busy) = (sequence + 1, Some(now), false);
        Some(Message { sequence, entries, run_id })
    }
}

/// Whether it is the topic of rigs or of slates.
pub(super) fn is_order(topic: &str) -> bool {
    use StageChannel::{Rig, Take};
    matches!(Topic::parse(topic), Ok(Topic::Stage { channel: Rig | Take, .. }))
}

fn loss(loss: &Loss) -> JournalLoss {
    let Loss { camera, dropped, too_large, bytes } = loss.clone();
    JournalLoss { camera: camera.unwrap_or_default(), dropped, too_large, bytes }
}

/// The losses of an entry.
pub(crate) fn losses(dropped: JournalDropped) -> Vec<Loss> {
    let loss = |JournalLoss { camera, dropped, too_large, bytes }| {
        let camera = Some(camera).filter(|camera| !camera.is_empty());
        Loss { camera, dropped, too_large, bytes }
    };
    dropped.losses.into_iter().map(loss).collect()
}

/// The first entry.
pub(super) fn start(settings: &Settings, rig: Option<&[u8]>, run_id: u64) -> JournalStart {
    JournalStart {
        version: env!("CARGO_PKG_VERSION").into(),
        config: settings.toml.clone(),
        weights: settings.weights.clone(),
        platform: platform().into(),
        rig: rig.map(<[u8]>::to_vec),
        run_id,
        body: settings.body.clone(),
        take: settings.carried.take.clone(),
        latency_ns: settings.carried.latency.unwrap_or_default().ns().unsigned_abs(),
        solve_ns: settings.carried.solve.ns().unsigned_abs(),
        time_offsets_ns: settings.carried.time_offsets.iter().map(|offset| offset.ns()).collect(),
        performers: settings.carried.performers.iter().map(wire_known).collect(),
        left_out: settings.carried.left_out.iter().map(|camera| *camera as u32).collect(),
        labels: settings.carried.labels.clone(),
        usual_px: settings.carried.usual_px.clone(),
        verdicts: settings.carried.verdicts.clone(),
        verdict: settings.carried.verdict.clone(),
        solvers: settings.carried.solvers.clone(),
        offsets_are_known: settings.carried.offsets_are_known,
    }
}
