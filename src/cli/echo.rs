//! `bundlemocap echo`

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::{Args, ValueEnum};
use serde_json::{Map, Value, json};

use super::Ended;
use super::bus::{BusArguments, open};
use super::clock::{ATTENTION, PATIENCE, Stop};
use super::failure::Exit;
use super::terminal::{complain, tell};
use super::wire;
use crate::cli::tools::inbox::{Inbox, Received};
use crate::core::time::Timestamp;
use crate::io::wire::Topics;

/// Print the messages on the bus, one per line.
#[derive(Debug, Args)]
#[command(after_help = "\
Without --actor it prints the messages of every performer. A line starts with the time of arrival (UTC)
and the topic. Latency is arrival minus capture time on the clock of this computer. A final pose also
shows its declared latency, and how early or late it arrived relative to its due time: capture time plus
declared latency, or later where the latency has just fallen.

With --json the fields of `message` have the names of schemas/*.proto. States are names; run ids and
hashes are hexadecimal.

Examples:
  bundlemocap echo poses
  bundlemocap echo poses --actor p2
  bundlemocap echo status --count 1
  bundlemocap echo stage
  bundlemocap echo all --hz
  bundlemocap echo keyframes --json | jq .message.z
  bundlemocap echo keypoints --connect tcp/192.168.1.10:7447")]
pub(super) struct Arguments {
    /// The messages to print.
    #[arg(value_enum)]
    what: What,
    /// Print one JSON object per line, with all fields.
    #[arg(long)]
    json: bool,
    /// Stop after N lines.
    #[arg(long, value_name = "N")]
    count: Option<u64>,
    /// Print the message and byte rates of each topic instead, every second.
    #[arg(long)]
    hz: bool,
    #[command(flatten)]
    bus: BusArguments,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum What {
    /// Final poses, at the declared latency.
    Poses,
    /// Provisional poses of the open window.
    Provisional,
    /// 2D keypoints of every camera.
    Keypoints,
    /// The node's counters.
    Status,
    /// Who is on the stage: performers, and how many more people are seen.
    Stage,
    /// Events of the stage and of the performer.
    Events,
    /// Solved keyframes.
    Keyframes,
    /// The calibration.
    Rig,
    /// The performer's skeleton.
    Skeleton,
    /// The journal of the node's inputs.
    Journal,
    /// All messages of the stage.
    All,
}

impl What {
    fn patterns(self, topics: &Topics) -> Vec<String> {
        vec![match self {
            Self::Poses => topics.pose(),
            Self::Provisional => topics.provisional(),
            Self::Keypoints => topics.keypoints("*"),
            Self::Status => topics.status(),
            Self::Stage => topics.stage_status(),
            Self::Events => return vec![topics.stage_events(), topics.actor_events()],
            Self::Keyframes => topics.keyframe(),
            Self::Rig => topics.rig(),
            Self::Skeleton => topics.skeleton(),
            Self::Journal => topics.journal(),
            Self::All => topics.all(),
        }]
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let config = arguments.bus.settings()?;
    let bus = open(&config)?;
    let stop = Stop::on_signals()?;
    let patterns = arguments.what.patterns(&arguments.bus.topics(&config));
    let inbox = Inbox::open_all(&*bus, &patterns)?;
    let form = match (arguments.hz, arguments.json) {
        (true, json) => Form::Rates { json },
        (false, true) => Form::Json,
        (false, false) => Form::Line,
    };
    let nothing = || {
        let what = patterns.join(" and ");
        let fix = "check --stage and --actor, and whether the node runs";
        complain("warning", &format!("no messages on {what} yet; {fix}"));
    };
    let count = arguments.count.unwrap_or(u64::MAX);
    echo(&inbox, form, count, &stop, tell, (PATIENCE, nothing));
    if inbox.dropped() > 0 {
        let fix = "the terminal is too slow; print fewer messages";
        complain("warning", &format!("{} messages were not printed: {fix}", inbox.dropped()));
    }
    Ok(Exit::Done)
}

/// Output format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    Line,
    Json,
    Rates { json: bool },
}

/// Prints until `count` lines, a stop request, or `print` returns false. Calls `nothing` if no message comes within `patience`.
fn echo(
    inbox: &Inbox,
    form: Form,
    count: u64,
    stop: &Stop,
    mut print: impl FnMut(&str) -> bool,
    (patience, nothing): (Duration, impl Fn()),
) {
    let (mut printed, mut rates, mut since) = (0, Rates::default(), Instant::now());
    let (begin, mut waits) = (Instant::now(), true);
    while printed < count && !stop.is_set() {
        let received = inbox.next(ATTENTION);
        waits &= received.is_none();
        if waits && begin.elapsed() > patience {
            waits = false;
            nothing();
        }
        let line = match (form, received) {
            (Form::Line, Some(received)) => line(&received),
            (Form::Json, Some(received)) => json_line(&received).to_string(),
            (Form::Rates { json }, received) => {
                received.iter().for_each(|received| rates.count(received));
                if since.elapsed() < Duration::from_secs(1) {
                    continue;
                }
                let seconds = since.elapsed().as_secs_f64();
                since = Instant::now();
                std::mem::take(&mut rates).text(seconds, json)
            }
            (_, None) => continue,
        };
        if !print(&line) {
            return;
        }
        printed += 1;
    }
}

/// Counts of messages and bytes by topic.
#[derive(Default)]
struct Rates(BTreeMap<Arc<str>, [u64; 2]>);

impl Rates {
    fn count(&mut self, received: &Received) {
        let [messages, bytes] = self.0.entry(received.sample.topic.clone()).or_default();
        *messages += 1;
        *bytes += received.sample.payload.len() as u64;
    }

    fn text(self, seconds: f64, json: bool) -> String {
        let rates = self.0.iter().map(|(topic, [messages, bytes])| {
            (topic, *messages as f64 / seconds, *bytes as f64 / seconds)
        });
        if json {
            let topics = rates.map(|(topic, messages, bytes)| {
                (topic.to_string(), json!({ "messages_hz": messages, "bytes_hz": bytes }))
            });
            return Value::Object(topics.collect::<Map<_, _>>()).to_string();
        }
        let lines = rates.map(|(topic, messages, bytes)| {
            format!("{messages:8.1} Hz  {:9.1} kB/s  {topic}", bytes * 1e-3)
        });
        let text = lines.collect::<Vec<_>>().join("\n");
        if text.is_empty() { "nothing".to_owned() } else { text }
    }
}

fn line(received: &Received) -> String {
    let sample = &received.sample;
    let said = match received.message() {
        Ok(message) => wire::text(&message, received.arrival).unwrap_or_else(|| {
            let encoding = if sample.encoding.is_empty() { "unknown" } else { &*sample.encoding };
            format!("encoding {encoding}")
        }),
        Err(error) => format!("UNDECODABLE: {error}"),
    };
    let [time, bytes] = [time_of_day(received.arrival), sample.payload.len().to_string()];
    format!("{time} {}  {said}  {bytes} B", sample.topic).replace(char::is_control, " ")
}

fn json_line(received: &Received) -> Value {
    let Received { sample, arrival } = received;
    let mut object = Map::new();
    object.insert("topic".into(), json!(&*sample.topic));
    object.insert("encoding".into(), json!(&*sample.encoding));
    object.insert("arrival_time_ns".into(), json!(arrival.ns()));
    object.insert("bus_capture_time_ns".into(), json!(sample.capture.ns()));
    object.insert("bytes".into(), json!(sample.payload.len()));
    match received.message() {
        Ok(message) => object.insert("message".into(), json!(message)),
        Err(error) => object.insert("undecodable".into(), json!(error.to_string())),
    };
    Value::Object(object)
}

/// Hours, minutes, seconds and milliseconds of the day, UTC.
fn time_of_day(time: Timestamp) -> String {
    let ms = time.ns().rem_euclid(86_400_000_000_000) / 1_000_000;
    let (hours, minutes, seconds) = (ms / 3_600_000, ms / 60_000 % 60, ms / 1000 % 60);
    format!("{hours:02}:{minutes:02}:{seconds:02}.{:03}", ms % 1000)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Pose as BodyPose, Skeleton, StampedPose, TrackingState};
    use crate::core::time::Nanos;
    use crate::io::bus::{Bus, Memory};
    use crate::io::wire::{Event, KeypointFrame, LiveStamp, Pose, Schema, encode, media_type};

    const CAPTURE: Timestamp = Timestamp::from_ns(1_000_000_000);

    fn pose() -> Pose {
        let stamped = StampedPose::new(CAPTURE, BodyPose::rest(), TrackingState::Coasting);
        let stamped = StampedPose { window: 7, ..stamped };
        let due = Some(CAPTURE + Nanos::from_ms(250));
        let live = LiveStamp { due, latency: Nanos::from_ms(250), run_id: 0xab };
        Pose::from_core(&stamped, &Skeleton::default(), Some(live))
    }

    fn received(topic: &str, encoding: &str, payload: Vec<u8>) -> Received {
        let (topic, encoding) = (topic.into(), encoding.into());
        let sample = crate::io::bus::Sample { topic, capture: CAPTURE, encoding, payload };
        Received { sample, arrival: CAPTURE + Nanos::from_ms(251) }
    }

    fn of<T: Schema>(topic: &str, message: &T) -> Received {
        received(topic, &media_type(&T::full_name()), encode(message))
    }

    #[test]
    fn a_pose_is_printed_with_its_latencies() {
        let said = line(&of(&Topics::default().pose(), &pose()));
        for part in [
            "00:00:01.251 mocap/stage/actor/actor/pose",
            "window 7, coasting",
            "latency 251.0 ms",
            "declared 250.0 ms, 1.00 ms late",
        ] {
            assert!(said.contains(part), "{part:?} is not in {said}");
        }
        let mut early = of(&Topics::default().pose(), &pose());
        early.arrival = CAPTURE + Nanos::new(249_500_000);
        assert!(line(&early).contains("declared 250.0 ms, 0.50 ms early"), "{}", line(&early));
        let object = json_line(&of(&Topics::default().pose(), &pose()));
        assert_eq!(object["message"]["due_time_ns"], 1_250_000_000);
        assert_eq!(object["message"]["run_id"], "00000000000000ab");
        assert_eq!(object["message"]["local_rotations"].as_array().map(Vec::len), Some(84));
        assert_eq!(object["message"]["state"], "coasting");
    }

    #[test]
    fn what_cannot_be_decoded_is_shown_as_such() {
        let topics = Topics::default();
        let mut frame = KeypointFrame { format: "body_25".into(), ..KeypointFrame::default() };
        let good = line(&of(&topics.keypoints("a"), &frame));
        assert!(good.contains("frame 0, 0 people in body_25"), "{good}");
        frame.format = "body\n99".into();
        let unknown = of(&topics.keypoints("a"), &frame);
        let said = line(&unknown);
        assert!(said.contains("UNDECODABLE") && said.contains("99"), "{said}");
        assert!(!said.contains('\n') && said.ends_with(" B"), "{said}");
        assert!(json_line(&unknown)["undecodable"].is_string());
        let garbage = line(&received(&topics.pose(), "", vec![0xff; 9]));
        assert!(garbage.contains("UNDECODABLE") && garbage.contains("9 B"), "{garbage}");
        let foreign = line(&received("mocap/stage/gain", "text/plain", b"3".to_vec()));
        assert!(foreign.ends_with("mocap/stage/gain  encoding text/plain  1 B"), "{foreign}");
    }

    #[test]
    fn it_ends_after_the_count_and_when_nobody_reads() {
        let (bus, topics) = (Memory::new(), Topics::default());
        let inbox = Inbox::open(&bus, &topics.all()).unwrap();
        let publisher = bus.publisher(&topics.stage_events()).unwrap();
        let event = Event { kind: "late".into(), count: 2, ..Event::default() };
        for _ in 0..5 {
            publisher.put(CAPTURE, "", &encode(&event)).unwrap();
        }
        let mut lines = Vec::new();
        let print = |line: &str| {
            lines.push(line.to_owned());
            true
        };
        echo(&inbox, Form::Line, 2, &Stop::default(), print, (PATIENCE, || unreachable!()));
        assert_eq!(lines.len(), 2);
        assert!(lines[0].contains("stage/events  late x 2"), "{lines:?}");
        let mut tries = 0;
        let print = |_: &str| {
            tries += 1;
            tries < 2
        };
        echo(&inbox, Form::Json, u64::MAX, &Stop::default(), print, (PATIENCE, || unreachable!()));
        assert_eq!(tries, 2);
        let stop = Stop::default();
        stop.stop();
        let never = || unreachable!();
        echo(&inbox, Form::Line, u64::MAX, &stop, |_| never(), (PATIENCE, || unreachable!()));
        // Nothing comes.
        let silent = Inbox::open_all(&bus, &[topics.rig()]).unwrap();
        let (stop, said) = (Stop::default(), std::cell::Cell::new(0));
        let nothing = || {
            said.set(said.get() + 1);
            stop.stop();
        };
        echo(&silent, Form::Line, u64::MAX, &stop, |_| never(), (Duration::ZERO, nothing));
        assert_eq!(said.get(), 1);
    }

    #[test]
    fn rates_are_per_topic() {
        let mut rates = Rates::default();
        for _ in 0..30 {
            rates.count(&received("mocap/stage/events", "", vec![0; 100]));
        }
        let text = rates.text(0.5, false);
        assert!(text.contains("60.0 Hz") && text.contains("6.0 kB/s"), "{text}");
        assert_eq!(Rates::default().text(1.0, false), "nothing");
        assert_eq!(Rates::default().text(1.0, true), "{}");
    }
}
