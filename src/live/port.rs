//! Inputs, outputs and settings of the core.

use std::sync::Arc;

use super::config::Config;
use super::publication::Publication;
use crate::core::time::Timestamp;
use crate::core::tracker::{self, Job, Solution};

/// An input of the core.
#[derive(Clone, Debug)]
pub enum Input {
    /// A message from the bus.
    Message {
        /// Its topic.
        topic: Arc<str>,
        /// Its bytes.
        payload: Vec<u8>,
    },
    /// A calibration from a file, as the bytes of a `Rig` message.
    RigFile(Vec<u8>),
    /// The answer to the job that is out.
    Solved {
        /// The answer.
        solution: Box<Solution>,
        /// How long the solver took, nanoseconds.
        took_ns: u64,
    },
    /// Time has passed.
    Tick,
    /// So many messages were dropped, since the queue was full.
    Dropped(u64),
    /// Final poses were published; the deviation of each from its due time, microseconds, positive is
    /// late.
    Played(Vec<i32>),
    /// Nothing more will come.
    End,
}

/// What the core asks for.
#[derive(Clone, Debug)]
pub enum Output {
    /// A job to solve, at most one at a time.
    Solve(Box<Job>),
    /// A message to publish.
    Publish(Publication),
    /// Asks for a [`Input::Tick`] at this time of the node's clock, unless another input comes after
    /// it; replaces the time asked for before.
    Wake(Timestamp),
}

/// The settings of a core; the journal's first entry holds them.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Of the tracker.
    pub tracker: tracker::Config,
    /// Of the node.
    pub node: Config,
    /// All settings as TOML.
    pub toml: String,
    /// Fingerprint of the weights, hexadecimal.
    pub weights: String,
}
