//! Reconstruction loss of a decoded pose, with derivatives.
//!
//! Both distances are smoothed norms sqrt(d^2 + e^2) - e, so that training minimises the mean error
//! and not its square. d is |R - R'|_F / sqrt 2 per joint (radians; the angle, if small), or the
//! distance of joint centres (metres) with aligned pelvis, on the template body.

use nalgebra::{Matrix3, Vector3};

use super::corpus::POSE;
use super::rotation::{SixTape, from_six, from_six_backward};
use crate::core::body::{BODY_JOINTS, JOINTS, Joint, Skeleton};

/// e of rotations, radians.
const ROTATION_EDGE: f32 = 0.02;
/// e of joint centres, metres.
const POSITION_EDGE: f32 = 0.002;

/// Local rotations of the 21 joints below the pelvis.
pub type Locals = [Matrix3<f32>; BODY_JOINTS];

/// A joint tree in single precision.
#[derive(Clone, Debug)]
pub struct Tree {
    parents: [usize; JOINTS],
    offsets: [Vector3<f32>; JOINTS],
}

/// Global rotations and positions with the pelvis at the origin.
#[derive(Clone, Debug)]
pub struct Placed {
    rotations: [Matrix3<f32>; JOINTS],
    /// Joint centres, metres.
    pub positions: [Vector3<f32>; JOINTS],
}

impl Tree {
    /// The tree of a skeleton.
    pub fn new(skeleton: &Skeleton) -> Self {
        Self {
            parents: Joint::ALL.map(|joint| joint.parent().map_or(0, Joint::index)),
            offsets: Joint::ALL.map(|joint| skeleton.offset(joint).map(|value| value as f32)),
        }
    }

    /// Forward kinematics: G_j = G_p R_j and P_j = P_p + G_p o_j.
    pub fn place(&self, locals: &Locals) -> Placed {
        let mut placed = Placed {
            rotations: [Matrix3::identity(); JOINTS],
            positions: [Vector3::zeros(); JOINTS],
        };
        for joint in 1..JOINTS {
            let parent = self.parents[joint];
            let turn = placed.rotations[parent];
            placed.rotations[joint] = turn * locals[joint - 1];
            placed.positions[joint] = placed.positions[parent] + turn * self.offsets[joint];
        }
        placed
    }

    /// Backpropagates from the positions to the entries of the local rotations: adds to `out`.
    pub fn place_backward(
        &self,
        locals: &Locals,
        placed: &Placed,
        by_positions: &[Vector3<f32>; JOINTS],
        out: &mut Locals,
    ) {
        let mut by_position = *by_positions;
        let mut by_rotation = [Matrix3::zeros(); JOINTS];
        for joint in (1..JOINTS).rev() {
            let parent = self.parents[joint];
            let (shift, turn) = (by_position[joint], by_rotation[joint]);
            by_position[parent] += shift;
            by_rotation[parent] +=
                shift * self.offsets[joint].transpose() + turn * locals[joint - 1].transpose();
            out[joint - 1] += placed.rotations[parent].transpose() * turn;
        }
    }
}

/// Mean distances of a pose.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distances {
    /// Mean over the 21 rotations, radians.
    pub rotation: f32,
    /// Mean over the 22 joint centres, metres.
    pub position: f32,
}

/// Weights of the two distances.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Weight per radian.
    pub rotation: f32,
    /// Weight per metre.
    pub position: f32,
}

/// The local rotations of a pose of 126 values.
pub fn locals_of(pose: &[f32]) -> Locals {
    tapes_of(pose).map(|tape| tape.rotation)
}

fn tapes_of(pose: &[f32]) -> [SixTape; BODY_JOINTS] {
    std::array::from_fn(|joint| from_six(&pose[6 * joint..6 * joint + 6]))
}

/// Distances between `decoded` and `truth`. Writes the derivative of their weighted sum with
/// respect to `decoded` to `by_decoded`. All are 126 values long.
pub fn pose_loss(
    tree: &Tree,
    weights: Weights,
    decoded: &[f32],
    truth: &[f32],
    by_decoded: &mut [f32],
) -> Distances {
    let tapes = tapes_of(decoded);
    let locals = tapes.map(|tape| tape.rotation);
    let true_locals = locals_of(truth);
    let (placed, true_placed) = (tree.place(&locals), tree.place(&true_locals));

    let mut by_locals = [Matrix3::zeros(); BODY_JOINTS];
    let mut by_positions = [Vector3::zeros(); JOINTS];
    let distances = Distances {
        rotation: rotation_part(weights.rotation, &locals, &true_locals, &mut by_locals),
        position: position_part(weights.position, &placed, &true_placed, &mut by_positions),
    };
    tree.place_backward(&locals, &placed, &by_positions, &mut by_locals);
    by_decoded[..POSE].fill(0.0);
    for (joint, (tape, by)) in tapes.iter().zip(&by_locals).enumerate() {
        from_six_backward(tape, by, &mut by_decoded[6 * joint..6 * joint + 6]);
    }
    distances
}

/// The mean distance of rotations. Writes `weight` times its derivative to `by_locals`.
fn rotation_part(weight: f32, locals: &Locals, truth: &Locals, by_locals: &mut Locals) -> f32 {
    let share = 1.0 / BODY_JOINTS as f32;
    let mut sum = 0.0;
    for ((local, truth), by) in locals.iter().zip(truth).zip(by_locals) {
        let difference = (local - truth) * std::f32::consts::FRAC_1_SQRT_2;
        let root = (difference.norm_squared() + ROTATION_EDGE * ROTATION_EDGE).sqrt();
        sum += share * (root - ROTATION_EDGE);
        *by = difference * (weight * share * std::f32::consts::FRAC_1_SQRT_2 / root);
    }
    sum
}

/// The mean distance of joint centres. Writes `weight` times its derivative to `by_positions`.
fn position_part(
    weight: f32,
    placed: &Placed,
    truth: &Placed,
    by_positions: &mut [Vector3<f32>; JOINTS],
) -> f32 {
    let share = 1.0 / JOINTS as f32;
    let mut sum = 0.0;
    for ((position, truth), by) in placed.positions.iter().zip(&truth.positions).zip(by_positions) {
        let difference = position - truth;
        let root = (difference.norm_squared() + POSITION_EDGE * POSITION_EDGE).sqrt();
        sum += share * (root - POSITION_EDGE);
        *by = difference * (weight * share / root);
    }
    sum
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::super::latent::tests::check;
    use super::super::mlp::fill_normal;
    use super::*;

    fn pose(seed: u64) -> Vec<f32> {
        let mut values = vec![0.0; POSE];
        fill_normal(&mut values, &mut ChaCha8Rng::seed_from_u64(seed));
        for six in values.chunks_exact_mut(6) {
            six.iter_mut().for_each(|v| *v *= 0.3);
            six[0] += 1.0;
            six[4] += 1.0;
        }
        values
    }

    #[test]
    fn derivative_agrees_with_central_differences() {
        let tree = Tree::new(&Skeleton::default());
        let weights = Weights { rotation: 1.0, position: 10.0 };
        let (decoded, truth) = (pose(1), pose(2));
        let loss = |decoded: &[f32]| {
            let d = pose_loss(&tree, weights, decoded, &truth, &mut [0.0; POSE]);
            f64::from(weights.rotation * d.rotation) + f64::from(weights.position * d.position)
        };
        let mut analytic = [0.0; POSE];
        pose_loss(&tree, weights, &decoded, &truth, &mut analytic);
        check(&decoded, &analytic, loss);
    }

    #[test]
    fn placing_agrees_with_the_body() {
        let (skeleton, pose) = (Skeleton::default(), pose(3));
        let locals = locals_of(&pose);
        let placed = Tree::new(&skeleton).place(&locals);
        let posture = crate::core::body::forward(
            &skeleton,
            &Matrix3::identity(),
            &Vector3::zeros(),
            &locals.map(|local| local.map(f64::from)),
        );
        for (single, double) in placed.positions.iter().zip(&posture.positions) {
            assert!((single.map(f64::from) - double).norm() < 1e-5);
        }
    }

    #[test]
    fn the_true_pose_has_distance_zero() {
        let tree = Tree::new(&Skeleton::default());
        let weights = Weights { rotation: 1.0, position: 1.0 };
        let distances = pose_loss(&tree, weights, &pose(4), &pose(4), &mut [0.0; POSE]);
        assert!(distances.rotation < 1e-6 && distances.position < 1e-6);
    }
}
