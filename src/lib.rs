//! Streaming human motion capture: 2D keypoints of calibrated cameras in, smooth 3D poses out.
//!
//! The solver is a library without input or output. You give a [`Tracker`] the detections of each
//! camera. It asks you to solve a [`Job`] now and then, and it gives you poses:
//!
//! ```
//! use std::sync::Arc;
//!
//! use bundlemocap::{Input, Output, Rig, Solver, Tracker, TrackerConfig};
//! # use bundlemocap::{Detections, WeightsError};
//!
//! # fn run(rig: Arc<Rig>, frames: impl Iterator<Item = Detections>) -> Result<(), WeightsError> {
//! let config = TrackerConfig::default();
//! let mut tracker = Tracker::new(config, rig);
//! let mut solver = Solver::new(bundlemocap::Decoder::embedded()?, config);
//! for input in frames.map(Input::Detections).chain([Input::End]) {
//!     tracker.handle(input);
//!     while let Some(output) = tracker.poll() {
//!         match output {
//!             Output::Solve(job) => tracker.handle(Input::Solved(solver.solve(&job))),
//!             Output::Pose(pose) => println!("{} ns: {}", pose.capture.ns(), pose.pose.root_position),
//!             _ => {}
//!         }
//!     }
//! }
//! # Ok(())
//! # }
//! ```
//!
//! A [`Stage`] does this for several performers, with [inputs](StageInput) and [outputs](StageOutput) of its own.
//!
//! [`offline`] solves a recording with this loop and writes the results. `live` is the node: it
//! takes detections from a bus and publishes poses at a fixed latency.
//!
//! # Features
//! All are on by default. `default-features = false` leaves the solver, recordings and file formats.
//!
//! | feature | adds |
//! |---|---|
//! | `zenoh`, `iceoryx2` | the buses of that name |
//! | `live` | `live`, the node, and `config`, its settings |
//! | `view` | `view`: the live page, and the connection of Foxglove and Lichtblick |
//! | `research` | `research`: compared methods, experiments, synthetic recordings, training |
//! | `cli` | `cli`, the `bundlemocap` command; it needs `live` and `research` |
//!
//! # Layers
//! A module imports only from modules above it in this table, and in `core` and `io` a part only
//! from parts before it. No files of a folder import each other in a circle.
//! `tests/it/layers.rs` checks all of this.
//!
//! | module | parts | holds |
//! |---|---|---|
//! | [`core`] | `time`, `so3`, `linalg`, `random`, `detections`, `points`, `body`, `camera`, `association`, `calibration`, `optimise`, `manifold`, `cost`, `tracker`, `stage` | the solver: no input or output, no clock |
//! | [`io`] | `timecode`, `wire`, `new_file`, `recording`, `bus`, `formats`, `report` | messages, MCAP files, the bus, other programs' files, the report |
//! | [`diagnose`] | | is a camera wrong, and how to fix it |
//! | [`metrics`] | | errors of poses, reprojection, statistics |
//! | [`retarget`] | | poses on another skeleton |
//! | [`offline`] | | a recording solved, from opening it to its summary |
//! | `live` | `error`, `config`, `clock`, `observe`, `core`, `threads`, `replay` | the node: its core without I/O, the threads around it, replay |
//! | `view` | | the page that shows a stage or a recording in a browser |
//! | `research` | `synth`, `transition`, `train`, `methods`, `experiments` | synthetic recordings, training, compared methods, experiments |
//! | `config` | | all settings in one tree |
//! | `cli` | | the command line, one file for each command |
//!
//! # Conventions
//! The world is right-handed, in metres, y up. `a_from_b` maps coordinates of frame b to frame a.
//! Angles are radians. Missing is `Option`, never NaN or confidence 0.
//!
//! # Sources
//! - \[Albanis 2023\] Albanis, Zioulis, Kolomvatsos. BundleMoCap: Efficient, Robust and Smooth
//!   Motion Capture from Sparse Multiview Videos. CVMP 2023.
//! - \[Bell 1990\] Bell, Pedersen, Brand. A comparison of the accuracy of several hip center
//!   location prediction methods. Journal of Biomechanics 23(6).
//! - \[Bernardin 2008\] Bernardin, Stiefelhagen. Evaluating multiple object tracking performance:
//!   the CLEAR MOT metrics. EURASIP Journal on Image and Video Processing.
//! - \[Boldo 2008\] Boldo, Melquiond. Emulation of a FMA and correctly rounded sums: proved algorithms
//!   using rounding to odd. IEEE Transactions on Computers 57(4).
//! - \[Broyden 1965\] Broyden. A class of methods for solving nonlinear simultaneous equations.
//!   Mathematics of Computation 19.
//! - \[de Leva 1996\] de Leva. Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters.
//!   Journal of Biomechanics 29(9).
//! - \[Gordon 2014\] Gordon et al. 2012 Anthropometric Survey of U.S. Army Personnel: Methods and
//!   Summary Statistics. Natick/TR-15/007.
//! - \[Hyndman 1996\] Hyndman, Fan. Sample quantiles in statistical packages. The American
//!   Statistician 50(4).
//! - \[Kingma 2014\] Kingma, Welling. Auto-encoding variational Bayes. ICLR 2014.
//! - \[Knutson 2005\] Knutson. Anatomic and functional leg-length inequality. Chiropractic &
//!   Osteopathy 13:11.
//! - \[Lange 1989\] Lange, Little, Taylor. Robust statistical modeling using the t distribution.
//!   Journal of the American Statistical Association 84.
//! - \[Loshchilov 2019\] Loshchilov, Hutter. Decoupled weight decay regularization. ICLR 2019.
//! - \[Nielsen 1999\] Nielsen. Damping parameter in Marquardt's method. IMM-REP-1999-05, DTU.
//! - \[Nocedal 2006\] Nocedal, Wright. Numerical Optimization, 2nd edition. Springer.
//! - \[Okabe 2008\] Okabe, Ito. Color universal design. University of Tokyo.
//! - \[Pagnon 2022\] Pagnon, Domalain, Reveret. Pose2Sim: an open-source Python package for multiview
//!   markerless kinematics. Journal of Open Source Software 7(77).
//! - \[Pavlakos 2019\] Pavlakos et al. Expressive body capture: 3D hands, face, and body from a
//!   single image. CVPR 2019.
//! - \[Rempe 2021\] Rempe et al. HuMoR: 3D human motion model for robust pose estimation. ICCV 2021.
//! - \[Sen 1968\] Sen. Estimates of the regression coefficient based on Kendall's tau. Journal of the
//!   American Statistical Association 63.
//! - \[Sola 2018\] Sola, Deray, Atchuthan. A micro Lie theory for state estimation in robotics.
//!   arXiv:1812.01537.
//! - \[Welch 1967\] Welch. The use of fast Fourier transform for the estimation of power spectra.
//!   IEEE Transactions on Audio and Electroacoustics 15(2).
//! - \[Winter 2009\] Winter. Biomechanics and Motor Control of Human Movement, 4th edition. Wiley.
//! - \[Ye 2023\] Ye, Pavlakos, Malik, Kanazawa. Decoupling human and camera motion from videos in
//!   the wild. CVPR 2023.
//! - \[Zhou 2019\] Zhou, Barnes, Lu, Yang, Li. On the continuity of rotation representations in
//!   neural networks. CVPR 2019.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod cli;
#[cfg(feature = "live")]
pub mod config;
pub mod core;
pub mod diagnose;
pub mod io;
#[cfg(feature = "live")]
pub mod live;
pub mod metrics;
pub mod offline;
/// Methods, synthetic recordings and training for the evaluation. It may change in any version.
#[cfg(feature = "research")]
pub mod research;
pub mod retarget;
#[cfg(feature = "view")]
pub mod view;

/// Vectors, rotations and matrices of this library are nalgebra's.
pub use nalgebra;

pub use crate::core::body::{Joint, Pose, Skeleton, StampedPose, TrackingState};
pub use crate::core::camera::{Camera, CameraError, Lens, Rig};
pub use crate::core::detections::{Detection, Detections, Keypoint, KeypointFormat, Person};
pub use crate::core::manifold::{Decoder, WeightsError};
pub use crate::core::stage::{
    Input as StageInput, Output as StageOutput, PerformerId, Performers, Stage,
};
pub use crate::core::time::{Nanos, Timestamp};
pub use crate::core::tracker::{
    Config as TrackerConfig, Event, EventKind, Input, Job, Output, Solution, Solver, Tracker,
};
