//! The pose manifold: decoder, weights, interpolation.

use nalgebra::{Matrix3, Vector3};

/// Numbers in a latent code.
pub const LATENT: usize = 32;

/// A latent code z.
pub type Latent = [f64; LATENT];

/// The unknown of a window: a latent code and where the pelvis is.
#[derive(Clone, Debug, PartialEq)]
pub struct Keyframe {
    /// Latent code.
    pub z: Latent,
    /// `world_from_pelvis`.
    pub root_rotation: Matrix3<f64>,
    /// The pelvis in the world, metres.
    pub root_position: Vector3<f64>,
}
