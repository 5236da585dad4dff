//! Which bones move a vertex, and how much.
//!
//! A gate is a plane where the branch of a joint begins. A vertex before the gate belongs to the parent, one
//! behind it to the branch; over the gate's width the weight changes from one to the other. There the bones
//! between the two, which turn by a part of the joint's angle, have most of the weight: a limb then keeps
//! its girth when it bends or twists.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{BONES, STEPS, bone};
use crate::core::body::joints::Joint;

/// Number of bones that move a vertex.
pub(super) const INFLUENCES: usize = 4;

/// Bones and their weights, the largest first; the weights add up to 1.
pub(super) type Influences = [(u8, f64); INFLUENCES];

/// A plane through which the branch of a joint is entered, over some width. Template, left side and
/// midline, metres.
struct Gate {
    joint: Joint,
    /// A point of its middle.
    at: [f64; 3],
    /// Where it leads to.
    towards: [f64; 3],
    half_width: f64,
}

const fn gate(joint: Joint, at: [f64; 3], towards: [f64; 3], half_width: f64) -> Gate {
    Gate { joint, at, towards, half_width }
}

/// A point behind all gates of a joint is in its branch.
const GATES: [Gate; 17] = [
    gate(Joint::LHip, [0.095, -0.085, 0.000], [0.40, -0.88, -0.20], 0.075),
    gate(Joint::LHip, [0.000, -0.150, 0.000], [1.00, 0.00, 0.00], 0.020),
    gate(Joint::LKnee, [0.086, -0.489, 0.000], [0.00, -1.00, 0.00], 0.075),
    gate(Joint::LAnkle, [0.086, -0.913, -0.015], [0.00, -0.80, 0.60], 0.032),
    gate(Joint::LFoot, [0.101, -0.963, 0.115], [0.00, 0.00, 1.00], 0.025),
    gate(Joint::Spine1, [0.000, 0.105, 0.000], [0.00, 1.00, 0.00], 0.060),
    gate(Joint::Spine2, [0.000, 0.217, 0.000], [0.00, 1.00, 0.00], 0.045),
    gate(Joint::Spine3, [0.000, 0.300, 0.000], [0.00, 1.00, 0.00], 0.035),
    gate(Joint::Neck, [0.000, 0.475, -0.020], [0.00, 1.00, 0.20], 0.035),
    gate(Joint::Neck, [0.095, 0.475, 0.000], [-1.00, 1.20, 0.00], 0.030),
    gate(Joint::Head, [0.000, 0.556, 0.000], [0.00, 0.85, 0.50], 0.030),
    gate(Joint::LCollar, [0.070, 0.400, 0.000], [1.00, 0.00, 0.00], 0.040),
    gate(Joint::LCollar, [0.000, 0.375, 0.000], [0.20, 1.00, 0.00], 0.035),
    gate(Joint::LCollar, [0.095, 0.475, 0.000], [1.00, -1.20, 0.00], 0.030),
    gate(Joint::LShoulder, [0.160, 0.428, 0.000], [1.00, 0.00, 0.00], 0.130),
    gate(Joint::LElbow, [0.447, 0.428, 0.000], [1.00, 0.00, 0.00], 0.058),
    gate(Joint::LWrist, [0.711, 0.428, 0.000], [1.00, 0.00, 0.00], 0.030),
];

/// The part of the parent's weight that goes to the branch of `joint` at `p`, 0 to 1.
fn share(joint: Joint, p: &Vector3<f64>) -> f64 {
    let (joint, x) = match joint.side() {
        -1.0 => (joint.mirrored(), -p.x),
        0.0 => (joint, p.x.abs()),
        _ => (joint, p.x),
    };
    let p = Vector3::new(x, p.y, p.z);
    let passed = GATES.iter().filter(|gate| gate.joint == joint).map(|gate| {
        let depth = (p - Vector3::from(gate.at)).dot(&Vector3::from(gate.towards).normalize());
        let share = (0.5 + 0.5 * depth / gate.half_width).clamp(0.0, 1.0);
        // Smooth, or the skin gets a crease.
        share * share * (3.0 - 2.0 * share)
    });
    passed.product()
}

/// The influences at a point of the template's skin.
pub(super) fn influences(p: &Vector3<f64>) -> Influences {
    let mut weights = [0.0; BONES];
    weights[0] = 1.0;
    for parent in Joint::ALL {
        let branches: Vec<(Joint, f64)> = Joint::ALL
            .into_iter()
            .filter(|joint| joint.parent() == Some(parent))
            .map(|joint| (joint, share(joint, p)))
            .collect();
        let taken: f64 = branches.iter().map(|(_, share)| share).sum();
        if taken == 0.0 {
            continue;
        }
        let here = std::mem::take(&mut weights[parent.index()]);
        // From 0 at the parent to STEPS at the joint; each bone reaches as far as the next ones.
        let along = STEPS as f64 * taken.min(1.0);
        for (joint, share) in branches {
            for step in 0..=STEPS {
                let near = (1.0 - (along - step as f64).abs()).max(0.0);
                weights[bone(joint, step)] += here * near * share / taken;
            }
        }
    }
    let mut order: Vec<(u8, f64)> = (0..).zip(weights).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    let total: f64 = order[..INFLUENCES].iter().map(|(_, weight)| weight).sum();
    std::array::from_fn(|k| (order[k].0, order[k].1 / total))
}

/// Number of vertices from which a joint is regressed.
const SUPPORT: usize = 80;

/// A joint as a weighted sum of vertices, in every pose and shape: the smallest weights r with
/// sum r = 1 and, for each bone b with weight w_b, sum r w_b (v - joint) = 0. So the sum
/// stays at the joint however these bones turn about it. Only vertices that these bones alone move are used.
pub(super) fn regressor(
    joint: Joint,
    at: &Vector3<f64>,
    vertices: &[Vector3<f64>],
    influences: &[Influences],
) -> Vec<(u32, f64)> {
    let own: Vec<u8> = match joint.parent() {
        None => vec![0],
        Some(_) => (0..=STEPS).map(|step| bone(joint, step) as u8).collect(),
    };
    let counts = |k: &usize| influences[*k].iter().all(|(b, w)| *w == 0.0 || own.contains(b));
    let mut near: Vec<usize> = (0..vertices.len()).filter(counts).collect();
    near.sort_by(|a, b| {
        let far = |k: &usize| (vertices[*k] - at).norm_squared();
        far(a).total_cmp(&far(b))
    });
    near.truncate(SUPPORT);
    let rows = 1 + 3 * own.len();
    let conditions = DMatrix::from_fn(rows, near.len(), |row, column| {
        let (k, Some(row)) = (near[column], row.checked_sub(1)) else { return 1.0 };
        let weight =
            influences[k].iter().find(|(b, _)| *b == own[row / 3]).map_or(0.0, |(_, w)| *w);
        // In decimetres, so that all rows are of one size.
        10.0 * weight * (vertices[k] - at)[row % 3]
    });
    let mut square = &conditions * conditions.transpose();
    for k in 0..rows {
        square[(k, k)] += 1e-12;
    }
    let mut target = DVector::zeros(rows);
    target[0] = 1.0;
    // Cannot fail: the matrix is positive definite.
    let Some(factor) = square.cholesky() else { return Vec::new() };
    let weights = conditions.tr_mul(&factor.solve(&target));
    near.into_iter().map(|k| k as u32).zip(weights.iter().copied()).collect()
}
