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

/// What all nodes of the program share.
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
    rig: Option<Vec<u8>>,
) -> Result<Running, Failure> {
    let core = Core::new(Settings {
        tracker: config.tracker,
        node: config.node.clone(),
        toml: config.to_toml(),
        weights: parts.weights.clone(),
        body: parts.body.clone(),
        carried: Carried::default(),
        timecode: timecode(config)?,
    });
    let (bus, solver) =
        (Arc::clone(&parts.bus), Solver::new(parts.decoder.clone(), config.tracker));
    Ok(Node::start(bus, presence, core, solver, &config.node, solver_core, rig)?)
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
