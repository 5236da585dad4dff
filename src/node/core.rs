//! The node without its threads: messages, answers and time in; jobs and messages out.

use std::collections::VecDeque;
use std::sync::Arc;

use super::config::Config;
use crate::msg::Topics;
use crate::time::Timestamp;
use crate::track::{self, Job, Solution};

/// What the core is told.
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
    /// Nothing but time.
    Tick,
    /// The full queue dropped so many messages.
    Dropped(u64),
    /// Poses with a due time left; the deviation of each from it, microseconds, positive is late.
    Played(Vec<i32>),
    /// Nothing more will come.
    End,
}

/// What the core wants done.
#[derive(Clone, Debug)]
pub enum Output {
    /// A job to solve, at most one at a time.
    Solve(Box<Job>),
    /// A message to publish.
    Publish(Publication),
    /// Wants a `Tick` at this time of the node's clock, unless another input comes after it; each
    /// replaces the one before.
    Wake(Timestamp),
}

/// A message to publish.
#[derive(Clone, Debug, PartialEq)]
pub struct Publication {
    /// Where.
    pub topic: Arc<str>,
    /// The capture time that it is about.
    pub capture: Timestamp,
    /// Full name of its schema.
    pub schema: &'static str,
    /// Its bytes.
    pub payload: Vec<u8>,
    /// When to publish it, on the node's clock; at once if not given.
    pub due: Option<Timestamp>,
}

/// What the core is made from; kept in the journal's first entry.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Of the machine.
    pub track: track::Config,
    /// Of the node.
    pub node: Config,
    /// All settings as TOML.
    pub toml: String,
    /// Fingerprint of the weights, hexadecimal.
    pub weights: String,
}

/// The node without its threads. The same inputs at the same times give the same outputs.
pub struct Core {
    settings: Settings,
    topics: Topics,
    outputs: VecDeque<Output>,
}

impl Core {
    /// A core that waits for a rig and for keypoints.
    pub fn new(settings: Settings) -> Self {
        let topics =
            Topics { stage: settings.node.stage.clone(), actor: settings.node.actor.clone() };
        Self { settings, topics, outputs: VecDeque::new() }
    }

    /// Takes an input in; `now` is the node's clock, nanoseconds since 1970, and never goes back.
    pub fn handle(&mut self, now: Timestamp, input: Input) {
        let _ = (now, input, &self.settings, &self.topics);
    }

    /// The next output, if there is one.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }
}
