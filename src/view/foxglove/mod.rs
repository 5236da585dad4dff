//! Our messages with Foxglove's schemas, for Foxglove and Lichtblick: live over a WebSocket, beside ours; as an MCAP
//! file; or beside our own messages in a recording.
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

use foxglove::{Context, Encode, FoxgloveError, PartialMetadata, RawChannel, Schema};

use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{Companion, Foreign, Message};
use crate::io::wire::{PerformerLabel, Topic};

pub use live::{Bridge, bridge};

/// The cameras are published again after this time, for clients that came later.
const AGAIN: Nanos = Nanos::SECOND;
/// A recording begins again if times go back by more.
const LOOP: Nanos = Nanos::from_ms(10_000);

/// Where messages with Foxglove's schemas go.
trait Sink {
    /// Takes the message of a topic at a capture time, if anybody wants it.
    fn put<T: Encode>(&mut self, topic: &str, at: Timestamp, message: impl FnOnce() -> T);
}

/// What is known of a stage.
#[derive(Default)]
struct Scene {
    rig: Option<Rig>,
    /// By name, from the first skeleton on.
    performers: BTreeMap<String, Performer>,
    /// When the cameras are published again.
    next: Option<Timestamp>,
}

/// What is known of a performer.
struct Performer {
    /// It chooses the colour: by a name such as `p7`, or else in the order of arrival.
    number: usize,
    body: Skeleton,
    label: PerformerLabel,
}

impl Scene {
    /// Gives the sink what a message becomes. Returns whether it was a pose or keypoints.
    fn handle(&mut self, topic: &str, message: &Message, sink: &mut impl Sink) -> bool {
        let name = Topic::actor(topic);
        match message {
            // Decoded messages are valid: the conversions do not fail.
            Message::Rig(rig) => {
                if let Ok(rig) = rig.to_core() {
                    (self.rig, self.next) = (Some(rig), None);
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
                sink.put("/performers", pose.capture, || shown::bones(&name, one, &pose));
                sink.put("/tf", pose.capture, || shown::joints(&name, &one.body, &pose));
                self.publish_cameras(pose.capture, sink);
                return true;
            }
            Message::Keypoints(frame) => {
                let is_camera = |rig: &Rig| rig.index_of(&frame.camera).is_some();
                if !self.rig.as_ref().is_some_and(is_camera) {
                    return false;
                }
                let at = Timestamp::from_ns(frame.capture_time_ns);
                sink.put(&of_camera(&frame.camera, "keypoints"), at, || shown::keypoints(frame));
                self.publish_cameras(at, sink);
                return true;
            }
            _ => {}
        }
        false
    }

    /// Publishes the cameras once a second of capture time. Times may go back: by the latency, since keypoints
    /// come before the poses of their time; by more, a recording begins again.
    fn publish_cameras(&mut self, at: Timestamp, sink: &mut impl Sink) {
        let is_early = self.next.is_some_and(|next| (next - LOOP..next).contains(&at));
        let Some(rig) = self.rig.as_ref().filter(|_| !is_early) else { return };
        self.next = Some(at + AGAIN);
        for camera in &rig.cameras {
            let topic = of_camera(&camera.name, "calibration");
            sink.put(&topic, at, || shown::calibration(camera, at));
        }
        sink.put("/tf", at, || shown::cameras(rig, at));
    }
}

fn of_camera(name: &str, what: &str) -> String {
    format!("/camera/{name}/{what}")
}

/// The channels of a server or of a file.
struct Channels {
    context: Arc<Context>,
    channels: BTreeMap<String, Arc<RawChannel>>,
}

impl Channels {
    fn new(context: Arc<Context>) -> Self {
        Self { context, channels: BTreeMap::new() }
    }

    /// Sends a message on a topic, if anybody wants it. Foxglove's topics and ours have no name in common.
    fn send(
        &mut self,
        topic: &str,
        (encoding, schema): (&str, impl FnOnce() -> Option<Schema>),
        at: Timestamp,
        message: impl FnOnce(&mut Vec<u8>),
    ) {
        if !self.channels.contains_key(topic) {
            let builder = self.context.channel_builder(topic).message_encoding(encoding);
            match builder.schema(schema()).build_raw() {
                Ok(channel) => drop(self.channels.insert(topic.to_owned(), channel)),
                Err(error) => tracing::debug!("{topic} is not shown: {error}"),
            }
        }
        let Some(channel) = self.channels.get(topic).filter(|one| one.has_sinks()) else { return };
        let mut bytes = Vec::new();
        message(&mut bytes);
        channel.log_with_meta(&bytes, PartialMetadata::with_log_time(shown::nanoseconds(at)));
    }
}

impl Sink for Channels {
    fn put<T: Encode>(&mut self, topic: &str, at: Timestamp, message: impl FnOnce() -> T) {
        let encoding = T::get_message_encoding();
        // Encoding into memory does not fail.
        let encoded = |bytes: &mut Vec<u8>| drop(message().encode(bytes));
        self.send(topic, (&encoding, T::get_schema), at, encoded);
    }
}

/// Writes messages as an MCAP file with Foxglove's schemas.
pub struct FoxgloveFile<W: Write + Seek + Send + 'static> {
    scene: Scene,
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
        Ok(Self { scene: Scene::default(), channels: Channels::new(context), file })
    }

    /// Adds a message. Returns whether it was a pose or keypoints.
    pub fn add(&mut self, topic: &str, message: &Message) -> bool {
        self.scene.handle(topic, message, &mut self.channels)
    }

    /// Ends the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(self) -> Result<W, FoxgloveError> {
        self.file.close()
    }
}

/// Foxglove's messages beside ours in a recording.
#[derive(Default)]
pub struct Beside(Scene);

impl Companion for Beside {
    fn follow(&mut self, topic: &str, message: &Message) -> Vec<Foreign> {
        let mut collected = Collected(Vec::new());
        self.0.handle(topic, message, &mut collected);
        collected.0
    }
}

struct Collected(Vec<Foreign>);

impl Sink for Collected {
    fn put<T: Encode>(&mut self, topic: &str, at: Timestamp, message: impl FnOnce() -> T) {
        let Some(Schema { name, data, .. }) = T::get_schema() else { return };
        let mut payload = Vec::new();
        if message().encode(&mut payload).is_ok() {
            let topic = topic.to_owned();
            self.0.push(Foreign { topic, schema: name, descriptor: data, at, payload });
        }
    }
}
