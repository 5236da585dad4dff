//! Typed messages that the core publishes. The outlet encodes each of them once.

use std::sync::Arc;

use crate::core::time::Timestamp;
use crate::io::wire::{
    Event, HandOver, Journal, Keyframe, KeypointSet, Pose, Rig, Schema, Skeleton, StageStatus,
    Status, TakeAnswer, encode,
};

/// A message to publish.
#[derive(Clone, Debug, PartialEq)]
pub struct Publication {
    /// The topic.
    pub topic: Arc<str>,
    /// The capture time of the content.
    pub capture: Timestamp,
    /// When to publish it, on the node's clock; `None`: at once.
    pub due: Option<Timestamp>,
    /// The message.
    pub content: Content,
}

/// A message of the node.
#[derive(Clone, Debug, PartialEq)]
pub enum Content {
    /// An event.
    Event(Event),
    /// Counters.
    Status(Box<Status>),
    /// Who is there.
    StageStatus(StageStatus),
    /// The calibration from a file.
    Rig(Rig),
    /// The body.
    Skeleton(Skeleton),
    /// A final or provisional pose.
    Pose(Pose),
    /// A solved keyframe.
    Keyframe(Keyframe),
    /// Inputs of the node.
    Journal(Journal),
    /// The answer to a slate.
    Answer(TakeAnswer),
    /// The detections of one performer.
    Keypoints(KeypointSet),
    /// What another node needs to go on with a performer.
    HandOver(Box<HandOver>),
}

impl Content {
    /// Full name of the schema.
    pub fn schema(&self) -> &'static str {
        match self {
            Self::Event(_) => Event::FULL_NAME,
            Self::Status(_) => Status::FULL_NAME,
            Self::StageStatus(_) => StageStatus::FULL_NAME,
            Self::Rig(_) => Rig::FULL_NAME,
            Self::Skeleton(_) => Skeleton::FULL_NAME,
            Self::Pose(_) => Pose::FULL_NAME,
            Self::Keyframe(_) => Keyframe::FULL_NAME,
            Self::Journal(_) => Journal::FULL_NAME,
            Self::Answer(_) => TakeAnswer::FULL_NAME,
            Self::Keypoints(_) => KeypointSet::FULL_NAME,
            Self::HandOver(_) => HandOver::FULL_NAME,
        }
    }

    /// The bytes of the message.
    pub fn encode(&self) -> Vec<u8> {
        match self {
            Self::Event(message) => encode(message),
            Self::Status(message) => encode(&**message),
            Self::StageStatus(message) => encode(message),
            Self::Rig(message) => encode(message),
            Self::Skeleton(message) => encode(message),
            Self::Pose(message) => encode(message),
            Self::Keyframe(message) => encode(message),
            Self::Journal(message) => encode(message),
            Self::Answer(message) => encode(message),
            Self::Keypoints(message) => encode(message),
            Self::HandOver(message) => encode(&**message),
        }
    }
}
