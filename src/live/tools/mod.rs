//! Tools that run beside the node, and the queue that they share.

mod disturb;
pub mod inbox;
pub mod player;
pub mod take;

pub use disturb::{Disturbance, Disturbed, Sending};
