//! The live node: messages in, poses at a fixed latency out.
//!
//! [`Core`] does no I/O: its inputs are messages, solutions and time; its outputs are jobs and
//! publications. The threads around it: the bus fills bounded queues ([`Intake`]), the node loop
//! passes inputs and outputs, others solve, and one thread publishes poses when they are due
//! ([`Schedule`]).

pub(crate) mod clock;
mod config;
mod core;
mod error;
mod observe;
mod replay;
mod threads;

pub use clock::wall::WallClock;
pub use config::Config;
pub use core::Core;
pub use core::journal::platform;
pub use core::port::{
    Carried, Input, Loss, MOST_BYTES, MOST_ORDER_BYTES, Output, Settings, people_of,
};
pub use core::publication::{Content, Publication};
pub use error::{Elder, NodeError};
#[cfg(feature = "view")]
pub(crate) use observe::advice::{USED_AGAIN, advice, is_expected, is_fine};
pub use observe::process::Usage;
pub use observe::{log, metrics};
pub use replay::compare::{Comparison, Recorded};
pub use replay::{Gap, ReplayError, Replayed, find_nodes, replay};
pub use threads::cpu_affinity::SolverCore;
pub use threads::playout::{Deviations, Schedule};
pub use threads::presence::Presence;
pub use threads::queue::{Intake, Message};
pub use threads::rig_file::RigFile;
pub use threads::run::{Monitor, Node, Running};
