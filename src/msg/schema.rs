//! Names and descriptors of the schemas.

use prost::{Message, Name};

use super::{DecodeError, Event, Journal, Keyframe, KeypointFrame, Pose, Rig, Skeleton, Status};

/// How payloads are encoded, in MCAP's words.
pub const ENCODING: &str = "protobuf";
/// How [`Schema::DESCRIPTOR`] is encoded, in MCAP's words.
pub const SCHEMA_ENCODING: &str = "protobuf";

/// A message of ours that has a topic.
pub trait Schema: Message + Name + Default {
    /// The schema's name with its package.
    const FULL_NAME: &'static str;
    /// The schema's serialised `FileDescriptorSet`, as MCAP wants it.
    const DESCRIPTOR: &'static [u8];
}

macro_rules! schema {
    ($message:ty, $file:literal) => {
        impl Schema for $message {
            const FULL_NAME: &'static str = concat!("bundlemocap.v1.", stringify!($message));
            const DESCRIPTOR: &'static [u8] =
                include_bytes!(concat!(env!("OUT_DIR"), "/", $file, ".fds"));
        }
    };
}

schema!(KeypointFrame, "keypoint_frame");
schema!(Rig, "rig");
schema!(Pose, "pose");
schema!(Keyframe, "keyframe");
schema!(Skeleton, "skeleton");
schema!(Event, "event");
schema!(Status, "status");
schema!(Journal, "journal");

/// The message as bytes; the same message gives the same bytes.
pub fn encode(message: &impl Schema) -> Vec<u8> {
    message.encode_to_vec()
}

/// The message in `bytes`; fields that this version does not know are skipped.
///
/// # Errors
/// When `bytes` are no message of that schema. What the fields hold is checked by `to_core`.
pub fn decode<T: Schema>(bytes: &[u8]) -> Result<T, DecodeError> {
    T::decode(bytes).map_err(|reason| DecodeError::Malformed { message: T::NAME, reason })
}
