//! Input and output: messages, recordings, the bus, files of other programs, the report.

pub mod bus;
pub mod formats;
pub(crate) mod new_file;
pub mod recording;
pub mod report;
pub mod timecode;
#[cfg(feature = "cli")]
pub mod vmc;
pub mod wire;
