//! Methods by name.

pub use crate::research::methods::{LADDER, NAMES, named};

/// The default methods for real recordings: triangulation, the paper's and ours.
pub const OURS: [&str; 3] = ["triangulation", "paper-body", "default"];

/// All names in tables, without duplicates.
pub fn known() -> Vec<&'static str> {
    let steps = LADDER.iter().filter(|name| !NAMES.contains(name));
    NAMES.iter().chain(steps).copied().collect()
}
