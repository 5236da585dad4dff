//! Our messages with Foxglove's schemas, for Foxglove and Lichtblick: live over a WebSocket, or as an
//! MCAP file.
//!
//! | topic | schema | holds |
//! |---|---|---|
//! | `/performers` | `foxglove.SceneUpdate` | the bones and the name of each performer at each final pose |
//! | `/tf` | `foxglove.FrameTransforms` | the joints of each performer, such as `p1/l_knee`, and the cameras |
//! | `/camera/{name}/calibration` | `foxglove.CameraCalibration` | a camera |
//! | `/camera/{name}/keypoints` | `foxglove.ImageAnnotations` | the keypoints of each of its images |
//!
//! Times are capture times. The frame `world` is ours, with y up; its parent `root` has z up, as these
//! programs show it.

mod live;
mod shown;

use std::collections::BTreeMap;
use std::io::{Seek, Write};
use std::sync::Arc;

use foxglove::messages::{CameraCalibration, FrameTransforms, ImageAnnotations, SceneUpdate};
use foxglove::{Channel, Context, FoxgloveError};

use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::Message;
use crate::io::wire::{PerformerLabel, Topic};

pub use live::{Bridge, bridge};

/// The cameras are published again after this time, for clients that came later.
const AGAIN: Nanos = Nanos::SECOND;
/// A recording begins again if times go back by more.
const LOOP: Nanos = Nanos::from_ms(10_000);

/// The channels to Foxglove, and what is known of the stage.
struct Channels {
    context: Arc<Context>,
    scene: Channel<SceneUpdate>,
    transforms: Channel<FrameTransforms>,
    /// Of the cameras of the rig.
    cameras: BTreeMap<String, CameraChannels>,
    rig: Option<Rig>,
    /// By name, from the first skeleton on.
    performers: BTreeMap<String, Performer>,
    /// When the cameras are published again.
    next: Option<Timestamp>,
}

/// The channels of a camera.
struct CameraChannels {
    calibration: Channel<CameraCalibration>,
    keypoints: Channel<ImageAnnotations>,
}

/// What is known of a performer.
struct Performer {
    /// It chooses the colour: by a name such as `p7`, or else in the order of arrival.
    number: usize,
    body: Skeleton,
    label: PerformerLabel,
}

impl Channels {
    fn new(context: Arc<Context>) -> Self {
        Self {
            scene: context.channel_builder("/performers").build(),
            transforms: context.channel_builder("/tf").build(),
            cameras: BTreeMap::new(),
            rig: None,
            performers: BTreeMap::new(),
            next: None,
            context,
        }
    }

    /// Publishes a message in Foxglove's schemas. Returns whether it was a pose or keypoints.
    fn handle(&mut self, topic: &str, message: &Message) -> bool {
        let name = Topic::actor(topic);
        match message {
            // Decoded messages are valid: the conversions do not fail.
            Message::Rig(rig) => {
                if let Ok(rig) = rig.to_core() {
                    self.set_rig(rig);
                }
            }
            Message::Skeleton(body) => {
                if let Ok(body) = body.to_core() {
                    let own = name.strip_prefix('p').and_then(|n| n.parse::<usize>().ok());
                    let number =
                        own.and_then(|n| n.checked_sub(1)).unwrap_or(self.performers.len());
                    let label = PerformerLabel::default();
                    let new = Performer { number, body: body.clone(), label };
                    self.performers.entry(name).or_insert(new).body = body;
                }
            }
            Message::Status(status) => {
                if let Some(one) = self.performers.get_mut(&name) {
                    one.label = status.label.clone().unwrap_or_default();
                }
            }
            Message::Pose(pose) if !pose.provisional => {
                let Ok(pose) = pose.to_core() else { return false };
                let Some(one) = self.performers.get(&name) else { return false };
                let at = shown::nanoseconds(pose.capture);
                if self.scene.has_sinks() {
                    self.scene.log_with_time(&shown::bones(&name, one, &pose), at);
                }
                if self.transforms.has_sinks() {
                    self.transforms.log_with_time(&shown::joints(&name, &one.body, &pose), at);
                }
                self.publish_cameras(pose.capture);
                return true;
            }
            Message::Keypoints(frame) => {
                let at = Timestamp::from_ns(frame.capture_time_ns);
                let Some(camera) = self.cameras.get(&frame.camera) else { return false };
                if camera.keypoints.has_sinks() {
                    camera
                        .keypoints
                        .log_with_time(&shown::keypoints(frame), shown::nanoseconds(at));
                }
                self.publish_cameras(at);
                return true;
            }
            _ => {}
        }
        false
    }

    fn set_rig(&mut self, rig: Rig) {
        for camera in &rig.cameras {
            let topic = |what| format!("/camera/{}/{what}", camera.name);
            self.cameras.entry(camera.name.clone()).or_insert_with(|| CameraChannels {
                calibration: self.context.channel_builder(topic("calibration")).build(),
                keypoints: self.context.channel_builder(topic("keypoints")).build(),
            });
        }
        (self.rig, self.next) = (Some(rig), None);
    }

    /// Publishes the cameras once a second of capture time. Times may go back: by the latency, since keypoints
    /// come before the poses of their time; by more, a recording begins again.
    fn publish_cameras(&mut self, at: Timestamp) {
        let is_early = self.next.is_some_and(|next| (next - LOOP..next).contains(&at));
        let Some(rig) = self.rig.as_ref().filter(|_| !is_early) else { return };
        self.next = Some(at + AGAIN);
        let ns = shown::nanoseconds(at);
        for camera in &rig.cameras {
            if let Some(channels) = self.cameras.get(&camera.name) {
                channels.calibration.log_with_time(&shown::calibration(camera, at), ns);
            }
        }
        self.transforms.log_with_time(&shown::cameras(rig, at), ns);
    }
}

/// Writes messages as an MCAP file with Foxglove's schemas.
pub struct FoxgloveFile<W: Write + Seek + Send + 'static> {
    channels: Channels,
    file: foxglove::McapWriterHandle<W>,
}

impl<W: Write + Seek + Send + 'static> FoxgloveFile<W> {
    /// Begins a file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn new(to: W) -> Result<Self, FoxgloveError> {
        let context = Context::new();
        let file = context.mcap_writer().create(to)?;
        Ok(Self { channels: Channels::new(context), file })
    }

    /// Adds a message. Returns whether it was a pose or keypoints.
    pub fn add(&mut self, topic: &str, message: &Message) -> bool {
        self.channels.handle(topic, message)
    }

    /// Ends the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(self) -> Result<W, FoxgloveError> {
        self.file.close()
    }
}
