//! The cameras of `bench latency`: synthetic detections in real time.

use std::sync::{Arc, Mutex, PoisonError};

use prost::Message;

use crate::cli::failure::Failure;
use crate::cli::synth::RING;
use crate::core::body::{Shape, Skeleton};
use crate::core::camera::Rig;
use crate::core::detections::KeypointFormat;
use crate::core::random::Draws;
use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{Bus, Publisher};
use crate::io::wire::{self, KeypointFrame, Topics, encode};
use crate::live::WallClock;
use crate::research::synth::{Motion, MotionStyle, Noise, Recording, ring_rig};

/// The procedural motion stands still at multiples of this time, seconds, and can be reversed there.
const STANDS_EVERY: f64 = 13.0;
const ENCODING: &str = "application/protobuf;bundlemocap.v1.KeypointFrame";

/// When the cameras expose, and how well they know it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shutter {
    pub(super) fps: f64,
    /// Spread of the cameras' shutter times as a share of the frame period.
    pub(super) stagger: f64,
    /// Standard deviation of the error of capture times, milliseconds.
    pub(super) jitter_ms: f64,
}

/// Keypoint messages, encoded in advance without frame number and capture time.
pub(super) struct Cameras {
    rig: Rig,
    shutter: Shutter,
    /// By frame, then by camera.
    frames: Vec<Vec<Vec<u8>>>,
}

impl Cameras {
    /// Cameras on a ring around the procedural motion, at least two frames.
    pub(super) fn new(
        count: u8,
        shutter: Shutter,
        seconds: f64,
        noise: Noise,
        format: KeypointFormat,
    ) -> Result<Self, Failure> {
        let rig = ring_rig(usize::from(count), RING[0], RING[1])?;
        let skeleton = Skeleton::new(Shape::default());
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let mut recording = Recording::new(rig, skeleton, |seconds| motion.pose(seconds));
        (recording.fps, recording.stagger) = (shutter.fps, shutter.stagger);
        recording.frames = (seconds.min(STANDS_EVERY) * shutter.fps).round().max(1.0) as u64 + 1;
        recording.format = format;
        recording.noise = noise;
        let rig = &recording.rig;
        let encoded = recording.detections().map(|detections| {
            let camera = &rig.cameras[detections.camera];
            let size = [camera.width, camera.height];
            let unstamped = KeypointFrame {
                frame: 0,
                capture_time_ns: 0,
                ..KeypointFrame::from_core(&detections, &camera.name, size)
            };
            encode(&unstamped)
        });
        let all: Vec<Vec<u8>> = encoded.collect();
        let frames = all.chunks(usize::from(count)).map(<[Vec<u8>]>::to_vec).collect();
        Ok(Self { rig: recording.rig, shutter, frames })
    }

    /// The calibration as a message.
    pub(super) fn rig_message(&self) -> Vec<u8> {
        encode(&wire::Rig::from_core(&self.rig))
    }

    /// Mean size of a message, bytes.
    pub(super) fn mean_bytes(&self) -> f64 {
        let (count, bytes) = (self.frames.iter().flatten())
            .fold((0usize, 0usize), |(count, bytes), message| (count + 1, bytes + message.len()));
        bytes as f64 / count.max(1) as f64
    }

    /// Capture time of a frame relative to frame 0.
    fn since_start(&self, frame: u64) -> Nanos {
        Nanos::of_frames(frame, self.shutter.fps)
    }

    /// Time of a camera's exposure after that of the first, and the error of its timestamp.
    fn offsets(&self, frame: u64, camera: usize) -> [Nanos; 2] {
        let Shutter { fps, stagger, jitter_ms } = self.shutter;
        let share = camera as f64 / self.rig.cameras.len() as f64;
        let error = jitter_ms * Draws { seed: 1, stream: camera as u64 }.normals(0, frame)[0];
        [1e9 * stagger * share / fps, 1e6 * error].map(Nanos::rounded)
    }

    /// The message of a camera; the motion runs forwards, then backwards. Frame number and capture
    /// time are appended, which Protocol Buffers decodes as one message.
    fn message(&self, frame: u64, camera: usize, capture: Timestamp) -> Vec<u8> {
        let last = self.frames.len() as u64 - 1;
        let at = frame % (2 * last);
        let mut bytes = self.frames[at.min(2 * last - at) as usize][camera].clone();
        let capture_time_ns = capture.ns();
        let stamp = KeypointFrame { frame, capture_time_ns, ..KeypointFrame::default() };
        bytes.extend(stamp.encode_to_vec());
        bytes
    }
}

/// Capture time and sending time of each frame.
#[derive(Clone, Default)]
pub(super) struct Sent(Arc<Mutex<Vec<(Timestamp, Timestamp)>>>);

impl Sent {
    /// Capture times in order, each with the sending time of the last camera's message.
    pub(super) fn take(&self) -> Vec<(Timestamp, Timestamp)> {
        std::mem::take(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn add(&self, capture: Timestamp, at: Timestamp) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push((capture, at));
    }
}

/// Sends `frames` frames of every camera in real time.
pub(super) fn send(
    cameras: &Cameras,
    bus: &dyn Bus,
    topics: &Topics,
    clock: WallClock,
    frames: u64,
    sent: &Sent,
) -> Result<(), Failure> {
    let publishers = (cameras.rig.cameras.iter())
        .map(|camera| bus.publisher(&topics.keypoints(&camera.name)))
        .collect::<Result<Vec<Box<dyn Publisher>>, _>>()?;
    let start = clock.now() + Nanos::from_ms(100);
    for frame in 0..frames {
        let capture = start + cameras.since_start(frame);
        let messages: Vec<_> = (0..publishers.len())
            .map(|camera| {
                let [after, error] = cameras.offsets(frame, camera);
                let stamp = capture + after + error;
                (capture + after, stamp, cameras.message(frame, camera, stamp))
            })
            .collect();
        let mut at = capture;
        for (publisher, (exposed, stamp, message)) in publishers.iter().zip(&messages) {
            clock.wait_until(*exposed);
            at = clock.now();
            publisher.put(*stamp, ENCODING, message)?;
        }
        sent.add(capture, at);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::wire::decode;

    #[test]
    fn messages_hold_their_stamps_and_go_back_and_forth() {
        let noise = Noise::none();
        let shutter = Shutter { fps: 10.0, stagger: 0.5, jitter_ms: 1.0 };
        let cameras = Cameras::new(2, shutter, 0.4, noise, KeypointFormat::Body25).unwrap();
        assert_eq!(cameras.frames.len(), 5);
        assert_eq!(cameras.offsets(3, 1)[0], Nanos::from_ms(25));
        let errors: f64 = (0..1000).map(|frame| cameras.offsets(frame, 1)[1].ms().powi(2)).sum();
        assert!((errors / 1000.0 - 1.0).abs() < 0.1, "{errors}");
        let read = |frame: u64| {
            let bytes = cameras.message(frame, 1, Timestamp::from_ns(77));
            decode::<KeypointFrame>(&bytes).unwrap()
        };
        let people = |frame: u64| read(frame).people;
        assert_eq!((read(6).frame, read(6).capture_time_ns), (6, 77));
        assert_eq!(read(6).camera, "cam02");
        assert_eq!(people(6), people(2));
        assert_eq!(people(8), people(0));
        assert_eq!(people(9), people(1));
        assert_ne!(people(4), people(3));
    }
}
