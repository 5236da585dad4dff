//! The window problem: reprojection, robust loss, prior.
//!
//! \[Albanis 2023, eq. 2 to 6\], over a path x(t) = (z(t), R(t), p(t)) through latent keyframes:
//!
//! cost = 1/2 sum over observations of w rho(|pixel(t) - detected|^2)
//! + 1/2 prior sum of n_k |z_k|^2 + 1/2 sum of n_k stiffness |acceleration at k|^2
//!
//! rho is a robust loss ([`LossKind`]), w the detector's confidence times the point's weight, n_k the
//! number of frames of keyframe k. The path is evaluated at each observation's own capture time.
//! Differs: the paper evaluates it at the frames of genlocked cameras, and has no stiffness.

mod chain_rule;
mod config;
mod correction;
mod counts;
mod feet;
mod frame_cost;
mod joint_variance;
mod marginal;
mod observation;
mod observation_batch;
mod path;
mod reprojection;
mod robust;
mod scene;
mod stiffness;
mod unknowns;
mod workspace;

pub use config::Config;
#[doc(hidden)]
pub use correction::CorrectionProblem;
#[doc(hidden)]
pub use counts::Counts;
#[doc(hidden)]
pub use marginal::Marginal;
#[doc(hidden)]
pub use observation::{FrameObservations, Observation};
#[doc(hidden)]
pub use path::PathProblem;
pub use robust::{Loss, LossKind};
#[doc(hidden)]
pub use scene::Scene;
pub use stiffness::Stiffness;
#[doc(hidden)]
pub use unknowns::{FreeBody, PathKeyframe};
#[doc(hidden)]
pub use workspace::Workspace;
