//! A recording to solve: its cameras, its detections, its truth.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

use prost::Name;

use super::Error;
use super::in_order::InOrder;
use crate::core::body::{Skeleton, StampedPose};
use crate::core::camera::{Camera, CameraError, Rig};
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{FramePeriod, FrameRate, RATE_FRAMES, UnitCheck};
use crate::diagnose::WrongTimes;
use crate::io::recording::{CameraInfo, Info, Message, Reader, summarise};
use crate::io::wire::{self, StageChannel, Topic};

/// A recording with matching keypoints and rig. The file is opened once; its messages are streamed,
/// so memory does not depend on its length.
pub struct Recording {
    reader: Reader,
    rig: Arc<Rig>,
    messages: u64,
    /// Frames of the busiest camera.
    frames: u64,
    /// Number of frames, by camera.
    counts: BTreeMap<String, u64>,
    format: String,
    /// Whether the file is whole: then a camera without keypoints has none.
    is_whole: bool,
    /// Cameras with keypoints.
    seen: BTreeMap<String, CameraInfo>,
    /// First and last capture time that is used, if not all are.
    span: Option<[Timestamp; 2]>,
    /// First and last log time of the file.
    log_span: Option<[Timestamp; 2]>,
    /// What is wrong with the capture times of cameras, by name; it is corrected.
    wrong_times: BTreeMap<String, Vec<WrongTimes>>,
    /// Its first calibration, if that is used.
    own_rig: Option<wire::Rig>,
    /// Whether another one follows, in what was read.
    has_other_rig: bool,
}

/// A camera with more than this part of the fastest one's frames is as fast.
const MOSTLY: f64 = 0.8;

/// A message of a recording.
pub(crate) enum Item {
    /// A camera's detections; the camera index is that in the chosen rig. The number of points whose
    /// confidence was above 1 in the message.
    Detections(Detections, usize),
    /// The same of a held-out camera; the camera index is that in the list of held-out cameras.
    HeldOut(Detections, usize),
    /// An actor's true body, before the true poses.
    TrueBody(String, Box<Skeleton>),
    /// An actor's true pose.
    TruePose(String, Box<StampedPose>),
}

impl fmt::Debug for Recording {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Recording")
            .field("path", &self.path())
            .field("span", &self.span)
            .finish_non_exhaustive()
    }
}

impl Recording {
    /// Opens a recording and checks that its cameras fit its rig.
    ///
    /// # Errors
    /// A file that cannot be read, a recording of another program, missing keypoints or rig, fewer than two cameras
    /// in the rig, or a camera whose first image has another size.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, Error> {
        Self::open_with(path, None)
    }

    /// Opens a recording with this calibration. The recording's own one may be missing or wrong.
    ///
    /// # Errors
    /// As [`Recording::open`], or a camera that is not in this calibration.
    pub fn open_with(path: impl AsRef<Path>, rig: Option<Rig>) -> Result<Self, Error> {
        let mut reader = Reader::open(path)?;
        let info = summarise(&mut reader)?;
        let path = reader.path();
        if info.cameras.is_empty() {
            return Err(without_keypoints(path, &info));
        }
        let own_rig = info.first_rig.clone().filter(|_| rig.is_none());
        let rig = Arc::new(rig.map_or_else(|| first_rig(path, &info), Ok)?);
        let messages = info.topics.values().map(|topic| topic.count).sum();
        let keypoints = wire::KeypointFrame::full_name();
        let (mut frames, mut counts) = (0, BTreeMap::new());
        for (name, topic) in info.topics.iter().filter(|(_, topic)| topic.schema == keypoints) {
            frames = topic.count.max(frames);
            if let Ok(Topic::Stage { channel: StageChannel::Keypoints { camera }, .. }) =
                Topic::parse(name)
            {
                let count = counts.entry(camera.to_owned()).or_insert(0);
                *count = topic.count.max(*count);
            }
        }
        let used = info.cameras.iter().filter(|(name, _)| rig.index_of(name).is_some());
        let format = Formats::of(used.map(|(name, one)| (&**name, &*one.format))).usual;
        let (is_whole, seen, log_span) = (info.report.is_clean(), info.cameras, info.span);
        let (span, wrong_times) = (None, BTreeMap::new());
        let recording = Self {
            reader,
            rig,
            messages,
            frames,
            counts,
            format,
            is_whole,
            seen,
            span,
            log_span,
            wrong_times,
            own_rig,
            has_other_rig: false,
        };
        recording.check_cameras()?;
        Ok(recording)
    }

    /// Uses only what was captured in this span, first and last time.
    #[must_use]
    pub fn within(self, span: Option<[Timestamp; 2]>) -> Self {
        Self { span, ..self }
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.reader.path()
    }

    /// All cameras of the recording.
    pub fn rig(&self) -> &Arc<Rig> {
        &self.rig
    }

    /// The number of messages, from the file's index.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// Number of frames of the busiest camera.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// About the number of them that are used.
    pub(crate) fn frames_in_span(&self) -> u64 {
        let (Some([first, last]), Some([begin, end])) = (self.span, self.log_span) else {
            return self.frames;
        };
        let part = last.min(end).seconds_since(first.max(begin)) / end.seconds_since(begin);
        // Without an overlap, the cameras' clock is another one than the recorder's.
        let part = if part > 0.0 { part.min(1.0) } else { 1.0 };
        (self.frames as f64 * part).ceil() as u64
    }

    /// The first of the fastest cameras of `rig` whose times are not corrected: its frame numbers are those of the
    /// recording.
    pub(crate) fn clock_camera(&self, rig: &Rig) -> usize {
        let is_right = |camera: &Camera| {
            camera.time_offset == Nanos::ZERO && !self.wrong_times.contains_key(&camera.name)
        };
        let frames = |camera: &Camera| self.counts.get(&camera.name).copied().unwrap_or_default();
        let right = || rig.cameras.iter().filter(|camera| is_right(camera));
        let most = right().map(frames).max().unwrap_or_default();
        let is_fast = |camera: &&Camera| frames(camera) as f64 > MOSTLY * most as f64;
        let fast = right().find(is_fast).and_then(|camera| rig.index_of(&camera.name));
        fast.unwrap_or(0)
    }

    /// Name of the keypoint format of most cameras. Others are left out.
    pub fn format(&self) -> &str {
        &self.format
    }

    /// Checks that the cameras with keypoints are in the rig, and that their first images have the calibrated size. Of
    /// the recording's own rig two cameras are enough; the others are left out.
    fn check_cameras(&self) -> Result<(), Error> {
        let path = || self.path().to_owned();
        let is_own = self.own_rig.is_some();
        let are_enough = is_own && self.seen.len() >= self.uncalibrated().count() + 2;
        if let Some(camera) = self.uncalibrated().next().filter(|_| !are_enough) {
            return Err(Error::Uncalibrated { path: path(), camera: camera.clone() });
        }
        for (name, info) in &self.seen {
            let Some(index) = self.rig.index_of(name) else { continue };
            let camera = &self.rig.cameras[index];
            let (detected, calibrated) = (info.image_size, [camera.width, camera.height]);
            if !detected.contains(&0) && !camera.is_of_size(detected) {
                let camera = name.clone();
                return Err(Error::ImageSize { path: path(), camera, calibrated, detected });
            }
        }
        Ok(())
    }

    /// Cameras with keypoints that are not in the rig.
    fn uncalibrated(&self) -> impl Iterator<Item = &String> {
        self.seen.keys().filter(|name| self.rig.index_of(name).is_none())
    }

    /// The camera with a name; else the only one whose name differs just in case, in `_`, `-` or
    /// blanks, or in leading zeros.
    ///
    /// # Errors
    /// No camera, or more than one, fits.
    pub fn camera(&self, name: &str) -> Result<&Camera, Error> {
        let cameras = &self.rig.cameras;
        let alike = || cameras.iter().filter(|camera| plain(&camera.name) == plain(name));
        let found = cameras.iter().find(|camera| camera.name == name).or_else(|| {
            let mut alike = alike();
            alike.next().filter(|_| alike.next().is_none())
        });
        found.ok_or_else(|| {
            let known: Vec<&str> = cameras.iter().map(|camera| camera.name.as_str()).collect();
            let (path, known) = (self.path().to_owned(), known.join(", "));
            Error::NoSuchCamera { path, name: name.to_owned(), known }
        })
    }

    /// The rig to solve with, and the cameras named in `held_out`, each once. The rig has the cameras named in `only`,
    /// or all with keypoints if `only` is empty, without those in `held_out`.
    ///
    /// # Errors
    /// An unknown camera, one in `only` without keypoints, or fewer than two cameras.
    pub fn chosen(
        &self,
        only: &[String],
        held_out: &[String],
    ) -> Result<(Rig, Vec<Camera>), Error> {
        let path = || self.path().to_owned();
        let named = |names: &[String]| {
            names.iter().map(|name| self.camera(name)).collect::<Result<Vec<_>, _>>()
        };
        let (wanted, mut held_out) = (named(only)?, named(held_out)?);
        let mut seen = BTreeSet::new();
        held_out.retain(|camera| seen.insert(&camera.name));
        let chosen = self.rig.cameras.iter().filter(|camera| {
            let is_wanted = match wanted.is_empty() {
                true => !self.is_silent(camera),
                false => wanted.contains(camera),
            };
            is_wanted && !held_out.contains(camera)
        });
        let rig = Rig::new(self.rig.version, chosen.cloned().collect());
        let silent = match &rig {
            Ok(rig) => {
                let mut used = rig.cameras.iter().chain(held_out.iter().copied());
                used.find(|camera| self.is_silent(camera))
            }
            Err(_) => self.silent().next().filter(|_| only.is_empty() && held_out.is_empty()),
        };
        if let Some(camera) = silent {
            return Err(Error::SilentCamera { path: path(), camera: camera.name.clone() });
        }
        let all = self.rig.cameras.len();
        let rig = rig.map_err(|source| match source {
            CameraError::TooFewCameras { found: left } if all > 1 => {
                Error::FewCameras { path: path(), left, all }
            }
            source => Error::Rig { path: path(), source },
        })?;
        Ok((rig, held_out.into_iter().cloned().collect()))
    }

    fn is_silent(&self, camera: &Camera) -> bool {
        self.is_whole && !self.seen.contains_key(&camera.name)
    }

    /// A note for the user if the calibration changes in the recording. Call it after the recording was read.
    pub fn rig_note(&self) -> Option<String> {
        self.has_other_rig.then(|| {
            "the calibration changes in the recording; only the first one is used (--rig takes another)"
                .to_owned()
        })
    }

    /// What could not be used, in words: cameras without a calibration, and what was lost when the recording was last
    /// read.
    pub fn losses(&self) -> Vec<String> {
        let mut losses = self.reader.report().losses();
        let cameras: Vec<&str> = self.uncalibrated().map(String::as_str).collect();
        if !cameras.is_empty() {
            let text = format!("no calibration of camera {}; it is left out", cameras.join(", "));
            losses.insert(0, text);
        }
        losses
    }

    /// The calibrated cameras without keypoints.
    fn silent(&self) -> impl Iterator<Item = &Camera> {
        self.rig.cameras.iter().filter(|camera| self.is_silent(camera))
    }

    /// The rig of all cameras, with `cameras` in place of those of the same names.
    pub(crate) fn rig_with<'a>(&self, cameras: impl Iterator<Item = &'a Camera>) -> Rig {
        let mut rig = Rig::clone(&self.rig);
        for camera in cameras {
            let own = rig.cameras.iter_mut().filter(|own| own.name == camera.name);
            own.for_each(|own| own.clone_from(camera));
        }
        rig
    }

    /// Undoes the last correction of a camera's capture times.
    pub(crate) fn undo_correction(&mut self, camera: &str) {
        if let Some(wrong) = self.wrong_times.get_mut(camera) {
            wrong.pop();
            self.wrong_times.retain(|_, wrong| !wrong.is_empty());
        }
    }

    /// Corrects the capture times of a camera from the next pass on.
    pub(crate) fn correct(&mut self, camera: &str, wrong: WrongTimes) {
        self.wrong_times.entry(camera.to_owned()).or_default().push(wrong);
    }

    /// A note that names the cameras without keypoints, if there are any.
    pub fn silent_note(&self) -> Option<String> {
        let silent: Vec<_> = self.silent().map(|camera| &*camera.name).collect();
        let note = || format!("no keypoints of camera {}; the others are used", silent.join(", "));
        (!silent.is_empty()).then(note)
    }

    /// Measures the frame rate of the cameras of `rig` on their first frames. Forgets all corrections of capture times.
    ///
    /// # Errors
    /// Capture times that are not in nanoseconds.
    pub(crate) fn frame_period(&mut self, rig: &Rig) -> Result<Option<FramePeriod>, Error> {
        let cameras = rig.cameras.len();
        let mut rate = FrameRate::new(cameras);
        let mut checks = vec![(0, UnitCheck::default()); cameras];
        self.wrong_times.clear();
        self.reader.rewind()?;
        while let Some(entry) = self.reader.next() {
            let Message::Keypoints(frame) = entry?.message else { continue };
            let Some(camera) = rig.index_of(&frame.camera) else { continue };
            let capture = Timestamp::from_ns(frame.capture_time_ns);
            rate.note(camera, frame.frame, capture);
            let (count, check) = &mut checks[camera];
            if let Some(reason) = check.add(capture) {
                let path = self.reader.path().to_owned();
                return Err(Error::TimeUnit { path, camera: frame.camera, reason });
            }
            *count += 1;
            if *count == RATE_FRAMES {
                break;
            }
        }
        Ok(rate.period())
    }

    /// Streams the recording from its start: the detections of all cameras of `rig` and of the
    /// held-out cameras, and the truth, if any. Frames of cameras with time offsets are put in order.
    /// [`losses`](Self::losses) tells what was lost.
    pub(crate) fn stream(
        &mut self,
        rig: &Rig,
        held_out: &[Camera],
        mut each_message: impl FnMut() -> ControlFlow<()>,
        mut take: impl FnMut(Item) -> Result<(), Error>,
    ) -> Result<(), Error> {
        self.reader.rewind()?;
        let mut is_empty = true;
        self.has_other_rig = false;
        // The held-out cameras follow the others.
        let cameras: Vec<&Camera> = rig.cameras.iter().chain(held_out).collect();
        let first = cameras.iter().filter_map(|camera| {
            let info = self.seen.get(&camera.name)?;
            Some((camera.name.as_str(), info.format.as_str()))
        });
        let mut formats = Formats::of(first);
        let offsets: Vec<_> = cameras.iter().map(|camera| camera.time_offset).collect();
        // Otherwise they keep the order of the recording.
        let is_corrected = !self.wrong_times.is_empty();
        let sorts = is_corrected || offsets.iter().any(|offset| *offset != offsets[0]);
        let mut in_order = InOrder::new(&offsets, !is_corrected);
        while let Some(entry) = self.reader.next() {
            let mut entry = entry?;
            let mut index = None;
            if each_message().is_break() {
                return Err(Error::Stopped { path: self.path().to_owned() });
            }
            let captured = match &mut entry.message {
                Message::Keypoints(frame) => {
                    index = cameras.iter().position(|camera| camera.name == frame.camera);
                    let Some(index) = index else { continue };
                    let own = Timestamp::from_ns(frame.capture_time_ns);
                    let wrong = self.wrong_times.get(&frame.camera).into_iter().flatten();
                    let right = wrong.fold(own, |time, wrong| wrong.corrected(time));
                    frame.capture_time_ns = right.ns();
                    Some(right + offsets[index])
                }
                Message::TruthPose(pose) => Some(Timestamp::from_ns(pose.capture_time_ns)),
                Message::Rig(rig) => {
                    let own = self.own_rig.as_ref();
                    let is_used = self.span.is_none_or(|[_, last]| entry.log_time <= last);
                    self.has_other_rig |=
                        is_used && own.is_some_and(|own| own.cameras != rig.cameras);
                    None
                }
                _ => None,
            };
            let is_out = |[first, last]: [Timestamp; 2]| {
                captured.is_some_and(|time| !(first..=last).contains(&time))
            };
            if self.span.is_some_and(is_out) {
                continue;
            }
            let item = match entry.message {
                Message::Keypoints(frame) => {
                    is_empty = false;
                    let size = [frame.image_width, frame.image_height];
                    let camera = index.map(|index| cameras[index]);
                    if camera.is_some_and(|one| !size.contains(&0) && !one.is_of_size(size)) {
                        let [width, height] = size;
                        let what =
                            format!("an image of {width} x {height}, not of the calibrated size");
                        self.reader.reject(&entry.topic, &what);
                        continue;
                    }
                    let usual = formats.vote(&frame.camera, &frame.format);
                    if frame.format != usual {
                        let what = format!("{}, most cameras have {usual}", frame.format);
                        self.reader.reject(&entry.topic, &what);
                        continue;
                    }
                    let (percent, solved) = (in_percent(&frame), rig.cameras.len());
                    let held_out = index.and_then(|index| index.checked_sub(solved));
                    let frame = frame.to_core(|_| held_out.or(index));
                    frame.map(|frame| match held_out {
                        None => Item::Detections(frame, percent),
                        Some(_) => Item::HeldOut(frame, percent),
                    })
                }
                Message::TruthSkeleton(body) => {
                    let actor = Topic::actor(&entry.topic);
                    body.to_truth().map(|body| Item::TrueBody(actor, Box::new(body)))
                }
                Message::TruthPose(pose) => {
                    let actor = Topic::actor(&entry.topic);
                    pose.to_core().map(|pose| Item::TruePose(actor, Box::new(pose)))
                }
                _ => continue,
            };
            match item {
                Ok(item) => match index.zip(captured) {
                    Some((camera, captured)) if sorts => in_order.add(camera, captured, item),
                    _ => take(item)?,
                },
                Err(error) => self.reader.reject(&entry.topic, &error),
            }
            while let Some(item) = in_order.next(false) {
                take(item)?;
            }
        }
        if is_empty && self.span.is_some() {
            return Err(Error::EmptySpan { path: self.path().to_owned() });
        }
        while let Some(item) = in_order.next(true) {
            take(item)?;
        }
        Ok(())
    }
}

/// The newest keypoint format of each camera.
#[derive(Default)]
struct Formats {
    cameras: BTreeMap<String, String>,
    /// That of most cameras; of as many, the one that was so before.
    usual: String,
}

impl Formats {
    /// Of the cameras' first frames.
    fn of<'a>(first: impl Iterator<Item = (&'a str, &'a str)>) -> Self {
        let mut formats = Self::default();
        for (camera, format) in first {
            formats.vote(camera, format);
        }
        formats
    }

    /// A camera sends this format. Returns the usual one.
    fn vote(&mut self, camera: &str, format: &str) -> &str {
        if self.cameras.get(camera).is_none_or(|before| before != format) {
            self.cameras.insert(camera.to_owned(), format.to_owned());
            let votes = |format: &str| self.cameras.values().filter(|one| *one == format).count();
            if votes(format) > votes(&self.usual) {
                format.clone_into(&mut self.usual);
            }
        }
        &self.usual
    }
}

/// Higher confidences are in per cent. Scores of some detectors are a little above 1.
const HIGHEST: f32 = 1.5;

/// The number of points of a frame whose confidence is far above 1, as if in per cent.
fn in_percent(frame: &wire::KeypointFrame) -> usize {
    let points = frame.people.iter().flat_map(|person| person.points.as_chunks::<3>().0);
    points.filter(|[.., confidence]| *confidence > HIGHEST).count()
}

/// The error for a recording without keypoints of any camera.
fn without_keypoints(path: &Path, info: &Info) -> Error {
    const SHOWN: usize = 8;
    let path = path.to_owned();
    if let Some((topic, reason)) = refused::<wire::KeypointFrame>(info) {
        let (topic, reason) = (topic.to_owned(), reason.to_owned());
        return Error::KeypointFormat { path, topic, reason };
    }
    let topics: Vec<&str> = info.topics.keys().map(String::as_str).take(SHOWN).collect();
    let held = if topics.is_empty() { "nothing".to_owned() } else { topics.join(", ") };
    Error::NoKeypoints { path, held }
}

/// The first rig of a recording. It may come after the first keypoints.
fn first_rig(path: &Path, info: &Info) -> Result<Rig, Error> {
    let bad = |reason: String| Error::BadRig { path: path.to_owned(), reason };
    match &info.first_rig {
        Some(rig) => rig.to_core().map_err(|error| bad(error.to_string())),
        None => Err(match refused::<wire::Rig>(info) {
            Some((topic, reason)) => bad(format!("{topic}: {reason}")),
            None => Error::NoRig { path: path.to_owned() },
        }),
    }
}

/// The first topic of a schema with unusable messages, and the reason of its first one.
fn refused<T: Name>(info: &Info) -> Option<(&str, &str)> {
    let schema = T::full_name();
    let of_schema = |topic: &&String| info.topics.get(*topic).is_some_and(|t| t.schema == schema);
    let topic = info.report.undecodable.keys().find(of_schema)?;
    Some((topic, &info.report.undecodable[topic].first))
}

/// A name without the differences between tools: case, separators, leading zeros of numbers.
fn plain(name: &str) -> String {
    let mut plain = String::new();
    let mut digits = String::new();
    for c in name.chars().chain(['\0']) {
        if c.is_ascii_digit() {
            digits.push(c);
            continue;
        }
        if !digits.is_empty() {
            let number = digits.trim_start_matches('0');
            plain.push_str(if number.is_empty() { "0" } else { number });
            digits.clear();
        }
        plain.extend(c.to_lowercase().filter(|c| c.is_alphanumeric()));
    }
    plain
}

#[cfg(test)]
mod tests {
    use super::plain;

    #[test]
    fn names_match_across_tools() {
        assert_eq!(plain("cam01"), plain("cam_1"));
        assert_eq!(plain("Cam 01"), plain("cam-01"));
        assert_ne!(plain("cam01"), plain("cam10"));
        assert_ne!(plain("cam0"), plain("cam"));
    }
}
