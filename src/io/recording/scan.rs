//! Reads a file record by record, and continues after damage.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use mcap::records::{Metadata, Record, op};

use super::RECORD_LIMIT;
use super::chunk::unpack;
use super::error::{Damage, Report};
use super::message::Channel;
use super::tail::{RECORD_HEAD, Tail, read_metadata, read_tail};

/// A message as stored in the file.
pub(super) struct RawMessage {
    pub channel: u16,
    pub log_time: u64,
    pub publish_time: u64,
    pub data: Vec<u8>,
}

/// A file that is being read.
pub(super) struct Scan {
    file: BufReader<File>,
    size: u64,
    /// Offset of the next record.
    offset: u64,
    /// Whether the data section has ended and the (damaged) index follows.
    past_data: bool,
    done: bool,
    /// Opcode, length and body of the current record.
    record: Vec<u8>,
    pending: VecDeque<RawMessage>,
    schemas: BTreeMap<u16, String>,
    /// The index; the error says why it cannot be used.
    pub tail: Result<Option<Tail>, Damage>,
    pub channels: BTreeMap<u16, Channel>,
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    pub report: Report,
}

impl Scan {
    /// Starts after the magic bytes, which the caller has checked.
    pub fn new(file: File) -> io::Result<Self> {
        let size = file.metadata()?.len();
        let mut file = BufReader::with_capacity(1 << 17, file);
        let tail = read_tail(&mut file, size)?;
        let mut scan = Self {
            file,
            size,
            offset: mcap::MAGIC.len() as u64,
            past_data: false,
            done: false,
            record: Vec::new(),
            pending: VecDeque::new(),
            schemas: BTreeMap::new(),
            tail,
            channels: BTreeMap::new(),
            metadata: BTreeMap::new(),
            report: Report::default(),
        };
        scan.adopt_tail()?;
        scan.file.seek(SeekFrom::Start(scan.offset))?;
        Ok(scan)
    }

    /// Returns to the first message. Losses are reset; channels and metadata are kept.
    pub fn rewind(&mut self) -> io::Result<()> {
        self.offset = mcap::MAGIC.len() as u64;
        (self.past_data, self.done) = (false, false);
        self.pending.clear();
        self.report = Report::default();
        self.file.seek(SeekFrom::Start(self.offset)).map(drop)
    }

    /// Size of the file, bytes.
    pub fn size(&self) -> u64 {
        self.size
    }

    /// With a good index, channels and metadata are known from the start.
    fn adopt_tail(&mut self) -> io::Result<()> {
        let Ok(Some(tail)) = &self.tail else { return Ok(()) };
        self.channels = tail.channels.clone();
        for place in tail.metadata.clone() {
            if let Some(metadata) = read_metadata(&mut self.file, place)? {
                self.keep_metadata(metadata);
            }
        }
        Ok(())
    }

    fn keep_metadata(&mut self, metadata: Metadata) {
        self.metadata.insert(metadata.name, metadata.metadata);
    }

    /// The next message, in the order of the file.
    pub fn next_message(&mut self) -> io::Result<Option<RawMessage>> {
        loop {
            if let Some(message) = self.pending.pop_front() {
                return Ok(Some(message));
            }
            if self.done {
                return Ok(None);
            }
            self.step()?;
        }
    }

    /// Handles the record at `offset`.
    fn step(&mut self) -> io::Result<()> {
        self.read(RECORD_HEAD)?;
        if self.record.len() < RECORD_HEAD as usize {
            return self.cut("the file ends without a footer");
        }
        let (opcode, length) = head_of(&self.record);
        let left = self.size.saturating_sub(self.offset + RECORD_HEAD);
        if let Some(reason) = self.misframed(opcode, length, left) {
            return self.resume(reason);
        }
        if length > left {
            return self.cut_inside(opcode, left);
        }
        match opcode {
            op::DATA_END if self.tail.is_ok() => self.done = true,
            op::DATA_END => {
                self.past_data = true;
                self.skip(length)?;
            }
            op::FOOTER => self.finish(),
            op::CHUNK | op::SCHEMA | op::CHANNEL | op::MESSAGE | op::METADATA
                if !self.past_data =>
            {
                self.take(opcode, length)?;
            }
            _ => self.skip(length)?,
        }
        Ok(())
    }

    /// Why no record of that opcode and length can be at `offset`; `left` bytes follow its header.
    fn misframed(&self, opcode: u8, length: u64, left: u64) -> Option<String> {
        if matches!(opcode, 0 | 0x10..=0x7f) {
            return Some(format!("no record has the opcode {opcode:#04x}"));
        }
        let Ok(Some(tail)) = &self.tail else { return None };
        if opcode != op::CHUNK && tail.chunk_starts.binary_search(&self.offset).is_ok() {
            return Some(format!("opcode {opcode:#04x} where the index has a chunk"));
        }
        let next_chunk = tail.chunk_after(self.offset);
        if matches!(opcode, op::DATA_END | op::FOOTER) && next_chunk.is_some() {
            return Some(format!("opcode {opcode:#04x} where the index lists more chunks"));
        }
        let end = self.offset.saturating_add(RECORD_HEAD).saturating_add(length);
        (length > left || next_chunk.is_some_and(|next| end > next))
            .then(|| format!("a record of {length} bytes does not fit here"))
    }

    /// Continues at the next chunk in the index.
    fn resume(&mut self, reason: String) -> io::Result<()> {
        self.report.damaged(self.offset, reason);
        let next = self.tail.as_ref().ok().and_then(Option::as_ref);
        match next.and_then(|tail| tail.chunk_after(self.offset)) {
            Some(next) => {
                self.offset = next;
                self.file.seek(SeekFrom::Start(next))?;
            }
            None => self.done = true,
        }
        Ok(())
    }

    fn cut(&mut self, reason: &str) -> io::Result<()> {
        self.report.damaged(self.offset, reason);
        self.done = true;
        Ok(())
    }

    /// Ends the file inside a record, of which `left` bytes are present.
    fn cut_inside(&mut self, opcode: u8, left: u64) -> io::Result<()> {
        if opcode == op::CHUNK && left <= RECORD_LIMIT as u64 {
            self.read_more(left)?;
            let (records, _) = unpack(&self.record);
            self.accept(records);
        }
        self.cut("the file ends inside a record")
    }

    /// Handles the footer, which is reached only if the index or the end of the data is damaged.
    fn finish(&mut self) {
        if let Err(damage) = &self.tail {
            self.report.damage.push(damage.clone());
        }
        self.done = true;
    }

    fn take(&mut self, opcode: u8, length: u64) -> io::Result<()> {
        if length > RECORD_LIMIT as u64 {
            let reason = format!("a record of {length} bytes is longer than {RECORD_LIMIT}");
            self.report.damaged(self.offset, reason);
            return self.skip(length);
        }
        self.read_more(length)?;
        let result = if opcode == op::CHUNK {
            let (records, error) = unpack(&self.record);
            error.map_or_else(|| Ok(records), Err)
        } else {
            let body = &self.record[RECORD_HEAD as usize..];
            mcap::parse_record(opcode, body).map(|record| vec![record.into_owned()])
        };
        match result {
            Ok(records) => self.accept(records),
            // Its length may also be wrong; the index is more reliable.
            Err(error) if opcode == op::CHUNK && matches!(self.tail, Ok(Some(_))) => {
                return self.resume(format!("chunk skipped: {error}"));
            }
            Err(error) if opcode == op::CHUNK => {
                self.report.damaged(self.offset, format!("chunk skipped: {error}"));
            }
            Err(error) => self.report.damaged(self.offset, error),
        }
        self.offset += RECORD_HEAD + length;
        Ok(())
    }

    fn accept(&mut self, records: Vec<Record<'static>>) {
        for record in records {
            match record {
                Record::Schema { header, .. } => {
                    self.schemas.insert(header.id, header.name);
                }
                Record::Channel(channel) => {
                    self.learn(&channel);
                }
                Record::Message { header, data } => self.pending.push_back(RawMessage {
                    channel: header.channel_id,
                    log_time: header.log_time,
                    publish_time: header.publish_time,
                    data: data.into_owned(),
                }),
                Record::Metadata(metadata) => self.keep_metadata(metadata),
                _ => {}
            }
        }
    }

    /// Stores a channel; the data section has priority over the index, unless the schema was lost.
    fn learn(&mut self, channel: &mcap::records::Channel) {
        let schema = self.schemas.get(&channel.schema_id).cloned();
        let known = schema.is_some() || channel.schema_id == 0;
        if known || !self.channels.contains_key(&channel.id) {
            let encoding = &channel.message_encoding;
            let ours = Channel::new(&channel.topic, &schema.unwrap_or_default(), encoding);
            self.channels.insert(channel.id, ours);
        }
    }

    /// Replaces `record` by the next `length` bytes, fewer at the end of the file.
    fn read(&mut self, length: u64) -> io::Result<()> {
        self.record.clear();
        self.read_more(length)
    }

    fn read_more(&mut self, length: u64) -> io::Result<()> {
        (&mut self.file).take(length).read_to_end(&mut self.record).map(drop)
    }

    fn skip(&mut self, length: u64) -> io::Result<()> {
        self.offset += RECORD_HEAD + length;
        self.file.seek(SeekFrom::Start(self.offset)).map(drop)
    }
}

/// Opcode and length of a record.
fn head_of(record: &[u8]) -> (u8, u64) {
    let mut length = [0; 8];
    length.copy_from_slice(&record[1..RECORD_HEAD as usize]);
    (record[0], u64::from_le_bytes(length))
}
