//! Wire types and their conversions; the schemas are in `schemas/`.
//!
//! The types generated from the schemas are re-exported here. Each has `from_core`, which cannot
//! fail, and `to_core`, which checks all data from outside: lengths, finite numbers, quaternions,
//! names. Invalid data never cause a panic.

mod check;
mod event;
mod generated;
mod hand_over;
mod json;
mod keyframe;
mod keypoints;
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
    ENCODING, SCHEMA_ENCODING, Schema, decode, descriptor, encode, media_type, schema_of,
};
pub use topic::{
    ActorChannel, NameError, StageChannel, Topic, TopicError, Topics, is_truth, valid_name,
};

/// Why a message cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// The bytes are not Protocol Buffers, or are incomplete.
    #[error("{message}: not a message of this schema: {reason}")]
    Malformed {
        /// The expected schema.
        message: &'static str,
        /// The message from the decoder.
        reason: prost::DecodeError,
    },
    /// A list of the wrong length.
    #[error("{message}.{field}: {found} entries, expected {expected}")]
    Length {
        /// The schema.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// Number of entries in the message.
        found: usize,
        /// Expected number of entries.
        expected: usize,
    },
    /// A number that is NaN or infinite.
    #[error("{message}.{field}: entry {index} is not a finite number")]
    NotFinite {
        /// The schema.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// Index of the entry.
        index: usize,
    },
    /// An unknown keypoint format.
    #[error(
        "KeypointFrame.format: unknown keypoint format {name:?}, use one of body_25, body_25b, \
         coco_17, halpe_26, coco_wholebody_133"
    )]
    UnknownFormat {
        /// The name in the message.
        name: String,
    },
    /// A camera that is not in the rig.
    #[error("KeypointFrame.camera: camera {name:?} is not in the rig, add its calibration")]
    UnknownCamera {
        /// The name in the message.
        name: String,
    },
    /// Any other invalid value.
    #[error("{message}.{field}: {reason}")]
    Invalid {
        /// The schema.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// What is wrong with the value.
        reason: String,
    },
}
