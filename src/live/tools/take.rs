//! A recording as its cameras would send it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use prost::Name as _;

use crate::core::time::Timestamp;
use crate::io::recording::{Message, RawEntry, Reader, RecordError, Report};
use crate::io::wire::{self, KeypointFrame, decode, encode};
use crate::live::tools::{Disturbance, Disturbed};

/// A frame that was captured up to this much before one that came earlier was out of order, and is
/// sent after it; ns. One that was captured even earlier has another clock.
const OUT_OF_ORDER_NS: i64 = 1_000_000_000;
/// Frame period of a recording of one frame, ns.
const FALLBACK_PERIOD_NS: i64 = 16_666_667;

/// The frames of a recording, all in memory.
#[derive(Debug, Default)]
pub(crate) struct Take {
    /// Calibrations with the capture time from which they hold; the first one holds from the start.
    rigs: Vec<(i64, Vec<u8>)>,
    pub(crate) cameras: Vec<CameraFrames>,
    /// First and last capture time of all cameras, ns.
    span: [i64; 2],
    /// Mean frame period of the fastest camera, ns.
    period: i64,
}

/// The frames of one camera, in the order of the file.
#[derive(Debug, Default)]
pub(crate) struct CameraFrames {
    pub(crate) name: String,
    frames: Vec<Frame>,
    /// When each frame is sent, on the cameras' clock, ns; ascending.
    due: Vec<i64>,
    /// Frame numbers of one round.
    numbers: u64,
}

#[derive(Debug)]
struct Frame {
    capture: i64,
    payload: Vec<u8>,
}

/// Why a recording cannot be played.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TakeError {
    /// The recording cannot be read.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A recording without keypoints.
    #[error(
        "{path} holds no keypoints to play; give a recording of `bundlemocap import`, `synth` or \
         `record`"
    )]
    NoKeypoints {
        /// The recording.
        path: PathBuf,
    },
    /// A camera that the recording does not have.
    #[error("{path} has no keypoints of a camera {name:?}, but of {known}")]
    UnknownCamera {
        /// The recording.
        path: PathBuf,
        /// The name asked for.
        name: String,
        /// The cameras of the recording, with commas between.
        known: String,
    },
}

/// Something to send.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Due {
    /// Nanoseconds of the cameras' clock from the first capture time of the first round on.
    pub(crate) at: i64,
    pub(crate) what: What,
}

/// What is to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum What {
    /// A calibration.
    Rig(usize),
    /// A frame of a camera.
    Frame { camera: usize, frame: usize, round: u64 },
}

impl Take {
    /// Reads a recording; of its cameras only those named, all if none are. With it the damage of
    /// the recording.
    pub(crate) fn read(path: &Path, only: &[String]) -> Result<(Self, Report), TakeError> {
        let mut reader = Reader::open(path)?;
        let mut gathered = Gathered::default();
        while let Some(raw) = reader.next_raw() {
            let raw = raw?;
            if let Err(error) = gathered.add(&raw) {
                reader.reject(&raw.topic, &error);
            }
        }
        if gathered.cameras.is_empty() {
            return Err(TakeError::NoKeypoints { path: path.to_owned() });
        }
        Ok((gathered.take().of_cameras(path, only)?, reader.report().clone()))
    }

    fn of_cameras(mut self, path: &Path, only: &[String]) -> Result<Self, TakeError> {
        let has = |name: &&String| self.cameras.iter().any(|camera| camera.name == **name);
        if let Some(unknown) = only.iter().find(|name| !has(name)) {
            let names: Vec<&str> = self.cameras.iter().map(|camera| camera.name.as_str()).collect();
            let (path, name, known) = (path.to_owned(), unknown.clone(), names.join(", "));
            return Err(TakeError::UnknownCamera { path, name, known });
        }
        self.cameras.retain(|camera| only.is_empty() || only.contains(&camera.name));
        Ok(self)
    }

    /// Frames of all cameras.
    pub(crate) fn frames(&self) -> usize {
        self.cameras.iter().map(|camera| camera.frames.len()).sum()
    }

    /// The calibration's bytes.
    pub(crate) fn rig(&self, index: usize) -> Option<&[u8]> {
        self.rigs.get(index).map(|(_, payload)| payload.as_slice())
    }

    /// From the first frame of a round to the first of the next, ns.
    fn round_ns(&self) -> i64 {
        self.span[1].saturating_sub(self.span[0]).saturating_add(self.period)
    }

    /// What is sent in that round, from 0, in order.
    pub(crate) fn round(
        &self,
        round: u64,
        disturbance: &Disturbance,
        counts: &mut Disturbed,
    ) -> Vec<Due> {
        let start = self.round_start(round).saturating_sub(self.span[0]);
        let rigs = self.rigs.iter().enumerate().skip(1);
        let mut all: Vec<Due> = rigs
            .map(|(index, (at, _))| Due { at: at.saturating_add(start), what: What::Rig(index) })
            .collect();
        for (camera, frames) in self.cameras.iter().enumerate() {
            let stream = (round << 16) + camera as u64;
            let sent = disturbance.apply(stream, &frames.due, counts).into_iter();
            all.extend(sent.map(|sending| Due {
                at: sending.due_ns.saturating_add(start),
                what: What::Frame { camera, frame: sending.frame, round },
            }));
        }
        // Stable: frames of one camera keep their order.
        all.sort_by_key(|due| due.at);
        all
    }

    /// When a round begins, ns from the beginning of the first.
    fn round_start(&self, round: u64) -> i64 {
        i64::try_from(round).unwrap_or(i64::MAX).saturating_mul(self.round_ns())
    }

    /// When a frame was captured, ns from the first capture time of the first round.
    pub(crate) fn captured(&self, camera: usize, frame: usize, round: u64) -> i64 {
        let capture = self.cameras[camera].frames[frame].capture;
        capture.saturating_sub(self.span[0]).saturating_add(self.round_start(round))
    }

    /// The frame as it was recorded, and its capture time.
    pub(crate) fn original(&self, camera: usize, frame: usize) -> (Timestamp, &[u8]) {
        let frame = &self.cameras[camera].frames[frame];
        (Timestamp::from_ns(frame.capture), &frame.payload)
    }

    /// The frame as if captured at that time, with the frame number of that round.
    pub(crate) fn stamped(
        &self,
        camera: usize,
        frame: usize,
        round: u64,
        capture: Timestamp,
    ) -> Vec<u8> {
        let camera = &self.cameras[camera];
        let payload = &camera.frames[frame].payload;
        // It was decoded before, so this does not fail.
        let Ok(mut message) = decode::<KeypointFrame>(payload) else { return payload.clone() };
        message.capture_time_ns = capture.ns();
        message.frame = message.frame.wrapping_add(round.wrapping_mul(camera.numbers));
        encode(&message)
    }
}

/// A recording while it is read.
#[derive(Default)]
struct Gathered {
    /// Payloads, each with the number of frames before it.
    rigs: Vec<(usize, Vec<u8>)>,
    cameras: BTreeMap<String, Vec<(u64, Frame)>>,
    /// Capture times in the order of the file.
    captures: Vec<i64>,
}

impl Gathered {
    /// Keeps inputs; what a node made of them, and truth, is passed over.
    fn add(&mut self, raw: &RawEntry) -> Result<(), wire::DecodeError> {
        let is = |name: String| *raw.schema == name;
        if is(wire::Rig::full_name()) {
            raw.message()?;
            self.rigs.push((self.captures.len(), raw.payload.clone()));
        } else if is(KeypointFrame::full_name())
            && let Message::Keypoints(message) = raw.message()?
        {
            let (capture, payload) = (message.capture_time_ns, raw.payload.clone());
            self.captures.push(capture);
            let frames = self.cameras.entry(message.camera).or_default();
            frames.push((message.frame, Frame { capture, payload }));
        }
        Ok(())
    }

    fn take(self) -> Take {
        let first = self.captures.iter().copied().min().unwrap_or(0);
        let last = self.captures.iter().copied().max().unwrap_or(0);
        let busiest = self.cameras.values().map(Vec::len).max().unwrap_or(0);
        let period = match i64::try_from(busiest) {
            Ok(frames) if frames > 1 => last.saturating_sub(first) / (frames - 1),
            _ => FALLBACK_PERIOD_NS,
        };
        let holds_from = |before: usize| self.captures.get(before).copied().unwrap_or(last);
        Take {
            rigs: self.rigs.into_iter().map(|(before, rig)| (holds_from(before), rig)).collect(),
            cameras: self.cameras.into_iter().map(CameraFrames::new).collect(),
            span: [first, last],
            period,
        }
    }
}

impl CameraFrames {
    fn new((name, frames): (String, Vec<(u64, Frame)>)) -> Self {
        let numbers = || frames.iter().map(|(number, _)| *number);
        let [least, most] = [numbers().min(), numbers().max()].map(Option::unwrap_or_default);
        let mut newest = i64::MIN;
        let mut due = Vec::with_capacity(frames.len());
        for (_, frame) in &frames {
            let out_of_order = frame.capture < newest && newest - frame.capture <= OUT_OF_ORDER_NS;
            newest = if out_of_order { newest } else { frame.capture };
            due.push(newest);
        }
        let frames: Vec<Frame> = frames.into_iter().map(|(_, frame)| frame).collect();
        let mut order: Vec<usize> = (0..frames.len()).collect();
        order.sort_by_key(|&frame| due[frame]);
        let mut slots: Vec<Option<Frame>> = frames.into_iter().map(Some).collect();
        Self {
            name,
            frames: order.iter().filter_map(|&frame| slots[frame].take()).collect(),
            due: order.iter().map(|&frame| due[frame]).collect(),
            numbers: most.wrapping_sub(least).wrapping_add(1),
        }
    }
}

#[cfg(all(test, feature = "research"))]
pub(crate) mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::core::detections::{Detections, KeypointFormat};
    use crate::io::recording::{Provenance, Writer};
    use crate::io::wire::Topics;
    use crate::research::synth::ring_rig;

    /// Capture time of frame 0, ns.
    const START: i64 = 7_000_000_000;
    /// Frame period, ns.
    pub(crate) const PERIOD: i64 = 10_000_000;

    /// A recording of a rig and empty frames of cameras, captured at those periods, in that order.
    pub(crate) fn file(cameras: &[(&str, &[i64])]) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("take.mcap");
        let mut writer = Writer::create(&path, Topics::default(), &Provenance::default()).unwrap();
        writer.rig(&ring_rig(2, 4.0, 1.6).unwrap(), Timestamp::from_ns(START)).unwrap();
        for (camera, (name, periods)) in cameras.iter().enumerate() {
            for (frame, period) in periods.iter().enumerate() {
                let detections = Detections {
                    camera,
                    frame: 100 + frame as u64,
                    capture: Timestamp::from_ns(START + period * PERIOD),
                    format: KeypointFormat::Body25,
                    people: Vec::new(),
                };
                writer.keypoints(&detections, name, [640, 480]).unwrap();
            }
        }
        writer.finish().unwrap();
        (folder, path)
    }

    pub(crate) fn of(file: &(tempfile::TempDir, PathBuf), only: &[&str]) -> Take {
        let only: Vec<String> = only.iter().map(|name| (*name).to_owned()).collect();
        Take::read(&file.1, &only).unwrap().0
    }

    #[test]
    fn a_later_calibration_is_sent_before_the_frame_that_it_comes_before() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("two.mcap");
        let mut writer = Writer::create(&path, Topics::default(), &Provenance::default()).unwrap();
        let mut frame = Detections {
            camera: 0,
            frame: 0,
            capture: Timestamp::from_ns(START),
            format: KeypointFormat::Body25,
            people: Vec::new(),
        };
        for version in 0..2 {
            let mut rig = ring_rig(2, 4.0, 1.6).unwrap();
            rig.version = version;
            writer.rig(&rig, frame.capture).unwrap();
            writer.keypoints(&frame, "a", [640, 480]).unwrap();
            frame.capture = frame.capture + PERIOD;
        }
        writer.finish().unwrap();
        let round =
            of(&(folder, path), &[]).round(0, &Disturbance::default(), &mut Disturbed::default());
        let what: Vec<What> = round.iter().map(|due| due.what).collect();
        let frame = |frame| What::Frame { camera: 0, frame, round: 0 };
        assert_eq!(what, [frame(0), What::Rig(1), frame(1)]);
        assert_eq!(round.iter().map(|due| due.at).collect::<Vec<_>>(), [0, PERIOD, PERIOD]);
    }
}
