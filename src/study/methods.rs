//! Methods by name.

use crate::baseline::{Method, Windows};

/// The paper's method and ours, the ones that real recordings are solved with if no others are
/// named.
pub const OURS: [&str; 2] = ["paper", "default"];

/// The names that [`named`] knows, in the order of the table.
pub fn names() -> Vec<String> {
    OURS.map(str::to_owned).into()
}

/// The method of that name.
pub fn named(name: &str) -> Option<Box<dyn Method>> {
    match name {
        "paper" => Some(Box::new(Windows::paper())),
        "default" => Some(Box::new(Windows::default_settings())),
        _ => None,
    }
}
