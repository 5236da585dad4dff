//! The solver without its surroundings: no I/O and no clock.

pub mod body;
pub mod camera;
pub mod cost;
pub mod detections;
pub mod linalg;
pub mod manifold;
pub mod optimise;
pub mod random;
pub mod so3;
pub mod time;
pub mod tracker;
