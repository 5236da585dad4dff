//! The live node: messages in, poses at a fixed latency out.

mod config;
mod core;

pub use config::Config;
pub use core::{Core, Input, Output, Publication, Settings};
