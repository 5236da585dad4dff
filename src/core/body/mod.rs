//! The body: a skeleton with shape, its forward kinematics, and the detector keypoints on it.
//!
//! Rest pose: T-pose, y up, +z forward, +x the subject's left, metres.

mod forward;
mod joints;
mod keypoint_offsets;
mod keypoints;
mod mesh;
mod pose;
mod skeleton;

pub use forward::Posture;
#[doc(hidden)]
pub use forward::{Arms, Tangents, Wrenches, forward, push_forward};
pub use joints::{BODY_JOINTS, FASTEST, FEET, JOINTS, Joint};
#[doc(hidden)]
pub use keypoint_offsets::{KeypointOffsets, OFFSETS, OffsetPrior, SYMMETRIC_OFFSETS};
pub use keypoints::{Attachment, BodyPoint, fitted_points};
pub use mesh::{Bulge, Mesh};
pub use pose::{Bone, JointDeviations, Pose, StampedPose, TrackingState};
pub use skeleton::{
    BODY_COEFFICIENTS, SHAPE_COEFFICIENTS, SYMMETRIC_SHAPE, Shape, ShapeCoefficient, Skeleton,
};
