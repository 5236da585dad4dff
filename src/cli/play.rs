//! `bundlemocap play`

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;

use super::Ended;
use super::bus::{BusArguments, open, topics};
use super::clock::{SteadyClock, Stop};
use super::failure::{Exit, Failure, within};
use super::span::{SpanArguments, Times};
use super::terminal::{complain, progress, say, table, ticker};
use crate::cli::tools::Disturbance;
use crate::cli::tools::inbox::Inbox;
use crate::cli::tools::player::{Clock, Playing, Sent, play};
use crate::cli::tools::take::Take;
use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{Bus, BusError};
use crate::io::wire::{CameraCounters, Status, Topics, decode};

/// Time from opening the bus to the first frame, for publishers and subscribers to connect.
const LEAD: Duration = Duration::from_millis(500);

/// After this time a node has told what it receives.
const PATIENCE: Nanos = Nanos::from_ms(3000);
/// The last statuses come within this time.
const HISTORY: Duration = Duration::from_millis(500);

/// Publish the keypoints of a recording in real time, as its cameras would.
#[derive(Debug, Args)]
#[command(after_help = "\
The calibration is sent first, then every frame at its time. Frames get new capture times on the
clock of this computer: the first is the time of sending, the intervals are those of the recording
divided by the speed. Outputs of a node and ground truth are not played. All frames are kept in
memory, about 1 kB each. If the connection is lost meanwhile, the exit code is 6.

To play cameras from several processes or computers, use the same --start-at for all.

Examples:
  bundlemocap play recordings/walk.mcap
  bundlemocap play recordings/walk.mcap --loop --speed 0.5
  bundlemocap play walk.mcap --camera cam01 --start-at $(($(date +%s) + 10))
  bundlemocap play walk.mcap --drop 0.02 --late 0.02 --duplicate 0.02 --reorder 0.02 --seed 1")]
pub(super) struct Arguments {
    /// MCAP recording with keypoints.
    file: PathBuf,
    /// Playback speed relative to real time, 0.01 to 100.
    #[arg(long, default_value_t = 1.0, allow_negative_numbers = true)]
    speed: f64,
    /// Restart at the end; capture times and frame numbers continue.
    #[arg(long = "loop", conflicts_with = "keep_times")]
    repeat: bool,
    /// Send the recorded payloads with their capture times unchanged.
    #[arg(long)]
    keep_times: bool,
    /// Do not send the calibration.
    #[arg(long)]
    only_keypoints: bool,
    /// Play only this camera; may be repeated.
    #[arg(long, value_name = "NAME")]
    camera: Vec<String>,
    /// Time of the first frame, seconds since 1970; default: half a second from now.
    #[arg(long, value_name = "SECONDS")]
    start_at: Option<f64>,
    #[command(flatten)]
    span: SpanArguments,
    #[command(flatten)]
    network: Network,
    #[command(flatten)]
    bus: BusArguments,
}

/// Disturbances of the frames.
#[derive(Debug, Args)]
#[command(next_help_heading = "Bad network")]
struct Network {
    /// Share of lost frames, 0 to 1.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, allow_negative_numbers = true)]
    drop: f64,
    /// Share of delayed frames, 0 to 1.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, allow_negative_numbers = true)]
    late: f64,
    /// Longest delay, milliseconds, 0 to 60000.
    #[arg(long, value_name = "MS", default_value_t = 80.0, allow_negative_numbers = true)]
    late_ms: f64,
    /// Share of frames that are sent twice, 0 to 1.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, allow_negative_numbers = true)]
    duplicate: f64,
    /// Share of frames that are sent after the camera's next frame, 0 to 1.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, allow_negative_numbers = true)]
    reorder: f64,
    /// Seed of the disturbances.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

impl Network {
    fn disturbance(&self) -> Result<Disturbance, Failure> {
        let Self { drop, late, late_ms, duplicate, reorder, seed } = *self;
        let shares = [
            ("--drop", drop),
            ("--late", late),
            ("--duplicate", duplicate),
            ("--reorder", reorder),
        ];
        for (option, share) in shares {
            within(option, share, 0.0, 1.0)?;
        }
        within("--late-ms", late_ms, 0.0, 6e4)?;
        Ok(Disturbance {
            drop,
            late,
            duplicate,
            reorder,
            longest_delay: Nanos::new((late_ms * 1e6) as i64),
            seed,
        })
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    within("--speed", arguments.speed, 0.01, 100.0)?;
    let disturbance = arguments.network.disturbance()?;
    // A wrong --start-at is found before the file is read.
    start(arguments, &SteadyClock::new(Stop::default()))?;
    let config = arguments.bus.settings()?;
    let span = arguments.span.within(&Times::of(&arguments.file, Some(&config))?)?;
    let reading = ticker();
    reading.set_message(format!("reading {}", arguments.file.display()));
    let (take, report) = Take::read(&arguments.file, &arguments.camera, span)?;
    reading.finish_and_clear();
    for lost in report.losses() {
        complain("warning", &format!("{}: {lost}", arguments.file.display()));
    }
    let bus = open(&config)?;
    let clock = SteadyClock::new(Stop::on_signals()?);
    let how = Playing {
        start: start(arguments, &clock)?,
        speed: arguments.speed,
        keep_times: arguments.keep_times,
        repeat: arguments.repeat,
        rig: !arguments.only_keypoints,
        disturbance,
    };
    let bar = match how.repeat {
        true => ticker(),
        false => progress(take.frames() as u64, "frames"),
    };
    let topics = topics(&config);
    let mut link = Link::default();
    let sent = play(&take, &how, &*bus, &topics, &clock, |sent| {
        bar.set_position(sent.all());
        if how.repeat && sent.all().is_multiple_of(100) {
            bar.set_message(format!("{} frames", sent.all()));
        }
        link.check(&*bus);
    })?;
    bar.finish_and_clear();
    say(&table(&rows(&take, &sent)));
    if sent.lasted >= PATIENCE && !link.is_lost {
        tell_what_nodes_receive(&take, &*bus, &topics)?;
    }
    Ok(if link.was_lost { Exit::InPart } else { Exit::Done })
}

/// Whether the connection to the router is there.
struct Link {
    checked: Instant,
    is_lost: bool,
    was_lost: bool,
}

impl Default for Link {
    fn default() -> Self {
        Self { checked: Instant::now(), is_lost: false, was_lost: false }
    }
}

impl Link {
    /// Looks once a second; says when the connection is lost.
    fn check(&mut self, bus: &dyn Bus) {
        if self.checked.elapsed() < Duration::from_secs(1) {
            return;
        }
        self.checked = Instant::now();
        let is_lost = !bus.is_connected();
        if is_lost && !self.is_lost {
            complain("warning", "the connection is lost; frames are lost until it is back");
        }
        self.is_lost = is_lost;
        self.was_lost |= is_lost;
    }
}

/// Warns of cameras from which no node has had a frame, and says if there is no node.
fn tell_what_nodes_receive(take: &Take, bus: &dyn Bus, topics: &Topics) -> Result<(), BusError> {
    // Not before: who subscribes is shown among those who receive poses.
    let of_nodes = Topics { actor: "*".into(), ..topics.clone() };
    let inbox = Inbox::open(bus, &of_nodes.status())?;
    let begin = Instant::now();
    let received = std::iter::from_fn(|| inbox.next(HISTORY.saturating_sub(begin.elapsed())));
    let statuses: Vec<Status> =
        received.filter_map(|received| decode(&received.sample.payload).ok()).collect();
    if statuses.is_empty() {
        complain(
            "note",
            &format!("no node publishes its status on stage {}; does one run?", topics.stage),
        );
        return Ok(());
    }
    let is_unheard = |name: &&str| {
        let counters = statuses.iter().flat_map(|status| &status.cameras);
        let mut own = counters.filter(|one| one.camera == *name).peekable();
        let is_none = |one: &CameraCounters| {
            let CameraCounters { used, late, duplicate, unusable, dropped, rate_hz, .. } = one;
            used + late + duplicate + unusable + dropped == 0 && *rate_hz == 0.0
        };
        own.peek().is_some() && own.all(is_none)
    };
    let names = take.cameras.iter().map(|camera| camera.name.as_str());
    let unheard = names.filter(is_unheard).collect::<Vec<_>>().join(", ");
    if !unheard.is_empty() {
        let why = "may this program publish there ([bus.zenoh] config)?";
        complain("warning", &format!("no frame of {unheard} has reached the node: {why}"));
    }
    Ok(())
}

/// The time of the first frame.
fn start(arguments: &Arguments, clock: &dyn Clock) -> Result<Timestamp, Failure> {
    let Some(seconds) = arguments.start_at else {
        return Ok(clock.now() + LEAD.into());
    };
    let start = Timestamp::from_ns((seconds * 1e9).round() as i64);
    let ahead = start.seconds_since(clock.now());
    if !(0.0..=86_400.0).contains(&ahead) {
        let message = format!(
            "--start-at is {ahead:.3} s from now, but must be 0 to 86400 s ahead, as seconds since \
             1970"
        );
        return Err(Failure::new(Exit::Usage, message));
    }
    Ok(start)
}

fn rows(take: &Take, sent: &Sent) -> Vec<(String, String)> {
    let mut rows = Vec::new();
    let mut row = |name: &str, value: String| rows.push((name.to_owned(), value));
    for (camera, frames) in take.cameras.iter().zip(&sent.frames) {
        row(&format!("camera {}", camera.name), format!("{frames} frames"));
    }
    row("calibrations", sent.rigs.to_string());
    let seconds = sent.lasted.seconds();
    if seconds > 0.0 {
        let rate = sent.all() as f64 / seconds;
        let kilobytes = sent.bytes as f64 / seconds * 1e-3;
        row("rate", format!("{rate:.1} messages/s, {kilobytes:.0} kB/s for {seconds:.1} s"));
    }
    let done = sent.disturbed;
    let disturbed = [
        ("lost", done.dropped),
        ("delayed", done.late),
        ("sent twice", done.duplicated),
        ("sent out of order", done.reordered),
    ];
    for (what, count) in disturbed.into_iter().filter(|(_, count)| *count > 0) {
        row(what, format!("{count} frames, as requested"));
    }
    row("largest delay of sending", format!("{:.2}", sent.worst_delay));
    rows
}
