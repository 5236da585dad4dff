//! Methods measured against each other, synthetic recordings, training.

pub mod experiments;
pub mod methods;
pub mod synth;
pub mod train;
pub mod transition;
