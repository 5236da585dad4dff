//! The kinds of performers: bodies of our model, and bodies that our model does not know.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::skinned::Skinned;
use crate::core::body::{Attachment, Joint, Posture, Skeleton};
use crate::core::detections::Keypoint;
use crate::core::named;

named! {
    /// Whose bones a performer has, and where detectors see its keypoints.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Body {
        /// A random shape of our body model, and our places of keypoints. Systematic offsets mirror each
        /// other.
        #[default]
        Own = "own",
        /// The skeleton of the motion's file, and keypoints at its joints. Half of the variance of the
        /// systematic offsets is the same on both sides, mirrored; the rest is each side's own. No joint
        /// but the limbs' has a counterpart in our model.
        Foreign = "foreign",
        /// One of the bodies of [`Skinned`]. Its keypoints are on the skin and shift with the pose. The
        /// systematic offsets are like those of `Foreign`.
        Skinned = "skinned",
    }
}

/// Where detectors see the keypoints of a body.
#[derive(Clone, Copy, Debug, Default)]
pub enum Places {
    /// Where our body model has them.
    #[default]
    Own,
    /// At the joints.
    Foreign,
    /// On the skin.
    Skinned(&'static Skinned),
}

impl Places {
    /// Name of a body with a skin.
    pub fn name(self) -> Option<String> {
        match self {
            Self::Skinned(body) => Some(body.name.clone()),
            Self::Own | Self::Foreign => None,
        }
    }

    /// Share of the variance of a systematic offset that left and right do not have in common.
    pub(super) const fn asymmetry(self) -> f64 {
        match self {
            Self::Own => 0.0,
            Self::Foreign | Self::Skinned(_) => 0.5,
        }
    }

    /// Position of a keypoint in the world, metres, and what turns its offset.
    pub(super) fn of(
        self,
        keypoint: Keypoint,
        skeleton: &Skeleton,
        posture: &Posture,
    ) -> (Vector3<f64>, Matrix3<f64>) {
        let (joint, offset) = match self {
            Self::Own => {
                let attachment = Attachment::of(keypoint);
                return (attachment.position(posture, skeleton), attachment.turn(posture));
            }
            Self::Foreign => foreign(keypoint),
            Self::Skinned(body) => {
                let position = body.position(keypoint, posture);
                return (position, posture.rotations[body.carrier(keypoint)]);
            }
        };
        let rotation = posture.rotations[joint.index()];
        (posture.positions[joint.index()] + rotation * offset, rotation)
    }
}

/// Limb keypoints are at the joints. The points of head and feet are at usual distances of an adult.
fn foreign(keypoint: Keypoint) -> (Joint, Vector3<f64>) {
    use Keypoint as K;
    let (left, side) = keypoint.of_left();
    let (joint, [x, y, z]) = match left {
        K::Nose => (Joint::Head, [0.0, 0.045, 0.125]),
        K::LEye => (Joint::Head, [0.031, 0.075, 0.098]),
        K::LEar => (Joint::Head, [0.078, 0.050, 0.005]),
        K::HeadTop => (Joint::Head, [0.0, 0.180, 0.020]),
        K::UpperNeck => (Joint::Neck, [0.0, 0.050, 0.0]),
        K::Neck => (Joint::Neck, [0.0, -0.030, 0.020]),
        K::MidHip => (Joint::Pelvis, [0.0, 0.0, 0.0]),
        K::LShoulder => (Joint::LShoulder, [0.0; 3]),
        K::LElbow => (Joint::LElbow, [0.0; 3]),
        K::LWrist => (Joint::LWrist, [0.0; 3]),
        K::LHip => (Joint::LHip, [0.0; 3]),
        K::LKnee => (Joint::LKnee, [0.0; 3]),
        K::LAnkle => (Joint::LAnkle, [0.0; 3]),
        K::LBigToe => (Joint::LAnkle, [0.0, -0.070, 0.180]),
        K::LSmallToe => (Joint::LAnkle, [0.050, -0.070, 0.140]),
        _ => (Joint::LAnkle, [0.0, -0.060, -0.045]),
    };
    let joint = if side < 0.0 { joint.mirrored() } else { joint };
    (joint, Vector3::new(side * x, y, z))
}
