//! Decodes messages of a recording by schema and topic.

use std::sync::Arc;

use prost::Name;
use serde::{Serialize, Serializer};

use crate::core::time::Timestamp;
use crate::io::wire::{
    DecodeError, ENCODING, Event, HandOver, Journal, Keyframe, KeypointFrame, KeypointSet, Pose,
    RetargetedPose, Rig, Skeleton, StageStatus, Status, Take, TakeAnswer, decode, is_truth,
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

/// The content of a message. Ours are checked: their `to_core` succeeds (for keypoints, if the
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

/// The schemas that we decode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Keypoints,
    Rig,
    Pose,
    Keyframe,
    Skeleton,
    Event,
    Status,
    StageStatus,
    Journal,
    Retargeted,
    Take,
    TakeAnswer,
    KeypointSet,
    HandOver,
}

impl Kind {
    fn of_schema(schema: &str) -> Option<Self> {
        Some(match schema.strip_prefix(Pose::PACKAGE)?.strip_prefix('.')? {
            KeypointFrame::NAME => Self::Keypoints,
            Rig::NAME => Self::Rig,
            Pose::NAME => Self::Pose,
            Keyframe::NAME => Self::Keyframe,
            Skeleton::NAME => Self::Skeleton,
            Event::NAME => Self::Event,
            Status::NAME => Self::Status,
            StageStatus::NAME => Self::StageStatus,
            Journal::NAME => Self::Journal,
            RetargetedPose::NAME => Self::Retargeted,
            Take::NAME => Self::Take,
            TakeAnswer::NAME => Self::TakeAnswer,
            KeypointSet::NAME => Self::KeypointSet,
            HandOver::NAME => Self::HandOver,
            _ => return None,
        })
    }
}

/// A channel of a recording.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Channel {
    pub topic: Arc<str>,
    pub schema: Arc<str>,
    pub encoding: Arc<str>,
    /// `None` for a foreign schema.
    pub kind: Option<Kind>,
}

impl Channel {
    pub fn new(topic: &str, schema: &str, encoding: &str) -> Self {
        let kind = Kind::of_schema(schema).filter(|_| encoding == ENCODING);
        Self { topic: topic.into(), schema: schema.into(), encoding: encoding.into(), kind }
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
        match Kind::of_schema(schema).filter(|_| encoding == ENCODING) {
            Some(kind) => Self::of_kind(kind, topic, data),
            None => Ok(Self::Other { schema: schema.to_owned(), data: data.to_owned() }),
        }
    }

    fn of_kind(kind: Kind, topic: &str, data: &[u8]) -> Result<Self, DecodeError> {
        let truth = is_truth(topic);
        Ok(match kind {
            Kind::Keypoints => {
                let check = |frame: &KeypointFrame| frame.to_core(|_| Some(0)).map(drop);
                Self::Keypoints(checked(data, check)?)
            }
            Kind::KeypointSet => {
                let check = |set: &KeypointSet| set.to_core(|_| Some(0)).map(drop);
                Self::KeypointSet(checked(data, check)?)
            }
            Kind::HandOver => {
                let state = checked(data, |state: &HandOver| state.to_core().map(drop))?;
                Self::HandOver(Box::new(state))
            }
            Kind::Rig => Self::Rig(checked(data, |rig: &Rig| rig.to_core().map(drop))?),
            Kind::Pose => {
                let pose = checked(data, |pose: &Pose| {
                    pose.joint_positions()?;
                    pose.to_core().map(drop)
                })?;
                if truth { Self::TruthPose(pose) } else { Self::Pose(pose) }
            }
            Kind::Keyframe => {
                Self::Keyframe(checked(data, |keyframe: &Keyframe| keyframe.to_core().map(drop))?)
            }
            Kind::Skeleton => {
                let of = if truth { Skeleton::to_truth } else { Skeleton::to_core };
                let skeleton = checked(data, |skeleton: &Skeleton| of(skeleton).map(drop))?;
                if truth { Self::TruthSkeleton(skeleton) } else { Self::Skeleton(skeleton) }
            }
            Kind::Event => Self::Event(decode::<Event>(data)?.validated()?),
            Kind::Status => Self::Status(Box::new(decode(data)?)),
            Kind::StageStatus => Self::StageStatus(decode(data)?),
            Kind::Journal => Self::Journal(decode(data)?),
            Kind::Retargeted => Self::Retargeted(decode::<RetargetedPose>(data)?.validated()?),
            Kind::Take => Self::Take(decode(data)?),
            Kind::TakeAnswer => Self::TakeAnswer(decode(data)?),
        })
    }
}

fn checked<T: crate::io::wire::Schema>(
    data: &[u8],
    check: impl FnOnce(&T) -> Result<(), DecodeError>,
) -> Result<T, DecodeError> {
    let message = decode(data)?;
    check(&message)?;
    Ok(message)
}
