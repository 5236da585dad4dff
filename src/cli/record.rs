//! `bundlemocap record`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::Args;

use super::Ended;
use super::bus::{BusArguments, open, topics};
use super::clock::{ATTENTION, Stop};
use super::failure::{Exit, Failure};
use super::inbox::{Inbox, Received};
use super::terminal::{complain, note, say, table, ticker};
use crate::config::Config;
use crate::msg::{ENCODING, schema_of};
use crate::record::{Provenance, RawEntry, RecordError, Writer};
use crate::time::Timestamp;

/// How often the file is brought up to date.
const FLUSH: Duration = Duration::from_secs(1);

/// Record everything on the bus, inputs and outputs.
#[derive(Debug, Args)]
#[command(after_help = "\
Payloads are kept byte for byte. A message is filed under the time it arrived here (log time), with
its capture time beside it (publish time). Until it ends, by Ctrl-C or SIGTERM, the recording is at
FILE.part, which can be read up to its last second whatever happens to this program.

Examples:
  bundlemocap record take1.mcap
  bundlemocap record inputs.mcap --topics 'mocap/stage/camera/**'
  bundlemocap record take1.mcap --connect tcp/192.168.1.10:7447")]
pub(super) struct Arguments {
    /// The recording to write.
    file: PathBuf,
    /// The topics to record; all of the stage if not given. `*` stands for one part, `**` for any
    /// number of them.
    #[arg(long, value_name = "PATTERN")]
    topics: Option<String>,
    /// Replace the file if it is there.
    #[arg(long)]
    overwrite: bool,
    #[command(flatten)]
    bus: BusArguments,
}

/// What was recorded.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Recorded {
    /// Messages by topic.
    pub(super) topics: BTreeMap<Arc<str>, u64>,
    /// Messages on all topics.
    pub(super) messages: u64,
    /// Bytes of payload.
    pub(super) bytes: u64,
    /// Messages that came while the queue to the disk was full.
    pub(super) dropped: u64,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let path = &arguments.file;
    if path.exists() && !arguments.overwrite {
        let fix = "choose another name, or give --overwrite";
        return Err(Failure::new(Exit::Usage, format!("{} is there; {fix}", path.display())));
    }
    let config = arguments.bus.settings()?;
    let bus = open(&config)?;
    let stop = Stop::on_signals()?;
    let pattern = arguments.topics.clone().unwrap_or_else(|| topics(&config).all());
    let inbox = Inbox::open(&*bus, &pattern)?;
    let writer = start(path, &config, &pattern)?;
    note(&format!("recording {pattern} to {}; Ctrl-C ends it", path.display()));
    let (begin, line) = (Instant::now(), ticker());
    let recorded = record(inbox, writer, &stop, |recorded| {
        line.set_message(progress(recorded, begin.elapsed()));
    })?;
    line.finish_and_clear();
    say(&table(&rows(path, &recorded, begin.elapsed())));
    if recorded.dropped == 0 {
        return Ok(Exit::Done);
    }
    let fix = "the disk is too slow; record fewer --topics, or on another disk";
    complain("warning", &format!("{} messages were dropped: {fix}", recorded.dropped));
    Ok(Exit::InPart)
}

fn start(path: &Path, config: &Config, pattern: &str) -> Result<Writer, Failure> {
    let provenance = Provenance {
        config: config.to_toml(),
        more: BTreeMap::from([("topics".into(), pattern.into())]),
        ..Provenance::default()
    };
    Ok(Writer::live(path, topics(config), &provenance)?)
}

/// Writes what comes until `stop` is set, then what still waits, and finishes the file.
/// `each_second` is told what was recorded so far.
pub(super) fn record(
    mut inbox: Inbox,
    mut writer: Writer,
    stop: &Stop,
    mut each_second: impl FnMut(&Recorded),
) -> Result<Recorded, RecordError> {
    let mut recorded = Recorded::default();
    let mut flushed = Instant::now();
    loop {
        if stop.is_set() {
            inbox.close();
        }
        match inbox.next(ATTENTION) {
            Some(received) => recorded.write(&mut writer, received)?,
            None if stop.is_set() => break,
            None => {}
        }
        if flushed.elapsed() >= FLUSH {
            flushed = Instant::now();
            writer.flush()?;
            recorded.dropped = inbox.dropped();
            each_second(&recorded);
        }
    }
    recorded.dropped = inbox.dropped();
    writer.finish()?;
    Ok(recorded)
}

impl Recorded {
    fn write(&mut self, writer: &mut Writer, received: Received) -> Result<(), RecordError> {
        let entry = entry(received);
        writer.write_raw(&entry)?;
        self.messages += 1;
        self.bytes += entry.payload.len() as u64;
        *self.topics.entry(entry.topic).or_default() += 1;
        Ok(())
    }
}

/// How a message from the bus is filed.
fn entry(Received { sample, arrival }: Received) -> RawEntry {
    let schema = schema_of(&sample.topic, &sample.encoding);
    let said_when = sample.capture > Timestamp::default();
    RawEntry {
        topic: sample.topic,
        schema: schema.unwrap_or_default().into(),
        encoding: if schema.is_some() { ENCODING.into() } else { sample.encoding },
        log_time: arrival,
        publish_time: if said_when { sample.capture } else { arrival },
        payload: sample.payload,
    }
}

fn progress(recorded: &Recorded, elapsed: Duration) -> String {
    let Recorded { messages, bytes, dropped, .. } = recorded;
    let dropped = if *dropped > 0 { format!(", {dropped} DROPPED") } else { String::new() };
    let megabytes = *bytes as f64 * 1e-6;
    format!("{:.0} s, {messages} messages, {megabytes:.1} MB{dropped}", elapsed.as_secs_f64())
}

fn rows(path: &Path, recorded: &Recorded, elapsed: Duration) -> Vec<(String, String)> {
    let topics = recorded.topics.iter();
    let topics = topics.map(|(topic, count)| (topic.to_string(), format!("{count} messages")));
    let file = (path.display().to_string(), progress(recorded, elapsed));
    topics.chain([file]).collect()
}
