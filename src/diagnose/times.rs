//! Capture times that are wrong.

use crate::core::time::{Nanos, Timestamp};

/// The clock of a camera beside the right one. Times are capture times, before the camera's time offset is added.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Clock {
    /// Its times are too late by this.
    pub(super) late: Nanos,
    /// It runs so many times as fast, from this time on.
    pub(super) rate: Option<(Timestamp, f64)>,
}

impl Clock {
    /// Its time at a right time.
    pub(super) fn of(&self, right: Timestamp) -> Timestamp {
        let run = |(from, rate): (Timestamp, f64)| {
            from + Nanos::rounded((right - from).ns() as f64 * rate)
        };
        self.rate.map_or(right, run) + self.late
    }

    /// The right time at its time.
    fn corrected(&self, own: Timestamp) -> Timestamp {
        let own = own - self.late;
        let run =
            |(from, rate): (Timestamp, f64)| from + Nanos::rounded((own - from).ns() as f64 / rate);
        self.rate.map_or(own, run)
    }

    /// A clock that is late by so much more.
    pub(super) fn later(self, late: Nanos) -> Self {
        Self { late: self.late + late, ..self }
    }
}

/// What is wrong with the capture times of a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct WrongTimes {
    pub(super) clock: Clock,
    /// `None`: all are wrong. Otherwise only those from a capture time on, or those before it.
    pub(super) only: Option<(Timestamp, Only)>,
}

/// A part of a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Only {
    Before,
    From,
}

impl WrongTimes {
    /// By how much they are late, if that is all.
    pub(crate) fn late(&self) -> Option<Nanos> {
        let is_shift = self.only.is_none() && self.clock.rate.is_none();
        is_shift.then_some(self.clock.late)
    }

    /// The right capture time of a frame.
    pub(crate) fn corrected(&self, capture: Timestamp) -> Timestamp {
        let is_wrong = self.only.is_none_or(|(at, only)| (capture < at) == (only == Only::Before));
        if is_wrong { self.clock.corrected(capture) } else { capture }
    }
}
