//! `bundlemocap bench`

mod cameras;
mod node;
mod report;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};

use crate::cli::Ended;
use crate::cli::bus::BusName;
use crate::cli::failure::{Exit, Failure, frame_rate_option, json, ratio, value_name, within};
use crate::cli::synth::NoiseName;
use crate::cli::terminal::{complain, progress, say, table};
use crate::config::Config;
use crate::io::bus::Bus;
use crate::io::formats::keypoint_format;
use crate::io::wire::Topics;
use crate::live::{SolverCore, WallClock};
use cameras::{Cameras, Sent, Shutter, send};
use node::{NodeProcess, PATIENCE, isolated};
use report::{Heard, Load, Report, UsageAt, report};

/// How often the resource usage of the node is measured.
const LOOK: Duration = Duration::from_millis(500);
/// Time for the last poses and status to arrive, beyond the declared latency.
const TAIL: Duration = Duration::from_millis(1500);

/// Benchmark the live node on this computer.
#[derive(Debug, Args)]
#[command(after_help = "\
Example:
  bundlemocap bench latency --bus zenoh --cameras 4 --fps 60 --seconds 60")]
pub(super) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    Latency(Latency),
}

/// Run a node with synthetic cameras and measure its latency and output.
#[derive(Debug, Args)]
#[command(after_help = "\
The node runs in a separate process, on a free port or with its own names in shared memory. The
cameras send each message at its capture time. Poses are counted from the first published one; the
time before it is the acquisition.

Examples:
  bundlemocap bench latency --bus zenoh --cameras 4 --fps 60 --seconds 60
  bundlemocap bench latency --bus iceoryx2 --cameras 16 --fps 120 --seconds 20 --json
  bundlemocap bench latency --stagger 0.5 --jitter-ms 1      # free-running cameras, poor clocks")]
struct Latency {
    /// The bus between the cameras and the node.
    #[arg(long, value_enum, default_value = "zenoh")]
    bus: BusName,
    /// Number of cameras around the performer, 2 to 64.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(2..=64))]
    cameras: u8,
    /// Frame rate of every camera, 1 to 1000 Hz; a number, or a ratio such as 60000/1001.
    #[arg(long, default_value_t = 60.0, value_parser = ratio, allow_negative_numbers = true)]
    fps: f64,
    /// Duration, 1 to 100000 s.
    #[arg(long, default_value_t = 60.0, allow_negative_numbers = true)]
    seconds: f64,
    /// Noise level of the detectors.
    #[arg(long, value_enum, default_value_t = NoiseName::Studio)]
    noise: NoiseName,
    /// Keypoint format: body_25, body_25b, coco_17, halpe_26 or coco_wholebody_133.
    #[arg(long, default_value = "body_25")]
    format: String,
    /// Spread of the cameras' shutter times as a share of the frame period, below 1; 0 is genlock.
    #[arg(long, default_value_t = 0.0, value_parser = share, allow_negative_numbers = true)]
    stagger: f64,
    /// Standard deviation of the error of capture times, below 100 ms.
    #[arg(long, value_name = "MS", default_value_t = 0.0, value_parser = jitter, allow_negative_numbers = true)]
    jitter_ms: f64,
    /// Settings file of the node, for one performer; its addresses, certificates, names and calibration are ignored.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print one JSON object instead of the table.
    #[arg(long)]
    json: bool,
    /// Also print the node's log on standard error.
    #[arg(long)]
    log: bool,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let What::Latency(latency) = &arguments.what;
    let report = measure(latency)?;
    if latency.json {
        say(&json(&report)?);
    } else {
        say(&table(&report.rows()));
    }
    Ok(Exit::Done)
}

/// A number of a range.
fn parse_within(text: &str, range: std::ops::Range<f64>) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|error: std::num::ParseFloatError| error.to_string())?;
    let std::ops::Range { start, end } = range;
    if range.contains(&value) {
        Ok(value)
    } else {
        Err(format!("must be {start} or more and below {end}"))
    }
}

fn share(text: &str) -> Result<f64, String> {
    parse_within(text, 0.0..1.0)
}

fn jitter(text: &str) -> Result<f64, String> {
    parse_within(text, 0.0..100.0)
}

fn measure(arguments: &Latency) -> Result<Report, Failure> {
    let fps = frame_rate_option(arguments.fps)?;
    let seconds = within("--seconds", arguments.seconds, 1.0, 1e5)?;
    let mut config = arguments.config.as_deref().map(Config::load).transpose()?.unwrap_or_default();
    config.bus.kind = arguments.bus.kind();
    let config = isolated(config)?;
    let format = keypoint_format(&arguments.format)?;
    let noise = arguments.noise.noise();
    let shutter = Shutter { fps, stagger: arguments.stagger, jitter_ms: arguments.jitter_ms };
    let cameras = Cameras::new(arguments.cameras, shutter, seconds, noise, format)?;

    let mut node = NodeProcess::start(&config, seconds + 60.0)?;
    // Cameras and subscribers stay off the solver's core, because they represent other computers.
    let _ = config.node.solver_core.then(SolverCore::reserve);
    let bus = node.connect(&config)?;
    let heard = Heard::default();
    let sent = Sent::default();
    let usage = play(arguments, &config, &cameras, &*bus, &mut node, &heard, &sent)?;
    if arguments.log {
        node.log().lines().for_each(|line| complain("node", line));
    }
    node.stop()?;
    let load = Load {
        bus: value_name(arguments.bus),
        cameras: arguments.cameras,
        fps,
        stagger: arguments.stagger,
        jitter_ms: arguments.jitter_ms,
        seconds,
        message_bytes: cameras.mean_bytes(),
        window_span_ms: 1e3 * config.tracker.at_period(1e9 / fps).window() as f64 / fps,
    };
    Ok(report(load, &heard, &sent.take(), &usage))
}

/// Sends the frames and measures the node meanwhile.
fn play(
    arguments: &Latency,
    config: &Config,
    cameras: &Cameras,
    bus: &dyn Bus,
    node: &mut NodeProcess,
    heard: &Heard,
    sent: &Sent,
) -> Result<Vec<UsageAt>, Failure> {
    let clock = WallClock::start();
    let topics = Topics { stage: config.node.stage.clone(), actor: config.node.actor.clone() };
    let _listening = heard.listen(bus, &topics, clock)?;
    let rig = bus.publisher(&topics.rig())?;
    let encoding = "application/protobuf;bundlemocap.v1.Rig";
    rig.put(clock.now(), encoding, &cameras.rig_message())?;
    wait_for_status(node, heard)?;

    let frames = (arguments.seconds * arguments.fps).round().max(1.0) as u64;
    let bar = progress(arguments.seconds as u64, "s");
    let usage = std::thread::scope(|scope| {
        let sending = scope.spawn(|| send(cameras, bus, &topics, clock, frames, sent));
        let begin = Instant::now();
        let mut usage: Vec<UsageAt> = Vec::new();
        while !sending.is_finished() {
            std::thread::sleep(LOOK);
            node.check()?;
            if heard.first_pose().is_some() {
                usage.extend(node.usage().map(|usage| (clock.now(), usage)));
            }
            bar.set_position(begin.elapsed().as_secs());
        }
        let sending = sending.join();
        sending.unwrap_or_else(|_| {
            Err(Failure::new(Exit::Unexpected, "the cameras' thread panicked"))
        })?;
        Ok(usage)
    });
    bar.finish_and_clear();
    std::thread::sleep(Duration::from_nanos(heard.latency().ns().unsigned_abs()) + TAIL);
    usage
}

fn wait_for_status(node: &mut NodeProcess, heard: &Heard) -> Result<(), Failure> {
    let begin = Instant::now();
    while !heard.has_status() {
        node.check()?;
        if begin.elapsed() > PATIENCE {
            let message = format!("the node has not published a status within {PATIENCE:?}");
            return Err(Failure::new(Exit::Unexpected, message));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(())
}
