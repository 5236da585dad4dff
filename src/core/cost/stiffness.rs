//! Accelerations along a path, and what they cost.
//!
//! Over three keyframes in a row, t1 and t2 seconds apart, the acceleration of the position is
//! a = c0 p0 + c1 p1 + c2 p2 with c0 = 2 / ((t1 + t2) t1), c2 = 2 / ((t1 + t2) t2) and
//! c1 = -c0 - c2; that of the code alike, that of the rotation
//! c2 log(R2 R1^T) - c0 log(R1 R0^T).
//!
//! Each of the three counts 1/2 s^2 ln(1 + w |a|^2 / s^2): people mostly move evenly and sometimes
//! very abruptly, so a few large accelerations must not count with their squares.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::chain_rule::block;
use super::unknowns::Unknowns;
use crate::core::manifold::{Keyframe, LATENT, Latent};
use crate::core::optimise::{BlockBanded, NormalEquations};
use crate::core::so3;

/// Weights of accelerations, per nominal frame: all zero leaves the path as free as its
/// interpolation is. Differs: the paper has no such term.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Stiffness {
    /// Of the latent code, square pixels per (1/s^2)^2.
    pub latent: f64,
    /// Of the root's rotation, square pixels per (rad/s^2)^2.
    pub rotation: f64,
    /// Of the root's position, square pixels per (m/s^2)^2.
    pub position: f64,
    /// Of the corrections of joints, square pixels per (rad/s^2)^2.
    pub correction: f64,
    /// Scale s, pixels: an acceleration of this weighted size has half of its weight left.
    pub robust_scale_px: f64,
}

impl Default for Stiffness {
    fn default() -> Self {
        Self { latent: 1e-3, rotation: 0.04, position: 0.4, correction: 0.1, robust_scale_px: 30.0 }
    }
}

impl Stiffness {
    /// No such term, as in the paper.
    pub const NONE: Self =
        Self { latent: 0.0, rotation: 0.0, position: 0.0, correction: 0.0, robust_scale_px: 1.0 };

    /// All weights times `factor`.
    pub fn times(self, factor: f64) -> Self {
        let Self { latent, rotation, position, correction, .. } = self;
        Self {
            latent: latent * factor,
            rotation: rotation * factor,
            position: position * factor,
            correction: correction * factor,
            ..self
        }
    }

    /// Whether accelerations cost nothing.
    pub(super) fn is_none(&self) -> bool {
        [self.latent, self.rotation, self.position] == [0.0; 3]
    }

    /// The cost of all triples of keyframes whose last one is free.
    pub(super) fn cost(&self, path: &Unknowns) -> f64 {
        self.triples(path).map(|triple| triple.cost).sum()
    }

    /// The same; its gradient is added.
    pub(super) fn add_gradient(&self, path: &Unknowns, gradient: &mut [f64]) -> f64 {
        let add = |triple: Triple| {
            triple.add_gradient(path, gradient);
            triple.cost
        };
        self.triples(path).map(add).sum()
    }

    /// The same; its gradient and Gauss-Newton Hessian are added.
    pub(super) fn add(&self, path: &Unknowns, equations: &mut NormalEquations) -> f64 {
        let add = |triple: Triple| {
            triple.add_gradient(path, &mut equations.gradient);
            triple.add_hessian(path, &mut equations.hessian);
            triple.cost
        };
        self.triples(path).map(add).sum()
    }

    fn triples<'a>(&'a self, path: &'a Unknowns) -> impl Iterator<Item = Triple> + 'a {
        let count = if self.is_none() { 0 } else { path.keyframes.len() };
        (2..count).filter(|&last| path.is_free(last)).map(|last| Triple::new(self, path, last))
    }
}

/// The factors c0, c1, c2 of three values in their acceleration, 1/s^2, from the times between them,
/// seconds.
pub(super) fn acceleration_factors(first: f64, second: f64) -> [f64; 3] {
    let [c0, c2] = [first, second].map(|t| 2.0 / ((first + second) * t));
    [c0, -c0 - c2, c2]
}

/// Three keyframes in a row, and the acceleration over them.
struct Triple {
    keyframes: [usize; 3],
    /// Factors of the three codes and positions in the acceleration.
    factors: [f64; 3],
    /// Rotation vectors of the pelvis from the first keyframe to the second, and on to the third.
    rotations: [Vector3<f64>; 2],
    code: Latent,
    rotation: Vector3<f64>,
    position: Vector3<f64>,
    /// IRLS weights of code, rotation and position, times the frames that the last keyframe stands for.
    weights: [f64; 3],
    cost: f64,
}

impl Triple {
    fn new(weights: &Stiffness, path: &Unknowns, last: usize) -> Self {
        let keyframes = [last - 2, last - 1, last];
        let [k0, k1, k2] = keyframes.map(|k| &path.keyframes[k]);
        let [t0, t1, t2] = keyframes.map(|k| path.capture(k));
        let (first, second) = (t1.seconds_since(t0), t2.seconds_since(t1));
        let [c0, c1, c2] = acceleration_factors(first, second);
        let turn =
            |a: &Keyframe, b: &Keyframe| so3::turn_between(&a.root_rotation, &b.root_rotation);
        let (early, late) = (turn(k0, k1), turn(k1, k2));
        let code: Latent = std::array::from_fn(|i| c0 * k0.z[i] + c1 * k1.z[i] + c2 * k2.z[i]);
        let rotation = late * c2 - early * c0;
        let position = k0.root_position * c0 + k1.root_position * c1 + k2.root_position * c2;
        let squares = [
            weights.latent * code.iter().map(|v| v * v).sum::<f64>(),
            weights.rotation * rotation.norm_squared(),
            weights.position * position.norm_squared(),
        ];
        let (scale, frames) =
            (weights.robust_scale_px * weights.robust_scale_px, path.frames(last));
        let ratios = squares.map(|square| 1.0 + square / scale);
        let [by_code, by_rotation, by_position] = ratios.map(|ratio| frames / ratio);
        Self {
            keyframes,
            factors: [c0, c1, c2],
            rotations: [early, late],
            code,
            rotation,
            position,
            weights: [
                weights.latent * by_code,
                weights.rotation * by_rotation,
                weights.position * by_position,
            ],
            cost: 0.5 * frames * scale * ratios.iter().map(|ratio| libm::log(*ratio)).sum::<f64>(),
        }
    }

    /// The derivative of the rotation's acceleration by the three keyframes' rotation vectors.
    fn rotation_tangents(&self, path: &Unknowns) -> [Matrix3<f64>; 3] {
        let ([early, late], [c0, _, c2]) = (&self.rotations, self.factors);
        let [w0, w1, w2] = self.keyframes.map(|k| &path.rotation_vectors[k]);
        let (early_by0, early_by1) = so3::turn_between_tangents(early, w0, w1);
        let (late_by1, late_by2) = so3::turn_between_tangents(late, w1, w2);
        [early_by0 * -c0, late_by1 * c2 - early_by1 * c0, late_by2 * c2]
    }

    /// The free keyframes: which of the three, and the number among the free ones.
    fn free<'a>(&'a self, path: &'a Unknowns) -> impl Iterator<Item = (usize, usize)> + 'a {
        let free = self.keyframes.iter().enumerate().filter(|&(_, &k)| path.is_free(k));
        free.map(|(which, &k)| (which, path.number(k)))
    }

    fn add_gradient(&self, path: &Unknowns, gradient: &mut [f64]) {
        let [latent, rotation, position] = self.weights;
        let tangents = self.rotation_tangents(path);
        for (a, keyframe) in self.free(path) {
            let mine = &mut gradient[block(keyframe)];
            let (codes, roots) = mine.split_at_mut(LATENT);
            let factor = latent * self.factors[a];
            codes.iter_mut().zip(&self.code).for_each(|(g, v)| *g += factor * v);
            let turned = tangents[a].tr_mul(&self.rotation) * rotation;
            let moved = self.position * (position * self.factors[a]);
            roots.iter_mut().zip(turned.iter().chain(&moved)).for_each(|(g, v)| *g += v);
        }
    }

    fn add_hessian(&self, path: &Unknowns, hessian: &mut BlockBanded) {
        let [latent, rotation, position] = self.weights;
        let tangents = self.rotation_tangents(path);
        for (a, row) in self.free(path) {
            for (b, column) in self.free(path).take_while(|&(b, _)| b <= a) {
                let factor = self.factors[a] * self.factors[b];
                let turned = tangents[a].tr_mul(&tangents[b]) * rotation;
                for (j, column) in block(column).enumerate() {
                    let entries = hessian.column_mut(block(row), column);
                    match j.checked_sub(LATENT) {
                        None => entries[j] += latent * factor,
                        Some(j @ 0..3) => {
                            (0..3).for_each(|i| entries[LATENT + i] += turned[(i, j)])
                        }
                        Some(_) => entries[j] += position * factor,
                    }
                }
            }
        }
    }
}
