//! Writing a recording.

use std::collections::BTreeMap;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapError, WriteOptions};

use super::METADATA;
use super::error::RecordError;
use super::message::RawEntry;
use super::target::{Target, part_of};
use crate::core::body::{self, StampedPose};
use crate::core::camera;
use crate::core::detections::Detections;
use crate::core::manifold::StampedKeyframe;
use crate::core::time::Timestamp;
use crate::io::wire::{
    ENCODING, Event, Keyframe, KeypointFrame, Pose, Rig, SCHEMA_ENCODING, Schema, Skeleton, Status,
    Topics, descriptor, encode,
};

/// Chunks close above this many bytes: what a cut or a flipped bit can cost, about a second of
/// four cameras.
const CHUNK_BYTES: u64 = 64 << 10;
const ZSTD_LEVEL: u32 = 3;

/// Where a recording comes from; kept in its metadata next to the version of this tool.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Provenance {
    /// The configuration, TOML.
    pub config: String,
    /// Hash of the manifold's weights; empty if none were used.
    pub weights: String,
    /// Anything else, by name. Nothing that changes from run to run, lest the bytes do.
    pub more: BTreeMap<String, String>,
}

impl Provenance {
    fn record(&self) -> Metadata {
        let mut metadata = self.more.clone();
        metadata.insert("version".into(), env!("CARGO_PKG_VERSION").into());
        metadata.insert("config".into(), self.config.clone());
        metadata.insert("weights".into(), self.weights.clone());
        Metadata { name: METADATA.into(), metadata }
    }
}

struct OpenChannel {
    id: u16,
    sequence: u32,
    schema: String,
    encoding: String,
}

/// A recording that is being written: beside its target, until [`Writer::finish`] renames it.
/// Dropped before that, it leaves nothing; a live one leaves the part that was written.
pub struct Writer {
    path: PathBuf,
    topics: Topics,
    /// By topic; nearly always one.
    channels: BTreeMap<String, Vec<OpenChannel>>,
    mcap: mcap::Writer<BufWriter<Target>>,
}

impl Writer {
    /// Starts a recording that will be at `path`.
    ///
    /// # Errors
    /// When the folder is not there or not writable.
    pub fn create(
        path: impl AsRef<Path>,
        topics: Topics,
        provenance: &Provenance,
    ) -> Result<Self, RecordError> {
        let path = path.as_ref();
        let target = Target::temporary(path).map_err(RecordError::write(path))?;
        Self::start(path, target, topics, provenance)
    }

    /// Starts a live recording that will be at `path`. Until it is finished it is at `path` with
    /// `.part` after it, where it can be read up to the last [`Writer::flush`] even when this
    /// process was killed.
    ///
    /// # Errors
    /// When the folder is not there or not writable, or when such a part is there already.
    pub fn live(
        path: impl AsRef<Path>,
        topics: Topics,
        provenance: &Provenance,
    ) -> Result<Self, RecordError> {
        let path = path.as_ref();
        let target = Target::part(path).map_err(|source| match source.kind() {
            io::ErrorKind::AlreadyExists => RecordError::LeftOver { part: part_of(path) },
            _ => RecordError::write(path)(source),
        })?;
        Self::start(path, target, topics, provenance)
    }

    fn start(
        path: &Path,
        target: Target,
        topics: Topics,
        provenance: &Provenance,
    ) -> Result<Self, RecordError> {
        let start = || -> Result<_, McapError> {
            let mut mcap = options().create(BufWriter::new(target))?;
            mcap.write_metadata(&provenance.record())?;
            Ok(mcap)
        };
        let mcap = start().map_err(|error| write_error(path, error))?;
        Ok(Self { path: path.to_owned(), topics, channels: BTreeMap::new(), mcap })
    }

    /// The calibration, valid from `at`.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn rig(&mut self, rig: &camera::Rig, at: Timestamp) -> Result<(), RecordError> {
        self.write(&self.topics.rig(), at, &Rig::from_core(rig))
    }

    /// What `camera` (its name) saw in an image of `image_size` pixels, width and height.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn keypoints(
        &mut self,
        detections: &Detections,
        camera: &str,
        image_size: [u32; 2],
    ) -> Result<(), RecordError> {
        let frame = KeypointFrame::from_core(detections, camera, image_size);
        self.write(&self.topics.keypoints(camera), detections.capture, &frame)
    }

    /// A pose that was solved offline. Live ones go through [`Writer::write`].
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn pose(
        &mut self,
        pose: &StampedPose,
        skeleton: &body::Skeleton,
    ) -> Result<(), RecordError> {
        self.write(&self.topics.pose(), pose.capture, &Pose::from_core(pose, skeleton, None))
    }

    /// A final keyframe; `weights` is the fingerprint of the decoder's weights, hexadecimal.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn keyframe(
        &mut self,
        keyframe: &StampedKeyframe,
        weights: &str,
    ) -> Result<(), RecordError> {
        let message = Keyframe::from_core(keyframe, weights);
        self.write(&self.topics.keyframe(), keyframe.capture, &message)
    }

    /// The body, valid from `at`.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn skeleton(
        &mut self,
        skeleton: &body::Skeleton,
        at: Timestamp,
    ) -> Result<(), RecordError> {
        self.write(&self.topics.skeleton(), at, &Skeleton::from_core(skeleton))
    }

    /// Something that happened.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn event(&mut self, event: &Event) -> Result<(), RecordError> {
        let topic = match event.event_kind() {
            Some(kind) => self.topics.events(kind),
            None => self.topics.stage_events(),
        };
        self.write(&topic, Timestamp::from_ns(event.capture_time_ns), event)
    }

    /// Counters.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn status(&mut self, status: &Status) -> Result<(), RecordError> {
        self.write(&self.topics.status(), Timestamp::from_ns(status.capture_time_ns), status)
    }

    /// The true pose, in a synthetic recording.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn truth_pose(
        &mut self,
        pose: &StampedPose,
        skeleton: &body::Skeleton,
    ) -> Result<(), RecordError> {
        self.write(&self.topics.truth(), pose.capture, &Pose::from_core(pose, skeleton, None))
    }

    /// The true body, in a synthetic recording, valid from `at`.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn truth_skeleton(
        &mut self,
        skeleton: &body::Skeleton,
        at: Timestamp,
    ) -> Result<(), RecordError> {
        self.write(&self.topics.truth_skeleton(), at, &Skeleton::from_core(skeleton))
    }

    /// Any message of ours, on any topic, filed under the time `at`.
    ///
    /// # Errors
    /// When the disk does not take it, or `at` is negative.
    pub fn write<T: Schema>(
        &mut self,
        topic: &str,
        at: Timestamp,
        message: &T,
    ) -> Result<(), RecordError> {
        let log_time = u64::try_from(at.ns())
            .map_err(|_| RecordError::BeforeEpoch { topic: topic.to_owned(), ns: at.ns() })?;
        let times = [log_time; 2];
        self.log(topic, &T::full_name(), ENCODING, times, &encode(message))
            .map_err(|error| write_error(&self.path, error))
    }

    /// A message as its bytes are. With the schema's descriptor if it is ours, else without a
    /// schema. Times before the epoch are filed at the epoch.
    ///
    /// # Errors
    /// When the disk does not take it.
    pub fn write_raw(&mut self, entry: &RawEntry) -> Result<(), RecordError> {
        let times = [entry.log_time, entry.publish_time];
        let times = times.map(|time| u64::try_from(time.ns()).unwrap_or(0));
        self.log(&entry.topic, &entry.schema, &entry.encoding, times, &entry.payload)
            .map_err(|error| write_error(&self.path, error))
    }

    /// `times`: log and publish time.
    fn log(
        &mut self,
        topic: &str,
        schema: &str,
        encoding: &str,
        times: [u64; 2],
        payload: &[u8],
    ) -> Result<(), McapError> {
        let of_kind =
            |channel: &&mut OpenChannel| channel.schema == schema && channel.encoding == encoding;
        let open = self.channels.get_mut(topic);
        let (channel_id, sequence) = match open.and_then(|open| open.iter_mut().find(of_kind)) {
            Some(channel) => {
                channel.sequence = channel.sequence.wrapping_add(1);
                (channel.id, channel.sequence)
            }
            None => (self.open_channel(topic, schema, encoding)?, 0),
        };
        let [log_time, publish_time] = times;
        let header = MessageHeader { channel_id, sequence, log_time, publish_time };
        self.mcap.write_to_known_channel(&header, payload)
    }

    fn open_channel(
        &mut self,
        topic: &str,
        schema: &str,
        encoding: &str,
    ) -> Result<u16, McapError> {
        let schema_id = match descriptor(schema) {
            Some(descriptor) => self.mcap.add_schema(schema, SCHEMA_ENCODING, descriptor)?,
            None => 0,
        };
        let id = self.mcap.add_channel(schema_id, topic, encoding, &BTreeMap::new())?;
        let (schema, encoding) = (schema.to_owned(), encoding.to_owned());
        let open = self.channels.entry(topic.to_owned()).or_default();
        open.push(OpenChannel { id, sequence: 0, schema, encoding });
        Ok(id)
    }

    /// Closes the open chunk and gives everything to the system, so that it outlives this process.
    ///
    /// # Errors
    /// When the disk does not take it.
    pub fn flush(&mut self) -> Result<(), RecordError> {
        self.mcap.flush().map_err(|error| write_error(&self.path, error))
    }

    /// Completes the recording and puts it in its place.
    ///
    /// # Errors
    /// When the disk does not take it; the target is then as it was.
    pub fn finish(mut self) -> Result<(), RecordError> {
        let write = RecordError::write(&self.path);
        self.mcap.finish().map_err(|error| write_error(&self.path, error))?;
        let file = self.mcap.into_inner();
        let file = file.into_inner().map_err(|error| write(error.into_error()))?;
        file.persist(&self.path).map_err(&write)
    }
}

/// Everything that decides about bytes is set here, so that a default cannot change it.
fn options() -> WriteOptions {
    WriteOptions::new()
        .compression(Some(Compression::Zstd))
        .compression_level(ZSTD_LEVEL)
        .compression_threads(0)
        .chunk_size(Some(CHUNK_BYTES))
        .profile("")
        .library("bundlemocap")
}

fn write_error(path: &Path, error: McapError) -> RecordError {
    let source = match error {
        McapError::Io(source) => source,
        other => io::Error::other(other),
    };
    RecordError::Write { path: path.to_owned(), source }
}
