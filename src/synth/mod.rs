//! Synthetic recordings with a known truth.
//!
//! A [`Motion`] (or any function from seconds to a pose) is seen by the cameras of a rig, whose
//! detectors err as real ones do ([`Noise`]). Everything follows from a seed.

pub mod curves;
mod leg;
mod motion;

pub use motion::{Motion, MotionStyle};
