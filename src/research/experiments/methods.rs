//! Methods by name.

pub use crate::research::methods::named;

/// The paper's method and ours, the ones that real recordings are solved with if no others are
/// named.
pub const OURS: [&str; 2] = ["paper", "default"];

/// The names that [`named`] knows, in the order of the table.
pub fn names() -> Vec<String> {
    crate::research::methods::NAMES.iter().map(|&name| name.to_owned()).collect()
}
