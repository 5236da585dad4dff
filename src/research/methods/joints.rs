//! Joint positions of many frames, with their Jacobians with respect to each frame's unknowns.

use nalgebra::Vector3;

use crate::core::body::{BODY_JOINTS, JOINTS, Joint, Skeleton, Tangents, forward, push_forward};
use crate::core::manifold::{Decoder, Jacobians, Keyframe, LATENT, Latent};
use crate::core::so3;

/// Unknowns of a frame.
pub const UNKNOWNS: usize = LATENT + 6;

/// Frames that are decoded at once; bounds the memory.
const BATCH: usize = 64;

/// Joint coordinates per frame.
pub const COORDINATES: usize = 3 * JOINTS;

/// Joint positions of frames, metres.
#[derive(Clone, Debug, Default)]
pub struct Joints {
    /// x, y, z of each joint, frame after frame.
    positions: Vec<f64>,
    /// Jacobians with respect to the frame's unknowns, 66 x 38 row-major each; empty if not asked
    /// for.
    jacobians: Vec<f64>,
}

impl Joints {
    /// The joints of `keyframes`. `turns` are their rotation vectors w, whose left Jacobian enters
    /// the derivatives.
    pub(super) fn new(
        decoder: &Decoder,
        skeleton: &Skeleton,
        keyframes: &[Keyframe],
        turns: &[Vector3<f64>],
        jacobians: bool,
    ) -> Self {
        let mut joints = Self::default();
        let mut work = Jacobians::default();
        let mut local_tangents = vec![0.0; 3 * BODY_JOINTS * LATENT];
        let mut tangents = Tangents::zeros(UNKNOWNS);
        for (keyframes, turns) in keyframes.chunks(BATCH).zip(turns.chunks(BATCH)) {
            let codes: Vec<Latent> = keyframes.iter().map(|keyframe| keyframe.z).collect();
            decoder.values(&codes, &mut work);
            if jacobians {
                decoder.tangents(&mut work);
            }
            for (n, (keyframe, turn)) in keyframes.iter().zip(turns).enumerate() {
                let local = work.rotations(n);
                let (root, position) = (&keyframe.root_rotation, &keyframe.root_position);
                let posture = forward(skeleton, root, position, &local);
                joints.positions.extend(posture.positions.iter().flatten());
                if jacobians {
                    work.local_tangents(n, &mut local_tangents);
                    tangents.clear_root();
                    tangents.set_root_rotation(LATENT, &so3::left_jacobian(turn));
                    tangents.set_root_position(LATENT + 3, 1.0);
                    let local = &local_tangents;
                    push_forward(skeleton, &posture, local, LATENT, None, &mut tangents);
                    joints.add_rows(&tangents);
                }
            }
        }
        joints
    }

    fn add_rows(&mut self, tangents: &Tangents) {
        let at = self.jacobians.len();
        self.jacobians.resize(at + COORDINATES * UNKNOWNS, 0.0);
        let rows = self.jacobians[at..].chunks_exact_mut(3 * UNKNOWNS);
        for (joint, rows) in Joint::ALL.into_iter().zip(rows) {
            let shift = tangents.position(joint).iter().copied();
            rows.iter_mut().zip(shift).for_each(|(row, v)| *row = v.into());
        }
    }

    /// The 66 coordinates of a frame's joints.
    pub fn positions(&self, frame: usize) -> &[f64] {
        &self.positions[frame * COORDINATES..(frame + 1) * COORDINATES]
    }

    /// Jacobian of these coordinates, 66 x 38 row-major.
    pub fn jacobian(&self, frame: usize) -> &[f64] {
        const SIZE: usize = COORDINATES * UNKNOWNS;
        &self.jacobians[frame * SIZE..(frame + 1) * SIZE]
    }
}
