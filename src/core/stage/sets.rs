//! Frames of all cameras at about one time.

use std::collections::BTreeMap;

use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{Config, FramePeriod, FrameRate};

/// A set holds frames up to this part of the frame period after its first one.
const WIDTH: f64 = 0.8;
/// A set waits for a camera that was in one of so many sets before.
const EXPECTED_SETS: u64 = 30;
/// Frame period until the cameras' rate is known, ns: 60 frames per second.
const FALLBACK_PERIOD: f64 = 1e9 / 60.0;

/// The frames that wait for their set.
#[derive(Clone, Debug)]
pub(super) struct Sets {
    waiting: BTreeMap<(Timestamp, usize, u64), Detections>,
    rate: FrameRate,
    config: Config,
    /// By camera: the capture time of its last frame, and the number of the last set with a frame of it.
    newest: Vec<Option<Timestamp>>,
    last_set: Vec<Option<u64>>,
    count: u64,
}

impl Sets {
    pub(super) fn new(cameras: usize, config: Config, period: Option<FramePeriod>) -> Self {
        let mut rate = FrameRate::new(cameras);
        rate.know(period);
        Self {
            waiting: BTreeMap::new(),
            rate,
            config,
            newest: vec![None; cameras],
            last_set: vec![None; cameras],
            count: 0,
        }
    }

    /// Nominal frame period, ns.
    pub(super) fn period(&self) -> f64 {
        match self.config.frame_rate_hz {
            0.0 => self.rate.period().map_or(FALLBACK_PERIOD, |FramePeriod { ns, .. }| ns),
            given => 1e9 / given,
        }
    }

    /// Adds a frame. Frames of cameras that the rig does not have are not used.
    pub(super) fn add(&mut self, frame: Detections, rig: &Rig) {
        let Some(camera) = rig.cameras.get(frame.camera) else { return };
        self.rate.note(frame.camera, frame.frame, frame.capture);
        let at = frame.capture + camera.time_offset;
        self.newest[frame.camera] = Some(at);
        self.waiting.insert((at, frame.camera, frame.frame), frame);
    }

    /// The next set that is complete or has waited long enough, and its time. With `all`, whatever is
    /// there. The frames are in order of capture time, at most one of each camera.
    pub(super) fn next(&mut self, all: bool) -> Option<(Timestamp, Vec<Detections>)> {
        let (first, ..) = *self.waiting.keys().next()?;
        let period = self.period();
        let end = first + Nanos::rounded(WIDTH * period);
        let deadline = end + Nanos::rounded(self.config.deadline_frames as f64 * period);
        let is_expected = |set: &Option<u64>| match self.count {
            0 => true,
            count => set.is_some_and(|set| count - set <= EXPECTED_SETS),
        };
        let mut keys: Vec<(Timestamp, usize, u64)> = Vec::new();
        for key in self.waiting.range(..=(end, usize::MAX, u64::MAX)).map(|(key, _)| *key) {
            if keys.iter().all(|(_, camera, _)| *camera != key.1) {
                keys.push(key);
            }
        }
        let is_behind = |camera: usize| self.newest[camera].is_none_or(|newest| newest < first);
        let cameras = 0..self.newest.len();
        let waits = || cameras.clone().any(|c| is_expected(&self.last_set[c]) && is_behind(c));
        if !all && waits() && !self.newest.iter().flatten().any(|newest| *newest > deadline) {
            return None;
        }
        for (_, camera, _) in &keys {
            self.last_set[*camera] = Some(self.count);
        }
        self.count += 1;
        Some((first, keys.iter().filter_map(|key| self.waiting.remove(key)).collect()))
    }

    /// Forgets all frames; from here on there are that many cameras.
    pub(super) fn clear(&mut self, cameras: usize) {
        *self = Self::new(cameras, self.config, self.rate.period());
    }
}
