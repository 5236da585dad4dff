//! Methods by name.

pub use crate::research::methods::named;

/// The default methods for real recordings: the paper's and ours.
pub const OURS: [&str; 2] = ["paper", "default"];

/// The names that [`named`] knows, in the order of the table.
pub fn names() -> Vec<String> {
    crate::research::methods::NAMES.iter().map(|&name| name.to_owned()).collect()
}
