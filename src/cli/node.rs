//! Nodes of `run`: what they share, and what is said of them.

use std::sync::Arc;

use super::bus::topics;
use super::failure::{Exit, Failure};
use super::span::timecode;
use crate::config::Config;
use crate::core::manifold::Decoder;
use crate::core::tracker::Solver;
use crate::io::bus::{self, Kind};
use crate::io::wire::Status;
use crate::live::{Carried, Core, Node, NodeError, Presence, Running, Settings, SolverCore};

impl From<NodeError> for Failure {
    fn from(error: NodeError) -> Self {
        let exit = match error {
            NodeError::Bus(error) => return error.into(),
            NodeError::Rig(error) => return error.into(),
            NodeError::Occupied { .. } => Exit::SecondNode,
            NodeError::Prometheus { .. } | NodeError::Log { .. } => Exit::Usage,
            NodeError::Thread(_) | NodeError::Fault { .. } => Exit::Unexpected,
        };
        Self::new(exit, error.to_string())
    }
}

/// Most solver threads.
const MOST_SOLVERS: usize = 8;

/// What a node is made of.
pub(super) struct Parts {
    pub(super) bus: Arc<dyn bus::Bus>,
    pub(super) decoder: Decoder,
    pub(super) weights: String,
    /// The performer's body if it is known, as the bytes of a `Skeleton` message.
    pub(super) body: Option<Vec<u8>>,
}

/// Starts a node with these settings.
pub(super) fn start_node(
    parts: &Parts,
    config: &Config,
    presence: Presence,
    solver_core: Option<SolverCore>,
) -> Result<Running, Failure> {
    let core = Core::new(Settings {
        tracker: config.tracker,
        stage: config.stage,
        node: config.node.clone(),
        toml: config.to_toml(),
        weights: parts.weights.clone(),
        body: parts.body.clone(),
        carried: Carried::default(),
        timecode: timecode(config)?,
    });
    // Several performers share as many solvers as there are processors.
    let processors = std::thread::available_parallelism().map_or(1, usize::from);
    let count = if config.stage.several() { processors.min(MOST_SOLVERS) } else { 1 };
    let solver = || Solver::new(parts.decoder.clone(), config.tracker);
    let solvers = std::iter::repeat_with(solver).take(count).collect();
    Ok(Node::start(Arc::clone(&parts.bus), presence, core, solvers, &config.node, solver_core)?)
}

pub(super) fn say_hello(config: &Config, prometheus: Option<&str>) {
    let where_to = match config.bus.kind {
        Kind::Zenoh => {
            let zenoh = &config.bus.zenoh;
            let mode = format!("{:?}", zenoh.mode).to_lowercase();
            let to = |what: &str, list: &[String]| match list {
                [] => String::new(),
                list => format!(", {what} {}", list.join(" ")),
            };
            format!("zenoh {mode}{}{}", to("on", &zenoh.listen), to("to", &zenoh.connect))
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

pub(super) fn say_goodbye(actor: &str, status: Option<&Status>) {
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
