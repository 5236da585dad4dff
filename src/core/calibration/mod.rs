//! Cameras in time and in place: what the performer's motion says about the cameras' clocks and
//! poses.
//!
//! [`Tracks`] collect the performer's limbs in each view. [`time_offsets`] compares pairs of views,
//! [`refine`] adjusts the cameras to triangulated limbs.

mod epipolar;
mod refine;
mod time_offsets;
mod tracks;

pub use refine::{Correction, refine};
pub use time_offsets::{OffsetVerdict, TimeOffset, time_offsets};
pub use tracks::{LIMBS, Tracks};
