//! Our messages with Foxglove's schemas, for Foxglove and Lichtblick: live over a WebSocket, beside ours; as an MCAP
//! file; or beside our own messages in a recording.
//!
//! | topic | schema | holds |
//! |---|---|---|
//! | `/performers` | `foxglove.SceneUpdate` | the bones and the names of the performers at each final pose |
//! | `/cameras` | `foxglove.SceneUpdate` | the cameras with their names |
//! | `/tf` | `foxglove.FrameTransforms` | the joints of the performers, such as `p1/l_knee` |
//! | `/tf/cameras` | `foxglove.FrameTransforms` | the cameras, and `world` |
//! | `/camera/{name}/calibration` | `foxglove.CameraCalibration` | a camera |
//! | `/camera/{name}/keypoints` | `foxglove.ImageAnnotations` | the keypoints of each of its images |
//! | `/events` | `foxglove.Log` | the events |
//!
//! Times are capture times. The frame `world` is ours, with y up; its parent `root` has z up, as these
//! programs show it. At a jump in a file, these programs read only the last message of each topic. So in a file
//! each message has all performers, and the cameras, which come once a second, have topics of their own.

mod live;
mod shown;

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{Seek, Write};
use std::sync::Arc;

use foxglove::{Context, Encode, FoxgloveError, PartialMetadata, RawChannel, Schema};

use crate::core::body::{Skeleton, StampedPose};
use crate::core::camera::Rig;
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{Companion, Foreign, Message};
use crate::io::wire::{KeypointFrame, PerformerLabel, Topic};

pub use live::{Bridge, bridge};

/// The cameras are published again after this time, for clients that came later.
const AGAIN: Nanos = Nanos::SECOND;
/// A recording begins again if times go back by more.
const LOOP: Nanos = Nanos::from_ms(10_000);
/// In a file, poses wait so long for those of other performers, whose window may come later.
const WINDOW: Nanos = Nanos::from_ms(20_000);
/// Live, keypoints wait for the poses of their time: at most so long, and so many frames.
const APART: Nanos = Nanos::from_ms(2000);
const MOST_HELD: usize = 10_000;

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
    /// The time of the last pose.
    last_pose: Option<Timestamp>,
    order: Order,
}

/// In which order poses and keypoints come.
enum Order {
    /// As in a file: poses come window by window for each performer. They wait for the other performers.
    ByWindow(BTreeMap<Timestamp, Vec<(String, StampedPose)>>),
    /// As on the bus: poses come later than the keypoints of their time. The keypoints wait for them.
    Live(Vec<KeypointFrame>),
}

impl Default for Order {
    fn default() -> Self {
        Self::ByWindow(BTreeMap::new())
    }
}

/// What is known of a performer.
struct Performer {
    /// It chooses the colour: by a name such as `p7`, or else in the order of arrival.
    number: usize,
    body: Skeleton,
    label: PerformerLabel,
}

impl Scene {
    fn live() -> Self {
        Self { order: Order::Live(Vec::new()), ..Self::default() }
    }

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
                if !self.performers.contains_key(&name) {
                    return false;
                }
                let at = pose.capture;
                self.last_pose = Some(at);
                match &mut self.order {
                    Order::ByWindow(waiting) => {
                        let of_time = waiting.entry(at).or_default();
                        // The last one counts, as in a recorded loop.
                        of_time.retain(|(other, _)| *other != name);
                        of_time.push((name, pose));
                        self.put_waiting(Some(at - WINDOW), sink);
                    }
                    Order::Live(_) => {
                        self.put_poses(at, &[(name, pose)], sink);
                        self.put_held(|frame| frame <= at, sink);
                    }
                }
                return true;
            }
            Message::Keypoints(frame) => {
                let camera =
                    |rig: &Rig| rig.index_of(&frame.camera).map(|at| rig.cameras[at].time_offset);
                let Some(offset) = self.rig.as_ref().and_then(camera) else { return false };
                let capture_time_ns = frame.capture_time_ns.saturating_add(offset.ns());
                let frame = match offset {
                    Nanos::ZERO => Cow::Borrowed(frame),
                    _ => Cow::Owned(KeypointFrame { capture_time_ns, ..frame.clone() }),
                };
                let at = Timestamp::from_ns(frame.capture_time_ns);
                self.put_or_hold(&frame, at, sink);
                self.publish_cameras(at, sink);
                return true;
            }
            Message::Event(event) => {
                let at = Timestamp::from_ns(event.capture_time_ns);
                let of = if topic.contains("/actor/") { &*name } else { "" };
                sink.put("/events", at, || shown::log_line(of, event));
            }
            _ => {}
        }
        false
    }

    /// Puts the waiting poses of a file up to a time; `None`: all.
    fn put_waiting(&mut self, up_to: Option<Timestamp>, sink: &mut impl Sink) {
        while let Order::ByWindow(waiting) = &mut self.order
            && let Some(first) = waiting.first_entry()
            && up_to.is_none_or(|up_to| *first.key() <= up_to)
        {
            let (at, poses) = first.remove_entry();
            self.put_poses(at, &poses, sink);
        }
    }

    fn put_poses(&mut self, at: Timestamp, poses: &[(String, StampedPose)], sink: &mut impl Sink) {
        let all = || {
            poses.iter().filter_map(|(name, pose)| Some((name, self.performers.get(name)?, pose)))
        };
        sink.put("/performers", at, || shown::performers(all()));
        sink.put("/tf", at, || shown::joints(all()));
        self.publish_cameras(at, sink);
    }

    /// Puts keypoints, or holds them until the poses of their time come.
    fn put_or_hold(&mut self, frame: &KeypointFrame, at: Timestamp, sink: &mut impl Sink) {
        let ahead = self.last_pose.map_or(APART, |pose| at - pose);
        let is_ahead = Nanos::ZERO < ahead && ahead < APART;
        match &mut self.order {
            Order::Live(held) if is_ahead && held.len() < MOST_HELD => held.push(frame.clone()),
            _ => {
                // A late frame overtakes those that wait. Otherwise no poses come for these.
                if is_ahead || ahead.abs() >= APART {
                    self.put_held(|_| true, sink);
                }
                put_keypoints(frame, sink);
            }
        }
    }

    /// Puts the held keypoints whose time is due.
    fn put_held(&mut self, is_due: impl Fn(Timestamp) -> bool, sink: &mut impl Sink) {
        let Order::Live(held) = &mut self.order else { return };
        held.retain(|frame| {
            let is_due = is_due(Timestamp::from_ns(frame.capture_time_ns));
            if is_due {
                put_keypoints(frame, sink);
            }
            !is_due
        });
    }

    /// Publishes the cameras once a second of capture time. Times may go back: by the latency, since keypoints
    /// come before the poses of their time; by more, a recording begins again.
    fn publish_cameras(&mut self, at: Timestamp, sink: &mut impl Sink) {
        if !self.next.is_some_and(|next| (next - LOOP..next).contains(&at)) {
            self.next = Some(at + AGAIN);
            self.put_cameras(at, sink);
        }
    }

    fn put_cameras(&self, at: Timestamp, sink: &mut impl Sink) {
        let Some(rig) = &self.rig else { return };
        for camera in &rig.cameras {
            let topic = of_camera(&camera.name, "calibration");
            sink.put(&topic, at, || shown::calibration(camera, at));
        }
        sink.put("/cameras", at, || shown::cameras(rig, at));
        sink.put("/tf/cameras", at, || shown::camera_frames(rig, at));
    }
}

fn put_keypoints(frame: &KeypointFrame, sink: &mut impl Sink) {
    let at = Timestamp::from_ns(frame.capture_time_ns);
    sink.put(&of_camera(&frame.camera, "keypoints"), at, || shown::keypoints(frame));
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
    pub fn finish(mut self) -> Result<W, FoxgloveError> {
        self.scene.put_waiting(None, &mut self.channels);
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

    fn end(&mut self) -> Vec<Foreign> {
        let mut collected = Collected(Vec::new());
        self.0.put_waiting(None, &mut collected);
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

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use prost::Message as _;

    use super::*;
    use crate::core::body::{Pose, TrackingState};
    use crate::core::camera::{Camera, Lens};
    use crate::io::wire;

    /// Topics, times in ms, and messages.
    #[derive(Default)]
    struct Kept(Vec<(String, i64, Vec<u8>)>);

    impl Sink for Kept {
        fn put<T: Encode>(&mut self, topic: &str, at: Timestamp, message: impl FnOnce() -> T) {
            let mut bytes = Vec::new();
            message().encode(&mut bytes).unwrap();
            self.0.push((topic.to_owned(), at.ns() / 1_000_000, bytes));
        }
    }

    impl Kept {
        fn times(&self, of: &str) -> Vec<i64> {
            let of = self.0.iter().filter(|(topic, ..)| topic == of);
            of.map(|(_, ms, _)| *ms).collect()
        }
    }

    fn at(ms: i64) -> Timestamp {
        Timestamp::from_ns(ms * 1_000_000)
    }

    fn pose(name: &str, ms: i64) -> (String, Message) {
        let stamped = StampedPose::new(at(ms), Pose::rest(), TrackingState::Tracking);
        let pose = wire::Pose::from_core(&stamped, &Skeleton::default(), None);
        (format!("mocap/stage/actor/{name}/pose"), Message::Pose(pose))
    }

    fn skeleton(name: &str) -> (String, Message) {
        let topic = format!("mocap/stage/actor/{name}/skeleton");
        (topic, Message::Skeleton(wire::Skeleton::from_core(&Skeleton::default())))
    }

    fn keypoints(camera: &str, ms: i64) -> (String, Message) {
        let capture_time_ns = at(ms).ns();
        let frame = KeypointFrame { camera: camera.into(), capture_time_ns, ..Default::default() };
        (format!("mocap/stage/camera/{camera}/keypoints"), Message::Keypoints(frame))
    }

    #[test]
    fn in_a_file_a_message_has_all_performers_of_its_time() {
        let (mut scene, mut kept) = (Scene::default(), Kept::default());
        let windows = ["p1", "p2"].map(|name| (0..9).map(move |k| pose(name, 100 * k)));
        let messages = [skeleton("p1"), skeleton("p2")].into_iter();
        for (topic, message) in messages.chain(windows.into_iter().flatten()) {
            scene.handle(&topic, &message, &mut kept);
        }
        scene.put_waiting(None, &mut kept);
        let times: Vec<i64> = (0..9).map(|k| 100 * k).collect();
        for topic in ["/performers", "/tf"] {
            assert_eq!(kept.times(topic), times, "{topic}");
        }
        for (_, ms, bytes) in kept.0.iter().filter(|(topic, ..)| topic == "/performers") {
            let shown = foxglove::messages::SceneUpdate::decode(&**bytes).unwrap();
            let names: Vec<_> = shown.entities.iter().map(|one| &*one.id).collect();
            assert_eq!(names, ["p1", "p2"], "{ms} ms");
        }
    }

    #[test]
    fn events_are_lines_of_a_log() {
        let (mut scene, mut kept) = (Scene::default(), Kept::default());
        let event = wire::Event {
            capture_time_ns: at(70).ns(),
            kind: "out_of_order".into(),
            camera: Some("left".into()),
            count: 3,
            detail: "by 20 ms".into(),
            ..wire::Event::default()
        };
        for topic in ["mocap/stage/events", "mocap/stage/actor/p1/events"] {
            scene.handle(topic, &Message::Event(event.clone()), &mut kept);
        }
        assert_eq!(kept.times("/events"), [70, 70]);
        for ((.., bytes), name) in kept.0.iter().zip(["", "p1"]) {
            let log = foxglove::messages::Log::decode(&**bytes).unwrap();
            let expected = (name, "left: out of order: by 20 ms (3 times)");
            assert_eq!((&*log.name, &*log.message), expected);
            assert_eq!(log.level(), foxglove::messages::log::Level::Warning);
        }
    }

    #[test]
    fn live_keypoints_wait_for_the_poses_of_their_time() {
        let (mut scene, mut kept) = (Scene::live(), Kept::default());
        let matrix = Matrix3::new(500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0);
        let (lens, turn) = (Lens::BrownConrady([0.0; 8]), Matrix3::identity());
        let camera = |name, x| {
            Camera::new(name, [640, 480], &matrix, lens, turn, Vector3::new(x, 0.0, 1.0)).unwrap()
        };
        let rig = Rig { version: 1, cameras: vec![camera("left", 0.0), camera("right", 1.0)] };
        let topic = of_camera("left", "keypoints");
        let mut give = |(name, message): (String, Message)| {
            scene.handle(&name, &message, &mut kept);
            kept.times(&topic)
        };
        give(("mocap/stage/rig".into(), Message::Rig(wire::Rig::from_core(&rig))));
        // Nobody is followed yet.
        assert_eq!(give(keypoints("left", 0)), [0]);
        give(skeleton("p1"));
        assert_eq!(give(pose("p1", 100)), [0]);
        assert_eq!(give(keypoints("left", 400)), [0]);
        assert_eq!(give(keypoints("left", 500)), [0]);
        assert_eq!(give(pose("p1", 400)), [0, 400]);
        // The performer is lost.
        assert_eq!(give(keypoints("left", 3000)), [0, 400, 500, 3000]);
    }
}
