//! Cameras in time and in place: what the performer's motion says about the cameras' clocks and
//! poses.
//!
//! [`Tracks`] collect the performer's limbs in each view. [`time_offsets`] compares pairs of views,
//! [`LiveOffsets`] does so while the cameras run, [`refine`] adjusts the cameras to triangulated limbs.
//! [`Watchdog`] finds cameras that are moved while they run, and `mend` where they are then.

mod epipolar;
mod live_offsets;
mod mend;
mod normal;
mod refine;
mod time_offsets;
mod tracks;
mod views;
mod watchdog;

#[doc(hidden)]
pub use live_offsets::{LiveOffsets, News};
#[doc(hidden)]
pub use mend::{Seen, mend};
pub use normal::OffsetVerdict;
pub(crate) use normal::REACH as OFFSET_REACH;
pub use refine::{Correction, refine};
pub(crate) use time_offsets::offset_step;
pub use time_offsets::{TimeOffset, time_offsets};
#[doc(hidden)]
pub use tracks::{LIMBS, Limbs, Tracks, limbs};
#[doc(hidden)]
pub use watchdog::{Finding, Watchdog};
