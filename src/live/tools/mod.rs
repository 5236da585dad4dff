//! Tools beside the node: what they share of the bus.

mod disturb;
pub mod inbox;
pub mod player;
pub mod take;

pub use disturb::{Disturbance, Disturbed, Sending};
