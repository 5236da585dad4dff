//! Frames in the order of their corrected capture times.

use std::collections::BTreeMap;

use crate::core::time::{Nanos, Timestamp};

/// Most frames that wait for those of other cameras.
const WAITING: usize = 50_000;

/// Sorts the frames of cameras with time offsets.
pub(super) struct InOrder<T> {
    /// By camera.
    offsets: Vec<Nanos>,
    /// The newest corrected capture times, by camera.
    newest: Vec<Option<Timestamp>>,
    waiting: BTreeMap<(Timestamp, u64), T>,
    frames: u64,
}

impl<T> InOrder<T> {
    pub(super) fn new(offsets: Vec<Nanos>) -> Self {
        Self { newest: vec![None; offsets.len()], offsets, waiting: BTreeMap::new(), frames: 0 }
    }

    /// Adds a frame of a camera.
    pub(super) fn add(&mut self, camera: usize, capture: Timestamp, frame: T) {
        let corrected = capture + self.offsets[camera];
        self.newest[camera] = self.newest[camera].max(Some(corrected));
        self.waiting.insert((corrected, self.frames), frame);
        self.frames += 1;
    }

    /// The next frame, if no camera may have an earlier one. `all`: none has.
    pub(super) fn next(&mut self, all: bool) -> Option<T> {
        let (&(first, _), _) = self.waiting.first_key_value()?;
        // A camera may have no frames for a while.
        let is_next = all
            || self.waiting.len() > WAITING
            || self.newest.iter().all(|newest| *newest >= Some(first));
        is_next.then(|| self.waiting.pop_first()).flatten().map(|(_, frame)| frame)
    }
}
