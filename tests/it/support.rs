//! What the tests share: the folder of real data, the count of skipped tests, and pinned numbers.

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

/// Checks a number against the measured one. Both are the same in every run, so 4 % of slack is
/// enough. Update `measured` after a larger change, also after an improvement.
#[cfg(feature = "research")]
pub fn pinned(what: &str, value: f64, measured: f64) {
    let change = value / measured - 1.0;
    assert!(change.abs() < 0.04, "{what} is {value:.3}, {measured} was measured before");
}
