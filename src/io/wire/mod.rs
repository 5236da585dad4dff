//! Wire types and their codecs; the schemas are in `schemas/`.
//!
//! The types generated from the schemas are re-exported here. Each has `from_core`, which cannot
//! fail, and `to_core`, which checks everything that came from outside: lengths, finite numbers,
//! quaternions, names. Nothing from the wire panics.

mod check;
mod event;
mod generated;
mod json;
mod keyframe;
mod keypoints;
mod pose;
mod retargeted;
mod rig;
mod schema;
mod skeleton;
mod topic;

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
pub enum DecodeError {
    /// Not Protocol Buffers, or cut short.
    #[error("{message}: not a message of this schema: {reason}")]
    Malformed {
        /// The schema that was expected.
        message: &'static str,
        /// What the decoder met.
        reason: prost::DecodeError,
    },
    /// A list of the wrong length.
    #[error("{message}.{field}: {found} entries, expected {expected}")]
    Length {
        /// The schema.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// Entries that came.
        found: usize,
        /// Entries that must come.
        expected: usize,
    },
    /// NaN or infinite.
    #[error("{message}.{field}: entry {index} is not a finite number")]
    NotFinite {
        /// The schema.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// Which entry.
        index: usize,
    },
    /// A keypoint format that is not known.
    #[error(
        "KeypointFrame.format: unknown keypoint format {name:?}, use one of body_25, body_25b, \
         coco_17, halpe_26, coco_wholebody_133"
    )]
    UnknownFormat {
        /// The name that came.
        name: String,
    },
    /// A camera that the rig does not have.
    #[error("KeypointFrame.camera: camera {name:?} is not in the rig, add its calibration")]
    UnknownCamera {
        /// The name that came.
        name: String,
    },
    /// Any other value that makes no sense.
    #[error("{message}.{field}: {reason}")]
    Invalid {
        /// The schema.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// What is wrong with it.
        reason: String,
    },
}
