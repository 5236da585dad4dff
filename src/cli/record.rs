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
use super::terminal::{complain, note, say, table, ticker};
use crate::config::Config;
use crate::core::time::Timestamp;
use crate::io::recording::{Provenance, RawEntry, RecordError, Writer};
use crate::io::wire::{ENCODING, schema_of};
use crate::live::tools::inbox::{Inbox, Received};

/// How often the file is flushed.
const FLUSH: Duration = Duration::from_secs(1);

/// Record all messages on the bus, inputs and outputs.
#[derive(Debug, Args)]
#[command(after_help = "\
Payloads are kept byte for byte. The log time of a message is its arrival time here, the publish time
is its capture time. Until Ctrl-C or SIGTERM the recording is at FILE.part; if this program dies, that
file is readable up to its last second.

Examples:
  bundlemocap record take1.mcap
  bundlemocap record inputs.mcap --topics 'mocap/stage/camera/**'
  bundlemocap record take1.mcap --connect tcp/192.168.1.10:7447")]
pub(super) struct Arguments {
    /// Recording to write.
    file: PathBuf,
    /// Topics to record; default: all topics of the stage. `*` matches one part, `**` any number.
    #[arg(long, value_name = "PATTERN")]
    topics: Option<String>,
    /// Replace an existing file.
    #[arg(long)]
    overwrite: bool,
    #[command(flatten)]
    bus: BusArguments,
}

/// Counts of the recorded messages.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Recorded {
    /// Messages by topic.
    pub(super) topics: BTreeMap<Arc<str>, u64>,
    /// Messages on all topics.
    pub(super) messages: u64,
    /// Bytes of payload.
    pub(super) bytes: u64,
    /// Messages that were dropped because the queue to the disk was full.
    pub(super) dropped: u64,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let path = &arguments.file;
    if path.exists() && !arguments.overwrite {
        let fix = "choose another name, or use --overwrite";
        return Err(Failure::new(Exit::Usage, format!("{} exists; {fix}", path.display())));
    }
    let config = arguments.bus.settings()?;
    let bus = open(&config)?;
    let stop = Stop::on_signals()?;
    let pattern = arguments.topics.clone().unwrap_or_else(|| topics(&config).all());
    let inbox = Inbox::open(&*bus, &pattern)?;
    let writer = start(path, &config, &pattern)?;
    note(&format!("recording {pattern} to {}; stop with Ctrl-C", path.display()));
    let (begin, line) = (Instant::now(), ticker());
    let recorded = record(inbox, writer, &stop, |recorded| {
        line.set_message(progress(recorded, begin.elapsed()));
    })?;
    line.finish_and_clear();
    say(&table(&rows(path, &recorded, begin.elapsed())));
    if recorded.dropped == 0 {
        return Ok(Exit::Done);
    }
    let fix = "the disk is too slow; record fewer topics with --topics, or use another disk";
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

/// Writes messages until a stop request, then the remaining ones, and finishes the file.
/// `each_second` gets the counts so far.
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

/// The recorded entry of a message.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::bus::{Bus, Memory};
    use crate::io::recording::{Message, Reader};
    use crate::io::wire::{Event, Topics, encode, media_type};

    fn event(count: u64) -> Event {
        Event { kind: "late".into(), count, ..Event::default() }
    }

    fn set() -> Stop {
        let stop = Stop::default();
        stop.stop();
        stop
    }

    fn writer(path: &Path) -> Writer {
        Writer::live(path, Topics::default(), &Provenance::default()).unwrap()
    }

    #[test]
    fn everything_on_the_bus_is_kept_byte_for_byte() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("take.mcap");
        let (bus, topics) = (Memory::new(), Topics::default());
        let inbox = Inbox::open(&bus, &topics.all()).unwrap();
        let put = |topic: &str, encoding: &str, payload: &[u8]| {
            let publisher = bus.publisher(topic).unwrap();
            publisher.put(Timestamp::from_ns(70), encoding, payload).unwrap();
        };
        let typed = media_type("bundlemocap.v1.Event");
        put(&topics.stage_events(), &typed, &encode(&event(1)));
        put(&topics.stage_events(), "", &encode(&event(2)));
        put(&topics.stage_events(), &typed, b"\xff\xff");
        put("mocap/stage/mixer/gain", "application/json", b"{}");
        put("mocap/other/rig", "", b"not of this stage");

        let recorded = record(inbox, writer(&path), &set(), |_| {}).unwrap();
        assert_eq!((recorded.messages, recorded.dropped, recorded.topics.len()), (4, 0, 2));
        let mut reader = Reader::open(&path).unwrap();
        let mut raw = Vec::new();
        while let Some(entry) = reader.next_raw() {
            raw.push(entry.unwrap());
        }
        let payloads: Vec<&[u8]> = raw.iter().map(|entry| entry.payload.as_slice()).collect();
        assert_eq!(payloads, [&encode(&event(1))[..], &encode(&event(2)), b"\xff\xff", b"{}"]);
        let schemas: Vec<&str> = raw.iter().map(|entry| &*entry.schema).collect();
        assert_eq!(schemas[2..], ["bundlemocap.v1.Event", ""]);
        assert_eq!(&*raw[3].encoding, "application/json");
        assert!(raw.iter().all(|entry| entry.publish_time.ns() == 70));
        assert!(raw.iter().all(|entry| entry.log_time.ns() > 1_600_000_000_000_000_000));

        let mut reader = Reader::open(&path).unwrap();
        let messages: Vec<Message> = reader.by_ref().map(|entry| entry.unwrap().message).collect();
        assert_eq!(messages[..2], [1, 2].map(|count| Message::Event(event(count))));
        assert_eq!(reader.report().undecodable[&topics.stage_events()].count, 1);
        assert!(!folder.path().join("take.mcap.part").exists());
    }

    #[test]
    fn what_does_not_fit_the_queue_is_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("take.mcap");
        let (bus, topics) = (Memory::new(), Topics::default());
        let by_count = Inbox::of_size(&bus, &[&topics.all()], 3, usize::MAX).unwrap();
        let by_bytes = Inbox::of_size(&bus, &[&topics.all()], 100, 25).unwrap();
        let publisher = bus.publisher(&topics.stage_events()).unwrap();
        for _ in 0..10 {
            publisher.put(Timestamp::default(), "", &[0; 10]).unwrap();
        }
        let recorded = record(by_count, writer(&path), &set(), |_| {}).unwrap();
        assert_eq!((recorded.messages, recorded.dropped), (3, 7));
        let recorded = record(by_bytes, writer(&path), &set(), |_| {}).unwrap();
        assert_eq!((recorded.messages, recorded.bytes, recorded.dropped), (2, 20, 8));
    }

    #[test]
    fn a_recording_that_was_cut_short_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("take.mcap");
        std::fs::write(folder.path().join("take.mcap.part"), "precious").unwrap();
        let live = Writer::live(&path, Topics::default(), &Provenance::default());
        let error = Failure::from(live.err().unwrap()).line();
        assert!(error.contains("take.mcap.part") && error.contains("rename"), "{error}");
        assert_eq!(std::fs::read(folder.path().join("take.mcap.part")).unwrap(), b"precious");
    }
}
