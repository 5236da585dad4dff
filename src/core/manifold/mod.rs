//! The pose manifold: decoder, weights, interpolation, transitions.

pub(crate) mod activation;
mod decoder;
mod interpolate;
mod transition;
mod weights;

use nalgebra::{Matrix3, Vector3};

pub use decoder::{Decoder, EMBEDDED, Jacobians};
pub use interpolate::{Interpolation, LatentTangent};
pub use transition::{
    MOVE, Move, STATE, State, THREE, Transition, TransitionWork, move_of, state_of,
};
pub use weights::WeightsError;

use crate::core::so3;

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

impl Keyframe {
    /// The nearest keyframe that can be sent as a message bit for bit, so that whoever receives it
    /// decodes the same poses; see [`so3::quantised`].
    pub fn quantised(self) -> Self {
        Self { root_rotation: so3::quantised(&self.root_rotation), ..self }
    }
}

/// The Euclidean length of a latent code.
pub fn norm(z: &Latent) -> f64 {
    z.iter().map(|v| v * v).sum::<f64>().sqrt()
}
