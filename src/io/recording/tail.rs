//! Reads the index at the end of a file.

use std::collections::BTreeMap;
use std::io::{self, Read, Seek, SeekFrom};

use mcap::McapError;
use mcap::records::{Record, Statistics, op};
use mcap::sans_io::linear_reader::LinearReader;

use super::chunk::{drive, options};
use super::error::Damage;
use super::message::Channel;
use super::{INDEX_LIMIT, RECORD_LIMIT};

/// Opcode and length of a record.
pub(super) const RECORD_HEAD: u64 = 9;
/// The record before the summary, which holds a checksum.
const DATA_END: u64 = RECORD_HEAD + 4;
/// Footer record and closing magic.
const FOOTER: u64 = RECORD_HEAD + 20 + mcap::MAGIC.len() as u64;

/// Content of the index.
#[derive(Debug, Default)]
pub(super) struct Tail {
    pub channels: BTreeMap<u16, Channel>,
    pub statistics: Option<Statistics>,
    /// Offsets of the chunks, ascending.
    pub chunk_starts: Vec<u64>,
    /// Metadata records: offset and length.
    pub metadata: Vec<(u64, u64)>,
}

impl Tail {
    /// Offset of the first chunk after `offset`.
    pub fn chunk_after(&self, offset: u64) -> Option<u64> {
        let at = self.chunk_starts.partition_point(|&start| start <= offset);
        self.chunk_starts.get(at).copied()
    }

    fn visit(
        &mut self,
        schemas: &mut BTreeMap<u16, String>,
        record: Record<'_>,
    ) -> Result<(), McapError> {
        match record {
            Record::Schema { header, .. } => {
                schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                let schema = schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let ours = Channel::new(&channel.topic, &schema, &channel.message_encoding);
                self.channels.insert(channel.id, ours);
            }
            Record::Statistics(statistics) => self.statistics = Some(statistics),
            Record::ChunkIndex(index) => self.chunk_starts.push(index.chunk_start_offset),
            Record::MetadataIndex(index) => self.metadata.push((index.offset, index.length)),
            _ => {}
        }
        Ok(())
    }
}

/// Reads the end of a file of `size` bytes. The inner error says what is wrong with it; `None`
/// means that the file is complete but was written without an index.
pub(super) fn read_tail(
    file: &mut (impl Read + Seek),
    size: u64,
) -> io::Result<Result<Option<Tail>, Damage>> {
    let damage = |offset, reason: &str| Ok(Err(Damage { offset, reason: reason.to_owned() }));
    let Some(footer_at) = size.checked_sub(FOOTER) else {
        return damage(size, "the file ends too early");
    };
    let footer = read_at(file, footer_at, FOOTER)?;
    let Some((head, magic)) = footer.split_at_checked((FOOTER as usize) - mcap::MAGIC.len()) else {
        return damage(footer_at, "the file became shorter");
    };
    if magic != mcap::MAGIC || head[0] != op::FOOTER {
        return damage(footer_at, "the file does not end like a finished recording");
    }
    let Ok(Record::Footer(footer)) = mcap::parse_record(head[0], &head[RECORD_HEAD as usize..])
    else {
        return damage(footer_at, "the footer cannot be read");
    };
    let start = footer.summary_start;
    if start == 0 {
        return Ok(Ok(None));
    }
    if start <= DATA_END || start > footer_at || size - start > INDEX_LIMIT {
        let reason = format!("the footer puts the index at byte {start}, where it cannot be");
        return damage(footer_at, &reason);
    }
    let from = start - DATA_END;
    let bytes = read_at(file, from, size - from)?;
    Ok(parse(&bytes).map(Some).map_err(|error| Damage {
        offset: start,
        reason: format!("the index is damaged: {error}"),
    }))
}

/// Parses the index in `bytes`: the record that ends the data, the summary, footer and magic.
fn parse(bytes: &[u8]) -> Result<Tail, McapError> {
    let (mut tail, mut schemas) = (Tail::default(), BTreeMap::new());
    let options = options().with_validate_summary_section_crc(true).with_skip_end_magic(false);
    let mut reader = LinearReader::new_with_options(options);
    drive(&mut reader, bytes, |opcode, data| match opcode {
        op::ATTACHMENT => Ok(()),
        _ => tail.visit(&mut schemas, mcap::parse_record(opcode, data)?),
    })?;
    tail.chunk_starts.sort_unstable();
    Ok(tail)
}

/// Reads `length` bytes from `offset`; fewer at the end of the file.
fn read_at(file: &mut (impl Read + Seek), offset: u64, length: u64) -> io::Result<Vec<u8>> {
    file.seek(SeekFrom::Start(offset))?;
    let mut bytes = Vec::new();
    file.take(length).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// The metadata record at (offset, length), if there is one.
pub(super) fn read_metadata(
    file: &mut (impl Read + Seek),
    (offset, length): (u64, u64),
) -> io::Result<Option<mcap::records::Metadata>> {
    if length > RECORD_LIMIT as u64 {
        return Ok(None);
    }
    let bytes = read_at(file, offset, length)?;
    Ok(match bytes.split_at_checked(RECORD_HEAD as usize) {
        Some((head, body)) if head[0] == op::METADATA => match mcap::parse_record(head[0], body) {
            Ok(Record::Metadata(metadata)) => Some(metadata),
            _ => None,
        },
        _ => None,
    })
}
