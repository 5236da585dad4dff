//! Decodes messages of a recording by schema and topic.

use std::sync::Arc;

use serde::{Serialize, Serializer};

use crate::core::time::Timestamp;
use crate::io::wire::{
    DecodeError, ENCODING, Event, HandOver, Journal, Keyframe, KeypointFrame, KeypointSet, Pose,
    RetargetedPose, Rig, Schema, Skeleton, StageStatus, Status, Take, TakeAnswer, decode,
    descriptor, is_truth,
};

/// A message of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// The topic.
    pub topic: Arc<str>,
    /// Log time: the capture time in offline recordings, the arrival on the node's clock in live
    /// ones.
    pub log_time: Timestamp,
    /// Its content.
    pub message: Message,
}

/// An undecoded message of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RawEntry {
    /// The topic.
    pub topic: Arc<str>,
    /// Full name of its schema; empty without a schema.
    pub schema: Arc<str>,
    /// Encoding of the payload, by its name in MCAP; `protobuf` for ours.
    pub encoding: Arc<str>,
    /// Log time, as in [`Entry`].
    pub log_time: Timestamp,
    /// Publish time: the capture time in our files.
    pub publish_time: Timestamp,
    /// The bytes.
    pub payload: Vec<u8>,
}

/// The content of a message. Ours are checked: their `to_core`, if they have one, succeeds (for keypoints, if the
/// camera is known). [`wire`](crate::io::wire) defines the JSON; foreign messages are `null`.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Message {
    /// 2D keypoints of one image.
    Keypoints(KeypointFrame),
    /// Keypoints of all cameras with one performer alone.
    KeypointSet(KeypointSet),
    /// What another node needs to go on with a performer.
    HandOver(Box<HandOver>),
    /// Calibrated cameras.
    Rig(Rig),
    /// A solved pose.
    Pose(Pose),
    /// A solved keyframe.
    Keyframe(Keyframe),
    /// The body that was solved for.
    Skeleton(Skeleton),
    /// An event.
    Event(Event),
    /// Counters.
    Status(Box<Status>),
    /// Who is on the stage.
    StageStatus(StageStatus),
    /// Inputs of a node.
    Journal(Journal),
    /// A pose on another skeleton.
    Retargeted(RetargetedPose),
    /// A take begins or ends.
    Take(Take),
    /// What a node or a recorder did with it.
    TakeAnswer(TakeAnswer),
    /// The true pose, in synthetic recordings.
    TruthPose(Pose),
    /// The true body, in synthetic recordings.
    TruthSkeleton(Skeleton),
    /// A message that is not ours.
    #[serde(serialize_with = "as_null")]
    Other {
        /// Name of its schema; empty without a schema.
        schema: String,
        /// The payload.
        data: Vec<u8>,
    },
}

fn as_null<S: Serializer>(_: &str, _: &[u8], to: S) -> Result<S::Ok, S::Error> {
    to.serialize_none()
}

/// A channel of a recording.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Channel {
    pub topic: Arc<str>,
    pub schema: Arc<str>,
    pub encoding: Arc<str>,
    /// Whether the schema is ours.
    pub is_ours: bool,
}

impl Channel {
    pub fn new(topic: &str, schema: &str, encoding: &str) -> Self {
        let is_ours = encoding == ENCODING && descriptor(schema).is_some();
        Self { topic: topic.into(), schema: schema.into(), encoding: encoding.into(), is_ours }
    }
}

impl RawEntry {
    /// Decodes and checks the message.
    ///
    /// # Errors
    /// The payload is not valid.
    pub fn message(&self) -> Result<Message, DecodeError> {
        Message::decode(&self.topic, &self.schema, &self.encoding, &self.payload)
    }
}

impl Message {
    /// Decodes and checks the message in `data`. `schema` is its full name, `encoding` its name in
    /// MCAP; the topic separates truth from solved poses.
    ///
    /// # Errors
    /// The payload is not valid.
    pub fn decode(
        topic: &str,
        schema: &str,
        encoding: &str,
        data: &[u8],
    ) -> Result<Self, DecodeError> {
        let truth = is_truth(topic);
        Ok(match schema {
            _ if encoding != ENCODING => Self::other(schema, data),
            KeypointFrame::FULL_NAME => {
                let check = |frame: &KeypointFrame| frame.to_core(|_| Some(0)).map(drop);
                Self::Keypoints(checked(data, check)?)
            }
            KeypointSet::FULL_NAME => {
                let check = |set: &KeypointSet| set.to_core(|_| Some(0)).map(drop);
                Self::KeypointSet(checked(data, check)?)
            }
            HandOver::FULL_NAME => {
                let state = checked(data, |state: &HandOver| state.to_core().map(drop))?;
                Self::HandOver(Box::new(state))
            }
            Rig::FULL_NAME => Self::Rig(checked(data, |rig: &Rig| rig.to_core().map(drop))?),
            Pose::FULL_NAME => {
                let pose = checked(data, |pose: &Pose| {
                    pose.joint_positions()?;
                    pose.to_core().map(drop)
                })?;
                if truth { Self::TruthPose(pose) } else { Self::Pose(pose) }
            }
            Keyframe::FULL_NAME => {
                Self::Keyframe(checked(data, |keyframe: &Keyframe| keyframe.to_core().map(drop))?)
            }
            Skeleton::FULL_NAME => {
                let of = if truth { Skeleton::to_truth } else { Skeleton::to_core };
                let skeleton = checked(data, |skeleton: &Skeleton| of(skeleton).map(drop))?;
                if truth { Self::TruthSkeleton(skeleton) } else { Self::Skeleton(skeleton) }
            }
            Event::FULL_NAME => Self::Event(decode::<Event>(data)?.validated()?),
            Status::FULL_NAME => Self::Status(Box::new(decode(data)?)),
            StageStatus::FULL_NAME => Self::StageStatus(decode(data)?),
            Journal::FULL_NAME => Self::Journal(decode(data)?),
            RetargetedPose::FULL_NAME => {
                Self::Retargeted(decode::<RetargetedPose>(data)?.validated()?)
            }
            Take::FULL_NAME => Self::Take(decode(data)?),
            TakeAnswer::FULL_NAME => Self::TakeAnswer(decode(data)?),
            _ => Self::other(schema, data),
        })
    }

    fn other(schema: &str, data: &[u8]) -> Self {
        Self::Other { schema: schema.to_owned(), data: data.to_owned() }
    }
}

fn checked<T: Schema>(
    data: &[u8],
    check: impl FnOnce(&T) -> Result<(), DecodeError>,
) -> Result<T, DecodeError> {
    let message = decode(data)?;
    check(&message)?;
    Ok(message)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::wire::SCHEMAS;

    #[test]
    fn each_of_our_schemas_is_decoded() {
        for (schema, _) in SCHEMAS {
            let message = Message::decode("any", schema, ENCODING, &[]);
            assert!(!matches!(message, Ok(Message::Other { .. })), "{schema}");
        }
    }
}
