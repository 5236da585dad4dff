//! Integration tests, one binary.

mod bus;
mod camera;
mod cli;
mod experiments;
mod export;
mod genlock;
mod import;
mod jacobians;
mod layers;
mod live;
mod manifold;
mod messages;
mod methods;
mod node;
mod program;
mod python;
mod recording;
mod retarget;
mod slahmr;
mod solve;
mod synth;
mod take;
mod timing;
mod tools;
mod tracker;
mod train;
