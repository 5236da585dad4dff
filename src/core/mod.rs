//! The solver, without I/O and without a clock.
//!
//! The documentation lists the modules for users. The other modules are for the crate itself and its tests,
//! and may change in any version.

#[doc(hidden)]
pub mod association;
pub mod body;
pub mod calibration;
pub mod camera;
pub mod cost;
pub mod detections;
#[doc(hidden)]
pub mod fnv;
#[doc(hidden)]
pub mod limits;
#[doc(hidden)]
pub mod linalg;
pub mod manifold;
mod named;
#[doc(hidden)]
pub mod optimise;
#[doc(hidden)]
pub mod points;
#[doc(hidden)]
pub mod random;
pub mod so3;
pub mod stage;
pub mod time;
pub mod tracker;

pub(crate) use named::named;
