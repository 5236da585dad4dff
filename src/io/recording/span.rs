//! Reads a part of a recording by time.

use std::fs::File;
use std::io::{self, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use mcap::sans_io::indexed_reader::{IndexedReadEvent, IndexedReader, IndexedReaderOptions};
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use mcap::{McapError, Summary};

use super::RECORD_LIMIT;
use super::error::RecordError;
use super::message::RawEntry;
use super::reader::Reader;
use crate::core::time::Timestamp;
use crate::io::stamp;

/// A recording of which any span of log time can be read. With an index only the chunks of the span are
/// read; a file without one, such as a cut one, is read from its beginning each time.
#[derive(Debug)]
pub struct Spans {
    path: PathBuf,
    index: Option<Summary>,
    /// When it was opened, see [`stamp`].
    stamp: Option<(SystemTime, u64)>,
}

impl Spans {
    /// Opens a recording.
    ///
    /// # Errors
    /// As [`Reader::open`].
    pub fn open(path: impl AsRef<Path>) -> Result<Self, RecordError> {
        let path = path.as_ref().to_owned();
        Reader::open(&path)?;
        let stamp = stamp(&path);
        let read = RecordError::read(&path);
        let index = index(&mut File::open(&path).map_err(&read)?).map_err(&read)?;
        let index = index.filter(|index| !index.chunk_indexes.is_empty());
        Ok(Self { index, stamp, path: path.clone() })
    }

    /// The messages whose log time is in `[from, to)` and whose topic is `wanted`, in the order of log time if the
    /// file has a good index. Damaged parts are left out.
    ///
    /// # Errors
    /// The file cannot be read, or has changed since it was opened.
    pub fn read(
        &self,
        [from, to]: [Timestamp; 2],
        wanted: impl Fn(&str) -> bool,
    ) -> Result<Vec<RawEntry>, RecordError> {
        // Without an index the file may grow meanwhile.
        if self.index.is_some() && stamp(&self.path) != self.stamp {
            let changed = io::Error::other("it has changed since it was opened; open it again");
            return Err(RecordError::read(&self.path)(changed));
        }
        let indexed = self.index.as_ref().map(|index| self.by_index(index, [from, to], &wanted));
        if let Some(all) = indexed.transpose()?.flatten() {
            return Ok(all);
        }
        let (mut reader, mut all) = (Reader::open(&self.path)?, Vec::new());
        while let Some(entry) = reader.next_raw() {
            let entry = entry?;
            if (from..to).contains(&entry.log_time) && wanted(&entry.topic) {
                all.push(entry);
            }
        }
        Ok(all)
    }

    /// The same by the index; `None` if a chunk is damaged.
    fn by_index(
        &self,
        index: &Summary,
        span: [Timestamp; 2],
        wanted: impl Fn(&str) -> bool,
    ) -> Result<Option<Vec<RawEntry>>, RecordError> {
        let topics = index.channels.values().map(|channel| channel.topic.clone());
        let topics: Vec<String> = topics.filter(|topic| wanted(topic)).collect();
        if topics.is_empty() {
            // The reader would take this for all topics.
            return Ok(Some(Vec::new()));
        }
        let [start, end] = span.map(|at| u64::try_from(at.ns()).unwrap_or(0));
        let options = IndexedReaderOptions::new()
            .include_topics(topics)
            .starting_at(start)
            .ending_before(end)
            .with_record_length_limit(RECORD_LIMIT);
        let read = RecordError::read(&self.path);
        let mut file = File::open(&self.path).map_err(&read)?;
        let Ok(mut reader) = IndexedReader::new_with_options(index, options) else {
            return Ok(None);
        };
        let (mut all, mut chunk) = (Vec::new(), Vec::new());
        while let Some(event) = reader.next_event() {
            match event {
                Ok(IndexedReadEvent::ReadChunkRequest { offset, length }) => {
                    file.seek(SeekFrom::Start(offset)).map_err(&read)?;
                    chunk.resize(length, 0);
                    match file.read_exact(&mut chunk) {
                        // The file is truncated.
                        Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(None),
                        read_all => read_all.map_err(&read)?,
                    }
                    if reader.insert_chunk_record_data(offset, &chunk).is_err() {
                        return Ok(None);
                    }
                }
                Ok(IndexedReadEvent::Message { header, data }) => {
                    let Some(channel) = index.channels.get(&header.channel_id) else { continue };
                    let schema = channel.schema.as_ref().map_or("", |schema| &schema.name);
                    let time = |ns| Timestamp::from_ns(i64::try_from(ns).unwrap_or(i64::MAX));
                    all.push(RawEntry {
                        topic: channel.topic.as_str().into(),
                        schema: schema.into(),
                        encoding: channel.message_encoding.as_str().into(),
                        log_time: time(header.log_time),
                        publish_time: time(header.publish_time),
                        payload: data.to_owned(),
                    });
                }
                Err(_) => return Ok(None),
            }
        }
        Ok(Some(all))
    }
}

/// The index at the end of a file; `None` if there is none, or it is damaged.
fn index(file: &mut File) -> io::Result<Option<Summary>> {
    let options = SummaryReaderOptions::default().with_record_length_limit(RECORD_LIMIT);
    let mut reader = SummaryReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event {
            Ok(SummaryReadEvent::ReadRequest(count)) => {
                let read = file.read(reader.insert(count))?;
                reader.notify_read(read);
            }
            Ok(SummaryReadEvent::SeekRequest(to)) => match file.seek(to) {
                Ok(at) => reader.notify_seeked(at),
                // It is shorter than the end of an index.
                Err(_) => return Ok(None),
            },
            Err(McapError::Io(error)) => return Err(error),
            Err(_) => return Ok(None),
        }
    }
    Ok(reader.finish())
}
