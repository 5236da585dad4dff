//! The pose manifold: decoder, weights, interpolation.

pub(crate) mod activation;
mod correction;
mod decoder;
mod interpolate;
mod keyframe;
pub(crate) mod weights;

pub use correction::{CORRECTED, CORRECTION, Correction};
#[doc(hidden)]
pub use decoder::Jacobians;
pub use decoder::{Decoder, EMBEDDED};
pub use interpolate::Interpolation;
#[doc(hidden)]
pub use interpolate::LatentTangent;
pub(in crate::core) use keyframe::in_order;
pub use keyframe::{Keyframe, StampedKeyframe, TimedKeyframe};
pub use weights::{WeightsError, trained_on};

/// Size of a latent code.
pub const LATENT: usize = 32;

/// A latent code z.
pub type Latent = [f64; LATENT];

/// The Euclidean length of a latent code.
pub fn norm(z: &Latent) -> f64 {
    z.iter().map(|v| v * v).sum::<f64>().sqrt()
}
