//! A pose of the body, and the pose that a tracker publishes.

use nalgebra::{Matrix3, Vector3};

use super::forward::{Posture, forward};
use super::joints::{BODY_JOINTS, JOINTS, Joint};
use super::skeleton::Skeleton;
use crate::core::named;
use crate::core::so3;
use crate::core::time::Timestamp;

/// A bone: its joint; the joint centre in the parent's frame, metres; `parent_from_joint`, which is zero in the
/// T-pose. The parent of the pelvis is the world.
pub type Bone = (Joint, Vector3<f64>, Matrix3<f64>);

/// The root and the 21 local rotations.
#[derive(Clone, Debug, PartialEq)]
pub struct Pose {
    /// `world_from_pelvis`.
    pub root_rotation: Matrix3<f64>,
    /// The pelvis in the world, metres.
    pub root_position: Vector3<f64>,
    /// `parent_from_joint`, joints 1 to 21 in order.
    pub local: [Matrix3<f64>; BODY_JOINTS],
}

impl Pose {
    /// The rest pose at the origin.
    pub fn rest() -> Self {
        Self {
            root_rotation: Matrix3::identity(),
            root_position: Vector3::zeros(),
            local: [Matrix3::identity(); BODY_JOINTS],
        }
    }

    /// The pose at `s` on the path from `self` (s = 0) to `to` (s = 1): a slerp of each rotation,
    /// a straight line for the position. Values of `s` outside \[0, 1\] extrapolate.
    pub fn interpolate(&self, to: &Self, s: f64) -> Self {
        Self {
            root_rotation: so3::slerp(&self.root_rotation, &to.root_rotation, s),
            root_position: self.root_position.lerp(&to.root_position, s),
            local: std::array::from_fn(|j| so3::slerp(&self.local[j], &to.local[j], s)),
        }
    }

    /// Joint rotations and positions in the world.
    pub fn posture(&self, skeleton: &Skeleton) -> Posture {
        forward(skeleton, &self.root_rotation, &self.root_position, &self.local)
    }
}

named! {
    /// How far a pose can be trusted.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
    pub enum TrackingState {
        /// Fitted to the detections of its window.
        Tracking = "tracking",
        /// Extrapolated: too little was seen.
        Coasting = "coasting",
        /// Its window fitted badly; flagged, not to be used.
        Lost = "lost",
    }
}

/// The standard deviation of the error of each joint centre along each axis of the world, metres.
pub type JointDeviations = [f64; JOINTS];

/// A pose at a capture time.
#[derive(Clone, Debug, PartialEq)]
pub struct StampedPose {
    /// The capture time.
    pub capture: Timestamp,
    /// The pose.
    pub pose: Pose,
    /// The quality of the pose.
    pub state: TrackingState,
    /// Number of its window, from 0.
    pub window: u64,
    /// Version of the rig of the solve.
    pub rig_version: u64,
    /// Whether its window was still open.
    pub provisional: bool,
    /// Revision: counts up with each new pose of the same capture time.
    pub revision: u32,
    /// The standard deviations of its joint centres; `None` where they are not known.
    pub deviations: Option<JointDeviations>,
}

impl StampedPose {
    /// A final pose of window 0 and calibration 1, without standard deviations.
    pub fn new(capture: Timestamp, pose: Pose, state: TrackingState) -> Self {
        let (window, rig_version, provisional, revision) = (0, 1, false, 0);
        Self { capture, pose, state, window, rig_version, provisional, revision, deviations: None }
    }
}
