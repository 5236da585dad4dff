//! A recording solved: opened, fed to the tracker, summarised, written.

pub mod bvh;
pub mod driver;
pub mod figures;
mod hold_out;
pub mod input;
pub mod kept;
pub mod output;
mod reference;

pub use hold_out::{CONFIDENT, HeldOut, HoldOut, Kept, distances, pose_at};
pub use reference::{FrameClock, Reference, compare};
