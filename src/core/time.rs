//! Capture time.

use std::ops::{Add, Sub};

use serde::{Deserialize, Serialize};

/// Nanoseconds since the common epoch of the recording's cameras. Never a processing time.
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

    /// The capture time of frame `index` at `fps` frames per second, rounded to the nanosecond.
    pub fn of_frame(index: u64, fps: f64) -> Self {
        Self((index as f64 * 1e9 / fps).round() as i64)
    }

    /// Seconds from `earlier` to `self`; negative if `self` is earlier.
    pub fn seconds_since(self, earlier: Self) -> f64 {
        (self - earlier) as f64 * 1e-9
    }
}

/// Adds nanoseconds; saturates.
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
        self.origin + (k as f64 * self.period_ns).round() as i64
    }

    /// The last k whose time is not after `time`.
    pub fn at_or_before(&self, time: Timestamp) -> i64 {
        let near = ((time - self.origin) as f64 / self.period_ns).floor() as i64;
        (near - 1..=near + 1).rev().find(|&k| self.time(k) <= time).unwrap_or(near - 1)
    }

    /// The k whose time is nearest.
    pub fn nearest(&self, time: Timestamp) -> i64 {
        ((time - self.origin) as f64 / self.period_ns).round() as i64
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
        assert_eq!(far + 1, far);
        assert_eq!(far - Timestamp::from_ns(-1), i64::MAX);
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
        assert_eq!(grid.nearest(grid.time(17) + 3), 17);
    }
}
