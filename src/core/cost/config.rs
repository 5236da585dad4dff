//! Weights of the cost.

use serde::{Deserialize, Serialize};

use super::robust::LossKind;
use super::stiffness::Stiffness;
use crate::core::limits::{Limit, OutOfRange, check};
use crate::core::manifold::Interpolation;

/// Weights of the cost. The defaults come from the sweep in docs/results/solver.md.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The loss of reprojection errors. Differs: the paper has Geman-McClure.
    pub loss: LossKind,
    /// Scale s of the loss, pixels; the largest one where the tracker finds it from the detections.
    pub scale_px: f64,
    /// Weight of the prior on z per frame, square pixels; a keyframe stands for the frames up to
    /// it.
    pub prior: f64,
    /// Degrees of freedom of the prior, a Student t: fewer penalise unusual poses less. 0 means
    /// |z|^2.
    pub prior_dof: f64,
    /// Weight of the squared shape coefficients, square pixels, while the shape is free.
    pub shape_prior: f64,
    /// Weight of the squared keypoint offsets, square pixels for each (12 mm)^2, while they are free.
    pub offset_prior: f64,
    /// The distance between codes up to which a Jacobian of the decoder is reused; it only sets the
    /// direction of a step. Use 0 for problems that the data hardly determine, such as a prior near
    /// 0: they need exact steps. Differs: the paper needs no Jacobians.
    pub jacobian_reuse_radius: f64,
    /// Weight of the squared corrections of joints beside the manifold, square pixels per rad^2 and
    /// frame; 0 has no corrections. Differs: the paper has none.
    pub correction_prior: f64,
    /// Weight of the squared velocities of standing feet, square pixels per (m/s)^2 and frame; 0 lets
    /// feet slide. Part of the corrections. Differs: the paper has none.
    pub foot_contact: f64,
    /// The speed from which a foot does not stand, m/s.
    pub foot_contact_speed: f64,
    /// How latent codes are interpolated between keyframes.
    pub interpolation: Interpolation,
    /// Weights of the accelerations at the keyframes.
    pub stiffness: Stiffness,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            loss: LossKind::Cauchy,
            scale_px: 30.0,
            prior: 20.0,
            prior_dof: 50.0,
            shape_prior: 1000.0,
            offset_prior: 300.0,
            jacobian_reuse_radius: 0.7,
            correction_prior: 6000.0,
            foot_contact: 1e4,
            foot_contact_speed: 0.3,
            interpolation: Interpolation::Slerp,
            stiffness: Stiffness::default(),
        }
    }
}

impl Config {
    /// Checks the ranges of all numbers.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        check([
            Limit::above_0("scale_px", self.scale_px),
            Limit::from_0("prior", self.prior),
            Limit::from_0("prior_dof", self.prior_dof),
            Limit::from_0("shape_prior", self.shape_prior),
            Limit::from_0("offset_prior", self.offset_prior),
            Limit::from_0("jacobian_reuse_radius", self.jacobian_reuse_radius),
            Limit::from_0("correction_prior", self.correction_prior),
            Limit::from_0("foot_contact", self.foot_contact),
            Limit::above_0("foot_contact_speed", self.foot_contact_speed),
            Limit::from_0("stiffness.latent", self.stiffness.latent),
            Limit::from_0("stiffness.rotation", self.stiffness.rotation),
            Limit::from_0("stiffness.position", self.stiffness.position),
            Limit::from_0("stiffness.correction", self.stiffness.correction),
            Limit::above_0("stiffness.robust_scale_px", self.stiffness.robust_scale_px),
        ])
    }
}
