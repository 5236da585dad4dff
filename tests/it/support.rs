//! What the tests share: the folder of real data, and the count of skipped tests.

use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};

/// A folder of the real data; `None`, with a line, where there is no data at all.
///
/// # Panics
/// The data is there, but not this folder.
pub fn data(folder: &str) -> Option<PathBuf> {
    let root = std::env::var_os("BUNDLEMOCAP_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    if !root.is_dir() {
        skipped(&format!("no data in {}; set BUNDLEMOCAP_DATA", root.display()));
        return None;
    }
    let folder = root.join(folder);
    assert!(folder.is_dir(), "{} is not there; see BUNDLEMOCAP_DATA", folder.display());
    Some(folder.canonicalize().unwrap())
}

/// Says that a test is skipped, and why: on the screen, and in the file that CI counts lines of.
pub fn skipped(reason: &str) {
    println!("skipped: {reason}");
    if let Some(file) = std::env::var_os("BUNDLEMOCAP_SKIPPED") {
        let mut file = OpenOptions::new().create(true).append(true).open(file).unwrap();
        writeln!(file, "{reason}").unwrap();
    }
}
