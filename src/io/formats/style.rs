//! How a file turns, names and measures the joints of a body.

use nalgebra::{Matrix3, Vector3};

use super::{Unit, Up};
use crate::core::body::{Attachment, JOINTS, Joint, Pose, Skeleton};
use crate::core::detections::Keypoint;
use crate::core::named;
use crate::core::so3;

/// Length from wrist to knuckles, divided by the length of the forearm.
const HAND: f64 = 0.33;

named! {
    /// The pose in which all rotations of a file are zero. It stands upright.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
    pub enum RestPose {
        /// The arms are level.
        #[default]
        T = "t",
        /// The arms point down by 45 degrees.
        A = "a",
        /// The arms hang: a neutral pose.
        N = "n",
    }
}

impl RestPose {
    /// The pose, with the rotations that it has where a T-pose has none.
    pub fn pose(self) -> Pose {
        let mut pose = Pose::rest();
        let lowered: f64 = match self {
            Self::T => 0.0,
            Self::A => 45.0,
            Self::N => 90.0,
        };
        for shoulder in [Joint::LShoulder, Joint::RShoulder] {
            let angle = -shoulder.side() * lowered.to_radians();
            pose.local[shoulder.index() - 1] = so3::exp(&(Vector3::z() * angle));
        }
        pose
    }
}

named! {
    /// Whose names a file gives to joints.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
    pub enum JointNames {
        /// `pelvis`, `l_hip`, ...
        #[default]
        Ours = "ours",
        /// `mixamorig:Hips`, `mixamorig:LeftUpLeg`, ...
        Mixamo = "mixamo",
        /// Those of Unreal's mannequin: `pelvis`, `thigh_l`, ...
        Unreal = "unreal",
    }
}

impl JointNames {
    /// The name of a joint.
    pub fn of(self, joint: Joint) -> &'static str {
        match self {
            Self::Ours => joint.name(),
            Self::Mixamo => MIXAMO[joint.index()],
            Self::Unreal => UNREAL[joint.index()],
        }
    }
}

const MIXAMO: [&str; JOINTS] = [
    "mixamorig:Hips",
    "mixamorig:LeftUpLeg",
    "mixamorig:RightUpLeg",
    "mixamorig:Spine",
    "mixamorig:LeftLeg",
    "mixamorig:RightLeg",
    "mixamorig:Spine1",
    "mixamorig:LeftFoot",
    "mixamorig:RightFoot",
    "mixamorig:Spine2",
    "mixamorig:LeftToeBase",
    "mixamorig:RightToeBase",
    "mixamorig:Neck",
    "mixamorig:LeftShoulder",
    "mixamorig:RightShoulder",
    "mixamorig:Head",
    "mixamorig:LeftArm",
    "mixamorig:RightArm",
    "mixamorig:LeftForeArm",
    "mixamorig:RightForeArm",
    "mixamorig:LeftHand",
    "mixamorig:RightHand",
];

const UNREAL: [&str; JOINTS] = [
    "pelvis",
    "thigh_l",
    "thigh_r",
    "spine_01",
    "calf_l",
    "calf_r",
    "spine_02",
    "foot_l",
    "foot_r",
    "spine_03",
    "ball_l",
    "ball_r",
    "neck_01",
    "clavicle_l",
    "clavicle_r",
    "head",
    "upperarm_l",
    "upperarm_r",
    "lowerarm_l",
    "lowerarm_r",
    "hand_l",
    "hand_r",
];

named! {
    /// The axes of a joint in the rest pose of a file.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
    pub enum JointAxes {
        /// y along the bone and z to the front, of feet up: as Blender draws bones.
        #[default]
        Bone = "bone",
        /// Those of the world.
        World = "world",
    }
}

impl JointAxes {
    /// The axes of each joint in the world of a rest pose, as columns.
    pub(super) fn of(self, rest: &Pose, skeleton: &Skeleton) -> [Matrix3<f64>; JOINTS] {
        let rotations = rest.posture(skeleton).rotations;
        Joint::ALL.map(|joint| match self {
            Self::Bone => along(&(rotations[joint.index()] * bone(skeleton, joint))),
            Self::World => Matrix3::identity(),
        })
    }
}

/// Axes with y along a bone.
fn along(bone: &Vector3<f64>) -> Matrix3<f64> {
    let Some(y) = bone.try_normalize(1e-9) else { return Matrix3::identity() };
    let front = if y.z.abs() > 0.7 { Vector3::y() } else { Vector3::z() };
    let x = y.cross(&front).normalize();
    Matrix3::from_columns(&[x, y, x.cross(&y)])
}

/// A joint's bone in the joint's frame, metres: to the next joint towards head, hand or toes.
fn bone(skeleton: &Skeleton, joint: Joint) -> Vector3<f64> {
    let mut next = Joint::ALL.into_iter().filter(|next| next.parent() == Some(joint));
    let first = next.next();
    let next = next.find(|next| next.side() == 0.0).or(first);
    let end = next.map(|next| *skeleton.offset(next)).or_else(|| end_site(skeleton, joint));
    end.unwrap_or_default()
}

/// End of the bone of a last joint, metres from the joint.
pub(super) fn end_site(skeleton: &Skeleton, joint: Joint) -> Option<Vector3<f64>> {
    let point = |keypoint| Some(Attachment::of(keypoint).offset(skeleton));
    match joint {
        Joint::Head => point(Keypoint::HeadTop),
        Joint::LFoot => point(Keypoint::LBigToe),
        Joint::RFoot => point(Keypoint::RBigToe),
        Joint::LWrist | Joint::RWrist => Some(skeleton.offset(joint) * HAND),
        _ => None,
    }
}

/// How a file turns, names and measures the joints of a body.
#[derive(Clone, Debug)]
pub struct Style {
    /// The pose in which all rotations are zero.
    rest: RestPose,
    /// Rotations of the joints in that pose, where a T-pose has none.
    turns: [Matrix3<f64>; JOINTS],
    /// From our world to the file's.
    axes: Matrix3<f64>,
    /// The axis that points up.
    pub up: Up,
    /// The names of the joints.
    pub names: JointNames,
    /// The unit of length, where the format leaves it open.
    pub unit: Option<Unit>,
    /// The axes of the joints, where a file's rest pose may have rotations.
    pub joint_axes: JointAxes,
}

impl Default for Style {
    /// A T-pose with y up, our names, and the format's usual unit.
    fn default() -> Self {
        Self::new(RestPose::T, Up::Y)
    }
}

impl Style {
    /// Our names and the format's usual unit.
    pub fn new(rest: RestPose, up: Up) -> Self {
        let turns = rest.pose().posture(&Skeleton::default()).rotations;
        let axes = up.calibration_from_world();
        let (names, joint_axes) = (JointNames::Ours, JointAxes::Bone);
        Self { rest, turns, axes, up, names, unit: None, joint_axes }
    }

    /// The same with these axes of the joints in the rest pose.
    pub(super) fn with_axes(mut self, axes: &[Matrix3<f64>; JOINTS]) -> Self {
        for (turn, axes) in self.turns.iter_mut().zip(axes) {
            *turn = axes.transpose() * *turn;
        }
        self
    }

    /// The pose in which all rotations are zero.
    pub(super) fn rest(&self) -> Pose {
        self.rest.pose()
    }

    /// A place in the file's world, metres.
    pub fn place(&self, place: &Vector3<f64>) -> Vector3<f64> {
        self.axes * place
    }

    /// A place in the frame of a joint of our skeleton, in that joint's frame of the file, metres.
    pub(super) fn offset(&self, joint: Joint, of: &Vector3<f64>) -> Vector3<f64> {
        self.axes * self.turns[joint.index()] * of
    }

    /// The offsets of the joints in the file, metres.
    pub fn skeleton(&self, skeleton: &Skeleton) -> Skeleton {
        let turned =
            |joint: Joint| self.offset(joint.parent().unwrap_or(joint), skeleton.offset(joint));
        Skeleton::with_joint_offsets(Joint::ALL.map(turned))
    }

    /// The rotations and the place of a pose in the file: with [`Style::skeleton`] they give the places of
    /// the joints in the file's world.
    pub fn pose(&self, pose: &Pose) -> Pose {
        let Self { axes, turns, .. } = self;
        let turned = |before: &Matrix3<f64>, own: &Matrix3<f64>, joint: usize| {
            axes * before * own * turns[joint].transpose() * axes.transpose()
        };
        let parent = |joint: usize| Joint::ALL[joint].parent().map_or(0, Joint::index);
        Pose {
            root_rotation: turned(&Matrix3::identity(), &pose.root_rotation, 0),
            root_position: self.place(&pose.root_position),
            local: std::array::from_fn(|j| turned(&turns[parent(j + 1)], &pose.local[j], j + 1)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bent() -> Pose {
        let mut pose = Pose::rest();
        for (j, turn) in pose.local.iter_mut().enumerate() {
            *turn = so3::exp(&Vector3::new(0.3, 0.1 * j as f64 - 1.0, -0.4));
        }
        pose.root_rotation = so3::exp(&Vector3::new(0.2, 1.0, -0.3));
        pose.root_position = Vector3::new(0.4, 1.0, -2.0);
        pose
    }

    #[test]
    fn every_style_has_the_same_places() {
        let (body, pose) = (Skeleton::default(), bent());
        let wanted = pose.posture(&body).positions;
        for rest in [RestPose::T, RestPose::A, RestPose::N] {
            for up in [Up::Y, Up::Z] {
                let style = Style::new(rest, up);
                let found = style.pose(&pose).posture(&style.skeleton(&body)).positions;
                for (found, wanted) in found.iter().zip(&wanted) {
                    assert!((found - style.place(wanted)).norm() < 1e-12, "{rest:?} {up:?}");
                }
            }
        }
        let up = Style::new(RestPose::T, Up::Z).place(&Vector3::y());
        assert!((up - Vector3::z()).norm() < 1e-12);
    }

    #[test]
    fn rotations_are_zero_in_an_a_pose() {
        let style = Style::new(RestPose::A, Up::Y);
        let pose = style.pose(&RestPose::A.pose());
        assert!(pose.local.iter().all(|turn| (turn - Matrix3::identity()).norm() < 1e-12));
        let at = Pose::rest().posture(&style.skeleton(&Skeleton::default())).positions;
        for (shoulder, wrist) in
            [(Joint::LShoulder, Joint::LWrist), (Joint::RShoulder, Joint::RWrist)]
        {
            let arm = at[wrist.index()] - at[shoulder.index()];
            assert!((arm.x * shoulder.side() + arm.y).abs() < 0.1 * arm.norm(), "{arm}");
            assert!(arm.y < -0.3, "{arm}");
        }
    }
}
