//! Why the node does not start, or stops.

use std::io;

use crate::io::bus::BusError;
use crate::io::formats::ImportError;

/// Why the node does not start, or stops.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// A topic cannot be used.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The calibration file cannot be used.
    #[error(transparent)]
    Rig(#[from] ImportError),
    /// The Prometheus endpoint cannot be opened.
    #[error(
        "cannot listen for Prometheus on {address:?}: {reason}; give a free address and port, such \
         as 127.0.0.1:9464"
    )]
    Prometheus {
        /// The address from the settings.
        address: String,
        /// The reason from the system.
        reason: String,
    },
    /// The log filter is not valid.
    #[error("{variable} is {value:?}: {reason}; use a level such as info, or off")]
    Log {
        /// The environment variable.
        variable: &'static str,
        /// Its value.
        value: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The system refuses another thread.
    #[error("cannot start a thread: {0}; raise the limit of processes")]
    Thread(io::Error),
    /// A thread ended too early, by a fault of this program.
    #[error(
        "the {thread} thread ended by itself; this is a fault of the program, please report it"
    )]
    Fault {
        /// Name of the thread.
        thread: &'static str,
    },
}
