//! The live node: messages in, poses at a fixed latency out.

mod answers;
mod cameras;
mod clock;
mod config;
mod core;
mod events;
mod governor;
mod journal;
mod latency;
mod messages;
mod status;

pub use config::Config;
pub use core::{Core, Input, Output, Publication, Settings};
pub use journal::{hash, platform};
