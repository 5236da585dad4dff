//! The 22 joints, in the order of the SMPL-X body.

use std::cmp::Ordering;

use crate::core::named;

/// Number of joints, with the pelvis.
pub const JOINTS: usize = 22;
/// Number of joints with a local rotation from the manifold: all but the pelvis.
pub const BODY_JOINTS: usize = JOINTS - 1;
/// Upper bound of a joint's speed, m/s. A faster joint shows a jump in the capture, such as the one
/// after the reference pose at the start of many files.
pub const FASTEST: f64 = 15.0;

named! {
    /// A joint of the body, parents before children. The discriminant is its index everywhere.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
    #[allow(missing_docs)]
    #[repr(usize)]
    pub enum Joint {
        Pelvis = "pelvis",
        LHip = "l_hip",
        RHip = "r_hip",
        Spine1 = "spine1",
        LKnee = "l_knee",
        RKnee = "r_knee",
        Spine2 = "spine2",
        LAnkle = "l_ankle",
        RAnkle = "r_ankle",
        Spine3 = "spine3",
        LFoot = "l_foot",
        RFoot = "r_foot",
        Neck = "neck",
        LCollar = "l_collar",
        RCollar = "r_collar",
        Head = "head",
        LShoulder = "l_shoulder",
        RShoulder = "r_shoulder",
        LElbow = "l_elbow",
        RElbow = "r_elbow",
        LWrist = "l_wrist",
        RWrist = "r_wrist",
    }
}

use Joint::*;

/// The joints that stand on the ground: ankles and feet.
pub const FEET: [Joint; 4] = [LAnkle, RAnkle, LFoot, RFoot];

impl Joint {
    /// The index, 0 for the pelvis.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// The parent; `None` for the pelvis.
    pub const fn parent(self) -> Option<Self> {
        Some(match self {
            Pelvis => return None,
            LHip | RHip | Spine1 => Pelvis,
            LKnee => LHip,
            RKnee => RHip,
            Spine2 => Spine1,
            LAnkle => LKnee,
            RAnkle => RKnee,
            Spine3 => Spine2,
            LFoot => LAnkle,
            RFoot => RAnkle,
            Neck | LCollar | RCollar => Spine3,
            Head => Neck,
            LShoulder => LCollar,
            RShoulder => RCollar,
            LElbow => LShoulder,
            RElbow => RShoulder,
            LWrist => LElbow,
            RWrist => RElbow,
        })
    }

    /// The same joint on the other side; itself on the midline.
    pub const fn mirrored(self) -> Self {
        match self {
            LHip => RHip,
            RHip => LHip,
            LKnee => RKnee,
            RKnee => LKnee,
            LAnkle => RAnkle,
            RAnkle => LAnkle,
            LFoot => RFoot,
            RFoot => LFoot,
            LCollar => RCollar,
            RCollar => LCollar,
            LShoulder => RShoulder,
            RShoulder => LShoulder,
            LElbow => RElbow,
            RElbow => LElbow,
            LWrist => RWrist,
            RWrist => LWrist,
            Pelvis | Spine1 | Spine2 | Spine3 | Neck | Head => self,
        }
    }

    /// 1 on the left, -1 on the right, 0 on the midline.
    pub fn side(self) -> f64 {
        match self.cmp(&self.mirrored()) {
            Ordering::Less => 1.0,
            Ordering::Equal => 0.0,
            Ordering::Greater => -1.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parents_come_first_and_mirrors_are_an_involution() {
        for (index, joint) in Joint::ALL.into_iter().enumerate() {
            assert_eq!(joint.index(), index);
            assert_eq!(joint.mirrored().mirrored(), joint);
            assert_eq!(joint.parent().map(Joint::mirrored), joint.mirrored().parent());
            if let Some(parent) = joint.parent() {
                assert!(parent < joint);
            }
        }
    }
}
