//! What several commands share that talk to a running node.

mod disturb;
pub mod inbox;
pub mod player;
pub mod recorder;
pub mod room;
mod silence;
pub mod survey;
pub mod take;

pub use disturb::{Disturbance, Disturbed};
