//! Content of a recording, for `bundlemocap info`.

use std::collections::BTreeMap;
use std::path::Path;

use super::error::{RecordError, Report};
use super::message::{Entry, Message};
use super::reader::Reader;
use crate::core::time::Timestamp;
use crate::io::wire::{self, KeypointFrame, Rig, Schema};

/// Content of a recording.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Info {
    /// Size of the file, bytes.
    pub bytes: u64,
    /// Log times of the first and the last message.
    pub span: Option<[Timestamp; 2]>,
    /// Topics by name.
    pub topics: BTreeMap<String, TopicInfo>,
    /// Cameras with keypoints, by name.
    pub cameras: BTreeMap<String, CameraInfo>,
    /// Cameras of the first rig, in its order; empty without a rig.
    pub rig: Vec<String>,
    /// The first rig message.
    pub first_rig: Option<wire::Rig>,
    /// Metadata records by name.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    /// The losses. Damage inside chunks is not seen when only the index was read.
    pub report: Report,
    /// Whether the whole file was read; otherwise the counts are from the index at its end.
    pub scanned: bool,
}

/// Content of a topic.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TopicInfo {
    /// Name of the schema; empty without a schema.
    pub schema: String,
    /// Number of messages.
    pub count: u64,
    /// Messages per second: over the topic's own span if the file was scanned, otherwise over the
    /// span of the recording. `None` with fewer than two messages or no span.
    pub rate: Option<f64>,
}

/// Data from a camera's first frame.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// Name of the keypoint format.
    pub format: String,
    /// Width and height, pixels.
    pub image_size: [u32; 2],
}

impl Info {
    /// Time from the first message to the last, seconds; 0 for an empty recording.
    pub fn seconds(&self) -> f64 {
        self.span.map_or(0.0, |[first, last]| last.seconds_since(first))
    }

    fn of(reader: &Reader) -> Self {
        let topics = reader.channels().map(|channel| {
            let schema = channel.schema.to_string();
            (channel.topic.to_string(), TopicInfo { schema, ..TopicInfo::default() })
        });
        Self {
            bytes: reader.scan().size(),
            topics: topics.collect(),
            metadata: reader.metadata().clone(),
            ..Self::default()
        }
    }

    /// Stores data of a first frame or a first rig.
    fn note(&mut self, message: &Message) {
        match message {
            Message::Keypoints(frame) => self.note_camera(frame),
            Message::Rig(rig) if self.first_rig.is_none() => {
                self.rig = rig.cameras.iter().map(|camera| camera.name.clone()).collect();
                self.first_rig = Some(rig.clone());
            }
            _ => {}
        }
    }

    fn note_camera(&mut self, frame: &KeypointFrame) {
        if !self.cameras.contains_key(&frame.camera) {
            let image_size = [frame.image_width, frame.image_height];
            let camera = CameraInfo { format: frame.format.clone(), image_size };
            self.cameras.insert(frame.camera.clone(), camera);
        }
    }
}

fn rate(count: u64, [first, last]: [Timestamp; 2]) -> Option<f64> {
    let seconds = last.seconds_since(first);
    (count > 1 && seconds > 0.0).then(|| (count - 1) as f64 / seconds)
}

/// Content of the recording at `path`: from the index at its end if that is good, otherwise by
/// reading the whole file.
///
/// # Errors
/// As [`Reader::open`].
pub fn summary(path: impl AsRef<Path>) -> Result<Info, RecordError> {
    summarise(&mut Reader::open(path)?)
}

/// As [`summary`], for an open recording that has not been read; rewinds it.
///
/// # Errors
/// As the iterator of [`Reader`].
pub fn summarise(reader: &mut Reader) -> Result<Info, RecordError> {
    let info = match from_index(reader) {
        Some(info) => first_messages(info, reader),
        None => scan_all(reader),
    }?;
    reader.rewind()?;
    Ok(info)
}

/// Counts and times from the index.
fn from_index(reader: &Reader) -> Option<Info> {
    let tail = reader.scan().tail.as_ref().ok()?.as_ref()?;
    let statistics = tail.statistics.as_ref()?;
    let mut info = Info::of(reader);
    if statistics.message_count > 0 {
        let time = |ns| Timestamp::from_ns(i64::try_from(ns).unwrap_or(i64::MAX));
        info.span = Some([time(statistics.message_start_time), time(statistics.message_end_time)]);
    }
    for (id, &count) in &statistics.channel_message_counts {
        let topic = info.topics.get_mut(tail.channels.get(id)?.topic.as_ref())?;
        topic.count += count;
        topic.rate = info.span.and_then(|span| rate(topic.count, span));
    }
    Some(info)
}

/// Adds data from the first message of each camera and of the rig, and stops reading there.
fn first_messages(mut info: Info, reader: &mut Reader) -> Result<Info, RecordError> {
    let counted = |topic: &str| info.topics.get(topic).is_some_and(|topic| topic.count > 0);
    let wanted = [KeypointFrame::FULL_NAME, Rig::FULL_NAME];
    let mut unseen: std::collections::BTreeSet<_> = reader
        .channels()
        .filter(|channel| channel.is_ours && wanted.contains(&&*channel.schema))
        .filter(|channel| counted(&channel.topic))
        .map(|channel| channel.topic.clone())
        .collect();
    while !unseen.is_empty() {
        let Some(entry) = reader.next() else { break };
        let Entry { topic, message, .. } = entry?;
        unseen.remove(&topic);
        info.note(&message);
    }
    info.report = reader.report().clone();
    Ok(info)
}

/// Content of the recording at `path`, by reading the whole file; finds all damage.
///
/// # Errors
/// As [`Reader::open`] and the iterator.
pub fn scan(path: impl AsRef<Path>) -> Result<Info, RecordError> {
    scan_all(&mut Reader::open(path)?)
}

fn scan_all(reader: &mut Reader) -> Result<Info, RecordError> {
    let (mut first, mut topics) = (Info::default(), BTreeMap::new());
    for entry in reader.by_ref() {
        let Entry { topic, log_time, message } = entry?;
        first.note(&message);
        let (count, span) = topics.entry(topic).or_insert((0, [log_time; 2]));
        *count += 1;
        *span = [span[0].min(log_time), span[1].max(log_time)];
    }
    let (cameras, rig, first_rig) = (first.cameras, first.rig, first.first_rig);
    let mut info = Info { cameras, rig, first_rig, ..Info::of(reader) };
    for (topic, (count, span)) in topics {
        let entry = info.topics.entry(topic.to_string()).or_default();
        (entry.count, entry.rate) = (count, rate(count, span));
        let [start, end] = info.span.unwrap_or(span);
        info.span = Some([start.min(span[0]), end.max(span[1])]);
    }
    info.report = reader.report().clone();
    info.scanned = true;
    Ok(info)
}
