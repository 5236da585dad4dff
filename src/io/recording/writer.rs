//! Writes a recording.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapError, WriteOptions};

use super::METADATA;
use super::error::RecordError;
use super::message::{Message, RawEntry};
use super::target::{Target, part_of};
use crate::core::body::{self, StampedPose};
use crate::core::camera;
use crate::core::detections::Detections;
use crate::core::time::Timestamp;
use crate::io::wire::{
    ENCODING, KeypointFrame, Pose, Rig, SCHEMA_ENCODING, Schema, Skeleton, Topics, descriptor,
    encode,
};

/// Chunks close above this many bytes. A truncated file or a flipped bit loses at most a chunk,
/// about a second of four cameras.
const CHUNK_BYTES: u64 = 64 << 10;
const ZSTD_LEVEL: u32 = 3;

/// Origin of a recording; stored in its metadata with the version of this tool.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Provenance {
    /// The configuration, TOML.
    pub config: String,
    /// Hash of the manifold's weights; empty if none were used.
    pub weights: String,
    /// Other entries by name. They must not change from run to run, or the bytes differ.
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

/// A Protobuf message with a schema that is not ours.
pub struct Foreign {
    /// The topic; none of ours.
    pub topic: String,
    /// Full name of the schema.
    pub schema: String,
    /// The schema's serialised `FileDescriptorSet`.
    pub descriptor: Cow<'static, [u8]>,
    /// The capture time.
    pub at: Timestamp,
    /// The encoded message.
    pub payload: Vec<u8>,
}

/// Makes messages for other programs from ours.
pub trait Companion: Send {
    /// The messages that are written after this one of ours.
    fn follow(&mut self, topic: &str, message: &Message) -> Vec<Foreign>;

    /// The messages that are written at the end.
    fn end(&mut self) -> Vec<Foreign>;
}

struct OpenChannel {
    id: u16,
    sequence: u32,
    schema: String,
    encoding: String,
}

/// A recording that is being written beside its target, until [`Writer::finish`] renames it.
/// Dropped before that, it leaves nothing; a live recording leaves its part file.
pub struct Writer {
    path: PathBuf,
    topics: Topics,
    /// Channels by topic, usually one.
    channels: BTreeMap<String, Vec<OpenChannel>>,
    /// Number of channels.
    opened: usize,
    companion: Option<Box<dyn Companion>>,
    mcap: mcap::Writer<BufWriter<Target>>,
}

impl fmt::Debug for Writer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Writer").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Writer {
    /// Most channels of a recording: topics, times schemas of a topic. MCAP allows 65,535; so many
    /// are a fault of a publisher.
    pub const MOST_TOPICS: usize = 16_384;

    /// Starts a recording for `path`; [`Writer::finish`] replaces a file that is there. Write the frames of all cameras in
    /// order of capture time, not one camera after the other: a solve does not use frames that come too late.
    ///
    /// # Errors
    /// The folder is missing or not writable.
    pub fn create(
        path: impl AsRef<Path>,
        topics: Topics,
        provenance: &Provenance,
    ) -> Result<Self, RecordError> {
        let path = path.as_ref();
        let target = Target::temporary(path).map_err(RecordError::write(path))?;
        Self::start(path, target, topics, provenance)
    }

    /// Starts a live recording for `path`. Until it is finished it is at `path` with the suffix
    /// `.part`, where it can be read up to the last [`Writer::flush`], even if this process was
    /// killed.
    ///
    /// # Errors
    /// The folder is missing or not writable, or the part file exists.
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
        let (path, channels) = (path.to_owned(), BTreeMap::new());
        Ok(Self { path, topics, channels, opened: 0, companion: None, mcap })
    }

    /// From now on, also writes the messages that a companion makes from ours.
    #[must_use]
    pub fn with_companion(mut self, companion: Option<Box<dyn Companion>>) -> Self {
        self.companion = companion;
        self
    }

    /// Writes the calibration, valid from `at`.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn rig(&mut self, rig: &camera::Rig, at: Timestamp) -> Result<(), RecordError> {
        self.write(&self.topics.rig(), at, &Rig::from_core(rig))
    }

    /// Writes the detections of `camera` (its name) in an image of `image_size` pixels, width and
    /// height.
    ///
    /// # Errors
    /// As [`Writer::write`]; points that do not fit their format, or are not finite.
    pub fn keypoints(
        &mut self,
        detections: &Detections,
        camera: &str,
        image_size: [u32; 2],
    ) -> Result<(), RecordError> {
        if let Some(flaw) = detections.flaw() {
            let flaw = format!("camera {camera}, frame {}: {flaw}", detections.frame);
            let flaw = io::Error::new(io::ErrorKind::InvalidInput, flaw);
            return Err(RecordError::write(&self.path)(flaw));
        }
        let frame = KeypointFrame::from_core(detections, camera, image_size);
        self.write(&self.topics.keypoints(camera), detections.capture, &frame)
    }

    /// Writes a pose that was solved offline. Live poses use [`Writer::write`].
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

    /// Writes the body, valid from `at`.
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

    /// Writes a message of ours on any topic, with log time `at`. MCAP has no times before the epoch: the
    /// log time of such a message is 0, and the message holds its own time.
    ///
    /// # Errors
    /// The disk is full or fails.
    pub fn write<T: Schema>(
        &mut self,
        topic: &str,
        at: Timestamp,
        message: &T,
    ) -> Result<(), RecordError> {
        let payload = encode(message);
        self.log(topic, (&T::full_name(), Some(T::DESCRIPTOR)), ENCODING, [at; 2], &payload)?;
        let Some(companion) = &mut self.companion else { return Ok(()) };
        let decoded = Message::decode(topic, &T::full_name(), ENCODING, &payload);
        let foreign = decoded.map_or_else(|_| Vec::new(), |ours| companion.follow(topic, &ours));
        self.write_foreign(foreign)
    }

    fn write_foreign(&mut self, messages: Vec<Foreign>) -> Result<(), RecordError> {
        for Foreign { topic, schema, descriptor, at, payload } in messages {
            self.log(&topic, (&schema, Some(&descriptor)), ENCODING, [at; 2], &payload)?;
        }
        Ok(())
    }

    /// Writes an undecoded message: with the schema's descriptor if it is ours, otherwise without
    /// schema. Times before the epoch are written as 0.
    ///
    /// # Errors
    /// The disk is full or fails, or the topic is above [`Writer::MOST_TOPICS`].
    pub fn write_raw(&mut self, entry: &RawEntry) -> Result<(), RecordError> {
        let times = [entry.log_time, entry.publish_time];
        let schema = (&*entry.schema, descriptor(&entry.schema));
        self.log(&entry.topic, schema, &entry.encoding, times, &entry.payload)
    }

    /// `schema`: its full name, and its descriptor if that is known. `times`: log and publish time.
    fn log(
        &mut self,
        topic: &str,
        (schema, descriptor): (&str, Option<&[u8]>),
        encoding: &str,
        times: [Timestamp; 2],
        payload: &[u8],
    ) -> Result<(), RecordError> {
        let of_kind =
            |channel: &&mut OpenChannel| channel.schema == schema && channel.encoding == encoding;
        let open = self.channels.get_mut(topic);
        let (channel_id, sequence) = match open.and_then(|open| open.iter_mut().find(of_kind)) {
            Some(channel) => {
                channel.sequence = channel.sequence.wrapping_add(1);
                (channel.id, channel.sequence)
            }
            None if self.opened >= Self::MOST_TOPICS => {
                let (topic, most) = (topic.to_owned(), Self::MOST_TOPICS);
                return Err(RecordError::TooManyTopics { topic, most });
            }
            None => {
                let id = self.open_channel(topic, (schema, descriptor), encoding);
                (id.map_err(|error| write_error(&self.path, error))?, 0)
            }
        };
        let [log_time, publish_time] = times.map(|time| u64::try_from(time.ns()).unwrap_or(0));
        let header = MessageHeader { channel_id, sequence, log_time, publish_time };
        let written = self.mcap.write_to_known_channel(&header, payload);
        written.map_err(|error| write_error(&self.path, error))
    }

    fn open_channel(
        &mut self,
        topic: &str,
        (schema, descriptor): (&str, Option<&[u8]>),
        encoding: &str,
    ) -> Result<u16, McapError> {
        let schema_id = match descriptor {
            Some(descriptor) => self.mcap.add_schema(schema, SCHEMA_ENCODING, descriptor)?,
            None => 0,
        };
        let id = self.mcap.add_channel(schema_id, topic, encoding, &BTreeMap::new())?;
        let (schema, encoding) = (schema.to_owned(), encoding.to_owned());
        let open = self.channels.entry(topic.to_owned()).or_default();
        open.push(OpenChannel { id, sequence: 0, schema, encoding });
        self.opened += 1;
        Ok(id)
    }

    /// Closes the open chunk and passes all data to the system, so that it survives this process.
    ///
    /// # Errors
    /// The disk is full or fails.
    pub fn flush(&mut self) -> Result<(), RecordError> {
        self.mcap.flush().map_err(|error| write_error(&self.path, error))
    }

    /// Writes another metadata record.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub fn metadata(
        &mut self,
        name: &str,
        metadata: BTreeMap<String, String>,
    ) -> Result<(), RecordError> {
        let record = Metadata { name: name.into(), metadata };
        self.mcap.write_metadata(&record).map_err(|error| write_error(&self.path, error))
    }

    /// Completes the recording and moves it to its path.
    ///
    /// # Errors
    /// The disk is full or fails; the target is then unchanged.
    pub fn finish(mut self) -> Result<(), RecordError> {
        if let Some(mut companion) = self.companion.take() {
            self.write_foreign(companion.end())?;
        }
        let write = RecordError::write(&self.path);
        self.mcap.finish().map_err(|error| write_error(&self.path, error))?;
        let file = self.mcap.into_inner();
        let file = file.into_inner().map_err(|error| write(error.into_error()))?;
        file.persist(&self.path).map_err(&write)
    }
}

/// Sets every option that affects bytes, so that a new default cannot change them.
fn options() -> WriteOptions {
    WriteOptions::library(WriteOptions::new(), "bundlemocap")
        .compression(Some(Compression::Zstd))
        .compression_level(ZSTD_LEVEL)
        .compression_threads(0)
        .chunk_size(Some(CHUNK_BYTES))
        .profile("")
}

fn write_error(path: &Path, error: McapError) -> RecordError {
    let source = match error {
        McapError::Io(source) => source,
        other => io::Error::other(other),
    };
    RecordError::Write { path: path.to_owned(), source }
}
