//! Frames of all cameras at about one time.

use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::intake::Intake;
use crate::core::tracker::waiting::Closing;
use crate::core::tracker::{Config, Event, FALLBACK_PERIOD, FramePeriod};

/// A set holds frames up to this part of the frame period after its first one.
const WIDTH: f64 = 0.8;

/// A set that is complete.
#[derive(Clone, Debug)]
pub(super) struct Complete {
    /// The earliest capture time.
    pub(super) at: Timestamp,
    /// In order of capture time, at most one of each camera.
    pub(super) frames: Vec<Detections>,
    /// All frames up to this time are in this set or in one before.
    pub(super) until: Timestamp,
}

/// The frames that wait for their set.
#[derive(Clone, Debug)]
pub(super) struct Sets {
    config: Config,
    intake: Intake,
    /// The capture clock, live.
    pub(super) now: Option<Timestamp>,
    /// Live: the usual time from the capture of a frame to its arrival, and the longest time that a set
    /// may wait.
    pub(super) delay: Nanos,
    pub(super) longest_wait: Option<Nanos>,
    /// What is to be reported.
    pub(super) events: Vec<Event>,
}

impl Sets {
    pub(super) fn new(cameras: usize, config: Config, period: Option<FramePeriod>) -> Self {
        let mut intake = Intake::new(cameras, config.grace_windows * config.publish_frames);
        intake.rate().know(period);
        Self {
            config,
            intake,
            now: None,
            delay: Nanos::ZERO,
            longest_wait: None,
            events: Vec::new(),
        }
    }

    /// Nominal frame period, ns.
    pub(super) fn period(&mut self) -> f64 {
        match self.config.frame_rate_hz {
            0.0 => self.intake.rate().period().map_or(FALLBACK_PERIOD, |period| period.ns),
            given => 1e9 / given,
        }
    }

    pub(super) fn intake(&mut self) -> &mut Intake {
        &mut self.intake
    }

    /// Adds a frame; its capture time becomes that of the cameras' common clock. Frames of cameras that
    /// the rig does not have are not used.
    pub(super) fn add(&mut self, mut frame: Detections, rig: &Rig) {
        let Some(camera) = rig.cameras.get(frame.camera) else { return };
        frame.capture = frame.capture + camera.time_offset;
        let grace = self.now.map(|_| self.grace());
        self.events.extend(self.intake.receive(frame, self.now, grace));
    }

    /// No more frames will come.
    pub(super) fn end(&mut self) {
        for frame in self.intake.release() {
            self.events.extend(self.intake.admit(frame, self.now, None));
        }
    }

    /// How long a set waits after its end.
    fn grace(&mut self) -> Nanos {
        let asked = Nanos::rounded(self.config.deadline_frames as f64 * self.period());
        self.longest_wait.unwrap_or(Nanos::MAX).min(asked + self.delay)
    }

    /// The next set that is complete or has waited long enough. With `all`, whatever is there.
    pub(super) fn next(&mut self, all: bool) -> Option<Complete> {
        let at = self.intake.first()?;
        let (width, grace) = (Nanos::rounded(WIDTH * self.period()), self.grace());
        let behind = self.behind(at, width);
        let waiting = &self.intake.waiting;
        let is_waiting = waiting.any() && behind.iter().any(|&c| waiting.is_waited_for(c));
        // One camera's clock may be fast: only what two have reached counts.
        let clock = if self.now.is_some() { self.now } else { self.intake.front_or_alone() };
        let is_overdue = clock >= Some(at + width + grace);
        if !all && is_waiting && !is_overdue {
            return None;
        }
        if !all {
            let closing = Closing { end: at + width, waited: grace, what: "frame set" };
            self.events.extend(self.intake.waiting.close_without(&behind, closing, |_| true));
        }
        let (frames, missing) = self.intake.pop_set(width);
        self.events.extend(missing);
        let last = frames.last().map_or(at, |frame| frame.capture);
        let until = self.intake.first().map_or(last, |next| last.min(next - Nanos::new(1)));
        Some(Complete { at, frames, until: until.max(at) })
    }

    /// Cameras that may still send a frame of the set. A recording waits until they have passed its
    /// first frame; live, those whose next frame is expected before its end.
    fn behind(&mut self, at: Timestamp, width: Nanos) -> Vec<usize> {
        if self.now.is_none() {
            return self.intake.behind(at).collect();
        }
        let (period, cameras) = (Nanos::rounded(self.period()), self.intake.cameras());
        let is_behind = |c: &usize| self.intake.next(*c, period) <= Some(at + width);
        (0..cameras).filter(is_behind).collect()
    }

    /// When the next set has waited long enough, live.
    pub(super) fn wake(&mut self) -> Option<Timestamp> {
        let at = self.intake.first().filter(|_| self.now.is_some())?;
        Some(at + Nanos::rounded(WIDTH * self.period()) + self.grace())
    }

    /// Forgets all frames, and the time: the clock may have stepped back. From here on there are that
    /// many cameras. Returns the intake of before.
    pub(super) fn clear(&mut self, cameras: usize) -> Intake {
        let period = self.intake.rate().period();
        let before = std::mem::replace(self, Self::new(cameras, self.config, period));
        (self.delay, self.longest_wait) = (before.delay, before.longest_wait);
        self.events = before.events;
        before.intake
    }
}
