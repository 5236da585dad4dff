//! What the commands that talk to a running node share.

mod before;
mod disturb;
pub mod inbox;
mod numbers;
pub mod player;
pub mod recorder;
pub mod room;
mod silence;
pub mod survey;
pub mod take;

pub use disturb::{Disturbance, Disturbed};
