//! Feet that stand: velocities of ankles and feet have a cost while they are slow.
//!
//! Between two keyframes, t seconds apart, a joint at P has the velocity v = (P_k - P_(k-1)) / t. It
//! costs 1/2 n_k w c |v|^2, as in \[Ye 2023\]. The contact is c = (1 - (u / s)^2)^2, and 0 for u > s:
//! u is the joint's speed on the path before correction, from two keyframes before to two after.
//! Standing feet stay where the detections show them on average, on whatever they stand; no floor is
//! needed.

use nalgebra::{Matrix3, Vector3};

use super::unknowns::PathKeyframe;
use crate::core::body::{FEET, Pose, Posture, Skeleton};
use crate::core::manifold::{CORRECTED, CORRECTION, Correction};
use crate::core::optimise::NormalEquations;
use crate::core::so3;

/// Keyframes before and after the two of a velocity whose distance gives the contact.
const REACH: usize = 2;

/// The feet along a path of keyframes.
#[derive(Debug)]
pub(super) struct Feet {
    /// Poses of the keyframes without corrections; empty if feet do not stand.
    poses: Vec<Pose>,
    /// The contact c of each joint, from the keyframe before to this one.
    contacts: Vec<[f64; FEET.len()]>,
}

/// A joint of the foot and its derivatives by the corrections of its parents.
struct Placed {
    position: Vector3<f64>,
    /// Number of the corrected joint, and the derivative.
    by: Vec<(usize, Matrix3<f64>)>,
}

impl Feet {
    /// Of a path with these poses at its keyframes; `speed` is s, m/s.
    pub(super) fn new(
        path: &[PathKeyframe],
        poses: Vec<Pose>,
        skeleton: &Skeleton,
        speed: f64,
    ) -> Self {
        let postures: Vec<Posture> = poses.iter().map(|pose| pose.posture(skeleton)).collect();
        let contact = |k: usize| {
            let (from, to) = (k.saturating_sub(1 + REACH), (k + REACH).min(postures.len() - 1));
            let seconds = path[to].timed.capture.seconds_since(path[from].timed.capture);
            FEET.map(|joint| {
                let [start, end] = [from, to].map(|k| postures[k].positions[joint.index()]);
                let ratio = (end - start).norm_squared() / (seconds * speed).powi(2);
                if k == 0 { 0.0 } else { (1.0 - ratio).max(0.0).powi(2) }
            })
        };
        Self { contacts: (0..postures.len()).map(contact).collect(), poses }
    }

    /// The cost of the velocities up to free keyframes; its derivatives are added. `weight` is w.
    pub(super) fn add(
        &self,
        path: &[PathKeyframe],
        skeleton: &Skeleton,
        correction: impl Fn(usize) -> Correction,
        weight: f64,
        equations: &mut NormalEquations,
    ) -> f64 {
        let place = |(k, pose): (usize, &Pose)| placed(pose, skeleton, &correction(k));
        let placed: Vec<_> = self.poses.iter().enumerate().map(place).collect();
        let fixed = path.iter().filter(|at| !at.free).count();
        let mut cost = 0.0;
        for k in fixed.max(1)..placed.len() {
            let seconds = path[k].timed.capture.seconds_since(path[k - 1].timed.capture);
            for (joint, contact) in self.contacts[k].into_iter().enumerate() {
                let [from, to] = [k - 1, k].map(|k| &placed[k][joint]);
                let scale = weight * path[k].frames * contact / (seconds * seconds);
                let moved = to.position - from.position;
                cost += 0.5 * scale * moved.norm_squared();
                let ends = [(k - 1, from, -1.0), (k, to, 1.0)];
                let free =
                    ends.into_iter().filter(|(k, ..)| *k >= fixed).flat_map(|(k, at, sign)| {
                        let row = move |i: usize| (k - fixed) * CORRECTION + 3 * i;
                        at.by.iter().map(move |(i, by)| (k, row(*i), by * sign))
                    });
                for (k, row, by) in free.clone() {
                    let gradient = by.tr_mul(&moved) * scale;
                    let out = equations.gradient[row..row + 3].iter_mut();
                    out.zip(&gradient).for_each(|(out, v)| *out += v);
                    for (_, column, other) in free.clone().filter(|(other, ..)| *other <= k) {
                        let block = by.tr_mul(&other) * scale;
                        for (j, values) in block.column_iter().enumerate() {
                            let out = equations.hessian.column_mut(row..row + 3, column + j);
                            out.iter_mut().zip(&values).for_each(|(out, v)| *out += v);
                        }
                    }
                }
            }
        }
        cost
    }
}

/// The joints of the feet at a corrected pose.
fn placed(pose: &Pose, skeleton: &Skeleton, correction: &Correction) -> [Placed; FEET.len()] {
    let mut pose = pose.clone();
    correction.apply(&mut pose.local);
    let posture = pose.posture(skeleton);
    FEET.map(|foot| {
        let position = posture.positions[foot.index()];
        let parents = std::iter::successors(foot.parent(), |joint| joint.parent());
        let by = parents.filter_map(|joint| {
            let number = CORRECTED.iter().position(|corrected| *corrected == joint)?;
            let vector = Vector3::from_column_slice(&correction.0[3 * number..3 * number + 3]);
            let arm = position - posture.positions[joint.index()];
            let turn = posture.rotations[joint.index()] * so3::right_jacobian(&vector);
            Some((number, -arm.cross_matrix() * turn))
        });
        Placed { position, by: by.collect() }
    })
}
