//! `bundlemocap replay`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;

use super::Ended;
use super::failure::{Exit, Failure, failures};
use super::overwrite::{Overwrite, check_ending};
use super::solve::decoder;
use super::terminal::{complain, say, table};
use crate::config::Config;
use crate::core::time::Timestamp;
use crate::core::tracker::Solver;
use crate::io::recording::{Provenance, RawEntry, Reader, Writer};
use crate::io::wire::{ENCODING, JournalStart, Pose, Topics, decode};
use crate::live::{
    Carried, Gap, Recorded, ReplayError, Replayed, Settings, find_nodes, platform, replay,
};

/// Run the node again on its recorded inputs and compare the outputs.
#[derive(Debug, Args)]
#[command(after_help = "\
The recording must contain all inputs since the start of a run: since `bundlemocap take start`, or since
the start of the node. The run's journal contains its settings, what was known of body, latency and
clocks, and the order and times of its inputs. If an input is missing, the replay stops there, says so
and ends with code 6. It also ends with code 6 if the node was started again during the take. If there
are several nodes, such as a front and its solvers, each is replayed. The same version gives the same
bytes on every x86-64 processor. The recording is kept in memory.

Exit code 14: the outputs differ from the recorded ones.

Examples:
  bundlemocap replay take1.mcap --verify
  bundlemocap replay session.mcap --run walk --verify
  bundlemocap replay take1.mcap --out again.mcap")]
pub(super) struct Arguments {
    /// Recording of `bundlemocap record`.
    file: PathBuf,
    /// Compare the outputs with the recorded ones, byte for byte.
    #[arg(long)]
    verify: bool,
    /// Recording to write, with the same inputs and the new outputs.
    #[arg(long, value_name = "MCAP")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Manifold weights of the node; default: the embedded weights.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Run to replay, if the recording has several: the name of a take, or the id of a run.
    #[arg(long, value_name = "RUN")]
    run: Option<String>,
    /// Only the nodes of this stage.
    #[arg(long, value_name = "NAME")]
    stage: Option<String>,
    /// Only the node of this name: a performer, a front or a solver.
    #[arg(long, value_name = "NAME")]
    actor: Option<String>,
}

impl Arguments {
    /// The failure with the name of the file.
    fn of_file(&self, failure: Failure) -> Failure {
        Failure::new(failure.exit, format!("{}: {}", self.file.display(), failure.line()))
    }
}

failures! {
    ReplayError {
        ReplayError::NoJournal { .. } => NotOurs,
        ReplayError::SeveralRuns { .. } => Usage,
        _ => Malformed,
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    if let Some(out) = &arguments.out {
        arguments.overwrite.check_beside(&arguments.file, out)?;
        check_ending(out, "mcap")?;
    }
    let (messages, take) = read(&arguments.file)?;
    let nodes = find_nodes(&messages, arguments.stage.as_deref(), arguments.actor.as_deref())
        .map_err(|error| arguments.of_file(error.into()))?;
    if let [only] = &nodes[..] {
        return one(arguments, &messages, only, take.as_deref());
    }
    if arguments.out.is_some() {
        let names: Vec<String> = nodes.iter().map(Topics::journal).collect();
        let text = format!("--out is for one node; choose it with --actor: {}", names.join(", "));
        return Err(arguments.of_file(Failure::new(Exit::Usage, text)));
    }
    let (mut exit, mut absent) = (Exit::Done, 0);
    for topics in &nodes {
        say(&format!("{}:", topics.journal()));
        let ended = match one(arguments, &messages, topics, take.as_deref()) {
            Ok(exit) => exit,
            // The run is another node's.
            Err(failure) if failure.exit == Exit::Usage && arguments.run.is_some() => {
                absent += 1;
                if absent == nodes.len() {
                    return Err(failure);
                }
                say("no such run");
                continue;
            }
            Err(failure) => {
                complain("error", &failure.line());
                failure.exit
            }
        };
        if exit == Exit::Done || ended == Exit::Differs {
            exit = ended;
        }
    }
    Ok(exit)
}

/// Replays one node, of a recording of a take if there is one.
fn one(arguments: &Arguments, messages: &[Recorded], topics: &Topics, take: Option<&str>) -> Ended {
    let prepare = |start: &JournalStart| prepare(start, arguments.weights.as_deref());
    let run = arguments.run.as_deref().or(take);
    let replayed =
        replay(messages, topics, run, prepare).map_err(|failure| arguments.of_file(failure))?;
    if let Some(path) = &arguments.out {
        write(path, messages, &replayed)?;
    }
    say(&summary(&replayed, arguments.verify));
    let others = replayed.others.join(", ");
    let own = format!("{:016x}", replayed.start.run_id);
    let is_part = arguments.run != Some(own) && !others.is_empty();
    let exit = match arguments.verify {
        true => verdict(arguments, messages, &replayed, &topics.pose(), is_part)?,
        false => Exit::Done,
    };
    if is_part {
        let file = arguments.file.display();
        let text = format!(
            "{file}: the node was started again; replay its other runs with --run: {others}"
        );
        complain("warning", &text);
    }
    let Some(Gap { what, after }) = &replayed.gap else {
        return Ok(if is_part { Exit::InPart } else { exit });
    };
    let (inputs, seconds) = (replayed.inputs, after.seconds());
    let text = format!(
        "{}: {what} is missing {seconds:.3} s after the start; replayed up to there, {inputs} \
         inputs: it did not reach the recorder",
        arguments.file.display()
    );
    complain("warning", &text);
    Ok(Exit::InPart)
}

/// All messages of the file, in file order, and the take that it was recorded for.
fn read(path: &Path) -> Result<(Vec<Recorded>, Option<String>), Failure> {
    let mut reader = Reader::open(path)?;
    let mut messages = Vec::new();
    while let Some(entry) = reader.next_raw() {
        let RawEntry { topic, schema, log_time, publish_time, payload, .. } = entry?;
        messages.push(Recorded { time: log_time, capture: publish_time, topic, schema, payload });
    }
    for lost in reader.report().losses() {
        complain("warning", &format!("{}: {lost}", path.display()));
    }
    let take = reader.own_metadata("take").cloned();
    Ok((messages, take))
}

/// The recorded settings and solver of the node.
fn prepare(start: &JournalStart, weights: Option<&Path>) -> Result<(Settings, Solver), Failure> {
    let config = Config::parse(&start.config, Path::new("the journal's settings"))?;
    let decoder = decoder(weights)?;
    let ours = format!("{:016x}", decoder.fingerprint());
    if start.weights != ours {
        let theirs = &start.weights;
        let message = format!(
            "the node used the weights {theirs}, but these are {ours}; give the right ones with \
             --weights"
        );
        return Err(Failure::new(Exit::Weights, message));
    }
    let settings = Settings {
        toml: start.config.clone(),
        body: start.body.clone(),
        carried: Carried::of(start),
        ..config.core_settings(&decoder)?
    };
    Ok((settings, Solver::new(decoder, config.tracker)))
}

/// Writes the recorded inputs and the new outputs, sorted by time.
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

/// One line per topic.
fn summary(replayed: &Replayed, with_recorded: bool) -> String {
    let mut rows = vec![("inputs".to_owned(), replayed.inputs.to_string())];
    rows.extend(replayed.topics.iter().map(|(topic, compared)| {
        let mut text = format!("{} replayed", compared.replayed);
        if with_recorded {
            text += &match compared.differs_at {
                None if replayed.gap.is_some() => {
                    format!(", {} of {} recorded, equal", compared.equal, compared.recorded)
                }
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
        rows.push(("journal".to_owned(), "ends before the node or the take did".to_owned()));
    }
    table(&rows)
}

fn verdict(
    arguments: &Arguments,
    messages: &[Recorded],
    replayed: &Replayed,
    pose_topic: &str,
    is_part: bool,
) -> Ended {
    let file = arguments.file.display();
    let compared: usize = replayed.topics.values().map(|topic| topic.equal).sum();
    let differing = replayed.topics.values().filter(|topic| !topic.agrees()).count();
    if differing == 0 && compared > 0 {
        say(&format!("{compared} messages are equal, byte for byte"));
        return Ok(Exit::Done);
    }
    // A warning says what is missing.
    if compared == 0 && differing == 0 && (is_part || replayed.gap.is_some()) {
        return Ok(Exit::InPart);
    }
    if compared == 0 {
        let message = format!("{file} has no outputs of the node to compare; record them too");
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

/// The largest distance of a joint between recorded and replayed poses, metres.
fn farthest(recorded: &[Recorded], replayed: &[Recorded], topic: &str) -> f64 {
    let joints = |message: &Recorded| decode::<Pose>(&message.payload).ok()?.joint_positions().ok();
    let of_topic = |message: &&Recorded| *message.topic == *topic;
    let of_time = replayed.iter().filter(of_topic).map(|message| (message.capture, message));
    let of_time: BTreeMap<Timestamp, &Recorded> = of_time.collect();
    let distances = recorded.iter().filter(of_topic).filter_map(|message| {
        let (a, b) = (joints(message)?, joints(of_time.get(&message.capture)?)?);
        a.iter().zip(&b).map(|(a, b)| (a - b).norm()).reduce(f64::max)
    });
    distances.fold(0.0, f64::max)
}
