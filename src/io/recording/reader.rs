//! Reads a recording message by message.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::error::{RecordError, Report};
use super::message::{Channel, Entry, RawEntry};
use super::scan::{RawMessage, Scan};
use crate::core::time::Timestamp;

/// Returns the messages of a recording in the order of the file, which is the order of logging;
/// messages of different cameras are interleaved as written, not sorted. After the last one,
/// [`Reader::report`] is complete. Memory is bounded, see the module.
pub struct Reader {
    path: PathBuf,
    scan: Scan,
    done: bool,
}

impl fmt::Debug for Reader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Reader").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Reader {
    /// Opens a recording.
    ///
    /// # Errors
    /// The file cannot be read, is not MCAP, or has no channel of ours in its index.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, RecordError> {
        let path = path.as_ref();
        let read = RecordError::read(path);
        let mut file = File::open(path).map_err(&read)?;
        let mut magic = Vec::new();
        (&mut file).take(mcap::MAGIC.len() as u64).read_to_end(&mut magic).map_err(&read)?;
        if magic != mcap::MAGIC {
            let found = match magic.len() {
                0 => "it is empty".to_owned(),
                _ => format!("it begins with \"{}\"", magic.escape_ascii()),
            };
            return Err(RecordError::NotMcap { path: path.to_owned(), found });
        }
        let scan = Scan::new(file).map_err(&read)?;
        let reader = Self { path: path.to_owned(), scan, done: false };
        if reader.index_tells_all() {
            reader.require_channels()?;
        }
        Ok(reader)
    }

    /// Whether the index describes channels and schemas, so that it is complete.
    fn index_tells_all(&self) -> bool {
        let Ok(Some(tail)) = &self.scan.tail else { return false };
        !tail.channels.is_empty() && tail.channels.values().all(|c| !c.schema.is_empty())
    }

    /// Fails if all channels known so far are foreign.
    fn require_channels(&self) -> Result<(), RecordError> {
        if self.channels().any(|channel| channel.is_ours) {
            return Ok(());
        }
        let topics = self.channels().map(|channel| match &*channel.schema {
            "" => channel.topic.to_string(),
            schema => format!("{} ({schema})", channel.topic),
        });
        Err(RecordError::NoChannels { path: self.path.clone(), topics: topics.collect() })
    }

    /// Returns to the first message in the same open file; [`Reader::report`] is reset.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn rewind(&mut self) -> Result<(), RecordError> {
        self.done = false;
        self.scan.rewind().map_err(RecordError::read(&self.path))
    }

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Losses so far; complete after the last message.
    pub fn report(&self) -> &Report {
        &self.scan.report
    }

    /// Counts a message that the caller cannot use, for instance of an unknown camera.
    pub fn reject(&mut self, topic: &str, reason: &dyn std::fmt::Display) {
        self.scan.report.reject(topic, reason);
    }

    /// Metadata records by name: all of them if the file's index is good, otherwise those read so
    /// far. Ours is [`super::METADATA`].
    pub fn metadata(&self) -> &BTreeMap<String, BTreeMap<String, String>> {
        &self.scan.metadata
    }

    /// The value under `key` in our own metadata record, such as `config`; `None`: there is none.
    pub fn own_metadata(&self, key: &str) -> Option<&String> {
        self.metadata().get(super::METADATA)?.get(key)
    }

    pub(super) fn channels(&self) -> impl Iterator<Item = &Channel> {
        self.scan.channels.values()
    }

    pub(super) fn scan(&self) -> &Scan {
        &self.scan
    }

    /// The next message without decoding, valid or not, in the order of the file.
    ///
    /// # Errors
    /// As the iterator.
    pub fn next_raw(&mut self) -> Option<Result<RawEntry, RecordError>> {
        while !self.done {
            match self.scan.next_message() {
                Ok(Some(raw)) => {
                    if let Some(entry) = self.described(raw) {
                        return Some(Ok(entry));
                    }
                }
                Ok(None) => return self.end().map(Err),
                Err(source) => {
                    self.done = true;
                    return Some(Err(RecordError::Read { path: self.path.clone(), source }));
                }
            }
        }
        None
    }

    /// The message with the data of its channel, or `None` if the channel was lost.
    fn described(&mut self, raw: RawMessage) -> Option<RawEntry> {
        let Some(channel) = self.scan.channels.get(&raw.channel) else {
            let topic = format!("channel {}", raw.channel);
            self.scan.report.reject(&topic, &"its channel record was lost");
            return None;
        };
        let time = |ns| Timestamp::from_ns(i64::try_from(ns).unwrap_or(i64::MAX));
        Some(RawEntry {
            topic: channel.topic.clone(),
            schema: channel.schema.clone(),
            encoding: channel.encoding.clone(),
            log_time: time(raw.log_time),
            publish_time: time(raw.publish_time),
            payload: raw.data,
        })
    }

    /// The end: a complete file without messages of ours is an error.
    fn end(&mut self) -> Option<RecordError> {
        self.done = true;
        if self.scan.report.damage.is_empty() { self.require_channels().err() } else { None }
    }
}

impl Iterator for Reader {
    type Item = Result<Entry, RecordError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let raw = match self.next_raw()? {
                Ok(raw) => raw,
                Err(error) => return Some(Err(error)),
            };
            match raw.message() {
                Ok(message) => {
                    let RawEntry { topic, log_time, .. } = raw;
                    return Some(Ok(Entry { topic, log_time, message }));
                }
                Err(error) => self.scan.report.reject(&raw.topic, &error),
            }
        }
    }
}
