//! Allowed ranges of the numbers of a configuration.

use std::ops::RangeInclusive;

/// A number that is out of its range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{key} is {value}, but must be {allowed}")]
pub struct OutOfRange {
    /// Name of the key.
    pub key: String,
    /// Its value.
    pub value: f64,
    /// The allowed range, in words.
    pub allowed: &'static str,
}

impl OutOfRange {
    /// The same error with the table in front of the key.
    pub fn in_table(self, table: &str) -> Self {
        Self { key: format!("{table}.{}", self.key), ..self }
    }
}

/// A key, its value, the allowed range, and that range in words.
pub struct Limit(pub &'static str, pub f64, pub RangeInclusive<f64>, pub &'static str);

impl Limit {
    /// A number that is above 0.
    pub fn above_0(key: &'static str, value: f64) -> Self {
        Self(key, value, f64::MIN_POSITIVE..=f64::MAX, "a number above 0")
    }

    /// A number that is not negative.
    pub fn from_0(key: &'static str, value: f64) -> Self {
        Self(key, value, 0.0..=f64::MAX, "0 or more")
    }

    /// A count from 0 to 1000.
    pub fn up_to_1000(key: &'static str, value: usize) -> Self {
        Self(key, value as f64, 0.0..=1e3, "0 to 1000")
    }

    /// A count from 1 to 1000.
    pub fn one_to_1000(key: &'static str, value: usize) -> Self {
        Self(key, value as f64, 1.0..=1e3, "1 to 1000")
    }

    /// A rate per second: 1 to 1000, or 0, which `allowed` explains.
    pub fn rate_or_0(key: &'static str, value: f64, allowed: &'static str) -> Self {
        let least = if value == 0.0 { 0.0 } else { 1.0 };
        Self(key, value, least..=1e3, allowed)
    }
}

/// Checks limits in order.
///
/// # Errors
/// The first number that is out of its range.
pub fn check(limits: impl IntoIterator<Item = Limit>) -> Result<(), OutOfRange> {
    let mut limits = limits.into_iter();
    match limits.find(|Limit(_, value, range, _)| !range.contains(value)) {
        Some(Limit(key, value, _, allowed)) => Err(OutOfRange { key: key.into(), value, allowed }),
        None => Ok(()),
    }
}
