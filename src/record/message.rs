//! Messages of a recording, by schema and topic.

use std::sync::Arc;

use prost::Name;

use crate::msg::{
    DecodeError, ENCODING, Event, Keyframe, KeypointFrame, Pose, RetargetedPose, Rig, Skeleton,
    Status, decode, is_truth,
};
use crate::time::Timestamp;

/// A message of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// Where it was published.
    pub topic: Arc<str>,
    /// The time it is filed under; ours are capture times.
    pub log_time: Timestamp,
    /// What it says.
    pub message: Message,
}

/// What a message says. Each of ours is known to be sound: its `to_core` succeeds (that of
/// keypoints if the camera is known).
#[derive(Clone, Debug, PartialEq)]
pub enum Message {
    /// 2D keypoints of one image.
    Keypoints(KeypointFrame),
    /// Calibrated cameras.
    Rig(Rig),
    /// A solved pose.
    Pose(Pose),
    /// The end of a window.
    Keyframe(Keyframe),
    /// The body that was solved for.
    Skeleton(Skeleton),
    /// Something that happened.
    Event(Event),
    /// Counters.
    Status(Status),
    /// A pose on another skeleton.
    Retargeted(RetargetedPose),
    /// The true pose, in synthetic recordings.
    TruthPose(Pose),
    /// The true body, in synthetic recordings.
    TruthSkeleton(Skeleton),
    /// Something that is not ours.
    Other {
        /// Name of its schema; empty if it has none.
        schema: String,
        /// The payload.
        data: Vec<u8>,
    },
}

/// The messages that we know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Keypoints,
    Rig,
    Pose,
    Keyframe,
    Skeleton,
    Event,
    Status,
    Retargeted,
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
            RetargetedPose::NAME => Self::Retargeted,
            _ => return None,
        })
    }
}

/// A channel of a recording.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Channel {
    pub topic: Arc<str>,
    pub schema: String,
    /// `None`: not ours.
    pub kind: Option<Kind>,
}

impl Channel {
    pub fn new(topic: &str, schema: String, encoding: &str) -> Self {
        let kind = Kind::of_schema(&schema).filter(|_| encoding == ENCODING);
        Self { topic: topic.into(), schema, kind }
    }

    /// The message in `data`, checked.
    pub fn decode(&self, data: Vec<u8>) -> Result<Message, DecodeError> {
        let Some(kind) = self.kind else {
            return Ok(Message::Other { schema: self.schema.clone(), data });
        };
        let truth = is_truth(&self.topic);
        Ok(match kind {
            Kind::Keypoints => Message::Keypoints(checked(&data, |frame: &KeypointFrame| {
                frame.to_core(|_| Some(0)).map(drop)
            })?),
            Kind::Rig => Message::Rig(checked(&data, |rig: &Rig| rig.to_core().map(drop))?),
            Kind::Pose => {
                let pose = checked(&data, |pose: &Pose| {
                    pose.joint_positions()?;
                    pose.to_core().map(drop)
                })?;
                if truth { Message::TruthPose(pose) } else { Message::Pose(pose) }
            }
            Kind::Keyframe => Message::Keyframe(checked(&data, |keyframe: &Keyframe| {
                keyframe.to_core().map(drop)
            })?),
            Kind::Skeleton => {
                let skeleton = checked(&data, |skeleton: &Skeleton| skeleton.to_core().map(drop))?;
                if truth { Message::TruthSkeleton(skeleton) } else { Message::Skeleton(skeleton) }
            }
            Kind::Event => Message::Event(decode::<Event>(&data)?.validated()?),
            Kind::Status => Message::Status(decode(&data)?),
            Kind::Retargeted => Message::Retargeted(decode::<RetargetedPose>(&data)?.validated()?),
        })
    }
}

fn checked<T: crate::msg::Schema>(
    data: &[u8],
    check: impl FnOnce(&T) -> Result<(), DecodeError>,
) -> Result<T, DecodeError> {
    let message = decode(data)?;
    check(&message)?;
    Ok(message)
}
