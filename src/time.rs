//! Capture time.

use std::ops::{Add, Sub};

use serde::{Deserialize, Serialize};

/// Nanoseconds since an epoch that the recording's cameras share. Never a processing time.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[serde(transparent)]
pub struct Timestamp(i64);

impl Timestamp {
    /// From nanoseconds.
    pub const fn from_ns(ns: i64) -> Self {
        Self(ns)
    }

    /// Nanoseconds since the epoch.
    pub const fn ns(self) -> i64 {
        self.0
    }

    /// The capture time of frame `index` at `fps` frames a second, rounded to the nanosecond.
    pub fn of_frame(index: u64, fps: f64) -> Self {
        Self((index as f64 * 1e9 / fps).round() as i64)
    }

    /// Seconds from `earlier` to `self` (negative if `self` is the earlier one).
    pub fn seconds_since(self, earlier: Self) -> f64 {
        (self - earlier) as f64 * 1e-9
    }
}

/// Later by a number of nanoseconds; saturates.
impl Add<i64> for Timestamp {
    type Output = Self;
    fn add(self, ns: i64) -> Self {
        Self(self.0.saturating_add(ns))
    }
}

/// Nanoseconds between two stamps; saturates.
impl Sub for Timestamp {
    type Output = i64;
    fn sub(self, earlier: Self) -> i64 {
        self.0.saturating_sub(earlier.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_placed_to_the_nanosecond() {
        assert_eq!(Timestamp::of_frame(0, 60.0).ns(), 0);
        assert_eq!(Timestamp::of_frame(60, 60.0).ns(), 1_000_000_000);
        assert_eq!(Timestamp::of_frame(1, 60.0).ns(), 16_666_667);
    }

    #[test]
    fn arithmetic_saturates() {
        let far = Timestamp::from_ns(i64::MAX);
        assert_eq!(far + 1, far);
        assert_eq!(far - Timestamp::from_ns(-1), i64::MAX);
        assert_eq!(Timestamp::from_ns(500_000_000).seconds_since(Timestamp::default()), 0.5);
    }
}
