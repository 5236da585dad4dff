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
    /// Full name of the schema, and the bytes of the message.
    pub fn encoded(&self) -> (&'static str, Vec<u8>) {
        fn of<T: Schema>(message: &T) -> (&'static str, Vec<u8>) {
            (T::FULL_NAME, encode(message))
        }
        match self {
            Self::Event(message) => of(message),
            Self::Status(message) => of(&**message),
            Self::StageStatus(message) => of(message),
            Self::Rig(message) => of(message),
            Self::Skeleton(message) => of(message),
            Self::Pose(message) => of(message),
            Self::Keyframe(message) => of(message),
            Self::Journal(message) => of(message),
            Self::Answer(message) => of(message),
            Self::Keypoints(message) => of(message),
            Self::HandOver(message) => of(&**message),
        }
    }
}
