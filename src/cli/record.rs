//! `bundlemocap record`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;

use super::Ended;
use super::bus::{BusArguments, open, topics};
use super::clock::{ATTENTION, PATIENCE, Stop};
use super::failure::{Exit, Failure};
use super::overwrite::{Overwrite, check_ending};
use super::terminal::{complain, note, say, table, ticker};
use crate::cli::tools::inbox::{Inbox, Received};
use crate::cli::tools::recorder::{Recorded, Recorder, Said};
use crate::cli::tools::room::room;
use crate::config::Config;
use crate::core::time::Timestamp;
use crate::io::bus::{Bus, BusError, Guard, Publisher, matches};
use crate::io::recording::{Provenance, RawEntry, RecordError};
use crate::io::wire::{
    ENCODING, Schema, StageChannel, TakeAnswer, Topic, Topics, decode, encode, media_type,
    schema_of,
};
use crate::live::WallClock;

/// How often the files are flushed.
const FLUSH: Duration = Duration::from_secs(1);
/// How often recorders publish the free space of their disk.
const FREE_SPACE: Duration = Duration::from_secs(10);
/// How long a node may take to answer with its calibration.
const QUERY: Duration = Duration::from_millis(300);

/// Record all messages on the bus, inputs and outputs, and takes.
#[derive(Debug, Args)]
#[command(after_help = "\
Payloads are kept byte for byte. The log time of a message is its arrival time here, the publish time
is its capture time. Until Ctrl-C or SIGTERM the recording is at FILE.part; if this program dies, that
file is readable up to its last second. Recording stops before the disk is full. A recorder of
takes goes on: it ends the take, and begins others when there is room again. Every ten seconds the
recorder publishes the free space of its disk. These messages are not recorded.

`bundlemocap take start NAME` begins NAME.mcap beside FILE, with a journal of its own, and `take stop`
ends it. If there is a NAME.mcap, it is NAME_2.mcap and so on. A take that runs already is recorded from
there on. If FILE is a folder, or ends with /, only takes are recorded; the folder is created if missing.

Examples:
  bundlemocap record take1.mcap
  bundlemocap record takes/
  bundlemocap record inputs.mcap --topics 'mocap/stage/camera/**'
  bundlemocap record take1.mcap --connect tcp/192.168.1.10:7447")]
pub(super) struct Arguments {
    /// Recording to write, or a folder for takes.
    file: PathBuf,
    /// Topics to record; default: all topics of the stage. `*` matches one part, `**` any number.
    #[arg(long, value_name = "PATTERN")]
    topics: Option<String>,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    bus: BusArguments,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let path = &arguments.file;
    let is_folder = path.is_dir() || path.as_os_str().as_encoded_bytes().ends_with(b"/");
    if is_folder {
        let made = std::fs::create_dir_all(path);
        made.map_err(|source| RecordError::Write { path: path.clone(), source })?;
    } else {
        check_ending(path, "mcap")?;
        arguments.overwrite.check(path)?;
    }
    let config = arguments.bus.settings()?;
    let topics = topics(&config);
    if arguments.bus.actor().is_some() {
        let Topics { stage, actor } = &topics;
        let text = format!(
            "--actor: all performers are recorded; choose one with --topics \
             'mocap/{stage}/actor/{actor}/**'"
        );
        return Err(Failure::new(Exit::Usage, text));
    }
    let bus = open(&config)?;
    let stop = Stop::on_signals()?;
    let pattern = arguments.topics.clone().unwrap_or_else(|| topics.all());
    let mut patterns = vec![pattern.clone()];
    patterns.extend(Some(topics.take()).filter(|take| !matches(&pattern, take)));
    let inbox = Inbox::open_all(&*bus, &patterns)?;
    let folder = match path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        _ if is_folder => path,
        Some(folder) => folder,
        None => Path::new("."),
    };
    let file = Some(path.as_path()).filter(|_| !is_folder);
    let mut recorder =
        Recorder::start(file, folder, topics.clone(), provenance(&config, &pattern))?;
    for rig in
        bus.query(&topics.rig(), QUERY)?.into_iter().filter(|_| matches(&pattern, &topics.rig()))
    {
        recorder.write(entry(Received { sample: rig, arrival: WallClock::start().now() }))?;
    }
    let what = if is_folder { "takes of " } else { "" };
    note(&format!("recording {what}{pattern} to {}; stop with Ctrl-C", path.display()));
    let (begin, line) = (Instant::now(), ticker());
    let mut answers = Answers::open(&*bus, &topics)?;
    let room = || room(folder);
    let nothing =
        format!("no messages on {pattern}; check --stage, --topics and whether the node runs");
    let mut is_said = is_folder;
    let (recorded, is_stopped) = record(inbox, recorder, &mut answers, &stop, room, |recorded| {
        line.set_message(progress(recorded, begin.elapsed()));
        if recorded.messages == 0 && begin.elapsed() > PATIENCE && !is_said {
            is_said = true;
            complain("warning", &nothing);
        }
    })?;
    line.finish_and_clear();
    if !is_folder {
        say(&table(&rows(path, &recorded, begin.elapsed())));
    }
    if recorded.dropped > 0 {
        let fix = "the disk is too slow; record fewer topics with --topics, or use another disk";
        complain("warning", &format!("{} messages were dropped: {fix}", recorded.dropped));
    }
    let is_empty = !is_folder && recorded.messages == 0;
    if is_empty && !is_said {
        complain("warning", &nothing);
    }
    let lost = recorded.dropped + recorded.skipped + recorded.failed;
    let is_all = lost == 0 && !is_stopped && !is_empty;
    Ok(if is_all { Exit::Done } else { Exit::InPart })
}

fn provenance(config: &Config, pattern: &str) -> Provenance {
    Provenance {
        config: config.to_toml(),
        more: BTreeMap::from([("topics".into(), pattern.into())]),
        ..Provenance::default()
    }
}

/// Where answers to slates are published, and the running take is announced.
struct Answers<'a> {
    publisher: Box<dyn Publisher>,
    bus: &'a dyn Bus,
    topics: &'a Topics,
    announced: Option<(String, Option<Box<dyn Guard>>)>,
}

impl<'a> Answers<'a> {
    fn open(bus: &'a dyn Bus, topics: &'a Topics) -> Result<Self, BusError> {
        let publisher = bus.publisher(&topics.take_answers())?;
        Ok(Self { publisher, bus, topics, announced: None })
    }

    /// Announces the take that is recorded: a node that starts during it takes part.
    fn announce(&mut self, take: Option<&str>) {
        if take == self.announced.as_ref().map(|(before, _)| before.as_str()) {
            return;
        }
        let announced = |name: &str| match self.bus.announce(&self.topics.recorded_take(name)) {
            Ok(guard) => Some(guard),
            Err(error) => {
                complain("warning", &format!("cannot announce the take: {error}"));
                None
            }
        };
        self.announced = take.map(|name| (name.to_owned(), announced(name)));
    }

    /// Answers slates, and prints the rest.
    fn say(&self, all: Vec<Said>) {
        for said in all {
            match said {
                Said::Warning(text) => complain("warning", &text),
                Said::Answer(id, done) => {
                    let refused = done.is_err();
                    let text = done.unwrap_or_else(|why| why);
                    note(&text);
                    self.put(TakeAnswer { id, text, refused, ..TakeAnswer::default() });
                }
            }
        }
    }

    /// Publishes how many bytes are free.
    fn send_free_space(&self, free_bytes: u64) {
        // 0 would be an answer.
        self.put(TakeAnswer { free_bytes: free_bytes.max(1), ..TakeAnswer::default() });
    }

    fn put(&self, answer: TakeAnswer) {
        let answer = TakeAnswer { role: "recorder".into(), ..answer };
        let encoding = media_type(TakeAnswer::FULL_NAME);
        if let Err(error) = self.publisher.put(Timestamp::default(), &encoding, &encode(&answer)) {
            complain("warning", &format!("cannot answer: {error}"));
        }
    }
}

/// Writes messages until a stop request or until there is no `room`, then the remaining ones, and
/// finishes the files. `each_second` gets the counts so far. The second value is whether there was no
/// room.
fn record(
    mut inbox: Inbox,
    mut recorder: Recorder,
    answers: &mut Answers,
    stop: &Stop,
    room: impl Fn() -> Option<u64>,
    mut each_second: impl FnMut(&Recorded),
) -> Result<(Recorded, bool), RecordError> {
    let (mut flushed, clock) = (Instant::now(), WallClock::start());
    let mut sent: Option<Instant> = None;
    let mut is_full = false;
    loop {
        if stop.is_set() || is_full {
            inbox.close();
        }
        match inbox.next(ATTENTION) {
            Some(_) if is_full => {}
            Some(received) => {
                if is_free_space(&received) {
                    continue;
                }
                let arrival = received.arrival;
                let sample = &received.sample;
                if let Some(take) = recorder.command(&sample.topic, &sample.payload) {
                    answers.say(recorder.slate(&take, arrival)?);
                }
                answers.say(recorder.write(entry(received))?);
            }
            None if stop.is_set() || is_full => break,
            // All that came before is written.
            None => answers.say(recorder.tick(clock.now())?),
        }
        answers.announce(recorder.running());
        if flushed.elapsed() >= FLUSH {
            flushed = Instant::now();
            let free = room();
            if let Some(free) =
                free.filter(|_| sent.is_none_or(|sent| sent.elapsed() >= FREE_SPACE))
            {
                sent = Some(Instant::now());
                answers.send_free_space(free);
            }
            let (said, goes_on) = recorder.second(clock.now(), free)?;
            answers.say(said);
            is_full = !goes_on;
            each_second(&Recorded { dropped: inbox.dropped(), ..recorder.recorded() });
        }
    }
    let (recorded, said) = recorder.finish()?;
    answers.say(said);
    Ok((Recorded { dropped: inbox.dropped(), ..recorded }, is_full))
}

/// Whether it is about the free space of a recorder. Those are not recorded.
fn is_free_space(received: &Received) -> bool {
    let topic = Topic::parse(&received.sample.topic);
    matches!(topic, Ok(Topic::Stage { channel: StageChannel::TakeAnswers, .. }))
        && decode::<TakeAnswer>(&received.sample.payload).is_ok_and(|answer| answer.free_bytes > 0)
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
    let Recorded { messages, bytes, dropped, skipped, .. } = recorded;
    let mut lost = if *dropped > 0 { format!(", {dropped} DROPPED") } else { String::new() };
    if *skipped > 0 {
        lost += &format!(", {skipped} SKIPPED");
    }
    let megabytes = *bytes as f64 * 1e-6;
    format!("{:.0} s, {messages} messages, {megabytes:.1} MB{lost}", elapsed.as_secs_f64())
}

fn rows(path: &Path, recorded: &Recorded, elapsed: Duration) -> Vec<(String, String)> {
    let topics = recorded.topics.iter().map(|(topic, count)| {
        let missing = match recorded.numbers.missing(topic) {
            0 => String::new(),
            missing => format!(", missing by their numbers: {missing}"),
        };
        (topic.to_string(), format!("{count} messages{missing}"))
    });
    let file = (path.display().to_string(), progress(recorded, elapsed));
    topics.chain([file]).collect()
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use super::*;
    use crate::io::bus::Memory;
    use crate::io::recording::{Message, Reader, Writer};
    use crate::io::wire::{Event, Take};

    fn event(count: u64) -> Event {
        Event { kind: "late".into(), count, ..Event::default() }
    }

    fn set() -> Stop {
        let stop = Stop::default();
        stop.stop();
        stop
    }

    /// Records what is on the bus to `path`.
    fn recorded(bus: &Memory, inbox: Inbox, path: &Path) -> Recorded {
        recorded_until(bus, inbox, path, &set(), || None)
    }

    /// The same until a stop request, with so much `room` on the disk.
    fn recorded_until(
        bus: &Memory,
        inbox: Inbox,
        path: &Path,
        stop: &Stop,
        room: impl Fn() -> Option<u64>,
    ) -> Recorded {
        let (folder, topics) = (path.parent().unwrap(), Topics::default());
        let mut answers = Answers::open(bus, &topics).unwrap();
        let recorder =
            Recorder::start(Some(path), folder, topics.clone(), Provenance::default()).unwrap();
        record(inbox, recorder, &mut answers, stop, room, |_| {}).unwrap().0
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

        let recorded = recorded(&bus, inbox, &path);
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
    fn the_free_space_is_published_and_not_recorded() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("take.mcap");
        let (bus, topics) = (Memory::new(), Topics::default());
        let published = Inbox::open(&bus, &topics.take_answers()).unwrap();
        let inbox = Inbox::open(&bus, &topics.all()).unwrap();
        let stop = Stop::default();
        let room = || {
            stop.stop();
            Some(97_000_000_000)
        };
        let recorded = recorded_until(&bus, inbox, &path, &stop, room);
        let sample = published.next(Duration::ZERO).unwrap().sample;
        let answer: TakeAnswer = decode(&sample.payload).unwrap();
        let role = "recorder".into();
        let wanted = TakeAnswer { role, free_bytes: 97_000_000_000, ..TakeAnswer::default() };
        assert_eq!((answer, recorded.messages), (wanted, 0));
    }

    #[test]
    fn a_take_is_announced_while_it_is_recorded() {
        let folder = tempfile::tempdir().unwrap();
        let (bus, topics) = (Memory::new(), Topics::default());
        let inbox = Inbox::open(&bus, &topics.all()).unwrap();
        let take = Take { action: "start".into(), name: "walk".into(), ..Take::default() };
        let publisher = bus.publisher(&topics.take()).unwrap();
        publisher.put(Timestamp::default(), &media_type(Take::FULL_NAME), &encode(&take)).unwrap();
        let (stop, announced) = (Stop::default(), RefCell::default());
        let now = || bus.announced(&topics.recorded_take("*")).unwrap();
        let room = || {
            announced.replace(now());
            stop.stop();
            None
        };
        recorded_until(&bus, inbox, &folder.path().join("all.mcap"), &stop, room);
        assert_eq!((announced.into_inner(), now()), (vec![topics.recorded_take("walk")], vec![]));
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
        let recorded = super::tests::recorded(&bus, by_count, &path);
        assert_eq!((recorded.messages, recorded.dropped), (3, 7));
        let recorded = super::tests::recorded(&bus, by_bytes, &path);
        assert_eq!((recorded.messages, recorded.bytes, recorded.dropped), (2, 20, 8));
    }

    #[test]
    fn a_recording_that_was_cut_short_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("take.mcap");
        std::fs::write(folder.path().join("take.mcap.part"), "precious").unwrap();
        let live = Writer::live(&path, Topics::default(), &Provenance::default());
        let error = crate::cli::failure::Failure::from(live.err().unwrap()).line();
        assert!(error.contains("take.mcap.part") && error.contains("rename"), "{error}");
        assert_eq!(std::fs::read(folder.path().join("take.mcap.part")).unwrap(), b"precious");
    }
}
