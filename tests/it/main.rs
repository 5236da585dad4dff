//! Integration tests, one binary.

mod baseline;
mod bus;
mod camera;
mod cli;
mod export;
mod genlock;
mod import;
mod jacobians;
mod layers;
mod live;
mod manifold;
mod messages;
mod node;
mod program;
mod python;
mod recording;
mod retarget;
mod slahmr;
mod solve;
mod study;
mod synth;
mod take;
mod tools;
mod track;
mod train;
