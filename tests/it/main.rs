//! Integration tests, one binary.

mod camera;
mod cli;
mod export;
mod import;
mod jacobians;
mod layers;
mod manifold;
mod messages;
mod recording;
mod retarget;
mod solve;
mod synth;
mod track;
mod train;
