//! Running the core again on what a node was told, and comparing what comes out.
//!
//! The journal says in what order and when the core got its inputs; the messages themselves are
//! found by topic and hash. Jobs are solved when the journal says that their answer came, so the
//! same outputs must follow, byte for byte.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use super::core::{Core, Input, Output, Settings};
use super::journal::hash;
use crate::msg::journal_entry::Input as Entry;
use crate::msg::{
    DecodeError, Journal, JournalEntry, JournalMessage, JournalStart, Status, Topics, decode,
};
use crate::time::Timestamp;
use crate::track::{Job, Solver};

/// A message of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recorded {
    /// When it was recorded, or came out, on the node's clock.
    pub time: Timestamp,
    /// The capture time that it is about.
    pub capture: Timestamp,
    /// Its topic.
    pub topic: Arc<str>,
    /// Full name of its schema.
    pub schema: Arc<str>,
    /// Its bytes.
    pub payload: Vec<u8>,
}

/// Why a recording cannot be run again.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// No journal at all.
    #[error(
        "no journal on {topic}; record a node with `bundlemocap record`, and name its stage and \
         actor with --stage and --actor"
    )]
    NoJournal {
        /// Where it should be.
        topic: String,
    },
    /// The beginning is not there.
    #[error(
        "the journal begins with number {first}; start `bundlemocap record` before the cameras, and \
         restart the node for another take"
    )]
    Begun {
        /// Number of its first message.
        first: u64,
    },
    /// A message that the node got is not in the recording.
    #[error(
        "message {index} of the journal, {bytes_hash:016x} on {topic}, is not in the recording: it \
         was lost, or recording began after the cameras"
    )]
    Missing {
        /// How many entries come before.
        index: u64,
        /// Its topic.
        topic: String,
        /// Hash of its bytes.
        bytes_hash: u64,
    },
    /// The journal does not fit what the core does.
    #[error("entry {index} of the journal makes no sense: {reason}")]
    Senseless {
        /// How many entries come before.
        index: u64,
        /// What is wrong.
        reason: String,
    },
    /// A journal that cannot be decoded.
    #[error(transparent)]
    Decode(#[from] DecodeError),
}

/// How what came out compares with what was recorded, on one topic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Comparison {
    /// Messages in the recording.
    pub recorded: usize,
    /// Messages that came out.
    pub replayed: usize,
    /// Those with the same bytes, in the same order.
    pub equal: usize,
    /// The place of the first recorded message that did not come out.
    pub differs_at: Option<usize>,
}

impl Comparison {
    /// Every recorded message must come out, in order; a recording may have lost some of those that
    /// do, and go on after its journal.
    fn of(recorded: &[&[u8]], replayed: &[&[u8]]) -> Self {
        let (mut rest, mut equal) = (replayed, 0);
        let mut differs_at = None;
        for (place, message) in recorded.iter().enumerate() {
            match rest.iter().position(|other| other == message) {
                Some(at) => {
                    rest = &rest[at + 1..];
                    equal += 1;
                }
                None if rest.is_empty() && !replayed.is_empty() => break,
                None => {
                    differs_at = Some(place);
                    break;
                }
            }
        }
        Self { recorded: recorded.len(), replayed: replayed.len(), equal, differs_at }
    }

    /// Whether nothing differs.
    pub fn agrees(&self) -> bool {
        self.differs_at.is_none()
    }

    /// Messages that came out and that the recording lost.
    pub fn unrecorded(&self) -> usize {
        self.replayed - self.equal
    }
}

/// What a replay gave.
#[derive(Debug)]
pub struct Replayed {
    /// What the node started with.
    pub start: JournalStart,
    /// Entries of the journal that were told.
    pub inputs: u64,
    /// By topic, outputs of the core only.
    pub topics: BTreeMap<String, Comparison>,
    /// Everything that came out, in order.
    pub outputs: Vec<Recorded>,
    /// Whether the journal goes on to the node's end.
    pub is_whole: bool,
}

impl Replayed {
    /// What came out on the topics that were compared: calibrations are among the inputs.
    pub fn outputs(&self) -> impl Iterator<Item = &Recorded> {
        self.outputs.iter().filter(|message| self.topics.contains_key(&*message.topic))
    }
}

/// The journal of a recording, in order.
///
/// # Errors
/// None, one that cannot be decoded, or one without its beginning.
pub fn journal(messages: &[Recorded], topics: &Topics) -> Result<Vec<JournalEntry>, ReplayError> {
    let topic = topics.journal();
    let parts = messages.iter().filter(|message| *message.topic == *topic);
    let parts = parts.map(|message| decode::<Journal>(&message.payload));
    let mut parts = parts.collect::<Result<Vec<_>, _>>()?;
    parts.sort_by_key(|part| part.sequence);
    parts.dedup_by_key(|part| part.sequence);
    let first = parts.first().ok_or(ReplayError::NoJournal { topic })?.sequence;
    if first != 0 {
        return Err(ReplayError::Begun { first });
    }
    // What comes after a gap cannot be told.
    let whole = parts.iter().zip(0..).take_while(|(part, number)| part.sequence == *number).count();
    parts.truncate(whole);
    Ok(parts.into_iter().flat_map(|part| part.entries).collect())
}

/// Runs a core again. `settings` makes those that the journal's start tells of.
///
/// # Errors
/// A journal that is not whole, or messages that are missing.
pub fn replay<E: From<ReplayError>>(
    messages: &[Recorded],
    topics: &Topics,
    prepare: impl FnOnce(&JournalStart) -> Result<(Settings, Solver), E>,
) -> Result<Replayed, E> {
    let mut entries = journal(messages, topics)?.into_iter();
    let senseless = |reason: &str| ReplayError::Senseless { index: 0, reason: reason.to_owned() };
    let Some(JournalEntry { input: Some(Entry::Start(start)), .. }) = entries.next() else {
        return Err(senseless("it is no start").into());
    };
    let (settings, solver) = prepare(&start)?;
    let mut run = Run::new(messages, Core::new(settings), solver);
    let entries: Vec<JournalEntry> = entries.collect();
    let begin = entries.first().map_or(0, |first| first.time_ns);
    let begin = Timestamp::from_ns(begin);
    if let Some(rig) = &start.rig {
        run.tell(begin, Input::RigFile(rig.clone()));
        run.outputs.clear();
    }
    // The last answers and poses come after the end.
    let is_whole = entries.iter().any(|entry| matches!(entry.input, Some(Entry::End(_))));
    let inputs = entries.len() as u64 + 1;
    for (index, entry) in (1..).zip(entries) {
        let time = Timestamp::from_ns(entry.time_ns);
        let input = run.input(index, entry)?;
        run.tell(time, input);
    }
    let outputs = run.outputs;
    let topics = compare(messages, &outputs, topics, begin);
    Ok(Replayed { start, inputs, topics, outputs, is_whole })
}

/// A core that is told a journal.
struct Run<'a> {
    core: Core,
    solver: Solver,
    by_hash: HashMap<(&'a str, u64), &'a [u8]>,
    job: Option<Box<Job>>,
    outputs: Vec<Recorded>,
}

impl<'a> Run<'a> {
    fn new(messages: &'a [Recorded], core: Core, solver: Solver) -> Self {
        let keyed = messages
            .iter()
            .map(|message| ((&*message.topic, hash(&message.payload)), message.payload.as_slice()));
        Self { core, solver, by_hash: keyed.collect(), job: None, outputs: Vec::new() }
    }

    fn input(&mut self, index: u64, entry: JournalEntry) -> Result<Input, ReplayError> {
        let senseless = |reason: String| ReplayError::Senseless { index, reason };
        Ok(match entry.input {
            Some(Entry::Message(message)) => self.message(index, message)?,
            Some(Entry::Solved(solved)) => {
                let job = self.job.take().filter(|job| job.number == solved.job);
                let job = job.ok_or_else(|| senseless(format!("job {} is not out", solved.job)))?;
                let solution = Box::new(self.solver.solve(&job));
                Input::Solved { solution, took_ns: solved.took_ns }
            }
            Some(Entry::Tick(_)) => Input::Tick,
            Some(Entry::Dropped(count)) => Input::Dropped(count),
            Some(Entry::Played(played)) => Input::Played(played.deviation_us),
            Some(Entry::End(_)) => Input::End,
            Some(Entry::Start(_)) => return Err(senseless("a second start".to_owned())),
            None => return Err(senseless("of a later version".to_owned())),
        })
    }

    fn message(&self, index: u64, message: JournalMessage) -> Result<Input, ReplayError> {
        if let Some(payload) = message.payload {
            return Ok(match message.topic.as_str() {
                "" => Input::RigFile(payload),
                topic => Input::Message { topic: topic.into(), payload },
            });
        }
        let key = (message.topic.as_str(), message.hash);
        match self.by_hash.get(&key) {
            Some(payload) => {
                Ok(Input::Message { payload: payload.to_vec(), topic: message.topic.into() })
            }
            None => {
                let bytes_hash = message.hash;
                Err(ReplayError::Missing { index, topic: message.topic, bytes_hash })
            }
        }
    }

    fn tell(&mut self, now: Timestamp, input: Input) {
        self.core.handle(now, input);
        while let Some(output) = self.core.poll() {
            match output {
                Output::Solve(job) => self.job = Some(job),
                Output::Publish(publication) => self.outputs.push(Recorded {
                    time: publication.due.unwrap_or(now),
                    capture: publication.capture,
                    topic: publication.topic,
                    schema: publication.schema.into(),
                    payload: publication.payload,
                }),
                Output::Wake(_) => {}
            }
        }
    }
}

/// Compares what came out with what was recorded, topic by topic. Calibrations are inputs, and what
/// was published before the journal's beginning has nothing to be compared with.
fn compare(
    recorded: &[Recorded],
    replayed: &[Recorded],
    topics: &Topics,
    begin: Timestamp,
) -> BTreeMap<String, Comparison> {
    let is_early = |message: &Recorded| match *message.topic == *topics.status() {
        true => decode::<Status>(&message.payload).is_ok_and(|status| status.inputs == 0),
        false => message.time < begin,
    };
    let mut by_topic: BTreeMap<&str, [Vec<&[u8]>; 2]> = BTreeMap::new();
    for message in replayed.iter().filter(|message| *message.topic != *topics.rig()) {
        by_topic.entry(&message.topic).or_default()[1].push(&message.payload);
    }
    let ours = topics.outputs();
    let of_ours = |message: &&Recorded| ours.iter().any(|topic| **topic == *message.topic);
    for message in recorded.iter().filter(of_ours).filter(|message| !is_early(message)) {
        by_topic.entry(&message.topic).or_default()[0].push(&message.payload);
    }
    let compare = |[recorded, replayed]: [Vec<&[u8]>; 2]| Comparison::of(&recorded, &replayed);
    by_topic.into_iter().map(|(topic, sides)| (topic.to_owned(), compare(sides))).collect()
}
