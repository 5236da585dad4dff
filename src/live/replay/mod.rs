//! Runs the core on the recorded inputs of a node and compares the outputs with the recording.
//!
//! The journal holds order and times of the inputs; the messages are found by topic and hash. A job
//! is solved when the journal says that its solution arrived. So the outputs are equal, byte for
//! byte.

pub(super) mod compare;

use std::collections::{BTreeMap, HashMap};

use crate::core::fnv::fnv1a;
use crate::core::stage::PerformerId;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{Job, Solver};
use crate::io::wire::journal_entry::Input as Entry;
use crate::io::wire::{
    DecodeError, Journal, JournalEntry, JournalMessage, JournalStart, Schema, StageChannel, Take,
    Topic, Topics, decode, valid_name,
};
use crate::live::core::Core;
use crate::live::core::journal;
use crate::live::core::port::{Input, Output, Settings};
use crate::live::core::take::ends;
use compare::{At, Comparison, Recorded, compare};

/// Why a recording cannot be replayed. Its text says what is wrong, with units.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum ReplayError {
    /// `asked` and `found` are parts of the message; they may be empty.
    #[error(
        "there is no journal{asked}; give a recording of a node, made by `bundlemocap record`{found}"
    )]
    NoJournal { asked: String, found: String },
    /// `first` is the number of the journal's first message.
    #[error(
        "the journal begins with number {first}: recording began later than the run; use \
         `bundlemocap take start NAME`, or start `bundlemocap record` before the cameras"
    )]
    Begun { first: u64 },
    /// `why` is what is wrong with the given name, if there is one.
    #[error("{why}choose one of the recorded runs with --run: {found}")]
    SeveralRuns { why: String, found: String },
    /// `index` is the number of entries before it.
    #[error(
        "message {index} of the journal, {bytes_hash:016x} on {topic}, is not in the recording"
    )]
    Missing { index: u64, topic: String, bytes_hash: u64 },
    /// `index` is the number of entries before it.
    #[error("entry {index} of the journal cannot be replayed: {reason}")]
    Senseless { index: u64, reason: String },
    /// A journal that cannot be decoded.
    #[error(transparent)]
    Decode(#[from] DecodeError),
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
    /// Whether the journal reaches the end of the node or of the take.
    pub is_whole: bool,
    /// Ids of later runs of this node within the same take: it was started again.
    pub others: Vec<String>,
    /// What was missing, if the replay stopped early.
    pub gap: Option<Gap>,
}

/// An input that is not in the recording; the replay stops before it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gap {
    /// What is missing.
    pub what: String,
    /// When, since the run's first input.
    pub after: Nanos,
}

impl Replayed {
    /// The outputs on the topics that were compared; calibrations are inputs and not included.
    pub fn outputs(&self) -> impl Iterator<Item = &Recorded> {
        self.outputs.iter().filter(|message| self.topics.contains_key(&*message.topic))
    }
}

/// Finds the nodes whose journals are in a recording: those of a stage and an actor, if given.
///
/// # Errors
/// There is none.
pub fn find_nodes(
    messages: &[Recorded],
    stage: Option<&str>,
    actor: Option<&str>,
) -> Result<Vec<Topics>, ReplayError> {
    let nodes = messages.iter().filter(|message| *message.schema == *Journal::FULL_NAME);
    let nodes = nodes.filter_map(|message| Topic::parse(&message.topic).ok()?.topics());
    let nodes: BTreeMap<String, Topics> = nodes.map(|topics| (topics.journal(), topics)).collect();
    let is_asked_for = |topics: &&Topics| {
        stage.is_none_or(|stage| stage == topics.stage)
            && actor.is_none_or(|actor| actor == topics.actor)
    };
    let found: Vec<Topics> = nodes.values().filter(is_asked_for).cloned().collect();
    if found.is_empty() {
        let asked = [("stage", stage), ("actor", actor)].into_iter();
        let asked = asked.filter_map(|(what, name)| Some(format!(" of {what} {:?}", name?)));
        let all: Vec<String> = nodes.into_keys().collect();
        let found = match all.is_empty() {
            true => String::new(),
            false => format!(", or choose one of {}", all.join(", ")),
        };
        return Err(ReplayError::NoJournal { asked: asked.collect(), found });
    }
    Ok(found)
}

/// The journal of one run, as far as it has no gap.
struct Entries {
    id: String,
    /// The take that began the run, or that it joined; empty: none.
    take: String,
    entries: Vec<JournalEntry>,
    /// Number of the first missing part, if later ones are there.
    missing: Option<u64>,
    end: End,
}

/// How a run ends.
#[derive(Clone, Copy, PartialEq, Eq)]
enum End {
    /// With its take, or because a take begins.
    Take,
    /// With the node.
    Node,
    /// The journal does not reach it.
    Unknown,
}

impl Entries {
    /// Joins the parts, up to the first gap. `parts` are by number and begin with 0.
    fn of(id: u64, parts: BTreeMap<u64, Journal>) -> Self {
        let count = parts.len() as u64;
        let whole =
            parts.keys().zip(0..).take_while(|(number, expected)| *number == expected).count();
        let entries = parts.into_values().take(whole).flat_map(|part| part.entries);
        let entries: Vec<JournalEntry> = entries.collect();
        let take = entries.iter().find_map(|entry| match &entry.input {
            Some(Entry::Start(start)) if !start.take.is_empty() => Some(start.take.clone()),
            Some(Entry::Message(message)) => {
                let take = slate(message).filter(|take| take.action == "join");
                take.filter(|take| valid_name(&take.name).is_ok()).map(|take| take.name)
            }
            _ => None,
        });
        let take = take.unwrap_or_default();
        let missing = Some(whole as u64).filter(|whole| *whole < count);
        Self { id: format!("{id:016x}"), end: end(&entries, &take), take, entries, missing }
    }

    /// The node's time of the first entry, ns.
    fn begin_ns(&self) -> i64 {
        self.entries.first().map_or(0, |first| first.time_ns)
    }
}

/// The journal of a run, and the ids of later runs within the same take. `asked` is the run's id, or the name of its take
/// (then it is the first run). Without it, the recording must have only one run from its beginning.
fn journal(
    messages: &[Recorded],
    topics: &Topics,
    asked: Option<&str>,
) -> Result<(Entries, Vec<String>), ReplayError> {
    let topic = topics.journal();
    let mut runs: BTreeMap<u64, BTreeMap<u64, Journal>> = BTreeMap::new();
    for message in messages.iter().filter(|message| *message.topic == *topic) {
        // Others may publish anything there.
        let part = decode::<Journal>(&message.payload).ok();
        let Some(part) = part.filter(|part| !part.entries.is_empty()) else { continue };
        runs.entry(part.run_id).or_default().entry(part.sequence).or_insert(part);
    }
    let first = runs.values().filter_map(|parts| parts.keys().next()).min().copied();
    let Some(first) = first else {
        let asked = format!(" on {topic}");
        return Err(ReplayError::NoJournal { asked, found: String::new() });
    };
    runs.retain(|_, parts| parts.contains_key(&0));
    if runs.is_empty() {
        return Err(ReplayError::Begun { first });
    }
    let mut runs: Vec<Entries> =
        runs.into_iter().map(|(id, parts)| Entries::of(id, parts)).collect();
    runs.sort_by_key(Entries::begin_ns);
    let is_asked = |run: &Entries| asked.is_none_or(|name| *name == run.id || *name == run.take);
    let several = |why: &str| {
        let why = asked.map_or(String::new(), |name| format!("{why} {name}; "));
        let list = runs.iter().map(|Entries { id, take, .. }| match take.as_str() {
            "" => id.clone(),
            take => format!("{id} (take {take})"),
        });
        ReplayError::SeveralRuns { why, found: list.collect::<Vec<_>>().join(", ") }
    };
    let none = || several("there is no run or take");
    let at = runs.iter().position(is_asked).ok_or_else(none)?;
    let take = &runs[at].take;
    let (mut end, mut others) = (runs[at].end, Vec::new());
    for later in &runs[at + 1..] {
        let is_within = match end {
            End::Take => false,
            End::Node => !take.is_empty() && later.take == *take,
            End::Unknown => later.take.is_empty() || later.take == *take,
        };
        if is_asked(later) && (asked.is_none() || !is_within) {
            return Err(several("several are called"));
        }
        if is_within {
            others.push(later.id.clone());
            end = later.end;
        }
    }
    Ok((runs.swap_remove(at), others))
}

/// How the run of that take, or of none, ends in these entries. A take that waits to begin may be stopped before.
fn end(entries: &[JournalEntry], running: &str) -> End {
    let mut waiting: Option<String> = None;
    for entry in entries {
        match &entry.input {
            Some(Entry::End(_)) => return End::Node,
            Some(Entry::Message(message)) => {
                let Some(take) = slate(message) else { continue };
                match (&*take.action, ends(&take, running)) {
                    ("stop", true) => return End::Take,
                    ("stop", false) => {
                        waiting.take_if(|one| take.name.is_empty() || *one == take.name);
                    }
                    (_, true) => waiting = Some(take.name),
                    _ => {}
                }
            }
            _ => {}
        }
    }
    if waiting.is_some() { End::Take } else { End::Unknown }
}

fn slate(JournalMessage { topic, payload, .. }: &JournalMessage) -> Option<Take> {
    let is_slate =
        matches!(Topic::parse(topic), Ok(Topic::Stage { channel: StageChannel::Take, .. }));
    decode::<Take>(payload.as_ref().filter(|_| is_slate)?).ok()
}

/// Runs a core on a journal up to its end, or to the first input that is missing. `run` is the id of a
/// run or the name of a take, if the recording has several. `prepare` makes settings and solver from
/// the first entry.
///
/// # Errors
/// There is no journal of that run from its beginning, there are several, or an entry is senseless.
pub fn replay<E: From<ReplayError>>(
    messages: &[Recorded],
    topics: &Topics,
    run: Option<&str>,
    prepare: impl FnOnce(&JournalStart) -> Result<(Settings, Solver), E>,
) -> Result<Replayed, E> {
    let (Entries { entries, missing, end, .. }, others) = journal(messages, topics, run)?;
    let mut entries = entries.into_iter();
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
    let is_whole = end != End::Unknown;
    let mut last = begin;
    let mut inputs = 1;
    let mut gap = None;
    for (index, entry) in (1..).zip(entries) {
        last = Timestamp::from_ns(entry.time_ns);
        match run.input(index, entry) {
            Ok(input) => run.give(last, input),
            Err(ReplayError::Missing { topic, .. }) => {
                gap = Some(format!("a message on {topic}"));
                break;
            }
            Err(error) => return Err(error.into()),
        }
        inputs += 1;
    }
    let gap = gap.or_else(|| missing.map(|number| format!("part {number} of the journal")));
    let gap = gap.map(|what| Gap { what, after: last - begin });
    let outputs = run.outputs;
    let at = At { begin, end: last, run: start.run_id };
    let topics = compare(messages, &outputs, topics, &at, gap.is_some());
    Ok(Replayed { start, inputs, topics, outputs, is_whole, gap, others })
}

/// A core that gets its inputs from a journal.
struct Run<'a> {
    core: Core,
    solver: Solver,
    by_hash: HashMap<(&'a str, u64), &'a [u8]>,
    jobs: HashMap<(PerformerId, u64), Box<Job>>,
    outputs: Vec<Recorded>,
}

impl<'a> Run<'a> {
    fn new(messages: &'a [Recorded], core: Core, solver: Solver) -> Self {
        let keyed = messages.iter().map(|message| {
            ((&*message.topic, fnv1a(&message.payload)), message.payload.as_slice())
        });
        Self { core, solver, by_hash: keyed.collect(), jobs: HashMap::new(), outputs: Vec::new() }
    }

    fn input(&mut self, index: u64, entry: JournalEntry) -> Result<Input, ReplayError> {
        let senseless = |reason: String| ReplayError::Senseless { index, reason };
        Ok(match entry.input {
            Some(Entry::Message(message)) => self.message(index, message)?,
            Some(Entry::Solved(solved)) => {
                let performer = PerformerId(solved.performer as usize);
                let job = self.jobs.remove(&(performer, solved.job));
                let job = job.ok_or_else(|| senseless(format!("job {} is not out", solved.job)))?;
                let solution = Box::new(self.solver.solve(&job));
                Input::Solved {
                    performer,
                    solution,
                    took: Nanos::new(i64::try_from(solved.took_ns).unwrap_or(i64::MAX)),
                }
            }
            Some(Entry::Solvers(solvers)) => Input::Solvers(solvers.names),
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
                Output::Solve { performer, job, .. } => {
                    self.jobs.insert((performer, job.number), job);
                }
                Output::Publish(publication) => {
                    let (schema, payload) = publication.content.encoded();
                    self.outputs.push(Recorded {
                        time: publication.due.unwrap_or(now),
                        capture: publication.capture,
                        topic: publication.topic,
                        schema: schema.into(),
                        payload,
                    });
                }
                Output::Wake(_) | Output::Mended { .. } | Output::Body { .. } => {}
            }
        }
    }
}
