//! Frames in the order of their corrected capture times.

use std::collections::BTreeMap;

use crate::core::time::{Nanos, Timestamp};

/// Most frames that wait for those of other cameras.
const WAITING: usize = 50_000;
/// Frames of a recording are out of order by less than this.
const DISORDER: Nanos = Nanos::from_ms(2000);

/// Sorts the frames of cameras with time offsets.
pub(super) struct InOrder<T> {
    /// The newest corrected capture times, by camera.
    newest: Vec<Option<Timestamp>>,
    /// Most time between frames of two cameras that follow each other. `None`: it is not known.
    spread: Option<Nanos>,
    waiting: BTreeMap<(Timestamp, u64), T>,
    frames: u64,
}

impl<T> InOrder<T> {
    /// `offsets`: by camera. `is_known`: no times are wrong beside them.
    pub(super) fn new(offsets: &[Nanos], is_known: bool) -> Self {
        let spread = offsets.iter().max().zip(offsets.iter().min());
        let spread = spread.filter(|_| is_known).map(|(most, least)| *most - *least + DISORDER);
        let newest = vec![None; offsets.len()];
        Self { newest, spread, waiting: BTreeMap::new(), frames: 0 }
    }

    /// Adds a frame of a camera.
    pub(super) fn add(&mut self, camera: usize, corrected: Timestamp, frame: T) {
        self.newest[camera] = self.newest[camera].max(Some(corrected));
        self.waiting.insert((corrected, self.frames), frame);
        self.frames += 1;
    }

    /// The next frame, if no camera may have an earlier one. `all`: none has.
    pub(super) fn next(&mut self, all: bool) -> Option<T> {
        let (&(first, _), _) = self.waiting.first_key_value()?;
        let newest = self.newest.iter().flatten().max();
        let is_over = self.spread.zip(newest).is_some_and(|(spread, at)| first + spread <= *at);
        let is_next = all
            || is_over
            || self.waiting.len() > WAITING
            || self.newest.iter().all(|newest| *newest >= Some(first));
        is_next.then(|| self.waiting.pop_first()).flatten().map(|(_, frame)| frame)
    }
}
