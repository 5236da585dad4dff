//! Our messages with Foxglove's schemas, for Foxglove and Lichtblick: live over a WebSocket, or as an
//! MCAP file.
//!
//! | topic | schema | holds |
//! |---|---|---|
//! | `/performers` | `foxglove.SceneUpdate` | the bones of each performer at each final pose |
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
use crate::io::wire::Topic;

pub use live::{Bridge, bridge};

/// Calibrations and cameras are told again after this time, for who came later.
const AGAIN: Nanos = Nanos::SECOND;

/// The topics, and what is known of the stage.
struct Topics {
    context: Arc<Context>,
    performers: Channel<SceneUpdate>,
    transforms: Channel<FrameTransforms>,
    cameras: BTreeMap<String, Camera>,
    rig: Option<Rig>,
    /// By name, each with a number for its colour.
    bodies: BTreeMap<String, (usize, Skeleton)>,
    /// When the cameras are told again.
    next: Option<Timestamp>,
}

/// The topics of a camera.
struct Camera {
    calibration: Channel<CameraCalibration>,
    keypoints: Channel<ImageAnnotations>,
}

impl Topics {
    fn new(context: Arc<Context>) -> Self {
        Self {
            performers: context.channel_builder("/performers").build(),
            transforms: context.channel_builder("/tf").build(),
            cameras: BTreeMap::new(),
            rig: None,
            bodies: BTreeMap::new(),
            next: None,
            context,
        }
    }

    /// Passes on a message of the bus or of a recording.
    fn handle(&mut self, topic: &str, at: Timestamp, message: &Message) {
        match message {
            // They are checked: the conversions succeed.
            Message::Rig(rig) => self.rig = rig.to_core().ok(),
            Message::Skeleton(body) => {
                let (number, name) = (self.bodies.len(), Topic::actor(topic));
                if let Ok(body) = body.to_core() {
                    self.bodies.entry(name).or_insert((number, Skeleton::default())).1 = body;
                }
            }
            Message::Pose(pose) if !pose.provisional => {
                self.tell_cameras(at);
                let name = Topic::actor(topic);
                let (Some((number, body)), Ok(pose)) = (self.bodies.get(&name), pose.to_core())
                else {
                    return;
                };
                if self.performers.has_sinks() {
                    let scene = shown::bones(&name, *number, body, &pose);
                    self.performers.log_with_time(&scene, shown::nanoseconds(at));
                }
                if self.transforms.has_sinks() {
                    let joints = shown::joints(&name, body, &pose);
                    self.transforms.log_with_time(&joints, shown::nanoseconds(at));
                }
            }
            Message::Keypoints(frame) => {
                self.tell_cameras(at);
                let camera = self.camera(&frame.camera);
                if camera.keypoints.has_sinks() {
                    let annotations = shown::keypoints(frame);
                    camera.keypoints.log_with_time(&annotations, shown::nanoseconds(at));
                }
            }
            _ => {}
        }
    }

    fn camera(&mut self, name: &str) -> &Camera {
        let topic = |what| format!("/camera/{name}/{what}");
        self.cameras.entry(name.to_owned()).or_insert_with(|| Camera {
            calibration: self.context.channel_builder(topic("calibration")).build(),
            keypoints: self.context.channel_builder(topic("keypoints")).build(),
        })
    }

    /// Tells where the cameras are, if it is time.
    fn tell_cameras(&mut self, at: Timestamp) {
        let is_early = self.next.is_some_and(|next| (next - AGAIN..next).contains(&at));
        if is_early || self.rig.is_none() {
            return;
        }
        self.next = Some(at + AGAIN);
        let Some(rig) = self.rig.take() else { return };
        for camera in &rig.cameras {
            let calibration = shown::calibration(camera, at);
            let channel = &self.camera(&camera.name).calibration;
            channel.log_with_time(&calibration, shown::nanoseconds(at));
        }
        let cameras = shown::cameras(&rig, at);
        self.transforms.log_with_time(&cameras, shown::nanoseconds(at));
        self.rig = Some(rig);
    }
}

/// Writes messages as an MCAP file with Foxglove's schemas.
pub struct FoxgloveFile<W: Write + Seek + Send + 'static> {
    topics: Topics,
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
        Ok(Self { topics: Topics::new(context), file })
    }

    /// Adds a message of a capture time; those that Foxglove's schemas do not show are left out.
    pub fn add(&mut self, topic: &str, at: Timestamp, message: &Message) {
        self.topics.handle(topic, at, message);
    }

    /// Ends the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(self) -> Result<W, FoxgloveError> {
        self.file.close()
    }
}
