//! `bundlemocap replay`

use std::path::{Path, PathBuf};

use clap::Args;

use super::Ended;
use super::bus::{BusArguments, topics};
use super::failure::{Exit, Failure};
use super::figures::losses;
use super::solve::decoder;
use super::terminal::{complain, say, table};
use crate::config::Config;
use crate::msg::{ENCODING, JournalStart, Pose, Topics, decode};
use crate::node::{Recorded, ReplayError, Replayed, Settings, platform, replay};
use crate::record::{Provenance, RawEntry, Reader, Writer};
use crate::track::Solver;

/// Run the node's machine again on what it was told in a recording.
#[derive(Debug, Args)]
#[command(after_help = "\
The recording must hold all that the node was told since it started: begin to record before the
cameras play, and restart the node for another take. Its journal says in what order, at what times and with what iteration counts; the settings are in it
too. The same version gives the same bytes on every x86-64 processor. The recording is held in
memory.

Exit code 14 means that what came out differs from what was recorded.

Examples:
  bundlemocap replay take1.mcap --verify
  bundlemocap replay take1.mcap --out again.mcap")]
pub(super) struct Arguments {
    /// A recording of `bundlemocap record`.
    file: PathBuf,
    /// Compare what comes out with what was recorded, byte for byte.
    #[arg(long)]
    verify: bool,
    /// Write a recording of the same inputs with what comes out now.
    #[arg(long, value_name = "MCAP")]
    out: Option<PathBuf>,
    /// Weights of the manifold that the node had; the embedded ones if not given.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    #[command(flatten)]
    bus: BusArguments,
}

impl From<ReplayError> for Failure {
    fn from(error: ReplayError) -> Self {
        let exit = match error {
            ReplayError::NoJournal { .. } => Exit::NotOurs,
            _ => Exit::Malformed,
        };
        Self::new(exit, error.to_string())
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let topics = topics(&arguments.bus.settings()?);
    let messages = read(&arguments.file)?;
    let replayed = replay(&messages, &topics, |start| prepare(start, arguments.weights.as_deref()))
        .map_err(|failure: Failure| {
            Failure::new(failure.exit, format!("{}: {}", arguments.file.display(), failure.line()))
        })?;
    if let Some(path) = &arguments.out {
        write(path, &messages, &replayed)?;
    }
    say(&summary(&replayed, arguments.verify));
    if !arguments.verify {
        return Ok(Exit::Done);
    }
    verdict(arguments, &messages, &replayed, &topics.pose())
}

/// Every message of the file, in its order.
fn read(path: &Path) -> Result<Vec<Recorded>, Failure> {
    let mut reader = Reader::open(path)?;
    let mut messages = Vec::new();
    while let Some(entry) = reader.next_raw() {
        let RawEntry { topic, schema, log_time, publish_time, payload, .. } = entry?;
        messages.push(Recorded { time: log_time, capture: publish_time, topic, schema, payload });
    }
    for lost in losses(reader.report()) {
        complain("warning", &format!("{}: {lost}", path.display()));
    }
    Ok(messages)
}

/// The settings and the solver that the node had.
fn prepare(start: &JournalStart, weights: Option<&Path>) -> Result<(Settings, Solver), Failure> {
    let config = Config::parse(&start.config, Path::new("the journal's settings"))?;
    let decoder = decoder(weights)?;
    let ours = format!("{:016x}", decoder.fingerprint());
    if start.weights != ours {
        let theirs = &start.weights;
        let message = format!(
            "the node had the weights {theirs}, these are {ours}; give the file with --weights"
        );
        return Err(Failure::new(Exit::Weights, message));
    }
    let (track, node) = (config.track, config.node.clone());
    let settings = Settings { track, node, toml: start.config.clone(), weights: ours };
    Ok((settings, Solver::new(decoder, track)))
}

/// Writes the inputs as they were recorded, and what came out, by time.
fn write(path: &Path, messages: &[Recorded], replayed: &Replayed) -> Result<(), Failure> {
    let provenance = Provenance {
        config: replayed.start.config.clone(),
        weights: replayed.start.weights.clone(),
        ..Provenance::default()
    };
    let is_input = |message: &&Recorded| !replayed.topics.contains_key(&*message.topic);
    let mut all: Vec<&Recorded> =
        messages.iter().filter(is_input).chain(replayed.outputs()).collect();
    all.sort_by_key(|message| message.time);
    let mut writer = Writer::create(path, Topics::default(), &provenance)?;
    for Recorded { time, capture, topic, schema, payload } in all.into_iter().cloned() {
        let (log_time, publish_time, encoding) = (time, capture, ENCODING.into());
        let entry = RawEntry { topic, schema, encoding, log_time, publish_time, payload };
        writer.write_raw(&entry)?;
    }
    Ok(writer.finish()?)
}

/// A line for each topic.
fn summary(replayed: &Replayed, with_recorded: bool) -> String {
    let mut rows = vec![("inputs".to_owned(), replayed.inputs.to_string())];
    rows.extend(replayed.topics.iter().map(|(topic, compared)| {
        let mut text = format!("{} replayed", compared.replayed);
        if with_recorded {
            text += &match compared.differs_at {
                None if compared.unrecorded() > 0 => {
                    let lost = compared.unrecorded();
                    format!(", {} recorded, equal; {lost} not recorded", compared.recorded)
                }
                None => format!(", {} recorded, equal", compared.recorded),
                Some(at) => format!(", {} recorded, number {at} differs", compared.recorded),
            };
        }
        (topic.clone(), text)
    }));
    if !replayed.is_whole {
        rows.push(("journal".to_owned(), "ends before the node did".to_owned()));
    }
    table(&rows)
}

fn verdict(
    arguments: &Arguments,
    messages: &[Recorded],
    replayed: &Replayed,
    pose_topic: &str,
) -> Ended {
    let file = arguments.file.display();
    let compared: usize = replayed.topics.values().map(|topic| topic.equal).sum();
    let differing = replayed.topics.values().filter(|topic| !topic.agrees()).count();
    if differing == 0 && compared > 0 {
        say(&format!("{compared} messages are equal, byte for byte"));
        return Ok(Exit::Done);
    }
    if compared == 0 {
        let message = format!("{file}: nothing to compare; record the node's outputs too");
        return Err(Failure::new(Exit::NotOurs, message));
    }
    let ours = platform();
    let why = match ours == replayed.start.platform {
        true => format!("recorded by version {}", replayed.start.version),
        false => format!("recorded on {}, this is {ours}", replayed.start.platform),
    };
    let apart = farthest(messages, &replayed.outputs, pose_topic) * 1e3;
    let message = format!(
        "{file}: {differing} topics differ from the recording ({why}); joints are at most \
         {apart:.4} mm apart"
    );
    Err(Failure::new(Exit::Differs, message))
}

/// The largest distance of a joint between poses of the same place in their topic, metres.
fn farthest(recorded: &[Recorded], replayed: &[Recorded], topic: &str) -> f64 {
    let joints = |message: &Recorded| decode::<Pose>(&message.payload).ok()?.joint_positions().ok();
    let of_topic = |message: &&Recorded| *message.topic == *topic;
    let pairs = recorded.iter().filter(of_topic).zip(replayed.iter().filter(of_topic));
    let distances = pairs.filter_map(|(a, b)| {
        let (a, b) = (joints(a)?, joints(b)?);
        a.iter().zip(&b).map(|(a, b)| (a - b).norm()).reduce(f64::max)
    });
    distances.fold(0.0, f64::max)
}
