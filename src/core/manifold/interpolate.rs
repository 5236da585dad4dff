//! The path between two keyframes \[Albanis 2023, eq. 5 and 6\].
//!
//! The latent code runs along a slerp,
//! z(s) = sin((1 - s) a) / sin a * z0 + sin(s a) / sin a * z1, with a the angle between z0 and
//! z1; the rotation along a slerp, the position along a line.
//!
//! Near a = 0 the weights are those of the line. Near a = pi they would become infinite, so a is
//! limited to [`MAX_ANGLE`]: the path stays continuous and meets both ends.

use serde::{Deserialize, Serialize};

use super::{Keyframe, LATENT, Latent, norm};
use crate::core::named;
use crate::core::so3;

/// Below this angle between codes (radians) the path is a line.
const MIN_ANGLE: f64 = 1e-4;
/// Above this angle (radians) the weights no longer change with the angle.
const MAX_ANGLE: f64 = 0.9 * std::f64::consts::PI;
/// Codes shorter than this have no direction.
const MIN_NORM: f64 = 1e-9;

named! {
    /// Interpolation of the latent code between two keyframes.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Interpolation {
        /// Along the great circle.
        #[default]
        Slerp = "slerp",
        /// Along the line.
        Lerp = "lerp",
    }
}

/// The derivative of an interpolated code by one end: `scale` I + `across` `along`^T. 32x32.
#[derive(Clone, Debug, PartialEq)]
pub struct LatentTangent {
    /// Factor of the identity.
    pub scale: f64,
    /// Column of the rank-one part.
    pub across: Latent,
    /// Row of the rank-one part.
    pub along: Latent,
}

impl Interpolation {
    /// The code at `s`, 0 at `z0` and 1 at `z1`. Other values extrapolate.
    pub fn latent(self, z0: &Latent, z1: &Latent, s: f64) -> Latent {
        let (w0, w1) = match self.angle(z0, z1) {
            Some(angle) => (slerp_weight(1.0 - s, angle).0, slerp_weight(s, angle).0),
            None => (1.0 - s, s),
        };
        std::array::from_fn(|i| w0 * z0[i] + w1 * z1[i])
    }

    /// The derivative of [`Interpolation::latent`] by `z1`. That by `z0` is
    /// `tangent(z1, z0, 1 - s)`.
    pub fn tangent(self, z0: &Latent, z1: &Latent, s: f64) -> LatentTangent {
        let angle = match self.angle(z0, z1) {
            Some(angle) if angle < MAX_ANGLE => angle,
            Some(angle) => return LatentTangent::straight(slerp_weight(s, angle).0),
            None => return LatentTangent::straight(s),
        };
        let (_, dw0) = slerp_weight(1.0 - s, angle);
        let (w1, dw1) = slerp_weight(s, angle);
        let (n0, n1) = (norm(z0), norm(z1));
        let (sin, cos) = libm::sincos(angle);
        LatentTangent {
            scale: w1,
            across: std::array::from_fn(|i| dw0 * z0[i] + dw1 * z1[i]),
            along: std::array::from_fn(|i| (cos * z1[i] / n1 - z0[i] / n0) / (n1 * sin)),
        }
    }

    /// The keyframe values at `s` between two keyframes.
    pub fn keyframe(self, from: &Keyframe, to: &Keyframe, s: f64) -> Keyframe {
        Keyframe {
            z: self.latent(&from.z, &to.z, s),
            root_rotation: so3::slerp(&from.root_rotation, &to.root_rotation, s),
            root_position: from.root_position.lerp(&to.root_position, s),
            correction: from.correction.lerp(&to.correction, s),
        }
    }

    /// The angle of the slerp weights; `None` for the weights of a line.
    fn angle(self, z0: &Latent, z1: &Latent) -> Option<f64> {
        if self == Self::Lerp {
            return None;
        }
        let (n0, n1) = (norm(z0), norm(z1));
        if n0 < MIN_NORM || n1 < MIN_NORM {
            return None;
        }
        let dot: f64 = z0.iter().zip(z1).map(|(a, b)| a * b).sum();
        let angle = libm::acos((dot / (n0 * n1)).clamp(-1.0, 1.0));
        (angle > MIN_ANGLE).then_some(angle.min(MAX_ANGLE))
    }
}

impl LatentTangent {
    /// `scale` times the identity.
    pub fn straight(scale: f64) -> Self {
        Self { scale, across: [0.0; LATENT], along: [0.0; LATENT] }
    }
}

/// sin(k a) / sin a and its derivative by a.
fn slerp_weight(k: f64, angle: f64) -> (f64, f64) {
    let (sin, cos) = libm::sincos(angle);
    let (sin_k, cos_k) = libm::sincos(k * angle);
    (sin_k / sin, (k * cos_k * sin - sin_k * cos) / (sin * sin))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn code(seed: f64) -> Latent {
        std::array::from_fn(|i| ((i as f64 + 1.0) * seed).sin())
    }

    fn distance(a: &Latent, b: &Latent) -> f64 {
        norm(&std::array::from_fn(|i| a[i] - b[i]))
    }

    #[test]
    fn a_slerp_meets_both_ends_and_keeps_the_length_between_equals() {
        let (z0, mut z1) = (code(0.7), code(1.3));
        let scale = norm(&z0) / norm(&z1);
        z1.iter_mut().for_each(|v| *v *= scale);
        let path = |s| Interpolation::Slerp.latent(&z0, &z1, s);
        assert!(distance(&path(0.0), &z0) < 1e-12 && distance(&path(1.0), &z1) < 1e-12);
        assert!((norm(&path(0.5)) - norm(&z0)).abs() < 1e-12);
    }

    #[test]
    fn equal_codes_give_a_line() {
        let z = code(0.7);
        for s in [0.0, 0.3, 1.0] {
            assert!(distance(&Interpolation::Slerp.latent(&z, &z, s), &z) < 1e-12);
        }
        let zero = [0.0; LATENT];
        assert!(
            distance(&Interpolation::Slerp.latent(&zero, &z, 0.5), &z.map(|v| v / 2.0)) < 1e-12
        );
    }

    #[test]
    fn opposite_codes_stay_bounded_and_continuous() {
        let z0 = code(0.7);
        let opposite = z0.map(|v| -v);
        let mut nearly = opposite;
        nearly[3] += 1e-9;
        for s in [0.0, 0.25, 0.5, 0.9, 1.0] {
            let exact = Interpolation::Slerp.latent(&z0, &opposite, s);
            let near = Interpolation::Slerp.latent(&z0, &nearly, s);
            assert!(norm(&exact) < 1.5 * norm(&z0));
            assert!(distance(&exact, &near) < 1e-6);
        }
        assert!(distance(&Interpolation::Slerp.latent(&z0, &opposite, 1.0), &opposite) < 1e-12);
    }
}
