//! The live node: messages in, poses at a fixed latency out.
//!
//! [`Core`] does no I/O. Around it are threads: the bus calls back into a bounded queue
//! ([`Intake`]), the machine's thread gives messages, answers and time to the core and does what it
//! wants, one worker solves, and one timer publishes the poses that are due ([`Schedule`]).

mod answers;
mod board;
mod cameras;
mod clock;
mod config;
mod core;
mod cpu_affinity;
mod error;
mod events;
mod governor;
mod journal;
mod latency;
pub mod log;
mod messages;
pub mod metrics;
mod node_loop;
mod outlet;
mod playout;
mod process;
mod queue;
mod replay;
mod rig_file;
mod run;
mod status;
pub mod tools;
mod wall;

pub use config::Config;
pub use core::{Core, Input, Output, Publication, Settings};
pub use cpu_affinity::SolverCore;
pub use error::NodeError;
pub use journal::{hash, platform};
pub use playout::{Deviations, Schedule};
pub use process::Usage;
pub use queue::{Intake, Message};
pub use replay::{Comparison, Recorded, ReplayError, Replayed, replay};
pub use rig_file::RigFile;
pub use run::{Node, Running};
pub use wall::WallClock;
