//! The solver, without I/O and without a clock.

pub mod association;
pub mod body;
pub mod calibration;
pub mod camera;
pub mod cost;
pub mod detections;
pub mod fnv;
pub mod limits;
pub mod linalg;
pub mod manifold;
pub mod optimise;
pub mod points;
pub mod random;
pub mod so3;
pub mod stage;
pub mod time;
pub mod tracker;
