//! Why the node does not start, or stops.

use std::io;

use crate::core::limits::OutOfRange;
use crate::core::time::Timestamp;
use crate::io::bus::BusError;
use crate::io::formats::ImportError;
use crate::io::wire::NameError;

/// Why the node does not start, or stops. Its text says what is wrong, with units.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum NodeError {
    /// A topic cannot be used.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A number of the settings is out of range.
    #[error("[node] {0}")]
    Settings(#[from] OutOfRange),
    /// The name of the stage or the actor is not valid.
    #[error(transparent)]
    Name(#[from] NameError),
    #[error("the node has no solver; give it one or more")]
    NoSolver,
    /// The calibration file cannot be used.
    #[error(transparent)]
    Rig(#[from] ImportError),
    #[error(
        "another node publishes on stage {stage:?} what this one would (actor {actor:?}, or several performers): {elder}; \
         stop it, or wait for its end with --standby. Otherwise choose another [node] actor or, for several performers, \
         another [node] stage"
    )]
    Occupied { stage: String, actor: String, elder: Elder },
    #[error(
        "cannot listen for Prometheus on {address:?}: {reason}; give a free address and port, such \
         as 127.0.0.1:9464"
    )]
    Prometheus { address: String, reason: String },
    #[error("{variable} is {value:?}: {reason}; use a level such as info, or off")]
    Log { variable: &'static str, value: String, reason: String },
    #[error("cannot start a thread: {0}; raise the limit of processes")]
    Thread(io::Error),
    #[error(
        "the {thread} thread ended by itself; this is a fault of the program, please report it"
    )]
    Fault { thread: &'static str },
}

/// A node that was announced before another one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Elder {
    /// Its id, hexadecimal.
    pub id: String,
    /// When it was announced, on its own clock.
    pub since: Timestamp,
}

impl std::fmt::Display for Elder {
    fn fmt(&self, to: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let seconds = self.since.ns() / 1_000_000_000;
        let (hours, minutes) = (seconds / 3600 % 24, seconds / 60 % 60);
        write!(to, "node {}, since {hours:02}:{minutes:02}:{:02} UTC", self.id, seconds % 60)
    }
}
