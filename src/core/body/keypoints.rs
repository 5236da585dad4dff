//! The positions of detector keypoints on the body, and their weights in the fit.
//!
//! Each keypoint is an offset from one joint, scaled by the shape like its part of the body. The offset
//! turns with the joint, or with a mean of the joint and its parent. Detectors do not find joint centres:
//! their hips lie higher and wider than the hip joints, and their necks differ between data sets. Such
//! keypoints have an offset and a smaller weight \[Pavlakos 2019, sec. 3.2\]. A detected knee moves more
//! with the thigh than with the shank when the knee bends. A detected hip moves with pelvis and thigh
//! equally. The offsets of nose, head top, toes and heels were adjusted by up to 2 cm to OpenPose
//! BODY_25B on one performer.

use nalgebra::{Matrix3, Vector3};

use super::forward::{Arms, Posture};
use super::joints::Joint;
use super::keypoint_offsets::Slot;
use super::skeleton::{BODY_COEFFICIENTS, Part, SHAPE_COEFFICIENTS, ShapeCoefficient, Skeleton};
use crate::core::detections::{Keypoint, KeypointFormat};

/// The position of a keypoint on the body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attachment {
    /// The joint from whose centre the offset leads.
    pub joint: Joint,
    /// Share of the parent's rotation in what turns the offset; the rest is the joint's own.
    pub parent_share: f64,
    /// Weight of the keypoint in the fit; 0 if it is not fitted.
    pub weight: f64,
    template: Vector3<f64>,
    part: Part,
    /// 1 on the left, -1 on the right, 0 in the middle.
    side: f64,
    offset_slot: Option<Slot>,
}

impl Attachment {
    /// The attachment of `keypoint`.
    pub fn of(keypoint: Keypoint) -> Self {
        let (joint, template, part, weight) = table(keypoint);
        Self {
            joint,
            parent_share: parent_share(keypoint),
            weight,
            template: Vector3::from(template),
            part,
            side: keypoint.side(),
            offset_slot: Slot::of(keypoint),
        }
    }

    /// Offset from the joint's centre, with the body's keypoint offsets, metres.
    pub fn offset(&self, body: &Skeleton) -> Vector3<f64> {
        let offset = self
            .offset_slot
            .map_or_else(Vector3::zeros, |slot| slot.offset(body.keypoint_offsets()));
        self.part.scaled(&self.template, self.side, body.shape()) + offset
    }

    /// The keypoint in the world, metres.
    pub fn position(&self, posture: &Posture, body: &Skeleton) -> Vector3<f64> {
        self.arms(posture, &self.offset(body)).position(posture)
    }

    /// What turns the offset: G_j + s (G_parent - G_j).
    pub fn turn(&self, posture: &Posture) -> Matrix3<f64> {
        let own = posture.rotations[self.joint.index()];
        match self.joint.parent() {
            Some(parent) if self.parent_share != 0.0 => {
                own + (posture.rotations[parent.index()] - own) * self.parent_share
            }
            _ => own,
        }
    }

    /// The arms of an offset of this keypoint.
    pub fn arms(&self, posture: &Posture, offset: &Vector3<f64>) -> Arms {
        let arm = |joint: Joint, share: f64| posture.rotations[joint.index()] * offset * share;
        let parent = self.joint.parent().filter(|_| self.parent_share != 0.0);
        Arms {
            joint: self.joint,
            own: arm(self.joint, 1.0 - self.parent_share),
            of_parent: parent.map(|parent| (parent, arm(parent, self.parent_share))),
        }
    }

    /// Derivative of [`Attachment::offset`] by each body coefficient.
    pub fn offset_by_body(&self) -> [Vector3<f64>; BODY_COEFFICIENTS] {
        let mut all = [Vector3::zeros(); BODY_COEFFICIENTS];
        let (by_shape, by_offsets) = all.split_at_mut(SHAPE_COEFFICIENTS);
        for (out, by) in by_shape.iter_mut().zip(ShapeCoefficient::ALL) {
            *out = self.part.derivative(&self.template, self.side, by);
        }
        if let Some(slot) = self.offset_slot {
            slot.derivative(by_offsets);
        }
        all
    }
}

/// A keypoint that is fitted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyPoint {
    /// Index in the detector's format.
    pub index: usize,
    /// The keypoint.
    pub keypoint: Keypoint,
    /// Its position on the body.
    pub attachment: Attachment,
}

/// The keypoints of `format` with a weight above 0, in the order of the format.
pub fn fitted_points(format: KeypointFormat) -> Vec<BodyPoint> {
    format
        .keypoints()
        .iter()
        .enumerate()
        .map(|(index, &keypoint)| BodyPoint {
            index,
            keypoint,
            attachment: Attachment::of(keypoint),
        })
        .filter(|point| point.attachment.weight > 0.0)
        .collect()
}

/// Joint, offset (left side and midline, metres, template shape), part, weight.
fn table(keypoint: Keypoint) -> (Joint, [f64; 3], Part, f64) {
    use Keypoint as K;
    let (joint, [x, y, z], part, weight) = match keypoint {
        K::Nose => (Joint::Head, [0.0, 0.030, 0.112], Part::Head, 1.0),
        K::LEye | K::REye => (Joint::Head, [0.032, 0.055, 0.088], Part::Head, 1.0),
        K::LEar | K::REar => (Joint::Head, [0.072, 0.035, 0.010], Part::Head, 1.0),
        K::HeadTop => (Joint::Head, [0.0, 0.168, 0.040], Part::Head, 0.5),
        K::Neck => (Joint::Spine3, [0.0, 0.145, 0.010], Part::Trunk, 0.0),
        K::UpperNeck => (Joint::Neck, [0.0, 0.040, 0.010], Part::Trunk, 0.0),
        K::MidHip => (Joint::Pelvis, [0.0, -0.060, 0.010], Part::Hip, 0.0),
        K::LShoulder | K::RShoulder => (Joint::LShoulder, [0.0, 0.0, 0.0], Part::UpperArm, 1.0),
        K::LElbow | K::RElbow => (Joint::LElbow, [0.0, 0.0, 0.0], Part::UpperArm, 1.0),
        K::LWrist | K::RWrist => (Joint::LWrist, [0.0, 0.0, 0.0], Part::Forearm, 1.0),
        K::LHip | K::RHip => (Joint::LHip, [0.014, 0.018, 0.012], Part::Hip, 0.6),
        K::LKnee | K::RKnee => (Joint::LKnee, [0.0, 0.0, 0.010], Part::Thigh, 1.0),
        K::LAnkle | K::RAnkle => (Joint::LAnkle, [0.0, 0.0, 0.0], Part::Shank, 1.0),
        K::LBigToe | K::RBigToe => (Joint::LFoot, [-0.004, -0.011, 0.061], Part::Foot, 1.0),
        K::LSmallToe | K::RSmallToe => (Joint::LFoot, [0.034, -0.016, 0.018], Part::Foot, 1.0),
        K::LHeel | K::RHeel => (Joint::LAnkle, [0.0, -0.046, -0.040], Part::Foot, 1.0),
    };
    match keypoint.of_left() {
        (_, -1.0) => (joint.mirrored(), [-x, y, z], part, weight),
        _ => (joint, [x, y, z], part, weight),
    }
}

/// Share of a joint's parent in what turns a keypoint's offset.
fn parent_share(keypoint: Keypoint) -> f64 {
    match keypoint {
        Keypoint::LHip | Keypoint::RHip => 0.5,
        Keypoint::LKnee | Keypoint::RKnee => 0.7,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::super::keypoint_offsets::{KeypointOffsets, SYMMETRIC_OFFSETS};
    use super::*;
    use crate::core::body::Pose;
    use crate::core::so3;

    #[test]
    fn every_format_has_both_sides_of_each_limb() {
        for format in KeypointFormat::ALL {
            let points = fitted_points(format);
            for keypoint in [Keypoint::LWrist, Keypoint::RWrist, Keypoint::LAnkle, Keypoint::RAnkle]
            {
                assert!(points.iter().any(|p| p.keypoint == keypoint), "{}", format.name());
            }
        }
    }

    #[test]
    fn left_and_right_mirror_each_other() {
        let both = |i| if i < SYMMETRIC_OFFSETS { 0.1 * i as f64 } else { 0.0 };
        let offsets = KeypointOffsets(std::array::from_fn(both));
        let body = Skeleton::default().with_keypoint_offsets(offsets);
        for (l, r) in [(Keypoint::LHip, Keypoint::RHip), (Keypoint::LBigToe, Keypoint::RBigToe)] {
            let (l, r) = (Attachment::of(l), Attachment::of(r));
            let (a, b) = (l.offset(&body), r.offset(&body));
            assert_eq!(l.joint.mirrored(), r.joint);
            assert_eq!((-a.x, a.y, a.z), (b.x, b.y, b.z));
        }
    }

    #[test]
    fn differences_of_the_sides_move_left_and_right_apart() {
        let differences = |i| if i < SYMMETRIC_OFFSETS { 0.0 } else { 0.1 * i as f64 };
        let offsets = KeypointOffsets(std::array::from_fn(differences));
        let (plain, body) =
            (Skeleton::default(), Skeleton::default().with_keypoint_offsets(offsets));
        let moved = |keypoint| {
            let attachment = Attachment::of(keypoint);
            attachment.offset(&body) - attachment.offset(&plain)
        };
        let (l, r) = (moved(Keypoint::LWrist), moved(Keypoint::RWrist));
        assert!(l.norm() > 0.01);
        assert!((l - Vector3::new(r.x, -r.y, -r.z)).norm() < 1e-12, "{l} {r}");
        assert_eq!(moved(Keypoint::Nose), Vector3::zeros());
    }

    #[test]
    fn a_knee_turns_more_with_the_thigh_than_with_the_shank() {
        let (body, mut pose) = (Skeleton::default(), Pose::rest());
        // A bent knee turns the shank's front, where the point is, downwards.
        pose.local[Joint::LKnee.index() - 1] =
            so3::exp(&(Vector3::x() * std::f64::consts::FRAC_PI_2));
        let posture = pose.posture(&body);
        let knee = Attachment::of(Keypoint::LKnee);
        let away = knee.position(&posture, &body) - posture.positions[Joint::LKnee.index()];
        assert!((away - Vector3::new(0.0, -0.003, 0.007)).norm() < 1e-12, "{away}");
        let arms = knee.arms(&posture, &knee.offset(&body));
        assert!((arms.position(&posture) - knee.position(&posture, &body)).norm() < 1e-12);
    }
}
