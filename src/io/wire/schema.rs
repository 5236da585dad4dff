//! Names and descriptors of the schemas.

use prost::{Message, Name};

use super::{
    DecodeError, Event, HandOver, Journal, Keyframe, KeypointFrame, KeypointSet, Pose,
    RetargetedPose, Rig, Skeleton, StageStatus, Status, Take, TakeAnswer, Topic,
};

/// Encoding of payloads, by its name in MCAP.
pub const ENCODING: &str = "protobuf";
/// Encoding of [`Schema::DESCRIPTOR`], by its name in MCAP.
pub const SCHEMA_ENCODING: &str = "protobuf";

/// A message type of ours that is published on a topic.
pub trait Schema: Message + Name + Default {
    /// Full name, with the package.
    const FULL_NAME: &'static str;
    /// The schema's serialised `FileDescriptorSet`, as MCAP requires.
    const DESCRIPTOR: &'static [u8];
}

macro_rules! schemas {
    ($($message:ident: $file:literal,)*) => {
        $(impl Schema for $message {
            const FULL_NAME: &'static str = concat!("bundlemocap.v1.", stringify!($message));
            const DESCRIPTOR: &'static [u8] =
                include_bytes!(concat!(env!("OUT_DIR"), "/", $file, ".fds"));
        })*

        /// Full name and descriptor of every schema.
        pub const SCHEMAS: &[(&str, &[u8])] =
            &[$(($message::FULL_NAME, $message::DESCRIPTOR),)*];

        #[cfg(test)]
        const FILES: &[&str] = &[$($file,)*];
    };
}

schemas! {
    KeypointFrame: "keypoint_frame",
    Rig: "rig",
    Pose: "pose",
    Keyframe: "keyframe",
    Skeleton: "skeleton",
    Event: "event",
    Status: "status",
    Journal: "journal",
    RetargetedPose: "retargeted_pose",
    Take: "take",
    TakeAnswer: "take_answer",
    StageStatus: "stage_status",
    KeypointSet: "keypoint_set",
    HandOver: "hand_over",
}

/// Prefix of a payload's encoding on the bus; the name of the schema follows.
const MEDIA_TYPE: &str = "application/protobuf";

/// The encoding of a payload on the bus, from the full name of its schema.
pub fn media_type(schema: &str) -> String {
    format!("{MEDIA_TYPE};{schema}")
}

/// The descriptor of the schema with that full name, if it is ours.
pub fn descriptor(schema: &str) -> Option<&'static [u8]> {
    SCHEMAS.iter().find(|(name, _)| *name == schema).map(|(_, descriptor)| *descriptor)
}

/// Full name of the schema of a payload on the bus, if it is ours: from its encoding, or from its
/// topic if the encoding names no schema.
pub fn schema_of(topic: &str, encoding: &str) -> Option<&'static str> {
    let named = encoding.strip_prefix(MEDIA_TYPE).and_then(|rest| rest.strip_prefix(';'));
    let wanted = match (named, encoding) {
        (Some(schema), _) => schema.trim(),
        (None, "" | MEDIA_TYPE | "zenoh/bytes" | "application/octet-stream") => {
            Topic::parse(topic).ok()?.schema()
        }
        (None, _) => return None,
    };
    SCHEMAS.iter().find(|(name, _)| *name == wanted).map(|(name, _)| *name)
}

/// Encodes a message; equal messages give equal bytes.
pub fn encode(message: &impl Schema) -> Vec<u8> {
    message.encode_to_vec()
}

/// Decodes a message; skips fields that this version does not know.
///
/// # Errors
/// `bytes` are not a message of that schema. `to_core` checks the values of the fields.
pub fn decode<T: Schema>(bytes: &[u8]) -> Result<T, DecodeError> {
    T::decode(bytes).map_err(|reason| DecodeError::Malformed { message: T::NAME, reason })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::wire::Topics;

    #[test]
    fn the_table_holds_the_names_that_the_messages_have() {
        let names = SCHEMAS.iter().map(|(name, _)| (*name).to_owned());
        let ours = [
            KeypointFrame::full_name(),
            Rig::full_name(),
            Pose::full_name(),
            Keyframe::full_name(),
            Skeleton::full_name(),
            Event::full_name(),
            Status::full_name(),
            Journal::full_name(),
            RetargetedPose::full_name(),
            Take::full_name(),
            TakeAnswer::full_name(),
            StageStatus::full_name(),
            KeypointSet::full_name(),
            HandOver::full_name(),
        ];
        assert_eq!(names.collect::<Vec<_>>(), ours);
        assert_eq!(descriptor(&Pose::full_name()), Some(Pose::DESCRIPTOR));
        assert_eq!(descriptor("bundlemocap.v1.Nothing"), None);
    }

    #[test]
    fn each_message_has_a_golden_file() {
        for file in FILES {
            let path = format!("{}/tests/golden/{file}.snap", env!("CARGO_MANIFEST_DIR"));
            assert!(std::fs::exists(&path).unwrap(), "{path} is missing; see tests/it/messages.rs");
        }
    }

    #[test]
    fn the_encoding_goes_before_the_topic() {
        let topics = Topics::default();
        let pose = Pose::full_name();
        let of = |topic: &str, encoding: &str| schema_of(topic, encoding).map(str::to_owned);
        assert_eq!(of("any/where", &media_type(&pose)), Some(pose.clone()));
        assert_eq!(of(&topics.provisional(), ""), Some(pose.clone()));
        assert_eq!(of(&topics.rig(), &media_type(&pose)), Some(pose));
        assert_eq!(of(&topics.keypoints("a"), "zenoh/bytes"), Some(KeypointFrame::full_name()));
        assert_eq!(of(&topics.truth_skeleton(), ""), Some(Skeleton::full_name()));
        assert_eq!(of(&topics.rig(), "application/json"), None);
        assert_eq!(of(&topics.rig(), "application/protobuf;others.Rig"), None);
        assert_eq!(of(&topics.retargeted("robot"), ""), Some(RetargetedPose::full_name()));
        assert_eq!(of("rig", ""), None);
    }
}
