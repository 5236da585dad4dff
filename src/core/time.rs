//! Capture times and durations.

use std::fmt;
use std::ops::{Add, Div, Mul, Neg, RangeInclusive, Sub};
use std::time::Duration;

use serde::{Deserialize, Serialize};

/// Valid times: the years 1684 to 2255 by the Unix epoch.
pub const TIMES_NS: RangeInclusive<i64> = -9_000_000_000_000_000_000..=9_000_000_000_000_000_000;

/// Nanoseconds since an epoch: that of the cameras, unless stated otherwise.
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

    /// The capture time of frame `index` at `fps` frames per second; frame 0 is at the epoch.
    pub fn of_frame(index: u64, fps: f64) -> Self {
        Self::default() + Nanos::of_frames(index, fps)
    }

    /// Where `self` lies from `start` (0) to `end` (1).
    pub fn fraction(self, start: Self, end: Self) -> f64 {
        (self - start).ns() as f64 / (end - start).ns().max(1) as f64
    }

    /// Seconds from `earlier` to `self`; negative if `self` is earlier.
    pub fn seconds_since(self, earlier: Self) -> f64 {
        (self - earlier).seconds()
    }
}

/// Saturates.
impl Add<Nanos> for Timestamp {
    type Output = Self;
    fn add(self, duration: Nanos) -> Self {
        Self(self.0.saturating_add(duration.0))
    }
}

/// Saturates.
impl Sub<Nanos> for Timestamp {
    type Output = Self;
    fn sub(self, duration: Nanos) -> Self {
        Self(self.0.saturating_sub(duration.0))
    }
}

/// Saturates.
impl Sub for Timestamp {
    type Output = Nanos;
    fn sub(self, earlier: Self) -> Nanos {
        Nanos(self.0.saturating_sub(earlier.0))
    }
}

/// A duration in whole nanoseconds; may be negative. Arithmetic saturates.
///
/// It prints as milliseconds with one decimal, or with the precision that is asked for.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[serde(transparent)]
pub struct Nanos(i64);

impl Nanos {
    /// No time.
    pub const ZERO: Self = Self(0);
    /// The longest duration.
    pub const MAX: Self = Self(i64::MAX);
    /// One second.
    pub const SECOND: Self = Self(1_000_000_000);

    /// From nanoseconds.
    pub const fn new(ns: i64) -> Self {
        Self(ns)
    }

    /// From milliseconds.
    pub const fn from_ms(ms: i64) -> Self {
        Self(ms.saturating_mul(1_000_000))
    }

    /// From fractional nanoseconds, rounded to the nearest.
    pub fn rounded(ns: f64) -> Self {
        Self(ns.round() as i64)
    }

    /// The length of `count` frames at `fps` frames per second.
    pub fn of_frames(count: u64, fps: f64) -> Self {
        Self::rounded(count as f64 * 1e9 / fps)
    }

    /// In nanoseconds.
    pub const fn ns(self) -> i64 {
        self.0
    }

    /// In milliseconds.
    pub fn ms(self) -> f64 {
        self.0 as f64 * 1e-6
    }

    /// In seconds.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Without its sign.
    pub const fn abs(self) -> Self {
        Self(self.0.saturating_abs())
    }
}

/// Saturates.
impl From<Duration> for Nanos {
    fn from(duration: Duration) -> Self {
        Self(i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX))
    }
}

impl fmt::Display for Nanos {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.*} ms", f.precision().unwrap_or(1), self.ms())
    }
}

impl Add for Nanos {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0.saturating_add(other.0))
    }
}

impl Sub for Nanos {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0.saturating_sub(other.0))
    }
}

impl Neg for Nanos {
    type Output = Self;
    fn neg(self) -> Self {
        Self(self.0.saturating_neg())
    }
}

impl Mul<i64> for Nanos {
    type Output = Self;
    fn mul(self, factor: i64) -> Self {
        Self(self.0.saturating_mul(factor))
    }
}

/// Division by zero gives zero.
impl Div<i64> for Nanos {
    type Output = Self;
    fn div(self, divisor: i64) -> Self {
        Self(self.0.checked_div(divisor).unwrap_or(0))
    }
}

/// The times `origin + round(k * period_ns)` for whole k.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// The time of k = 0.
    pub origin: Timestamp,
    /// Nanoseconds between two times, above 0.
    pub period_ns: f64,
}

impl Grid {
    /// The time with index `k`.
    pub fn time(&self, k: i64) -> Timestamp {
        self.origin + Nanos::rounded(k as f64 * self.period_ns)
    }

    /// The last k whose time is not after `time`.
    pub fn at_or_before(&self, time: Timestamp) -> i64 {
        let near = ((time - self.origin).ns() as f64 / self.period_ns).floor() as i64;
        (near - 1..=near + 1).rev().find(|&k| self.time(k) <= time).unwrap_or(near - 1)
    }

    /// The k whose time is nearest.
    pub fn nearest(&self, time: Timestamp) -> i64 {
        ((time - self.origin).ns() as f64 / self.period_ns).round() as i64
    }

    /// The times after `start`, up to `end`.
    pub fn between(&self, start: Timestamp, end: Timestamp) -> impl Iterator<Item = Timestamp> {
        let grid = *self;
        (grid.at_or_before(start) + 1..=grid.at_or_before(end)).map(move |k| grid.time(k))
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
        assert_eq!(far + Nanos::new(1), far);
        assert_eq!(far - Timestamp::from_ns(-1), Nanos::MAX);
        assert_eq!(-Nanos::new(i64::MIN), Nanos::MAX);
        assert_eq!(Timestamp::from_ns(500_000_000).seconds_since(Timestamp::default()), 0.5);
    }

    #[test]
    fn every_time_belongs_to_one_window_only() {
        let grid = Grid { origin: Timestamp::from_ns(-7), period_ns: 1e9 / 60.0 };
        let borders: Vec<Timestamp> = (-3..40).map(|k| grid.time(10 * k)).collect();
        let mut times = Vec::new();
        for pair in borders.windows(2) {
            let inside: Vec<_> = grid.between(pair[0], pair[1]).collect();
            assert_eq!(inside.len(), 10);
            assert_eq!(inside.last(), Some(&pair[1]));
            times.extend(inside);
        }
        assert!(times.is_sorted() && times.windows(2).all(|pair| pair[0] < pair[1]));
        assert_eq!(grid.nearest(grid.time(17) + Nanos::new(3)), 17);
    }
}
