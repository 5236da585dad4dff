//! Aligns the target's zero pose with our T-pose: the rotations A_t = `ours_from_target` at rest.

use nalgebra::{Matrix3, Rotation3, Unit, Vector3};

use super::mapping::Follow;
use super::{Mapping, RetargetError, Target};
use crate::core::body::{Joint, Skeleton};
use crate::core::so3;

/// Trunk, shoulders and head keep the target's own rest posture if it is within this angle of ours,
/// cosine of 45 degrees. Beyond it the zero pose is not a standing posture.
const NO_POSTURE: f64 = 0.707;
/// If the shank is within this angle of the vertical, the foot stands flat; cosine of 10 degrees.
const STANDING: f64 = 0.985;
/// If the foot is further than this angle from ours, it does not stand; cosine of 60 degrees.
const FOOT_HANGS: f64 = 0.5;
/// Smaller rotations are rounding errors of a file, radians.
const ROUNDING: f64 = 1e-5;

/// The alignments A_t of all joints of the target.
pub(super) fn alignments(
    target: &Target,
    mapping: &Mapping,
    skeleton: &Skeleton,
) -> Result<Vec<Matrix3<f64>>, RetargetError> {
    let facing = target.facing(mapping)?;
    let mut all: Vec<Matrix3<f64>> = Vec::with_capacity(target.joints().len());
    for (index, joint) in target.joints().iter().enumerate() {
        let before = joint.parent.map_or(facing, |parent| all[parent]);
        let bones = Bones { target, mapping, skeleton, facing };
        all.push(match mapping.follow[index] {
            // Joints above the hips are not aligned, see `apply`.
            Follow::World => facing,
            Follow::Parent => before,
            Follow::Ours(joint, ..) => bones.align(index, joint, &before),
        });
    }
    Ok(all)
}

struct Bones<'a> {
    target: &'a Target,
    mapping: &'a Mapping,
    skeleton: &'a Skeleton,
    facing: Matrix3<f64>,
}

impl Bones<'_> {
    fn align(&self, index: usize, joint: Joint, before: &Matrix3<f64>) -> Matrix3<f64> {
        use Joint as J;
        match joint {
            J::LHip
            | J::RHip
            | J::LKnee
            | J::RKnee
            | J::LShoulder
            | J::RShoulder
            | J::LElbow
            | J::RElbow => self.lay(index, joint, before),
            J::LAnkle | J::RAnkle => self.foot(index, joint, before),
            J::LFoot | J::RFoot | J::LWrist | J::RWrist => *before,
            _ => self.posture(index, joint),
        }
    }

    /// Aligns a limb's bone with ours by the smallest rotation after that of its parent bone.
    fn lay(&self, index: usize, joint: Joint, before: &Matrix3<f64>) -> Matrix3<f64> {
        let (Some(theirs), Some(ours)) = (self.theirs(index, joint), self.ours(joint)) else {
            return *before;
        };
        smallest_turn(&(before * theirs), &ours) * before
    }

    /// Aligns a foot: keeps its slope on the floor, rotates it about the vertical to our heading.
    fn foot(&self, index: usize, joint: Joint, before: &Matrix3<f64>) -> Matrix3<f64> {
        let shank = joint.parent().and_then(|knee| self.theirs(self.mapping.joint(knee)?, knee));
        let stands = shank.is_none_or(|shank| -(self.facing * shank).normalize().y > STANDING);
        let before = if stands { &self.facing } else { before };
        let (Some(theirs), Some(ours)) = (self.theirs(index, joint), self.ours(joint)) else {
            return *before;
        };
        let theirs = (before * theirs).normalize();
        if theirs.dot(&ours) < FOOT_HANGS {
            return smallest_turn(&theirs, &ours) * before;
        }
        let heading = |foot: &Vector3<f64>| foot.x.atan2(foot.z);
        let turn = heading(&ours) - heading(&theirs);
        if turn.abs() < ROUNDING { *before } else { so3::about(1, turn) * before }
    }

    /// Aligns trunk, neck, head and collars.
    fn posture(&self, index: usize, joint: Joint) -> Matrix3<f64> {
        let (Some(theirs), Some(ours)) = (self.theirs(index, joint), self.ours(joint)) else {
            return self.facing;
        };
        let theirs = (self.facing * theirs).normalize();
        if theirs.dot(&ours) > NO_POSTURE {
            return self.facing;
        }
        smallest_turn(&theirs, &ours) * self.facing
    }

    /// The target's bone from this joint to its counterpart of our next joint, or to the end site
    /// of a limb's last joint, metres. `None` if there is none or it has no length.
    fn theirs(&self, index: usize, joint: Joint) -> Option<Vector3<f64>> {
        let next = next(joint).and_then(|next| self.mapping.joint(next));
        let below = |&end: &usize| end != index && self.target.is_below(end, index);
        let limb = joint.mirrored() != joint;
        match next.filter(below) {
            None if !limb => None,
            end => self.target.bone(index, end),
        }
    }

    /// Direction of our bone.
    fn ours(&self, joint: Joint) -> Option<Vector3<f64>> {
        self.skeleton.offset(next(joint)?).try_normalize(1e-9)
    }
}

/// The joint at the other end of a joint's bone.
fn next(joint: Joint) -> Option<Joint> {
    Some(match joint {
        Joint::LHip => Joint::LKnee,
        Joint::RHip => Joint::RKnee,
        Joint::LKnee => Joint::LAnkle,
        Joint::RKnee => Joint::RAnkle,
        Joint::LAnkle => Joint::LFoot,
        Joint::RAnkle => Joint::RFoot,
        Joint::LCollar => Joint::LShoulder,
        Joint::RCollar => Joint::RShoulder,
        Joint::LShoulder => Joint::LElbow,
        Joint::RShoulder => Joint::RElbow,
        Joint::LElbow => Joint::LWrist,
        Joint::RElbow => Joint::RWrist,
        Joint::Spine1 => Joint::Spine2,
        Joint::Spine2 => Joint::Spine3,
        Joint::Spine3 => Joint::Neck,
        Joint::Neck => Joint::Head,
        _ => return None,
    })
}

/// The smallest rotation from one direction to another. For opposite directions, it is about the
/// x axis, or the z axis if they are along x.
fn smallest_turn(from: &Vector3<f64>, to: &Vector3<f64>) -> Matrix3<f64> {
    if from.angle(to) < ROUNDING {
        return Matrix3::identity();
    }
    let turn = Rotation3::rotation_between(from, to).unwrap_or_else(|| {
        let axis = if to.x.abs() < 0.5 * to.norm() { Vector3::x() } else { Vector3::z() };
        let axis = axis - to * (to.dot(&axis) / to.norm_squared());
        Rotation3::from_axis_angle(&Unit::new_normalize(axis), std::f64::consts::PI)
    });
    turn.into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_turn_maps_one_direction_to_the_other_even_if_opposite() {
        let all = [Vector3::x(), -Vector3::x(), Vector3::new(0.1, -2.0, 0.3), Vector3::z()];
        for from in &all {
            for to in all.iter().flat_map(|to| [*to, -to]) {
                let turn = smallest_turn(from, &to);
                assert!(so3::is_rotation(&turn, 1e-12));
                assert!((turn * from.normalize() - to.normalize()).norm() < 1e-9);
            }
        }
    }
}
