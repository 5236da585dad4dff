//! Unpacks chunks.

use mcap::McapError;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::RECORD_LIMIT;

/// Options of every reader here: parts of a file, with a size limit.
pub(super) fn options() -> LinearReaderOptions {
    LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(RECORD_LIMIT)
}

/// Feeds `bytes` to `reader` and passes each record to `visit`.
pub(super) fn drive(
    reader: &mut LinearReader,
    mut bytes: &[u8],
    mut visit: impl FnMut(u8, &[u8]) -> Result<(), McapError>,
) -> Result<(), McapError> {
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                let (now, later) = bytes.split_at(wanted.min(bytes.len()));
                reader.insert(wanted)[..now.len()].copy_from_slice(now);
                reader.notify_read(now.len());
                bytes = later;
            }
            LinearReadEvent::Record { opcode, data } => visit(opcode, data)?,
        }
    }
    Ok(())
}

/// The schemas, channels and messages in a chunk record (`bytes`: opcode, length and body), and the
/// error that stopped the unpacking, if any. The checksum is checked last.
pub(super) fn unpack(bytes: &[u8]) -> (Vec<Record<'static>>, Option<McapError>) {
    let (mut records, mut unpacked) = (Vec::new(), 0);
    let mut reader = LinearReader::new_with_options(options());
    let result = drive(&mut reader, bytes, |opcode, data| {
        unpacked += data.len();
        if unpacked > RECORD_LIMIT {
            return Err(McapError::ChunkTooLarge(unpacked as u64));
        }
        if matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
            records.push(mcap::parse_record(opcode, data)?.into_owned());
        }
        Ok(())
    });
    (records, result.err())
}
