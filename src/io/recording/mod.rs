//! Reads and writes recordings: MCAP files.
//!
//! [`Writer`] writes to a temporary file beside the target and renames it in `finish`. Equal input
//! gives equal bytes: log times are capture times, and no clock is read. A live recording
//! ([`Writer::live`]) is written to `FILE.part` instead, which survives a crash.
//!
//! [`Reader`] streams: it holds one chunk (at most 64 MiB) and the index at the end of the file.
//! It reads past damage where it can:
//! - truncated file: it returns every complete message before the end;
//! - chunk with a wrong checksum or content: it skips the whole chunk;
//! - broken record framing: it continues at the next chunk in the index at the end of the file;
//!   without an index it stops there.
//!
//! [`Report`] lists the losses with their byte offsets.

mod body;
mod chunk;
mod error;
mod info;
mod message;
mod reader;
mod scan;
mod span;
mod tail;
mod target;
mod writer;

pub use body::{body_file, body_files, known_people, last_body, write_body, write_body_file};
pub use error::{Damage, RecordError, Report, Undecodable};
pub use info::{CameraInfo, Info, TopicInfo, scan, summarise, summary};
pub use message::{Entry, Message, RawEntry};
pub use reader::Reader;
pub use span::Spans;
pub use target::part_of;
pub use writer::{Companion, Foreign, Provenance, Writer};

/// Name of our metadata record.
pub const METADATA: &str = "bundlemocap";
/// Name of the metadata record of a solve that has the capture time of the take's first frame as
/// `first_capture_time_ns`: the first pose may be later.
pub const TAKE: &str = "bundlemocap.take";
/// Longest record, packed or unpacked, that is read into memory, bytes.
const RECORD_LIMIT: usize = 64 << 20;
/// Largest index that is read, bytes. That of a recording of hours has many records.
const INDEX_LIMIT: u64 = 1 << 30;
