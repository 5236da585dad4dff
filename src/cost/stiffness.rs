//! Accelerations along a path, and what they cost.
//!
//! Over three knots in a row, t1 and t2 seconds apart, the acceleration of the position is
//! a = c0 p0 + c1 p1 + c2 p2 with c0 = 2 / ((t1 + t2) t1), c2 = 2 / ((t1 + t2) t2) and
//! c1 = -c0 - c2; that of the code alike, that of the rotation
//! c2 log(R2 R1^T) - c0 log(R1 R0^T).
//!
//! Each of the three counts 1/2 s^2 ln(1 + w |a|^2 / s^2): people mostly move evenly and sometimes
//! very abruptly, so the large accelerations of a few moments must not count with their squares.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::ends::block;
use super::unknowns::Unknowns;
use crate::manifold::{Keyframe, LATENT, Latent};
use crate::so3;
use crate::solve::{Banded, Normal};

/// Weights of accelerations, per nominal frame: all zero leaves the path as free as its
/// interpolation is. Differs: the paper has no such term.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Stiffness {
    /// Of the latent code, square pixels per (1/s^2)^2.
    pub latent: f64,
    /// Of the root's rotation, square pixels per (rad/s^2)^2.
    pub turn: f64,
    /// Of the root's position, square pixels per (m/s^2)^2.
    pub shift: f64,
    /// Scale s, pixels: an acceleration of this weighted size has half of its weight left.
    pub scale_px: f64,
}

impl Default for Stiffness {
    fn default() -> Self {
        Self { latent: 1e-3, turn: 0.04, shift: 0.4, scale_px: 30.0 }
    }
}

impl Stiffness {
    /// No such term, as in the paper.
    pub const NONE: Self = Self { latent: 0.0, turn: 0.0, shift: 0.0, scale_px: 1.0 };

    /// All weights times `factor`.
    pub fn times(self, factor: f64) -> Self {
        let Self { latent, turn, shift, .. } = self;
        Self { latent: latent * factor, turn: turn * factor, shift: shift * factor, ..self }
    }

    /// Whether accelerations cost nothing.
    pub(super) fn is_none(&self) -> bool {
        [self.latent, self.turn, self.shift] == [0.0; 3]
    }

    /// The cost of all triples of knots of which the last is free.
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
    pub(super) fn add(&self, path: &Unknowns, normal: &mut Normal) -> f64 {
        let add = |triple: Triple| {
            triple.add_gradient(path, &mut normal.gradient);
            triple.add_hessian(path, &mut normal.hessian);
            triple.cost
        };
        self.triples(path).map(add).sum()
    }

    fn triples<'a>(&'a self, path: &'a Unknowns) -> impl Iterator<Item = Triple> + 'a {
        let knots = if self.is_none() { 0 } else { path.keyframes.len() };
        (2..knots).filter(|&last| path.is_free(last)).map(|last| Triple::new(self, path, last))
    }
}

/// Three knots in a row, and the acceleration over them.
struct Triple {
    knots: [usize; 3],
    /// By the three knots' codes and positions.
    factors: [f64; 3],
    /// How the pelvis turns from the first knot to the second and on to the third.
    turns: [Vector3<f64>; 2],
    code: Latent,
    rotation: Vector3<f64>,
    position: Vector3<f64>,
    /// IRLS weights of code, rotation and position, with the frames that the last knot stands for.
    weights: [f64; 3],
    cost: f64,
}

impl Triple {
    fn new(weights: &Stiffness, path: &Unknowns, last: usize) -> Self {
        let knots = [last - 2, last - 1, last];
        let [k0, k1, k2] = knots.map(|k| &path.keyframes[k]);
        let [t0, t1, t2] = knots.map(|k| path.capture(k));
        let (first, second) = (t1.seconds_since(t0), t2.seconds_since(t1));
        let [c0, c2] = [first, second].map(|t| 2.0 / ((first + second) * t));
        let c1 = -c0 - c2;
        let turn =
            |a: &Keyframe, b: &Keyframe| so3::turn_between(&a.root_rotation, &b.root_rotation);
        let (early, late) = (turn(k0, k1), turn(k1, k2));
        let code: Latent = std::array::from_fn(|i| c0 * k0.z[i] + c1 * k1.z[i] + c2 * k2.z[i]);
        let rotation = late * c2 - early * c0;
        let position = k0.root_position * c0 + k1.root_position * c1 + k2.root_position * c2;
        let squares = [
            weights.latent * code.iter().map(|v| v * v).sum::<f64>(),
            weights.turn * rotation.norm_squared(),
            weights.shift * position.norm_squared(),
        ];
        let (scale, frames) = (weights.scale_px * weights.scale_px, path.frames(last));
        let slack = squares.map(|square| 1.0 + square / scale);
        let [latent, turn, shift] = slack.map(|slack| frames / slack);
        Self {
            knots,
            factors: [c0, c1, c2],
            turns: [early, late],
            code,
            rotation,
            position,
            weights: [weights.latent * latent, weights.turn * turn, weights.shift * shift],
            cost: 0.5 * frames * scale * slack.iter().map(|slack| libm::log(*slack)).sum::<f64>(),
        }
    }

    /// The acceleration of the rotation by the three knots' rotation vectors.
    fn by_turn(&self, path: &Unknowns) -> [Matrix3<f64>; 3] {
        let ([early, late], [c0, _, c2]) = (&self.turns, self.factors);
        let [w0, w1, w2] = self.knots.map(|k| &path.turns[k]);
        let (early_by0, early_by1) = so3::turn_between_tangents(early, w0, w1);
        let (late_by1, late_by2) = so3::turn_between_tangents(late, w1, w2);
        [early_by0 * -c0, late_by1 * c2 - early_by1 * c0, late_by2 * c2]
    }

    /// The free knots: which of the three, and the number among the free ones.
    fn free<'a>(&'a self, path: &'a Unknowns) -> impl Iterator<Item = (usize, usize)> + 'a {
        let knots = self.knots.iter().enumerate().filter(|&(_, &knot)| path.is_free(knot));
        knots.map(|(which, &knot)| (which, path.number(knot)))
    }

    fn add_gradient(&self, path: &Unknowns, gradient: &mut [f64]) {
        let [latent, turn, shift] = self.weights;
        let by_turn = self.by_turn(path);
        for (a, knot) in self.free(path) {
            let mine = &mut gradient[block(knot)];
            let (codes, roots) = mine.split_at_mut(LATENT);
            let factor = latent * self.factors[a];
            codes.iter_mut().zip(&self.code).for_each(|(g, v)| *g += factor * v);
            let turned = by_turn[a].tr_mul(&self.rotation) * turn;
            let moved = self.position * (shift * self.factors[a]);
            roots.iter_mut().zip(turned.iter().chain(&moved)).for_each(|(g, v)| *g += v);
        }
    }

    fn add_hessian(&self, path: &Unknowns, hessian: &mut Banded) {
        let [latent, turn, shift] = self.weights;
        let by_turn = self.by_turn(path);
        for (a, row) in self.free(path) {
            for (b, column) in self.free(path).take_while(|&(b, _)| b <= a) {
                let factor = self.factors[a] * self.factors[b];
                let turned = by_turn[a].tr_mul(&by_turn[b]) * turn;
                for (j, column) in block(column).enumerate() {
                    let entries = hessian.column_mut(block(row), column);
                    match j.checked_sub(LATENT) {
                        None => entries[j] += latent * factor,
                        Some(j @ 0..3) => {
                            (0..3).for_each(|i| entries[LATENT + i] += turned[(i, j)])
                        }
                        Some(_) => entries[j] += shift * factor,
                    }
                }
            }
        }
    }
}
