//! Settings of the live node.

use serde::{Deserialize, Serialize};

use crate::core::limits::{Limit, OutOfRange, check};
use crate::core::tracker::Latency;
use crate::io::formats::{Auto, Convention, Unit, Up};

/// Settings of the live node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Name of the capture volume, part of every topic.
    pub stage: String,
    /// Name of the performer, part of all topics that belong to the performer.
    pub actor: String,
    /// Whether the node solves performers whose keypoints another node publishes, which tells people from each other.
    /// It shares them with others of this kind; `actor` is its name among them.
    pub solver: bool,
    /// Calibration file, read at the start and at each change. Empty: calibration from the bus.
    pub rig: String,
    /// The axis of that file's world that points up.
    pub rig_up: Auto<Up>,
    /// That file's unit of length.
    pub rig_unit: Auto<Unit>,
    /// Recording that holds the performer's body, such as a poses.mcap of `solve`. Empty: the body is
    /// estimated.
    pub body: String,
    /// Declared latency, milliseconds: a pose of capture time t is published at t plus this. A
    /// latency too short for windows gives poses with less look-ahead. 0: the node measures one in
    /// the first windows.
    pub latency_ms: f64,
    /// Poses per second. 0: the frame rate of the fastest camera.
    pub output_rate_hz: f64,
    /// Whether provisional poses of the open window are solved and published.
    pub provisional: bool,
    /// Whether the cameras' time offsets are estimated from the motion and corrected.
    pub time_offsets: bool,
    /// Whether cameras that were moved are found and left out.
    pub watch_cameras: bool,
    /// Whether a camera that was moved gets its new pose by itself; otherwise when asked to.
    pub mend_cameras: bool,
    /// Whether the solver gets a processor core of its own, so that poses are published on time.
    pub solver_core: bool,
    /// Largest number of queued messages; beyond it, the camera with most of them loses its oldest.
    pub queue: usize,
    /// Address of the Prometheus endpoint, such as 127.0.0.1:9464. Empty: none.
    pub prometheus: String,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            stage: "stage".into(),
            actor: "actor".into(),
            solver: false,
            rig: String::new(),
            rig_up: Auto::default(),
            rig_unit: Auto::default(),
            body: String::new(),
            latency_ms: 0.0,
            output_rate_hz: 0.0,
            provisional: true,
            time_offsets: true,
            watch_cameras: true,
            mend_cameras: false,
            solver_core: true,
            queue: 4096,
            prometheus: String::new(),
        }
    }
}

impl Config {
    /// How the calibration file is read. A corrected one is ours and says its unit and axis.
    pub fn convention(&self) -> Convention {
        let (up, unit) = (self.rig_up, self.rig_unit);
        Convention { up, unit, file_first: true, ..Convention::default() }
    }

    /// Checks the ranges of all numbers.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        let (latency, queue) = (self.latency_ms, self.queue as f64);
        let least = if latency == 0.0 { 0.0 } else { Latency::LEAST.ms() };
        let rate = "0 (rate of the cameras) or 1 to 1000";
        check([
            Limit::rate_or_0("output_rate_hz", self.output_rate_hz, rate),
            Limit("queue", queue, 16.0..=1e6, "16 to 1000000"),
            Limit("latency_ms", latency, least..=6e4, "0 (estimated) or 6 to 60000"),
        ])
    }
}
