//! The known quantities of a problem.

use super::config::Config;
use crate::core::body::BodyPoint;
use crate::core::camera::Rig;
use crate::core::manifold::Decoder;

/// What a cost needs besides the unknowns.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// The manifold.
    pub decoder: &'a Decoder,
    /// The cameras.
    pub rig: &'a Rig,
    /// The detector's points that are fitted.
    pub points: &'a [BodyPoint],
    /// Weights.
    pub config: &'a Config,
}
