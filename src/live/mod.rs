//! The live node: messages in, poses at a fixed latency out.
//!
//! [`Core`] does no I/O: its inputs are messages, solutions and time; its outputs are jobs and
//! publications. The threads around it: the bus fills bounded queues ([`Intake`]), the node loop
//! passes inputs and outputs, one thread solves, and one thread publishes poses when they are due
//! ([`Schedule`]).

mod advice;
mod answers;
mod board;
mod camera_clock;
mod cameras;
mod clock;
mod clock_base;
mod compare;
mod config;
mod core;
mod cpu_affinity;
mod delays;
mod endpoint;
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
mod performer;
mod performers;
mod playout;
mod port;
mod presence;
mod process;
mod publication;
mod queue;
mod replay;
mod rig_file;
mod rigs;
mod run;
mod solvers;
mod status;
mod take;
pub mod tools;
mod wall;
mod watch;

pub use compare::{Comparison, Recorded};
pub use config::Config;
pub use core::Core;
pub use cpu_affinity::SolverCore;
pub use error::{Elder, NodeError};
pub use journal::platform;
pub use playout::{Deviations, Schedule};
pub use port::{Carried, Input, Loss, MOST_BYTES, MOST_ORDER_BYTES, Output, Settings};
pub use presence::Presence;
pub use process::Usage;
pub use publication::{Content, Publication};
pub use queue::{Intake, Message};
pub use replay::{Gap, ReplayError, Replayed, find_node, replay};
pub use rig_file::RigFile;
pub use run::{Monitor, Node, Running};
pub use wall::WallClock;
