//! Settings of the live node.

use serde::{Deserialize, Serialize};

use crate::io::formats::Up;

/// Settings of the live node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Name of the capture volume, a part of every topic.
    pub stage: String,
    /// Name of the performer, a part of the topics of all that belongs to him.
    pub actor: String,
    /// Calibration file, read at the start and whenever it changes; empty: from the bus.
    pub rig: String,
    /// The axis of that file's world that points up.
    pub rig_up: Up,
    /// Declared latency: a pose of capture time t goes out at t plus this, milliseconds; 0 finds
    /// it from the first windows.
    pub latency_ms: f64,
    /// Poses a second; 0: as many as the fastest camera's frames.
    pub output_rate_hz: f64,
    /// Whether provisional poses of the open window are solved and published.
    pub provisional: bool,
    /// Whether the solver has a processor core of its own, so that poses leave on time.
    pub solver_core: bool,
    /// Messages that wait for the node at most; beyond, the oldest are dropped.
    pub queue: usize,
    /// Address of a Prometheus endpoint, such as 127.0.0.1:9464; empty: none.
    pub prometheus: String,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            stage: "stage".into(),
            actor: "actor".into(),
            rig: String::new(),
            rig_up: Up::default(),
            latency_ms: 0.0,
            output_rate_hz: 0.0,
            provisional: true,
            solver_core: true,
            queue: 4096,
            prometheus: String::new(),
        }
    }
}
