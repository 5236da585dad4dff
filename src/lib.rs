//! Streaming human motion capture: 2D keypoints of calibrated cameras in, smooth 3D poses out.
//!
//! The modules are layers; each imports only from those above it in this list
//! (`tests/it/layers.rs` checks it):
//!
//! | rank | module | holds |
//! |---|---|---|
//! | 0 | [`time`], [`so3`], [`gemm`], [`detect`] | time stamps, rotations, dense products, what a 2D detector says |
//! | 1 | [`body`], [`camera`], [`solve`] | skeleton and keypoints; cameras and triangulation; optimisers that know no bodies |
//! | 2 | [`manifold`] | pose decoder, weights, interpolation, transitions |
//! | 3 | [`cost`], [`msg`] | the window problem: reprojection, robust loss, prior; wire types |
//! | 4 | [`track`], [`baseline`] | the sans-IO machine: window assembly, acquisition, tracking; the methods it is compared with |
//! | 5 | [`bus`], [`record`], [`import`], [`export`], [`retarget`], [`train`], [`synth`], [`eval`] | the edges |
//! | 6 | [`node`], [`config`], [`study`], [`cli`] | the live node; methods measured against each other; composition |
//!
//! Conventions: world right-handed, metres, y up. `a_from_b` maps coordinates of frame b to
//! frame a. Angles in radians. Missing is `Option`, never NaN or confidence 0.
//!
//! # Sources
//! - \[Albanis 2023\] Albanis, Zioulis, Kolomvatsos. BundleMoCap: Efficient, Robust and Smooth
//!   Motion Capture from Sparse Multiview Videos. CVMP 2023.
//! - \[Bell 1990\] Bell, Pedersen, Brand. A comparison of the accuracy of several hip center
//!   location prediction methods. Journal of Biomechanics 23(6).
//! - \[Boldo 2008\] Boldo, Melquiond. Emulation of a FMA and correctly rounded sums: proved algorithms
//!   using rounding to odd. IEEE Transactions on Computers 57(4).
//! - \[de Leva 1996\] de Leva. Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters.
//!   Journal of Biomechanics 29(9).
//! - \[Gordon 2014\] Gordon et al. 2012 Anthropometric Survey of U.S. Army Personnel: Methods and
//!   Summary Statistics. Natick/TR-15/007.
//! - \[Hyndman 1996\] Hyndman, Fan. Sample quantiles in statistical packages. The American
//!   Statistician 50(4).
//! - \[Kingma 2014\] Kingma, Welling. Auto-encoding variational Bayes. ICLR 2014.
//! - \[Loshchilov 2019\] Loshchilov, Hutter. Decoupled weight decay regularization. ICLR 2019.
//! - \[Nielsen 1999\] Nielsen. Damping parameter in Marquardt's method. IMM-REP-1999-05, DTU.
//! - \[Nocedal 2006\] Nocedal, Wright. Numerical Optimization, 2nd edition. Springer.
//! - \[Okabe 2008\] Okabe, Ito. Color universal design. University of Tokyo.
//! - \[Pavlakos 2019\] Pavlakos et al. Expressive body capture: 3D hands, face, and body from a
//!   single image. CVPR 2019.
//! - \[Sola 2018\] Sola, Deray, Atchuthan. A micro Lie theory for state estimation in robotics.
//!   arXiv:1812.01537.
//! - \[Welch 1967\] Welch. The use of fast Fourier transform for the estimation of power spectra.
//!   IEEE Transactions on Audio and Electroacoustics 15(2).
//! - \[Winter 2009\] Winter. Biomechanics and Motor Control of Human Movement, 4th edition. Wiley.
//! - \[Ye 2023\] Ye, Pavlakos, Malik, Kanazawa. Decoupling human and camera motion from videos in
//!   the wild. CVPR 2023.
//! - \[Zhou 2019\] Zhou, Barnes, Lu, Yang, Li. On the continuity of rotation representations in
//!   neural networks. CVPR 2019.

pub mod baseline;
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
pub mod node;
pub mod record;
pub mod retarget;
pub mod so3;
pub mod solve;
pub mod study;
pub mod synth;
pub mod time;
pub mod track;
pub mod train;
