//! Input and output: messages, recordings, the bus, files of other programs, the report.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

pub mod bus;
pub mod formats;
pub(crate) mod new_file;
pub mod recording;
pub mod report;
pub mod timecode;
#[cfg(feature = "cli")]
pub mod vmc;
pub mod wire;

/// The last part of a path, for names and messages.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// A path with `ending` after its name: `take.mcap.part` of `take.mcap`.
pub(crate) fn with_ending(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(ending);
    name.into()
}

/// Time of a file's last change, and its length. `None`: there is no such file.
pub(crate) fn stamp(path: &Path) -> Option<(SystemTime, u64)> {
    let about = std::fs::metadata(path).ok()?;
    Some((about.modified().ok()?, about.len()))
}
