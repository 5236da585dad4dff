//! The node with its threads, from start to stop.

use std::collections::BTreeSet;
use std::fmt;
use std::path::PathBuf;
use std::sync::{Arc, PoisonError};
use std::thread::{Builder, JoinHandle};
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, SendTimeoutError, Sender, bounded, never};

use super::bodies_folder::BodiesFolder;
use super::cpu_affinity::SolverCore;
use super::node_loop::{Inbox, NodeLoop, Progress, Token};
use super::outlet::Outlet;
use super::playout::Playout;
use super::presence::Presence;
use super::queue::{Intake, MOST_A_SECOND, MOST_OF_ALL, Message};
use super::rig_file::RigFile;
use super::solvers::Solvers;
use crate::core::stage::PerformerId;
use crate::core::time::Nanos;
use crate::core::tracker::{Job, Solver};
use crate::io::bus::{Bus, Guard};
use crate::io::wire::{
    Event, Journal, Keyframe, Pose, Rig, Schema, Skeleton, StageStatus, Status, Take, TakeAnswer,
    Topics, encode,
};
use crate::live::clock::wall::WallClock;
use crate::live::config::Config;
use crate::live::core::Core;
use crate::live::error::NodeError;
use crate::live::observe::board::Board;
use crate::live::observe::endpoint::Endpoint;

/// How often a node looks which solvers are there.
const LOOK_FOR_SOLVERS: Duration = Duration::from_millis(50);
/// How often the calibration file is checked for changes.
const LOOK: Duration = Duration::from_millis(500);
/// Most batches of deviations that wait for the node loop; there is one per second.
const BATCHES: usize = 64;
/// Most calibrations that wait to be written.
const MENDED: usize = 64;

/// The others take over the performers of a solver that says nothing, after three seconds. A pose that is this late may come
/// from them.
const TAKEN_OVER: Nanos = Nanos::from_ms(2000);
/// Most bodies that wait to be written.
const BODIES: usize = 64;

/// A live node.
pub struct Node;

/// A running node. It stops when it is dropped; [`Running::stop`] also waits for the end.
pub struct Running {
    inputs: Vec<Box<dyn Guard>>,
    rig_answer: Option<Box<dyn Guard>>,
    stop: Sender<()>,
    over: Receiver<()>,
    stop_looking: Sender<()>,
    node_loop: JoinHandle<Result<(), NodeError>>,
    threads: Vec<(&'static str, JoinHandle<()>)>,
    playout: Arc<Playout>,
    endpoint: Option<Endpoint>,
    board: Arc<Board>,
    intake: Intake,
    topics: Topics,
    presence: Presence,
}

/// State of a node, for any thread.
#[derive(Clone)]
pub struct Monitor {
    board: Arc<Board>,
    intake: Intake,
    topics: Topics,
}

impl Monitor {
    /// The last status, if there is one.
    pub fn status(&self) -> Option<Status> {
        self.board.status()
    }

    /// The bytes of the `Rig` message in use, if there is one.
    pub fn rig(&self) -> Option<Vec<u8>> {
        self.board.rig().map(|sample| sample.payload)
    }

    /// Gives the node a command, as if it came from the bus. The journal has it.
    pub fn order(&self, take: &Take) {
        self.intake.push(Message { topic: self.topics.take().into(), payload: encode(take) });
    }
}

impl Node {
    /// Starts the threads and subscribes to the bus. `presence` is that of this node, alone; `config`
    /// is the core's. Each solver has a thread, the first one on `solver_core` if there is one.
    ///
    /// # Errors
    /// A setting is out of range, there is no solver, the bus refuses the topics, the calibration file
    /// cannot be used, the address is in use, or the system cannot start a thread.
    pub fn start(
        bus: Arc<dyn Bus>,
        presence: Presence,
        core: Core,
        solvers: Vec<Solver>,
        config: &Config,
        solver_core: Option<SolverCore>,
    ) -> Result<Running, NodeError> {
        config.validate()?;
        if solvers.is_empty() {
            return Err(NodeError::NoSolver);
        }
        let topics = Topics::new(&config.stage, &config.actor)?;
        let (clock, board) = (WallClock::start(), Arc::<Board>::default());
        // All performers of a solver have one queue.
        let most_of_others = if config.solver { MOST_OF_ALL } else { MOST_A_SECOND };
        let orders = [topics.take(), topics.rig()];
        let intake = Intake::new(config.queue, &orders, most_of_others);
        let endpoint = match config.prometheus.as_str() {
            "" => None,
            address => Some(Endpoint::start(address, Arc::clone(&board))?),
        };

        let (stop_looking, looking) = bounded(0);
        let mut threads = Vec::new();
        let (mended, to_write) = bounded(MENDED);
        let solver_names = match core.looks_for_solvers() {
            true => watch_solvers(&bus, &topics, looking.clone(), &mut threads)?,
            false => never(),
        };
        let rigs = match config.rig.as_str() {
            "" => never(),
            path => watch_rig(path.into(), config, (looking, to_write), &mut threads)?,
        };
        let (bodies, to_keep) = bounded::<(PerformerId, String, Option<Skeleton>)>(BODIES);
        if !core.bodies_folder().is_empty() {
            let mut folder = BodiesFolder::new(core.bodies_folder().into());
            let work = move || {
                to_keep
                    .iter()
                    .for_each(|(performer, name, body)| folder.change(performer, &name, body));
            };
            threads.push(("bodies", thread("bodies").spawn(work).map_err(NodeError::Thread)?));
        }
        let outlet = loop_outlet(&bus, &topics, &board)?;
        let solve = |mut solver: Solver| move |job: &Job| solver.solve(job);
        let solvers = solvers.into_iter().map(solve).collect();
        let (jobs, answers) = Solvers::start(solvers, solver_core, &mut threads)?;
        let playout = Arc::<Playout>::default();
        let most_late = config.solver.then_some(TAKEN_OVER);
        // It starts last: it holds the bus until the playout is closed.
        let played =
            start_playout(&bus, &topics, clock, &playout, &board, most_late, &mut threads)?;

        let (patterns, token) = (core.inputs(), Token::default());
        let (stop, stopped) = bounded(1);
        let node_loop = NodeLoop {
            core,
            clock,
            inbox: Inbox {
                intake: intake.clone(),
                answers,
                played,
                rigs,
                solver_names,
                stop: stopped,
            },
            token: Arc::clone(&token),
            jobs,
            playout: Arc::clone(&playout),
            outlet,
            board: Arc::clone(&board),
            rig_topic: topics.rig(),
            mended,
            bodies,
            progress: Progress::default(),
        };
        let (alive, over) = bounded(0);
        let work = move || {
            let _alive: Sender<()> = alive;
            node_loop.run()
        };
        let node_loop = thread("node-loop").spawn(work).map_err(NodeError::Thread)?;
        let mut running = Running {
            inputs: Vec::new(),
            rig_answer: None,
            stop,
            over,
            stop_looking,
            node_loop,
            threads,
            playout,
            endpoint,
            board,
            intake,
            topics,
            presence,
        };
        running.listen(&*bus, patterns)?;
        if config.solver {
            // It gets performers from here on.
            let announced = bus.announce(&running.topics.solver())?;
            *token.lock().unwrap_or_else(PoisonError::into_inner) = Some(announced);
        }
        Ok(running)
    }
}

impl fmt::Debug for Running {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Running").field("topics", &self.topics).finish_non_exhaustive()
    }
}

impl Running {
    /// The first of the patterns is the rig's topic.
    fn listen(&mut self, bus: &dyn Bus, patterns: Vec<String>) -> Result<(), NodeError> {
        let board = Arc::clone(&self.board);
        self.rig_answer = bus.answer(&patterns[0], Box::new(move || board.rig()))?;
        for pattern in patterns {
            let intake = self.intake.clone();
            let sink = move |sample: crate::io::bus::Sample| {
                intake.push(Message { topic: sample.topic, payload: sample.payload });
            };
            self.inputs.push(bus.subscribe(&pattern, Box::new(sink))?);
        }
        Ok(())
    }

    /// The node's announcement on the bus. It tells of an older node if two networks were joined while both nodes ran.
    pub fn presence(&self) -> &Presence {
        &self.presence
    }

    /// Disconnected when the node has stopped by itself, which is a fault.
    pub fn over(&self) -> &Receiver<()> {
        &self.over
    }

    /// The last status, if there is one.
    pub fn status(&self) -> Option<Status> {
        self.board.status()
    }

    /// State of the node for other threads.
    pub fn monitor(&self) -> Monitor {
        let (board, intake) = (Arc::clone(&self.board), self.intake.clone());
        Monitor { board, intake, topics: self.topics.clone() }
    }

    /// Number of messages that could not be published.
    pub fn publish_failures(&self) -> u64 {
        self.board.publish_failures()
    }

    /// Address of the Prometheus endpoint, if there is one.
    pub fn prometheus(&self) -> Option<&str> {
        self.endpoint.as_ref().map(|endpoint| endpoint.address.as_str())
    }

    /// Stops the input, publishes the remaining poses at their due times, and ends every thread.
    /// Returns the last status.
    ///
    /// # Errors
    /// A thread ended too early, by a fault.
    pub fn stop(self) -> Result<Option<Status>, NodeError> {
        drop(self.inputs);
        drop(self.stop);
        let ended = self.node_loop.join();
        self.playout.close();
        drop(self.stop_looking);
        let mut fault = None;
        for (name, thread) in self.threads {
            if thread.join().is_err() {
                fault = Some(NodeError::Fault { thread: name });
            }
        }
        drop((self.rig_answer, self.endpoint));
        let ended = ended.unwrap_or(Err(NodeError::Fault { thread: "node loop" }));
        fault.map_or(ended, Err)?;
        Ok(self.board.status())
    }
}

fn thread(name: &str) -> Builder {
    Builder::new().name(name.into())
}

/// Opens the topics on which the node loop publishes.
fn loop_outlet(bus: &Arc<dyn Bus>, topics: &Topics, board: &Board) -> Result<Outlet, NodeError> {
    let mut outlet = Outlet::new(Arc::clone(bus), board.failures());
    let all = [
        (topics.provisional(), Pose::FULL_NAME),
        (topics.keyframe(), Keyframe::FULL_NAME),
        (topics.skeleton(), Skeleton::FULL_NAME),
        (topics.actor_events(), Event::FULL_NAME),
        (topics.stage_events(), Event::FULL_NAME),
        (topics.stage_status(), StageStatus::FULL_NAME),
        (topics.status(), Status::FULL_NAME),
        (topics.journal(), Journal::FULL_NAME),
        (topics.take_answers(), TakeAnswer::FULL_NAME),
    ];
    for (topic, schema) in all {
        outlet.open(&topic, schema)?;
    }
    Ok(outlet)
}

/// Starts the thread that publishes poses when they are due and returns their deviations.
fn start_playout(
    bus: &Arc<dyn Bus>,
    topics: &Topics,
    clock: WallClock,
    playout: &Arc<Playout>,
    board: &Board,
    most_late: Option<Nanos>,
    threads: &mut Vec<(&'static str, JoinHandle<()>)>,
) -> Result<Receiver<Vec<i32>>, NodeError> {
    let mut outlet = Outlet::new(Arc::clone(bus), board.failures()).up_to(most_late);
    outlet.open(&topics.pose(), Pose::FULL_NAME)?;
    let (sender, played) = bounded(BATCHES);
    let playout = Arc::clone(playout);
    let work = move || playout.run(clock, outlet, &sender);
    threads.push(("playout", thread("playout").spawn(work).map_err(NodeError::Thread)?));
    Ok(played)
}

/// Starts the thread that looks which solvers are there, until `looking` closes. It puts out their names at first and
/// at each change.
fn watch_solvers(
    bus: &Arc<dyn Bus>,
    topics: &Topics,
    looking: Receiver<()>,
    threads: &mut Vec<(&'static str, JoinHandle<()>)>,
) -> Result<Receiver<Vec<String>>, NodeError> {
    let root = Topics { actor: String::new(), ..topics.clone() }.solver();
    let (bus, (sender, names)) = (Arc::clone(bus), bounded(1));
    let work = move || {
        let (mut before, mut unsure) = (None, None);
        while looking.recv_timeout(LOOK_FOR_SOLVERS) == Err(RecvTimeoutError::Timeout) {
            let names = match bus.announced(&format!("{root}*")) {
                // Without a router nobody is seen; the others may be there.
                Ok(_) if !bus.is_connected() => {
                    unsure = None;
                    continue;
                }
                Ok(names) => names,
                Err(error) => {
                    tracing::debug!("cannot look for solvers: {error}");
                    continue;
                }
            };
            let names = names.iter().filter_map(|name| name.strip_prefix(&root));
            let names: BTreeSet<String> = names.map(str::to_owned).collect();
            // Whose connection just ended sees nobody for a moment: who is gone must be so twice.
            let is_less =
                before.as_ref().is_some_and(|before: &BTreeSet<_>| !before.is_subset(&names));
            if is_less && unsure.as_ref() != Some(&names) {
                unsure = Some(names);
                continue;
            }
            unsure = None;
            if before.as_ref() != Some(&names) {
                let all = names.iter().cloned().collect();
                if sender.try_send(all).is_ok() {
                    before = Some(names);
                }
            }
        }
    };
    threads.push(("solver names", thread("solver-names").spawn(work).map_err(NodeError::Thread)?));
    Ok(names)
}

/// Writes calibrations with a mended camera, each in place of the one of that version.
fn write_mended(file: &mut RigFile, mended: &Receiver<(Rig, u64)>) {
    for (rig, instead_of) in mended.try_iter() {
        match file.replace(&rig, instead_of) {
            Ok(done) => tracing::info!("the mended calibration is written: {done}"),
            Err(why) => tracing::warn!("the mended calibration is used, but not written: {why}"),
        }
    }
}

/// Starts the thread that reads the calibration file, and writes the given ones to it, until `looking`
/// closes.
fn watch_rig(
    path: PathBuf,
    config: &Config,
    (looking, to_write): (Receiver<()>, Receiver<(Rig, u64)>),
    threads: &mut Vec<(&'static str, JoinHandle<()>)>,
) -> Result<Receiver<Vec<u8>>, NodeError> {
    let (mut file, first) = RigFile::open(path, config.convention())?;
    let (sender, rigs) = bounded(1);
    let _ = sender.try_send(first);
    let work = move || {
        let mut unsent = None;
        while looking.recv_timeout(LOOK) == Err(RecvTimeoutError::Timeout) {
            write_mended(&mut file, &to_write);
            let path = file.path().display().to_string();
            match file.changed() {
                Ok(None) => {}
                Ok(Some(rig)) => {
                    tracing::info!(path, "the calibration has changed");
                    unsent = Some(rig);
                }
                Err(error) => tracing::warn!("the previous calibration is kept: {error}"),
            }
            if let Some(rig) = unsent.take()
                && let Err(SendTimeoutError::Timeout(rig)) = sender.send_timeout(rig, LOOK)
            {
                unsent = Some(rig);
            }
        }
        write_mended(&mut file, &to_write);
    };
    threads.push(("rig file", thread("rig-file").spawn(work).map_err(NodeError::Thread)?));
    Ok(rigs)
}
