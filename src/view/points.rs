//! Where the solved bodies have their keypoints.

use std::collections::BTreeMap;

use crate::core::body::{BodyPoint, Skeleton, fitted_points};
use crate::core::detections::KeypointFormat;
use crate::io::wire::{self, ActorChannel, KeypointFrame, Pose, StageChannel, Topic, decode};

/// After so long without a frame of a format, nanoseconds, another one counts.
const FORGOTTEN: u64 = 1_000_000_000;

/// Follows the messages of a stage, for the keypoints of its bodies.
#[derive(Debug, Default)]
pub(super) struct Points {
    /// By performer.
    bodies: BTreeMap<String, Skeleton>,
    /// Those of the detector's format.
    points: Vec<BodyPoint>,
    format: Option<KeypointFormat>,
    /// Capture time of the last frame with that format.
    seen_ns: i64,
}

impl Points {
    /// Follows a message. Of a final pose it gives the places of its keypoints, as a topic and a payload: for each
    /// point its index in the detector's format and its x, y, z in the world (metres), all as `f32`.
    pub(super) fn follow(&mut self, topic: &str, payload: &[u8]) -> Option<(String, Vec<u8>)> {
        match Topic::parse(topic).ok()? {
            Topic::Stage { channel: StageChannel::Keypoints { .. }, .. } => {
                let frame = decode::<KeypointFrame>(payload).ok()?;
                let is_over = || frame.capture_time_ns.abs_diff(self.seen_ns) > FORGOTTEN;
                if self.format.is_none_or(|format| format.name() != frame.format) {
                    if self.format.is_some() && !is_over() {
                        return None;
                    }
                    self.format = KeypointFormat::from_name(&frame.format);
                    self.points = self.format.map(fitted_points).unwrap_or_default();
                }
                self.seen_ns = frame.capture_time_ns;
                None
            }
            Topic::Actor { actor, channel: ActorChannel::Skeleton, .. } => {
                let body =
                    decode::<wire::Skeleton>(payload).and_then(|body| body.to_core()).ok()?;
                self.bodies.insert(actor.to_owned(), body);
                None
            }
            Topic::Actor { stage, actor, channel: ActorChannel::Pose } => {
                let body = self.bodies.get(actor).filter(|_| !self.points.is_empty())?;
                let pose = decode::<Pose>(payload).and_then(|pose| pose.to_core()).ok()?;
                let posture = pose.pose.posture(body);
                let place = |point: &BodyPoint| {
                    let at = point.attachment.position(&posture, body);
                    [point.index as f64, at.x, at.y, at.z].map(|value| (value as f32).to_le_bytes())
                };
                let bytes = self.points.iter().flat_map(place).flatten().collect();
                Some((format!("mocap/{stage}/actor/{actor}/points"), bytes))
            }
            _ => None,
        }
    }
}
