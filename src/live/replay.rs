//! Runs the core on the recorded inputs of a node and compares the outputs with the recording.
//!
//! The journal holds order and times of the inputs; the messages are found by topic and hash. A job
//! is solved when the journal says that its solution arrived. So the outputs are equal, byte for
//! byte.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use super::core::Core;
use super::journal;
use super::port::{Input, Output, Settings};
use crate::core::fnv::fnv1a;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{EventKind, Job, Solver};
use crate::io::wire::journal_entry::Input as Entry;
use crate::io::wire::{
    DecodeError, Event, Journal, JournalEntry, JournalMessage, JournalStart, Schema, Status, Topic,
    Topics, decode,
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

/// Why a recording cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// No journal, or none of the given stage and actor.
    #[error(
        "there is no journal{asked}; give a recording of a node, made by `bundlemocap record`{found}"
    )]
    NoJournal {
        /// The given stage and actor, as text; empty if none were given.
        asked: String,
        /// The journals in the recording, as text; empty if there are none.
        found: String,
    },
    /// Journals of several nodes.
    #[error("there are journals of several nodes; choose one with --stage and --actor: {found}")]
    Several {
        /// Their topics, separated by commas.
        found: String,
    },
    /// The journal's beginning is missing.
    #[error(
        "the journal begins with number {first}; start `bundlemocap record` before the cameras, and \
         restart the node for another take"
    )]
    Begun {
        /// Number of its first message.
        first: u64,
    },
    /// An input of the node is missing in the recording.
    #[error(
        "message {index} of the journal, {bytes_hash:016x} on {topic}, is not in the recording: it \
         was lost, or recording began after the cameras"
    )]
    Missing {
        /// Number of entries before it.
        index: u64,
        /// Its topic.
        topic: String,
        /// Hash of its bytes.
        bytes_hash: u64,
    },
    /// An entry of the journal contradicts the core's outputs.
    #[error("entry {index} of the journal cannot be replayed: {reason}")]
    Senseless {
        /// Number of entries before it.
        index: u64,
        /// What is wrong.
        reason: String,
    },
    /// A journal that cannot be decoded.
    #[error(transparent)]
    Decode(#[from] DecodeError),
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
    /// messages, and may continue after the end of its journal.
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

    /// Whether every recorded message was replayed with the same bytes.
    pub fn agrees(&self) -> bool {
        self.differs_at.is_none()
    }

    /// Replayed messages that the recording lost.
    pub fn unrecorded(&self) -> usize {
        self.replayed - self.equal
    }
}

/// The result of a replay.
#[derive(Debug)]
pub struct Replayed {
    /// The first entry of the journal.
    pub start: JournalStart,
    /// Entries of the journal.
    pub inputs: u64,
    /// Comparison by topic, outputs of the core only.
    pub topics: BTreeMap<String, Comparison>,
    /// All outputs, in order.
    pub outputs: Vec<Recorded>,
    /// Whether the journal reaches the node's end.
    pub is_whole: bool,
}

impl Replayed {
    /// The outputs on the topics that were compared; calibrations are inputs and not included.
    pub fn outputs(&self) -> impl Iterator<Item = &Recorded> {
        self.outputs.iter().filter(|message| self.topics.contains_key(&*message.topic))
    }
}

/// Finds the node whose journal is in a recording.
///
/// # Errors
/// There is no journal of the given stage and actor, or there are several.
pub fn find_node(
    messages: &[Recorded],
    stage: Option<&str>,
    actor: Option<&str>,
) -> Result<Topics, ReplayError> {
    let nodes = messages.iter().filter(|message| *message.schema == *Journal::FULL_NAME);
    let nodes = nodes.filter_map(|message| Topic::parse(&message.topic).ok()?.topics());
    let nodes: BTreeMap<String, Topics> = nodes.map(|topics| (topics.journal(), topics)).collect();
    let list = |nodes: &[&Topics]| {
        nodes.iter().map(|topics| topics.journal()).collect::<Vec<_>>().join(", ")
    };
    let is_asked_for = |topics: &&Topics| {
        stage.is_none_or(|stage| stage == topics.stage)
            && actor.is_none_or(|actor| actor == topics.actor)
    };
    match *nodes.values().filter(is_asked_for).collect::<Vec<_>>() {
        [one] => Ok(one.clone()),
        [] => {
            let asked = [("stage", stage), ("actor", actor)].into_iter();
            let asked = asked.filter_map(|(what, name)| Some(format!(" of {what} {:?}", name?)));
            let found = match nodes.is_empty() {
                true => String::new(),
                false => {
                    format!(", or choose one of {}", list(&nodes.values().collect::<Vec<_>>()))
                }
            };
            Err(ReplayError::NoJournal { asked: asked.collect(), found })
        }
        ref several => Err(ReplayError::Several { found: list(several) }),
    }
}

/// The journal of a recording, in order.
///
/// # Errors
/// There is no journal, it cannot be decoded, or its beginning is missing.
pub fn journal(messages: &[Recorded], topics: &Topics) -> Result<Vec<JournalEntry>, ReplayError> {
    let topic = topics.journal();
    let missing = || ReplayError::NoJournal { asked: format!(" on {topic}"), found: String::new() };
    let parts = messages.iter().filter(|message| *message.topic == *topic);
    let parts = parts.map(|message| decode::<Journal>(&message.payload));
    let mut parts = parts.collect::<Result<Vec<_>, _>>()?;
    parts.sort_by_key(|part| part.sequence);
    parts.dedup_by_key(|part| part.sequence);
    let first = parts.first().ok_or_else(missing)?.sequence;
    if first != 0 {
        return Err(ReplayError::Begun { first });
    }
    // Entries after a gap cannot be replayed.
    let whole = parts.iter().zip(0..).take_while(|(part, number)| part.sequence == *number).count();
    parts.truncate(whole);
    Ok(parts.into_iter().flat_map(|part| part.entries).collect())
}

/// Runs a core on a journal. `prepare` makes settings and solver from the first entry.
///
/// # Errors
/// The journal is incomplete, or messages are missing.
pub fn replay<E: From<ReplayError>>(
    messages: &[Recorded],
    topics: &Topics,
    prepare: impl FnOnce(&JournalStart) -> Result<(Settings, Solver), E>,
) -> Result<Replayed, E> {
    let mut entries = journal(messages, topics)?.into_iter();
    let senseless = |reason: &str| ReplayError::Senseless { index: 0, reason: reason.to_owned() };
    let Some(JournalEntry { input: Some(Entry::Start(start)), .. }) = entries.next() else {
        return Err(senseless("it is not a start").into());
    };
    let (settings, solver) = prepare(&start)?;
    let mut run = Run::new(messages, Core::new(settings), solver);
    let entries: Vec<JournalEntry> = entries.collect();
    let begin = entries.first().map_or(0, |first| first.time_ns);
    let begin = Timestamp::from_ns(begin);
    if let Some(rig) = &start.rig {
        run.give(begin, Input::RigFile(rig.clone()));
        run.outputs.clear();
    }
    // The last answers and poses follow after the end.
    let is_whole = entries.iter().any(|entry| matches!(entry.input, Some(Entry::End(_))));
    let inputs = entries.len() as u64 + 1;
    for (index, entry) in (1..).zip(entries) {
        let time = Timestamp::from_ns(entry.time_ns);
        let input = run.input(index, entry)?;
        run.give(time, input);
    }
    let outputs = run.outputs;
    let topics = compare(messages, &outputs, topics, begin);
    Ok(Replayed { start, inputs, topics, outputs, is_whole })
}

/// A core that gets its inputs from a journal.
struct Run<'a> {
    core: Core,
    solver: Solver,
    by_hash: HashMap<(&'a str, u64), &'a [u8]>,
    job: Option<Box<Job>>,
    outputs: Vec<Recorded>,
}

impl<'a> Run<'a> {
    fn new(messages: &'a [Recorded], core: Core, solver: Solver) -> Self {
        let keyed = messages.iter().map(|message| {
            ((&*message.topic, fnv1a(&message.payload)), message.payload.as_slice())
        });
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
                Input::Solved {
                    solution,
                    took: Nanos::new(i64::try_from(solved.took_ns).unwrap_or(i64::MAX)),
                }
            }
            Some(Entry::Tick(_)) => Input::Tick,
            Some(Entry::Dropped(dropped)) => Input::Dropped(journal::losses(dropped)),
            Some(Entry::Played(played)) => Input::Played(played.deviation_us),
            Some(Entry::End(_)) => Input::End,
            Some(Entry::Start(_)) => return Err(senseless("it is a second start".to_owned())),
            None => return Err(senseless("it is of a later version".to_owned())),
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

    fn give(&mut self, now: Timestamp, input: Input) {
        self.core.handle(now, input);
        while let Some(output) = self.core.poll() {
            match output {
                Output::Solve(job) => self.job = Some(job),
                Output::Publish(publication) => self.outputs.push(Recorded {
                    time: publication.due.unwrap_or(now),
                    capture: publication.capture,
                    topic: publication.topic,
                    schema: publication.content.schema().into(),
                    payload: publication.content.encode(),
                }),
                Output::Wake(_) => {}
            }
        }
    }
}

/// Whether another node published it.
fn is_of_second_node(message: &Recorded) -> bool {
    *message.schema == *Event::FULL_NAME
        && decode::<Event>(&message.payload)
            .is_ok_and(|event| event.event_kind() == Some(EventKind::SecondNode))
}

/// Compares replayed with recorded messages, by topic. Skips calibrations, which are inputs, and
/// messages that were published before the journal began.
fn compare(
    recorded: &[Recorded],
    replayed: &[Recorded],
    topics: &Topics,
    begin: Timestamp,
) -> BTreeMap<String, Comparison> {
    let is_early = |message: &Recorded| match *message.topic == *topics.status() {
        true => decode::<Status>(&message.payload).is_ok_and(|status| status.inputs == 0),
        false => message.time < begin || is_of_second_node(message),
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
