//! Two-bone inverse kinematics of a leg with a given foot placement.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::curves::soft_min;
use crate::core::body::{Attachment, BODY_JOINTS, Joint, Pose, Skeleton};
use crate::core::detections::Keypoint;

/// Side of the body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Side {
    Left,
    Right,
}

impl Side {
    /// 0 for left, 1 for right.
    pub(super) fn index(self) -> usize {
        self as usize
    }

    /// 1 for left (+x), -1 for right.
    pub(super) fn sign(self) -> f64 {
        if self == Self::Left { 1.0 } else { -1.0 }
    }

    /// The joint on this side, given the left one.
    pub(super) fn of(self, left: Joint) -> Joint {
        if self == Self::Left { left } else { left.mirrored() }
    }
}

/// Segments of a body's left leg, metres; the right one mirrors it.
#[derive(Clone, Debug)]
pub(super) struct Leg {
    hip: Vector3<f64>,
    thigh: Vector3<f64>,
    shank: Vector3<f64>,
    /// Floor contacts of the ball of the foot and of the heel, relative to the ankle.
    ball: Vector3<f64>,
    heel: Vector3<f64>,
}

/// Largest cosine of the knee's flexion.
const STRAIGHTEST: f64 = 0.996;

impl Leg {
    pub(super) fn of(skeleton: &Skeleton) -> Self {
        let of = |joint| *skeleton.offset(joint);
        let point = |keypoint| Attachment::of(keypoint).offset(skeleton);
        let toe = of(Joint::LFoot) + point(Keypoint::LBigToe);
        let sole = toe.y;
        let heel = point(Keypoint::LHeel);
        Self {
            hip: of(Joint::LHip),
            thigh: of(Joint::LKnee),
            shank: of(Joint::LAnkle),
            ball: Vector3::new(0.0, sole, of(Joint::LFoot).z),
            heel: Vector3::new(0.0, sole, heel.z),
        }
    }

    /// Distance from hip to ankle of a straight leg.
    pub(super) fn length(&self) -> f64 {
        self.thigh.norm() + self.shank.norm()
    }

    /// Height of the pelvis above the floor with slightly bent knees.
    pub(super) fn standing_height(&self) -> f64 {
        0.988 * self.length() - self.ball.y - self.hip.y
    }

    /// Places one leg of `pose`; the pelvis must be placed already. The ankle is above `ground` (a
    /// point at the height of the sole) and the foot faces `heading`. The heel is raised by a
    /// rotation of `heel_off` about the ball, or the toes by `toes_off` about the heel, radians.
    pub(super) fn reach(
        &self,
        side: Side,
        ground: &Vector3<f64>,
        heading: &Matrix3<f64>,
        heel_off: f64,
        toes_off: f64,
        pose: &mut Pose,
    ) {
        let roll_on_ball = self.ball - about_x(heel_off) * self.ball;
        let roll_on_heel = self.heel - about_x(-toes_off) * self.heel;
        let ankle = ground + heading * (roll_on_ball + roll_on_heel) - Vector3::y() * self.ball.y;
        let foot = heading * about_x(heel_off - toes_off);

        let pelvis = pose.root_rotation;
        let hip_offset = Vector3::new(side.sign() * self.hip.x, self.hip.y, self.hip.z);
        let to_ankle = ankle - (pose.root_position + pelvis * hip_offset);
        let flexion = self.flexion_for(to_ankle.norm());
        let thigh = self.turn_towards(&to_ankle, &(heading * Vector3::z()), flexion);
        let shank = thigh * about_x(flexion);

        set(&mut pose.local, side.of(Joint::LHip), pelvis.transpose() * thigh);
        set(&mut pose.local, side.of(Joint::LKnee), about_x(flexion));
        set(&mut pose.local, side.of(Joint::LAnkle), shank.transpose() * foot);
        set(&mut pose.local, side.of(Joint::LFoot), about_x(-0.8 * heel_off));
    }

    /// Knee flexion, radians, that puts the ankle at `distance` from the hip, by the law of
    /// cosines. If that is too far, the flexion is smoothly limited short of straight.
    fn flexion_for(&self, distance: f64) -> f64 {
        let (a, b) = (self.thigh.norm(), self.shank.norm());
        let cosine = (distance * distance - a * a - b * b) / (2.0 * a * b);
        let rest = self.thigh.yz().angle(&self.shank.yz());
        soft_min(cosine, STRAIGHTEST, 0.02).max(-0.9).acos() - rest
    }

    /// Rotation `world_from_thigh` that aligns the line from hip to ankle with `to_ankle` and bends
    /// the knee towards `forward`.
    fn turn_towards(
        &self,
        to_ankle: &Vector3<f64>,
        forward: &Vector3<f64>,
        flexion: f64,
    ) -> Matrix3<f64> {
        let in_thigh = frame_of(&-(self.thigh + about_x(flexion) * self.shank), &Vector3::z());
        let in_world = frame_of(&-to_ankle, forward);
        in_world * in_thigh.transpose()
    }
}

/// A right-handed frame, as columns, with y along `up` and z as near to `forward` as possible.
fn frame_of(up: &Vector3<f64>, forward: &Vector3<f64>) -> Matrix3<f64> {
    let y = up.normalize();
    let x = y.cross(forward).normalize();
    Matrix3::from_columns(&[x, y, x.cross(&y)])
}

pub(super) fn set(local: &mut [Matrix3<f64>; BODY_JOINTS], joint: Joint, rotation: Matrix3<f64>) {
    local[joint.index() - 1] = rotation;
}

pub(super) fn about_x(angle: f64) -> Matrix3<f64> {
    Rotation3::from_axis_angle(&Vector3::x_axis(), angle).into_inner()
}
