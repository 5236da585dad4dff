//! Streaming human motion capture: 2D keypoints of calibrated cameras in, smooth 3D poses out.
//!
//! The modules are layers; each imports only from those above it in this list
//! (`tests/it/layers.rs` checks it):
//!
//! | rank | module | holds |
//! |---|---|---|
//! | 0 | [`time`], [`so3`], [`gemm`], [`detect`] | time stamps, rotations, dense products, what a 2D detector says |
//! | 1 | [`body`], [`camera`], [`solve`] | skeleton and keypoints; cameras and triangulation; optimisers that know no bodies |
//! | 2 | [`manifold`] | pose decoder, weights, interpolation |
//! | 3 | [`cost`], [`msg`] | the window problem: reprojection, robust loss, prior; wire types |
//! | 4 | [`track`] | the sans-IO machine: window assembly, acquisition, tracking |
//! | 5 | [`bus`], [`record`], [`import`], [`export`], [`train`], [`synth`], [`eval`] | the edges |
//! | 6 | [`config`], [`cli`] | composition |
//!
//! Conventions: world right-handed, metres, y up. `a_from_b` maps coordinates of frame b to
//! frame a. Angles in radians. Missing is `Option`, never NaN or confidence 0.
//!
//! # Sources
//! - \[Albanis 2023\] Albanis, Zioulis, Kolomvatsos. BundleMoCap: Efficient, Robust and Smooth
//!   Motion Capture from Sparse Multiview Videos. CVMP 2023.

pub mod body;
pub mod bus;
pub mod camera;
pub mod cli;
pub mod config;
pub mod cost;
pub mod detect;
pub mod eval;
pub mod export;
pub mod gemm;
pub mod import;
pub mod manifold;
pub mod msg;
pub mod record;
pub mod so3;
pub mod solve;
pub mod synth;
pub mod time;
pub mod track;
pub mod train;
