//! Solves a recording: opens it once, streams it through the tracker, summarises and writes.
//!
//! ```no_run
//! use bundlemocap::offline::{self, Options, Recording};
//!
//! # fn main() -> Result<(), offline::Error> {
//! let mut recording = Recording::open("recordings/walk.mcap")?;
//! let options = Options { out: Some("out".into()), ..Options::default() };
//! println!("{}", offline::solve(&mut recording, &options, &mut ())?);
//! # Ok(())
//! # }
//! ```
//!
//! Memory does not grow with the recording's length: poses are written and compared one by one,
//! errors are counted in [`Distribution`](crate::metrics::Distribution)s, and the plots of the
//! report average over time beyond 4096 values. Where capture times are corrected, frames wait for those of other
//! cameras, at most 50,000 of them.

mod body;
pub(crate) mod bvh;
mod calibrate;
mod camera_states;
mod check;
mod collected;
pub(crate) mod compact_pose;
mod driver;
mod error;
mod first_pass;
mod hold_out;
mod in_order;
mod motion;
mod options;
pub(crate) mod output;
pub(crate) mod poses;
pub(crate) mod recording;
mod reference;
mod series;
mod solve;
mod summary;
mod tracking;
mod truth;
mod windows;

pub use body::{TakeBody, estimate_body};
pub use calibrate::{CameraCorrection, ChangedCamera, CheckedCameras, check_cameras};
pub use check::check;
pub use error::Error;
pub use first_pass::{CameraOffset, first_pass_settings};
pub use hold_out::{HeldOut, HoldOut, Located, differences, distances, pose_at};
pub use motion::{Motion, read_motions};
pub use options::{NewCompanion, Observer, Options};
pub use recording::Recording;
pub use reference::{FrameClock, Reference, ReferenceComparison, ReferenceFit, positions};
pub use solve::{solve, solve_group};
pub use summary::{Group, PerformerSummary, Reprojection, SolveTime, Summary};
