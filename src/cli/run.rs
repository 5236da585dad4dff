//! `bundlemocap run`

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use clap::Args;
use crossbeam_channel::RecvTimeoutError;

use super::Ended;
use super::bus::{BusName, topics};
use super::clock::{ATTENTION, Stop};
use super::failure::{Exit, Failure};
use super::lookout::look;
use super::settings::changed;
use super::solve::decoder;
use super::stage::StageArguments;
use crate::config::Config;
use crate::core::manifold::Decoder;
use crate::core::tracker::Solver;
use crate::io::bus::{self, BusError, Kind, ZenohMode};
use crate::io::recording::last_body;
use crate::io::wire::{self, StageStatus, Status, Take, decode, encode};
use crate::live::{
    self, Core, Node, NodeError, Presence, Running, Settings, SolverCore, WallClock, log, people_of,
};

/// How often a standby node looks whether it is alone.
const LOOK: Duration = Duration::from_millis(200);
/// How often in a row there must be no other node before a standby takes over.
const LOOKS: u32 = 2;
/// How often a running node looks for an older one, which another network may bring.
const ELDERS: Duration = Duration::from_secs(2);
/// A take is joined after so many looks in a row: if it began after the node started, the command has come by then.
const LOOKS_TO_JOIN: u32 = 3;

/// Run the live node: keypoints from the bus in, poses at a fixed latency out.
#[derive(Debug, Args)]
#[command(after_help = "\
Runs until Ctrl-C or SIGTERM, then publishes the remaining poses and stops; a second signal stops it
at once. Events are logged on standard error, one per line. The environment variable BUNDLEMOCAP_LOG
sets the level (error, warn, info, debug, off) or a filter such as warn,zenoh=info.

Examples:
  bundlemocap run
  bundlemocap run studio.toml --rig Calib_qualisys.toml --prometheus 127.0.0.1:9464
  bundlemocap run studio.toml --body take1/poses.mcap
  bundlemocap run studio.toml --performers auto --names lead,double --bodies bodies/
  bundlemocap run studio.toml --performers auto --bodies bodies/ --only lead,double
  bundlemocap run --listen tcp/0.0.0.0:7447 --latency 50
  bundlemocap run studio.toml --view 127.0.0.1:8765       and open the page in a browser
  bundlemocap run studio.toml --foxglove 127.0.0.1:8766   and open ws://127.0.0.1:8766 in Lichtblick
  bundlemocap run --bus iceoryx2 --seconds 60
  bundlemocap run studio.toml --standby")]
pub(super) struct Arguments {
    /// Settings file; config/default.toml lists every setting.
    config: Option<PathBuf>,
    /// Bus; overrides the settings.
    #[arg(long, value_enum)]
    bus: Option<BusName>,
    /// Calibration file; overrides the settings. Without one, the calibration comes from the bus.
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// Recording that holds the performer's body; overrides the settings. Its bones are kept if they fit.
    /// Without one, the body is estimated.
    #[arg(long, value_name = "FILE")]
    body: Option<PathBuf>,
    /// The performer of that recording, if it has several.
    #[arg(long, value_name = "NAME")]
    body_actor: Option<String>,
    #[command(flatten)]
    stage: StageArguments,
    /// Manifold weights of `bundlemocap train`; default: the embedded weights.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Declared latency, milliseconds, from 6; overrides the settings. Poses of a short latency have
    /// less look-ahead. 0: estimated.
    #[arg(long, value_name = "MS", allow_negative_numbers = true)]
    latency: Option<f64>,
    /// Address on which the node listens; overrides the settings.
    #[arg(long, value_name = "ENDPOINT")]
    listen: Vec<String>,
    /// If another node publishes this performer, wait for its end and take over.
    #[arg(long)]
    standby: bool,
    /// Address of a Prometheus endpoint, such as 127.0.0.1:9464.
    #[arg(long, value_name = "ADDRESS")]
    prometheus: Option<String>,
    /// Serve the page that shows the stage in a browser, on this address. On an address that others can
    /// reach, the page needs the token in the printed address.
    #[cfg(feature = "view")]
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = super::view::ADDRESS)]
    view: Option<String>,
    /// Serve the stage to Foxglove and Lichtblick. Open ws://ADDRESS in them. No token: everybody who can
    /// reach the address can connect.
    #[cfg(feature = "view")]
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = super::view::FOXGLOVE)]
    foxglove: Option<String>,
    /// Stop after N seconds.
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    seconds: Option<f64>,
}

/// Most solver threads.
const MOST_SOLVERS: usize = 8;

impl From<NodeError> for Failure {
    fn from(error: NodeError) -> Self {
        let exit = match error {
            NodeError::Bus(error) => return error.into(),
            NodeError::Rig(error) => return error.into(),
            NodeError::Occupied { .. } => Exit::SecondNode,
            NodeError::Prometheus { .. } | NodeError::Log { .. } => Exit::Usage,
            NodeError::Settings(_) | NodeError::Name(_) => Exit::Malformed,
            NodeError::Thread(_) | NodeError::Fault { .. } | NodeError::NoSolver => {
                Exit::Unexpected
            }
        };
        Self::new(exit, error.to_string())
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let config = settings(arguments)?;
    let seconds = run_time(arguments.seconds)?;
    let decoder = decoder(arguments.weights.as_deref())?;
    let body = match config.node.body.as_str() {
        "" if arguments.body_actor.is_some() => {
            return Err(Failure::new(Exit::Usage, "--body-actor needs --body"));
        }
        "" => None,
        path => {
            let body = last_body(Path::new(path), arguments.body_actor.as_deref())?;
            Some(encode(&wire::Skeleton::from_core(&body)))
        }
    };
    // A wrong file is said at once; while this node stood by, another may have written more.
    config.known_people()?;
    let _log = log::start()?;
    // Before anything is opened, so that a signal always ends in a clean stop.
    let stop = Stop::on_signals()?;

    // Before the node publishes anything, so that a wrong address does not end a node that runs.
    #[cfg(feature = "view")]
    let _page = arguments.view.as_deref().map(|address| view(address, &config)).transpose()?;
    #[cfg(feature = "view")]
    let _bridge =
        arguments.foxglove.as_deref().map(|address| foxglove(address, &config)).transpose()?;

    // Before the bus starts its threads, so that they do not use this core.
    let is_one = !config.stage.several();
    let is_alone = is_one && config.node.solver_core && config.tracker.threads == 1;
    let solver_core = is_alone.then(SolverCore::reserve).flatten();
    let until = seconds.map(|seconds| Instant::now() + seconds);
    let Some(bus) = join(&config, &stop, until)? else { return Ok(Exit::Done) };
    let begin = None;
    let mut ready =
        Ready { arguments, config, decoder, body, stop, seconds, begin, bus, solver_core };
    loop {
        match ready.run()? {
            None => return Ok(Exit::Done),
            // The network was cut while this node stood by.
            Some(elder) if arguments.standby => tracing::warn!("{elder}"),
            Some(elder) => return Err(elder.into()),
        }
    }
}

/// Whether the router may still come. Certificates that are wrong stay so.
fn is_absent(error: &BusError) -> bool {
    match error {
        BusError::NobodyAnswers { .. } => true,
        // It may have begun to listen just now.
        BusError::Refused { endpoint, .. } => endpoint.starts_with("tcp/"),
        _ => false,
    }
}

/// Opens the bus. A client waits for its router: a solver may start before its front. `None` if stopped before.
fn join(
    config: &Config,
    stop: &Stop,
    until: Option<Instant>,
) -> Result<Option<Arc<dyn bus::Bus>>, Failure> {
    let mut is_said = false;
    loop {
        match bus::open_node(&config.bus) {
            Ok(bus) => return Ok(Some(Arc::from(bus))),
            Err(_) if stop.is_set() => return Ok(None),
            Err(error) if is_absent(&error) && until.is_none_or(|until| Instant::now() < until) => {
                if !std::mem::replace(&mut is_said, true) {
                    tracing::warn!("waiting: {error}");
                }
            }
            Err(error) => return Err(error.into()),
        }
        std::thread::sleep(LOOK);
    }
}

/// All that a node needs to run.
struct Ready<'a> {
    arguments: &'a Arguments,
    config: Config,
    decoder: Decoder,
    body: Option<Vec<u8>>,
    stop: Stop,
    seconds: Option<Duration>,
    /// Since when they count: the first run.
    begin: Option<Instant>,
    bus: Arc<dyn bus::Bus>,
    solver_core: Option<SolverCore>,
}

impl Ready<'_> {
    /// Runs the node until it is stopped, or until there is an elder one: `Some`.
    fn run(&mut self) -> Result<Option<NodeError>, Failure> {
        let Self { arguments, config, decoder, body, stop, seconds, begin, bus, solver_core } =
            self;
        let now = WallClock::start().now();
        let several = config.stage.several() && !config.node.solver;
        let presence = Presence::announce(Arc::clone(bus), topics(config), several, now)?;
        let heard = Arc::<Mutex<Option<StageStatus>>>::default();
        let listening = arguments.standby.then(|| listen(&**bus, config, &heard)).transpose()?;
        let Some(presence) = alone(presence, arguments.standby, stop)? else { return Ok(None) };
        drop(listening);
        let mut settings = Settings { body: body.clone(), ..config.core_settings(decoder)? };
        let before = heard.lock().unwrap_or_else(PoisonError::into_inner).take();
        let people = before.map_or_else(Vec::new, |before| people_of(&before, &config.node.actor));
        settings.carried.performers = match people.is_empty() {
            true => config.known_people()?,
            false => people,
        };
        let core = Core::new(settings);
        let is_one = !config.stage.several();
        // Several performers share as many solvers as there are processors.
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let count = if is_one { 1 } else { processors.min(MOST_SOLVERS) };
        let solver = || Solver::new(decoder.clone(), config.tracker);
        let solvers = std::iter::repeat_with(solver).take(count).collect();
        let running =
            Node::start(Arc::clone(bus), presence, core, solvers, &config.node, *solver_core)?;
        say_hello(config, running.prometheus());
        let (node, over) = (running.monitor(), AtomicBool::new(false));
        let begin = *begin.get_or_insert_with(Instant::now);
        let until = seconds.map(|seconds| begin + seconds);
        let (why, elder) = std::thread::scope(|scope| {
            let look_after_cameras = || {
                let is_over = || over.load(Ordering::Relaxed);
                if let Err(error) =
                    look(&**bus, &topics(config), &node, config.node.time_offsets, is_over)
                {
                    tracing::warn!("cannot look after the cameras: {error}");
                }
            };
            // A solver does not get their keypoints.
            if !config.node.solver {
                scope.spawn(look_after_cameras);
            }
            let why = wait(stop, &running, until);
            over.store(true, Ordering::Relaxed);
            why
        });
        let elder = elder.map(|elder| running.presence().stand_back(elder));
        tracing::info!("stopping: {why}");
        let status = running.stop()?;
        say_goodbye(&config.node.actor, status.as_ref());
        Ok(elder)
    }
}

/// Serves the page. It is a client of the bus like other programs, so that it cannot delay the node.
#[cfg(feature = "view")]
fn view(address: &str, config: &Config) -> Result<crate::view::Running, Failure> {
    let page = super::view::serve(address, super::view::live(config.clone()))?;
    // Not a log line, which the log level may hide: only here is the token told.
    super::terminal::note(&format!("the page is on {}", page.url()));
    Ok(page)
}

/// Serves the stage to Foxglove and Lichtblick, as a client of the bus too.
#[cfg(feature = "view")]
fn foxglove(address: &str, config: &Config) -> Result<crate::view::Bridge, Failure> {
    let bridge = crate::view::bridge(address, super::view::stage(config.clone(), "Foxglove"))?;
    tracing::info!("Foxglove and Lichtblick connect to {}", bridge.url());
    Ok(bridge)
}

/// Keeps what the node tells for which this one stands by.
fn listen(
    bus: &dyn bus::Bus,
    config: &Config,
    heard: &Arc<Mutex<Option<StageStatus>>>,
) -> Result<Box<dyn bus::Guard>, Failure> {
    let (heard, actor) = (Arc::clone(heard), config.node.actor.clone());
    // Of several performers there is one node on a stage, whatever it is called.
    let several = config.stage.several();
    let sink = move |sample: bus::Sample| {
        if let Ok(status) = decode::<StageStatus>(&sample.payload)
            && (several || status.node == actor)
        {
            *heard.lock().unwrap_or_else(PoisonError::into_inner) = Some(status);
        }
    };
    Ok(bus.subscribe(&topics(config).stage_status(), Box::new(sink))?)
}

/// The announcement as soon as no other node publishes this performer; `None` if stopped before.
fn alone(presence: Presence, standby: bool, stop: &Stop) -> Result<Option<Presence>, Failure> {
    if !standby {
        return Ok(Some(presence.alone()?));
    }
    let (mut last, mut absent) = (None, 0);
    while absent < LOOKS {
        if stop.is_set() {
            return Ok(None);
        }
        match presence.elder() {
            Ok(None) if presence.is_connected() => absent += 1,
            Ok(None) => absent = 0,
            Ok(Some(elder)) => {
                if last.as_ref() != Some(&elder) {
                    tracing::warn!("standing by for {elder}");
                    last = Some(elder);
                }
                absent = 0;
            }
            // The router does not answer: the other node may run.
            Err(BusError::Closed) => return Err(BusError::Closed.into()),
            Err(error) => {
                tracing::debug!("cannot look for another node: {error}");
                absent = 0;
            }
        }
        std::thread::sleep(LOOK);
    }
    if let Some(elder) = last {
        tracing::warn!("{elder} is gone, taking over");
    }
    Ok(Some(presence))
}

/// The settings, overridden by the arguments.
fn settings(arguments: &Arguments) -> Result<Config, Failure> {
    let config = changed(arguments.config.as_deref(), Config::conflict, |config| {
        if let Some(bus) = arguments.bus {
            config.bus.kind = bus.kind();
        }
        if let Some(rig) = &arguments.rig {
            config.node.rig = rig.display().to_string();
        }
        if let Some(body) = &arguments.body {
            config.node.body = body.display().to_string();
        }
        arguments.stage.apply(&mut config.stage)?;
        if let Some(latency) = arguments.latency {
            config.node.latency_ms = latency;
        }
        if !arguments.listen.is_empty() {
            config.bus.zenoh.listen.clone_from(&arguments.listen);
        }
        if let Some(prometheus) = &arguments.prometheus {
            config.node.prometheus.clone_from(prometheus);
        }
        if config.node.solver && config.node.actor == live::Config::default().actor {
            config.node.actor = own_name();
        }
        Ok(())
    })?;
    // The arguments get the same checks as a file.
    Config::parse(&config.to_toml(), Path::new("the settings")).map_err(|error| {
        let message = error.to_string();
        match arguments.latency {
            Some(_) if message.contains("latency_ms") => Failure::new(Exit::Usage, message),
            _ => error.into(),
        }
    })
}

/// The name of a solver that nobody gave a name.
fn own_name() -> String {
    let computer = rustix::system::uname().nodename().to_string_lossy().into_owned();
    let tame = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    // A name has at most 64 characters.
    let computer: String = computer.chars().map(tame).take(40).collect();
    format!("{computer}-{}", std::process::id())
}

fn run_time(seconds: Option<f64>) -> Result<Option<Duration>, Failure> {
    let wrong = |seconds: f64| {
        let message = format!("--seconds is {seconds}, but must be 0 to 1e8");
        Failure::new(Exit::Usage, message)
    };
    match seconds {
        Some(seconds) if !(0.0..=1e8).contains(&seconds) => Err(wrong(seconds)),
        seconds => Ok(seconds.map(Duration::from_secs_f64)),
    }
}

/// Waits until the node should stop; returns the reason, and the elder node if that is it.
fn wait(
    stop: &Stop,
    running: &Running,
    until: Option<Instant>,
) -> (&'static str, Option<live::Elder>) {
    let mut looked = Instant::now();
    let mut was_connected = true;
    // A take that this node has ended is not joined again.
    let (mut may_join, mut looks) = (true, 0);
    loop {
        if stop.is_set() {
            return ("stopped by a signal", None);
        }
        if until.is_some_and(|until| Instant::now() >= until) {
            return ("the time of --seconds is over", None);
        }
        if looked.elapsed() >= ELDERS {
            looked = Instant::now();
            let is_connected = running.presence().is_connected();
            match (was_connected, is_connected) {
                (true, false) => tracing::warn!("no connection to the router; it is tried again"),
                (false, true) => tracing::warn!("connected to the router again"),
                _ => {}
            }
            was_connected = is_connected;
            let elder = running.presence().elder();
            if let Ok(Some(elder)) = elder {
                return ("another node publishes this performer", Some(elder));
            }
            may_join &= running.status().is_none_or(|status| status.take.is_empty());
            if may_join && elder.is_ok() {
                let take = running.presence().recorded_take().unwrap_or_default();
                looks = if take.is_empty() { 0 } else { looks + 1 };
                if looks == LOOKS_TO_JOIN {
                    let join = Take { action: "join".into(), name: take, ..Take::default() };
                    running.monitor().order(&join);
                }
            }
        }
        if running.over().recv_timeout(ATTENTION) == Err(RecvTimeoutError::Disconnected) {
            return ("the node stopped by itself", None);
        }
    }
}

fn say_hello(config: &Config, prometheus: Option<&str>) {
    let where_to = match config.bus.kind {
        Kind::Zenoh => {
            let zenoh = &config.bus.zenoh;
            let mode = format!("{:?}", zenoh.mode).to_lowercase();
            let to = |what: &str, list: &[String]| match list {
                [] => String::new(),
                list => format!(", {what} {}", list.join(" ")),
            };
            // A client does not listen.
            let listen = if zenoh.mode == ZenohMode::Client { &[][..] } else { &zenoh.listen };
            format!("zenoh {mode}{}{}", to("on", listen), to("to", &zenoh.connect))
        }
        Kind::Iceoryx2 => format!("iceoryx2, prefix {:?}", config.bus.iceoryx2.prefix),
    };
    let node = &config.node;
    tracing::info!(stage = node.stage, actor = node.actor, "listening: {where_to}");
    match node.rig.as_str() {
        "" => tracing::info!("waiting for the calibration on {}", topics(config).rig()),
        path => tracing::info!("calibration from {path}"),
    }
    if let Some(address) = prometheus {
        tracing::info!("metrics on http://{address}/metrics");
    }
}

fn say_goodbye(actor: &str, status: Option<&Status>) {
    let Some(status) = status else { return };
    let playout = status.playout.clone().unwrap_or_default();
    tracing::info!(
        poses = playout.published,
        coasted = playout.coasted,
        missed = playout.missed,
        provisional = playout.provisional,
        dropped = status.queue_dropped,
        actor,
        "ended"
    );
}
