//! Corrections: small rotations of joints beside the manifold.

use nalgebra::{Matrix3, Vector3};

use crate::core::body::{BODY_JOINTS, Joint};
use crate::core::so3;

/// The joints with a correction: those that move limbs and trunk.
pub const CORRECTED: [Joint; 16] = [
    Joint::LHip,
    Joint::RHip,
    Joint::Spine1,
    Joint::LKnee,
    Joint::RKnee,
    Joint::LAnkle,
    Joint::RAnkle,
    Joint::Neck,
    Joint::LShoulder,
    Joint::RShoulder,
    Joint::LElbow,
    Joint::RElbow,
    Joint::LCollar,
    Joint::RCollar,
    Joint::Spine3,
    Joint::Head,
];

/// Count of a correction's numbers.
pub const CORRECTION: usize = 3 * CORRECTED.len();

/// Rotation vectors c, radians: the local rotation of a [`CORRECTED`] joint is G(z) exp(c).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Correction(pub [f64; CORRECTION]);

impl Default for Correction {
    fn default() -> Self {
        Self([0.0; CORRECTION])
    }
}

impl Correction {
    /// The corrected joints with their rotation vectors.
    pub fn vectors(&self) -> impl Iterator<Item = (Joint, Vector3<f64>)> + '_ {
        CORRECTED.into_iter().zip(self.0.chunks_exact(3).map(Vector3::from_column_slice))
    }

    /// Corrects the local rotations of a pose.
    pub fn apply(&self, local: &mut [Matrix3<f64>; BODY_JOINTS]) {
        for (joint, vector) in self.vectors().filter(|(_, vector)| *vector != Vector3::zeros()) {
            local[joint.index() - 1] *= so3::exp(&vector);
        }
    }

    /// At `s` on the line from `self` to `to`.
    pub fn lerp(&self, to: &Self, s: f64) -> Self {
        Self(std::array::from_fn(|i| self.0[i] + s * (to.0[i] - self.0[i])))
    }

    /// Rounded to f32, as messages hold it.
    pub fn quantised(&self) -> Self {
        Self(self.0.map(|c| f64::from(c as f32)))
    }
}
