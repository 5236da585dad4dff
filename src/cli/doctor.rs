//! `bundlemocap doctor`

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use clap::Args;

use super::Ended;
use super::bus::topics;
use super::clock::Stop;
use super::failure::Exit;
use super::terminal::{say, ticker};
use crate::cli::tools::room::room;
use crate::cli::tools::survey::{Seen, other_stages, survey};
use crate::config::Config;
use crate::core::camera::{Camera, Rig};
use crate::core::time::Nanos;
use crate::io::bus::{self, Bus, BusError, Kind};
use crate::io::formats::read_calibration;
use crate::live::WallClock;
use crate::metrics::statistics::percentile;

/// Usual time to solve and publish a window, milliseconds.
const SOLVE_MS: f64 = 26.0;
/// Poses leave late if timers of the system are later than this, milliseconds.
const TIMER_MS: f64 = 1.0;
/// Timer waits that are measured.
const WAITS: usize = 200;
/// Room on the disk that is enough, bytes.
const ENOUGH: u64 = 10 << 30;
/// Room in the shared memory that is enough, bytes.
const ENOUGH_SHARED: u64 = 256 << 20;

/// Check this computer, the settings and the cameras before a shoot.
#[derive(Debug, Args)]
#[command(after_help = "\
Checks the clock and the timers of this computer, the calibration, the latency, addresses and ports,
certificates, shared memory and the disk, and then listens to the cameras: rate, image size and delay of
each. Cameras must be sending. It runs beside the node or before it. With something wrong the exit code
is 17.

Examples:
  bundlemocap doctor
  bundlemocap doctor studio.toml
  bundlemocap doctor studio.toml --seconds 20 --disk /data/takes")]
pub(super) struct Arguments {
    /// Settings file; config/default.toml lists every setting.
    config: Option<PathBuf>,
    /// Listen to the cameras for N seconds; 0: do not listen.
    #[arg(long, value_name = "N", default_value_t = 5)]
    seconds: u64,
    /// Folder of the recordings.
    #[arg(long, value_name = "DIR", default_value = ".")]
    disk: PathBuf,
}

/// The findings, printed as they come.
#[derive(Default)]
struct Findings {
    wrong: usize,
    doubtful: usize,
}

impl Findings {
    fn good(&mut self, what: &str, text: impl AsRef<str>) {
        say(&format!("ok     {what:<12} {}", text.as_ref()));
    }

    fn doubtful(&mut self, what: &str, text: impl AsRef<str>) {
        self.doubtful += 1;
        say(&format!("look   {what:<12} {}", text.as_ref()));
    }

    fn wrong(&mut self, what: &str, text: impl AsRef<str>) {
        self.wrong += 1;
        say(&format!("wrong  {what:<12} {}", text.as_ref()));
    }

    fn good_if(&mut self, is_good: bool, what: &str, text: impl AsRef<str>) {
        if is_good { self.good(what, text) } else { self.doubtful(what, text) }
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let config = arguments.config.as_deref().map(Config::load).transpose()?.unwrap_or_default();
    let stop = Stop::on_signals()?;
    let mut findings = Findings::default();
    let name = arguments.config.as_ref().map(|path| path.display().to_string());
    findings.good("settings", name.as_deref().unwrap_or("the defaults; no file was given"));
    clock(&mut findings);
    cores(&config, &mut findings);
    let rig = rig(&config, &mut findings);
    port(&config, &mut findings);
    certificates(&config, &mut findings);
    disk("disk", &arguments.disk, ENOUGH, &mut findings);
    if config.bus.kind == Kind::Iceoryx2 {
        disk("shared memory", Path::new("/dev/shm"), ENOUGH_SHARED, &mut findings);
    }
    let mut rate = Some(config.tracker.frame_rate_hz).filter(|rate| *rate > 0.0);
    if let Some(bus) = open(&config, &mut findings)
        && arguments.seconds > 0
    {
        nodes(&*bus, &mut findings);
        let ticker = ticker();
        ticker.set_message(format!("listening to the cameras for {} s", arguments.seconds));
        let time = Duration::from_secs(arguments.seconds);
        let seen = survey(&*bus, time, || !stop.is_set())?;
        ticker.finish_and_clear();
        let stage = &config.node.stage;
        let of_stage = seen.iter().filter(|((of, _), _)| of == stage);
        let here: BTreeMap<&str, &Seen> =
            of_stage.map(|((_, camera), seen)| (&**camera, seen)).collect();
        cameras(&config, &other_stages(&seen, stage), &here, rig.as_ref(), &mut findings);
        let fastest = here.values().filter_map(|seen| seen.rate_hz()).reduce(f64::max);
        rate = rate.or(fastest);
        let delays = here.values().filter_map(|seen| Some(seen.delay_s()?[1]));
        latency(&config, rate, delays.reduce(f64::max), &mut findings);
    } else {
        latency(&config, rate, None, &mut findings);
    }
    let Findings { wrong, doubtful } = findings;
    say(&format!("{wrong} wrong, {doubtful} to look at"));
    Ok(if wrong > 0 { Exit::NotReady } else { Exit::Done })
}

/// Whether the clock is disciplined, and how late timers are.
fn clock(findings: &mut Findings) {
    let question = ["show", "-p", "NTPSynchronized", "--value"];
    let answer = Command::new("timedatectl").args(question).output();
    let answer = answer
        .ok()
        .filter(|output| output.status.success())
        .map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned());
    match answer.as_deref() {
        Some("yes") => findings.good("clock", "follows a time server"),
        Some("no") => findings.doubtful(
            "clock",
            "follows no time server; cameras on other computers need NTP or PTP on all of them",
        ),
        _ => findings.doubtful(
            "clock",
            "this system does not say whether it follows a time server; use NTP or PTP if the \
             cameras are on other computers",
        ),
    }
    let clock = WallClock::start();
    let late = (0..WAITS).map(|_| {
        let then = clock.now() + Nanos::from_ms(2);
        clock.wait_until(then);
        (clock.now() - then).ms()
    });
    let late = percentile(&late.collect::<Vec<f64>>(), 99.0).unwrap_or_default();
    let text = format!("99 % less than {:.0} µs late", 1e3 * late);
    findings.good_if(late < TIMER_MS, "timers", text);
}

fn cores(config: &Config, findings: &mut Findings) {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let text = format!("{cores}, {} for the solver", config.tracker.threads);
    findings.good_if(cores > config.tracker.threads, "cores", text);
}

/// The calibration of the settings.
fn rig(config: &Config, findings: &mut Findings) -> Option<Rig> {
    let path = match config.node.rig.as_str() {
        // The front gives it.
        "" if config.node.solver => return None,
        "" => {
            findings.doubtful(
                "calibration",
                "none in the settings: the node takes any that is published; give [node] rig",
            );
            return None;
        }
        path => path,
    };
    match read_calibration(Path::new(path), &config.node.convention()) {
        Ok(read) => {
            let names: Vec<&str> = read.rig.cameras.iter().map(|camera| &*camera.name).collect();
            findings
                .good("calibration", format!("{path}: {}: {}", read.summary(), names.join(", ")));
            for note in read.notes {
                findings.doubtful("calibration", note);
            }
            Some(read.rig)
        }
        Err(error) => {
            findings.wrong("calibration", error.to_string());
            None
        }
    }
}

/// The address of the Prometheus endpoint.
fn port(config: &Config, findings: &mut Findings) {
    let address = match config.node.prometheus.as_str() {
        "" => return findings.good("metrics", "none in the settings"),
        address => address,
    };
    match TcpListener::bind(address) {
        Ok(_) => findings.good("metrics", format!("{address} is free")),
        Err(error) => findings.doubtful(
            "metrics",
            format!("{address}: {error}; the node may be running, else choose another"),
        ),
    }
}

/// The files of `[bus.zenoh.tls]`.
fn certificates(config: &Config, findings: &mut Findings) {
    let tls = &config.bus.zenoh.tls;
    let files = [&tls.root_ca, &tls.certificate, &tls.key];
    for file in files.into_iter().filter(|file| !file.is_empty()) {
        match std::fs::read_to_string(file) {
            Ok(text) if text.contains("-----BEGIN ") => findings.good("certificates", file),
            Ok(_) => findings.wrong("certificates", format!("{file} is not a PEM file")),
            Err(error) => findings.wrong("certificates", format!("{file}: {error}")),
        }
    }
    if !Path::new(&tls.certificate).exists() {
        return;
    }
    // Expires within a week: the exit code is 1.
    let week = Command::new("openssl")
        .args(["x509", "-noout", "-checkend", "604800", "-in", &tls.certificate])
        .output();
    match week {
        Ok(output) if output.status.success() => {}
        Ok(_) => findings.wrong("certificates", "expired or expires within a week; make new ones"),
        Err(_) => findings.doubtful("certificates", "openssl is not here, dates were not checked"),
    }
}

fn disk(what: &str, folder: &Path, enough: u64, findings: &mut Findings) {
    let Some(room) = room(folder) else {
        return findings.wrong(what, format!("{} cannot be read", folder.display()));
    };
    if let Err(error) = tempfile::tempfile_in(folder) {
        return findings.wrong(what, format!("{} cannot be written: {error}", folder.display()));
    }
    let text = format!("{:.1} GB free in {}", room as f64 / 1e9, folder.display());
    findings.good_if(room >= enough, what, text);
}

/// The names under which nodes announce themselves.
const NODES: &str = "mocap/*/actor/*/node/*";

/// Joins the bus: beside a node, or in its place.
fn open(config: &Config, findings: &mut Findings) -> Option<Box<dyn Bus>> {
    match bus::open_client(&config.bus) {
        Ok(bus) => {
            let has_node = || bus.announced(NODES).is_ok_and(|names| !names.is_empty());
            match config.bus.kind {
                Kind::Iceoryx2 => findings.good("bus", "shared memory of this computer"),
                Kind::Zenoh if has_node() => findings.good("bus", "a node answers"),
                Kind::Zenoh => findings.doubtful("bus", "a router answers, but no node runs"),
            }
            Some(bus)
        }
        Err(BusError::NobodyAnswers { .. }) => match bus::open_node(&config.bus) {
            Ok(bus) => {
                let listen = config.bus.zenoh.listen.join(" ");
                findings.good("bus", format!("no node yet; listening on {listen} in its place"));
                let is_local = |address: &String| address.contains("127.0.0.1");
                if config.bus.zenoh.listen.iter().all(is_local) {
                    let public = listen.replace("127.0.0.1", "0.0.0.0");
                    let text = "other computers cannot connect; for them set [bus.zenoh] listen to";
                    findings.doubtful("bus", format!("{text} {public}"));
                }
                Some(bus)
            }
            Err(error) => {
                findings.wrong("bus", error.to_string());
                None
            }
        },
        Err(error) => {
            findings.wrong("bus", error.to_string());
            None
        }
    }
}

/// The nodes that run now.
fn nodes(bus: &dyn Bus, findings: &mut Findings) {
    let names = match bus.announced(NODES) {
        Ok(names) => names,
        Err(error) => return findings.wrong("node", error.to_string()),
    };
    for name in names {
        if let [_, stage, _, actor, ..] = name.split('/').collect::<Vec<_>>()[..] {
            findings.good("node", format!("runs for stage {stage}, actor {actor}"));
        }
    }
}

/// What the cameras send, compared with the calibration.
fn cameras(
    config: &Config,
    others: &[String],
    here: &BTreeMap<&str, &Seen>,
    rig: Option<&Rig>,
    findings: &mut Findings,
) {
    if !others.is_empty() {
        let stage = &config.node.stage;
        let text = format!("{stage} here; cameras also send on {}", others.join(", "));
        findings.doubtful("stage", text);
    }
    if here.is_empty() {
        let topic = topics(config).keypoints("CAMERA");
        findings.wrong("cameras", format!("nothing came on {topic}; start the detectors"));
    }
    for camera in rig.iter().flat_map(|rig| &rig.cameras) {
        if !here.is_empty() && !here.contains_key(&*camera.name) {
            findings.wrong(&camera.name, "is in the calibration and sends nothing");
        }
    }
    for (name, seen) in here {
        camera(name, seen, rig, findings);
    }
}

fn camera(name: &str, seen: &Seen, rig: Option<&Rig>, findings: &mut Findings) {
    if let Some(error) = &seen.unreadable {
        return findings.wrong(name, error);
    }
    let (Some([delay, slow]), Some(clock), Some(format)) =
        (seen.delay_s(), seen.clock_check(), seen.format)
    else {
        return;
    };
    let size = match seen.size {
        [0, 0] => "unknown image size".to_owned(),
        [width, height] => format!("{width} x {height}"),
    };
    let rate = seen.rate_hz().map_or("unknown rate".to_owned(), |rate| format!("{rate:.2} Hz"));
    let shows = 100 * seen.with_people / seen.frames.max(1);
    let text = format!(
        "{rate}, {}, {size}, delay {:.1} ms (99 %: {:.1}), somebody in {shows} %",
        format.name(),
        1e3 * delay,
        1e3 * slow
    );
    match rig.map(|rig| rig.cameras.iter().find(|camera| camera.name == name)) {
        Some(None) => findings.wrong(name, format!("is not in the calibration; {text}")),
        Some(Some(Camera { width, height, .. }))
            if ![[0, 0], [*width, *height]].contains(&seen.size) =>
        {
            findings.wrong(name, format!("the calibration is for {width} x {height}; {text}"));
        }
        _ => match clock {
            Ok(()) => findings.good(name, text),
            Err(fault) => findings.wrong(name, format!("{text}; {fault}")),
        },
    }
}

/// The latency that the settings ask for, and the one that windows need.
fn latency(config: &Config, rate: Option<f64>, delay_s: Option<f64>, findings: &mut Findings) {
    let Some(rate) = rate else { return };
    let delay = 1e3 * delay_s.unwrap_or(0.0).max(0.0);
    let frames = config.tracker.at_period(1e9 / rate).window();
    let window = 1e3 * (frames as f64 - 1.0) / rate;
    let needed = window + SOLVE_MS + delay;
    let parts = format!(
        "window {window:.0}, solve and publish {SOLVE_MS:.0}, cameras and network {delay:.0}"
    );
    match config.node.latency_ms {
        0.0 => findings.good("latency", format!("about {needed:.0} ms: {parts}")),
        asked if asked < delay + 6.0 => findings.wrong(
            "latency",
            format!("{asked} ms is too short: cameras and network alone take {delay:.0} ms"),
        ),
        asked => {
            let text = format!("{asked} ms; whole windows need about {needed:.0} ms: {parts}");
            findings.good("latency", text);
        }
    }
}
