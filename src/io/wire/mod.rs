//! Wire types and their conversions; the schemas are in `schemas/`.
//!
//! The types generated from the schemas are re-exported here. Those of cameras and poses have `from_core`, which cannot
//! fail, and `to_core`, which checks all data from outside: lengths, finite numbers, quaternions, names; `Event` and
//! `RetargetedPose` have `validated`. Counters, statuses, commands and journals are checked where they are
//! used. Invalid data never cause a panic.

mod check;
mod event;
mod generated;
mod hand_over;
mod json;
mod keyframe;
mod keypoints;
mod label;
mod pose;
mod retargeted;
mod rig;
mod schema;
mod skeleton;
mod topic;

pub use crate::core::time::TIMES_NS;
pub use generated::*;
pub use pose::LiveStamp;
pub use schema::{
    ENCODING, SCHEMA_ENCODING, SCHEMAS, Schema, decode, descriptor, encode, media_type, schema_of,
};
#[cfg(feature = "live")]
pub(crate) use skeleton::is_length;
pub use topic::{
    ActorChannel, NameError, StageChannel, Topic, TopicError, Topics, is_truth, valid_name,
};

/// Why a message cannot be used. Its text says what is wrong, with units.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum DecodeError {
    #[error("{message}: not a message of this schema: {reason}")]
    Malformed { message: &'static str, reason: prost::DecodeError },
    #[error("{message}.{field}: {found} entries, expected {expected}")]
    Length { message: &'static str, field: &'static str, found: usize, expected: usize },
    #[error("{message}.{field}: entry {index} is not a finite number")]
    NotFinite { message: &'static str, field: &'static str, index: usize },
    #[error(
        "KeypointFrame.format: unknown keypoint format {name:?}, use one of body_25, body_25b, \
         coco_17, halpe_26, coco_wholebody_133"
    )]
    UnknownFormat { name: String },
    #[error("KeypointFrame.camera: camera {name:?} is not in the rig, add its calibration")]
    UnknownCamera { name: String },
    /// Any other invalid value.
    #[error("{message}.{field}: {reason}")]
    Invalid { message: &'static str, field: &'static str, reason: String },
}
