//! Writing a recording.

use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapError, WriteOptions};
use tempfile::NamedTempFile;

use super::METADATA;
use super::error::RecordError;
use crate::body::{self, StampedPose};
use crate::camera;
use crate::detect::Detections;
use crate::msg::{
    ENCODING, Event, Keyframe, KeypointFrame, Pose, Rig, SCHEMA_ENCODING, Schema, Skeleton,
    StampedKeyframe, Status, Topics, encode,
};
use crate::time::Timestamp;

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
}

/// A recording that is being written: beside its target, until [`Writer::finish`] renames it.
/// Dropped before that, it leaves nothing.
pub struct Writer {
    path: PathBuf,
    topics: Topics,
    channels: BTreeMap<String, OpenChannel>,
    mcap: mcap::Writer<BufWriter<NamedTempFile>>,
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
        let start = || -> Result<_, McapError> {
            let mut mcap = options().create(BufWriter::new(temporary_beside(path)?))?;
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

    /// The end of a window.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn keyframe(&mut self, keyframe: &StampedKeyframe) -> Result<(), RecordError> {
        self.write(&self.topics.keyframe(), keyframe.capture, &Keyframe::from_core(keyframe))
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
        self.write(&self.topics.events(), Timestamp::from_ns(event.capture_time_ns), event)
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
        self.log(topic, log_time, message).map_err(|error| write_error(&self.path, error))
    }

    fn log<T: Schema>(&mut self, topic: &str, log_time: u64, message: &T) -> Result<(), McapError> {
        if !self.channels.contains_key(topic) {
            let id = self.open_channel::<T>(topic)?;
            self.channels.insert(topic.to_owned(), OpenChannel { id, sequence: 0 });
        }
        let Some(channel) = self.channels.get_mut(topic) else { return Ok(()) };
        let (channel_id, sequence) = (channel.id, channel.sequence);
        channel.sequence = sequence.wrapping_add(1);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        self.mcap.write_to_known_channel(&header, &encode(message))
    }

    fn open_channel<T: Schema>(&mut self, topic: &str) -> Result<u16, McapError> {
        let schema = self.mcap.add_schema(&T::full_name(), SCHEMA_ENCODING, T::DESCRIPTOR)?;
        self.mcap.add_channel(schema, topic, ENCODING, &BTreeMap::new())
    }

    /// Completes the recording and puts it in its place.
    ///
    /// # Errors
    /// When the disk does not take it; the target is then as it was.
    pub fn finish(mut self) -> Result<(), RecordError> {
        let write = RecordError::write(&self.path);
        self.mcap.finish().map_err(|error| write_error(&self.path, error))?;
        let mut file = self.mcap.into_inner();
        file.flush().map_err(&write)?;
        let file = file.into_inner().map_err(|error| write(error.into_error()))?;
        file.as_file().sync_all().map_err(&write)?;
        file.persist(&self.path).map_err(|error| write(error.error))?;
        Ok(())
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

/// A temporary file in the folder of `path`, readable as any new file is.
fn temporary_beside(path: &Path) -> io::Result<NamedTempFile> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".bundlemocap-").suffix(".mcap.part");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(folder)
}

fn write_error(path: &Path, error: McapError) -> RecordError {
    let source = match error {
        McapError::Io(source) => source,
        other => io::Error::other(other),
    };
    RecordError::Write { path: path.to_owned(), source }
}
