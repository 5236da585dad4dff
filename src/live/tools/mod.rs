//! Tools that run beside the node, and the queue that they share.

mod disturb;
#[cfg(feature = "cli")]
pub mod inbox;
#[cfg(feature = "cli")]
pub mod player;
#[cfg(feature = "cli")]
pub mod recorder;
#[cfg(feature = "cli")]
pub mod room;
#[cfg(feature = "cli")]
mod silence;
#[cfg(feature = "cli")]
pub mod survey;
#[cfg(feature = "cli")]
pub mod take;

pub use disturb::{Disturbance, Disturbed, Sending};
