//! A recording, prepared for sending as its cameras would.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use prost::Name as _;

use crate::cli::tools::{Disturbance, Disturbed};
use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::{Message, RawEntry, Reader, RecordError, Report};
use crate::io::wire::{self, KeypointFrame, decode, encode};

/// A frame that was captured up to this much before an earlier frame of the file was out of order,
/// and is sent after it. A larger step back means another clock.
const OUT_OF_ORDER: Nanos = Nanos::SECOND;
/// Frame period of a recording with one frame.
const FALLBACK_PERIOD: Nanos = Nanos::new(16_666_667);

/// The frames of a recording, all in memory.
#[derive(Debug, Default)]
pub(crate) struct Take {
    /// Calibrations, each with the capture time from which it is valid; the first is valid from the
    /// start.
    rigs: Vec<(Timestamp, Vec<u8>)>,
    pub(crate) cameras: Vec<CameraFrames>,
    /// First and last capture time of all cameras.
    span: [Timestamp; 2],
    /// Mean frame period of the fastest camera.
    period: Nanos,
}

/// The frames of one camera, in the order of the file.
#[derive(Debug, Default)]
pub(crate) struct CameraFrames {
    pub(crate) name: String,
    frames: Vec<Frame>,
    /// Send times of the frames on the cameras' clock; ascending.
    due: Vec<Timestamp>,
    /// Number of frame numbers in one round.
    numbers: u64,
}

#[derive(Debug)]
struct Frame {
    capture: Timestamp,
    payload: Vec<u8>,
}

/// Why a recording cannot be played.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TakeError {
    /// The recording cannot be read.
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error("{path} has no keypoints from --start to --end")]
    EmptySpan { path: PathBuf },
    #[error(
        "{path} holds no keypoints to play; give a recording of `bundlemocap import`, `synth` or \
         `record`"
    )]
    NoKeypoints { path: PathBuf },
    #[error("{path} has no keypoints of a camera {name:?}, but of {known}")]
    UnknownCamera { path: PathBuf, name: String, known: String },
}

/// A message to send.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Due {
    /// Send time on the cameras' clock, since the first capture time of the first round.
    pub(crate) at: Nanos,
    pub(crate) what: What,
}

/// Content of a message to send.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum What {
    /// A calibration.
    Rig(usize),
    /// A frame of a camera.
    Frame { camera: usize, frame: usize, round: u64 },
}

impl Take {
    /// Reads the cameras in `only` from a recording; all cameras if `only` is empty. Of frames, those
    /// captured in `span`, if there is one. Also returns the damage of the recording.
    pub(crate) fn read(
        path: &Path,
        only: &[String],
        span: Option<[Timestamp; 2]>,
    ) -> Result<(Self, Report), TakeError> {
        let mut reader = Reader::open(path)?;
        let mut gathered = Gathered { span, ..Gathered::default() };
        while let Some(raw) = reader.next_raw() {
            let raw = raw?;
            if let Err(error) = gathered.add(&raw) {
                reader.reject(&raw.topic, &error);
            }
        }
        if gathered.cameras.is_empty() && span.is_some() {
            return Err(TakeError::EmptySpan { path: path.to_owned() });
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

    /// Number of frames of all cameras.
    pub(crate) fn frames(&self) -> usize {
        self.cameras.iter().map(|camera| camera.frames.len()).sum()
    }

    /// The calibration's bytes.
    pub(crate) fn rig(&self, index: usize) -> Option<&[u8]> {
        self.rigs.get(index).map(|(_, payload)| payload.as_slice())
    }

    /// Time from the first frame of a round to the first of the next.
    fn round_length(&self) -> Nanos {
        self.span[1] - self.span[0] + self.period
    }

    /// The messages of that round, counted from 0, in order.
    pub(crate) fn round(
        &self,
        round: u64,
        disturbance: &Disturbance,
        counts: &mut Disturbed,
    ) -> Vec<Due> {
        let since_start = |at| at - self.span[0] + self.round_start(round);
        // The first calibration of the first round is sent before it; a later round returns to it.
        let is_sent = round == 0 || self.rigs.len() < 2;
        let rigs = self.rigs.iter().enumerate().skip(usize::from(is_sent));
        let mut all: Vec<Due> = rigs
            .map(|(index, (at, _))| {
                let at = if index == 0 { self.round_start(round) } else { since_start(*at) };
                Due { at, what: What::Rig(index) }
            })
            .collect();
        for (camera, frames) in self.cameras.iter().enumerate() {
            let stream = (round << 16) + camera as u64;
            let sent = disturbance.apply(stream, &frames.due, counts).into_iter();
            all.extend(sent.map(|sending| Due {
                at: since_start(sending.due),
                what: What::Frame { camera, frame: sending.frame, round },
            }));
        }
        // The sort is stable: frames of one camera keep their order.
        all.sort_by_key(|due| due.at);
        all
    }

    /// Start of a round, since the start of the first.
    pub(crate) fn round_start(&self, round: u64) -> Nanos {
        self.round_length() * i64::try_from(round).unwrap_or(i64::MAX)
    }

    /// Capture time of a frame, since the first capture time of the first round.
    pub(crate) fn captured(&self, camera: usize, frame: usize, round: u64) -> Nanos {
        let capture = self.cameras[camera].frames[frame].capture;
        capture - self.span[0] + self.round_start(round)
    }

    /// The recorded frame and its capture time.
    pub(crate) fn original(&self, camera: usize, frame: usize) -> (Timestamp, &[u8]) {
        let frame = &self.cameras[camera].frames[frame];
        (frame.capture, &frame.payload)
    }

    /// The frame with a new capture time and the frame number of that round.
    pub(crate) fn stamped(
        &self,
        camera: usize,
        frame: usize,
        round: u64,
        capture: Timestamp,
    ) -> Vec<u8> {
        let camera = &self.cameras[camera];
        let payload = &camera.frames[frame].payload;
        // Cannot fail: the frame was decoded before.
        let Ok(mut message) = decode::<KeypointFrame>(payload) else { return payload.clone() };
        message.capture_time_ns = capture.ns();
        message.frame = message.frame.wrapping_add(round.wrapping_mul(camera.numbers));
        encode(&message)
    }
}

/// State while a recording is read.
#[derive(Default)]
struct Gathered {
    /// First and last capture time of the frames, if not all are read.
    span: Option<[Timestamp; 2]>,
    /// Payloads, each with the number of frames before it.
    rigs: Vec<(usize, Vec<u8>)>,
    cameras: BTreeMap<String, Vec<(u64, Frame)>>,
    /// Capture times in the order of the file.
    captures: Vec<Timestamp>,
}

impl Gathered {
    /// Stores inputs; skips outputs of a node, and truth.
    fn add(&mut self, raw: &RawEntry) -> Result<(), wire::DecodeError> {
        let is = |name: String| *raw.schema == name;
        if is(wire::Rig::full_name()) {
            raw.message()?;
            self.rigs.push((self.captures.len(), raw.payload.clone()));
        } else if is(KeypointFrame::full_name())
            && let Message::Keypoints(message) = raw.message()?
        {
            let capture = Timestamp::from_ns(message.capture_time_ns);
            if self.span.is_some_and(|[start, end]| !(start..=end).contains(&capture)) {
                return Ok(());
            }
            let payload = raw.payload.clone();
            self.captures.push(capture);
            let frames = self.cameras.entry(message.camera).or_default();
            frames.push((message.frame, Frame { capture, payload }));
        }
        Ok(())
    }

    fn take(self) -> Take {
        let first = self.captures.iter().copied().min().unwrap_or_default();
        let last = self.captures.iter().copied().max().unwrap_or_default();
        let busiest = self.cameras.values().map(Vec::len).max().unwrap_or(0);
        let period = match i64::try_from(busiest) {
            Ok(frames) if frames > 1 => (last - first) / (frames - 1),
            _ => FALLBACK_PERIOD,
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
        let mut newest = Timestamp::from_ns(i64::MIN);
        let mut due = Vec::with_capacity(frames.len());
        for (_, frame) in &frames {
            let out_of_order = frame.capture < newest && newest - frame.capture <= OUT_OF_ORDER;
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

    /// Capture time of frame 0.
    const START: Timestamp = Timestamp::from_ns(7_000_000_000);
    pub(crate) const PERIOD: Nanos = Nanos::from_ms(10);

    /// A recording with a rig and empty frames of cameras at those periods, in that order.
    pub(crate) fn file(cameras: &[(&str, &[i64])]) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("take.mcap");
        let mut writer = Writer::create(&path, Topics::default(), &Provenance::default()).unwrap();
        writer.rig(&ring_rig(2, 4.0, 1.6).unwrap(), START).unwrap();
        for (camera, (name, periods)) in cameras.iter().enumerate() {
            for (frame, period) in periods.iter().enumerate() {
                let detections = Detections {
                    camera,
                    frame: 100 + frame as u64,
                    capture: START + PERIOD * *period,
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
        Take::read(&file.1, &only, None).unwrap().0
    }

    #[test]
    fn a_later_calibration_is_sent_before_the_frame_that_it_comes_before() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("two.mcap");
        let mut writer = Writer::create(&path, Topics::default(), &Provenance::default()).unwrap();
        let mut frame = Detections {
            camera: 0,
            frame: 0,
            capture: START,
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
        assert_eq!(
            round.iter().map(|due| due.at).collect::<Vec<_>>(),
            [Nanos::ZERO, PERIOD, PERIOD]
        );
    }
}
