//! Recordings: MCAP files in and out.
//!
//! [`Writer`] writes to a temporary file beside the target and renames it in `finish`. The same
//! input gives the same bytes: log times are capture times, nothing asks a clock. A live recording
//! ([`Writer::live`]) is written to `FILE.part` instead, which outlives a crash.
//!
//! [`Reader`] streams: it holds one chunk (at most 64 MiB) and the index at the end of the file.
//! Damage never ends a reading early where more can be had:
//! - a file that was cut: every whole message before the cut is given;
//! - a chunk whose check sum or content is wrong is skipped, all of it;
//! - where the record framing itself is broken, reading goes on at the next chunk that the index
//!   at the end of the file knows; without an index it ends there.
//!
//! What was lost is in [`Report`], each piece with its byte offset.

mod chunk;
mod error;
mod info;
mod message;
mod reader;
mod scan;
mod tail;
mod target;
mod writer;

pub use error::{Damage, RecordError, Report, Undecodable};
pub use info::{CameraInfo, Info, TopicInfo, scan, summarise, summary};
pub use message::{Entry, Message, RawEntry};
pub use reader::Reader;
pub use writer::{Provenance, Writer};

/// Name of our metadata record.
pub const METADATA: &str = "bundlemocap";
/// Longest record, packed or unpacked, that is read into memory; bytes.
const RECORD_LIMIT: usize = 64 << 20;
