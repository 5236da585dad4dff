//! When windows open and close.

use super::event::{Event, EventKind};
use super::port::Output;
use super::state_machine::{Phase, Tracker};
use super::waiting::Closing;
use crate::core::time::{Grid, Nanos, Timestamp};

/// Frame period if it cannot be measured, ns: that of 60 frames/s.
pub(in crate::core) const FALLBACK_PERIOD: f64 = 1e9 / 60.0;
/// A live tracker drops an open window that ended this long before the newest frames, and continues
/// with those. The limit is larger while the shape is estimated, and while a window waits for a silent camera.
const MAX_BACKLOG: Nanos = Nanos::SECOND;
/// The windows of the shape raise that limit to this at most.
const MAX_SHAPE: Nanos = Nanos::from_ms(10_000);
/// Live, frames wait this long until their rate is known.
const NO_RATE: Nanos = Nanos::from_ms(5000);

/// A window that is open.
#[derive(Clone, Copy, Debug)]
pub(super) struct Window {
    pub(super) start: Timestamp,
    pub(super) end: Timestamp,
    /// The solution is final up to here.
    pub(super) publish: Timestamp,
}

impl Tracker {
    /// Sends the job of the open window if the window is complete, else a provisional fit.
    pub(super) fn advance(&mut self) {
        if self.pending.is_some() || self.abandoned.is_some() {
            return;
        }
        self.skip_backlog();
        let Some(window) = self.open_window() else { return };
        if !self.is_closing && !self.try_close_window(window.end) {
            if let Some(end) = self.complete_until() {
                self.send_provisional(window, end);
            }
            return;
        }
        self.start = Some(window.start);
        // The newest pose first: the window's own solve takes longer.
        self.is_closing = self.is_newest(window.end) && self.send_provisional(window, window.end);
        if !self.is_closing {
            self.send_window(window);
        }
    }

    /// Whether the cameras are less than half a window after `end`.
    pub(super) fn is_newest(&self, end: Timestamp) -> bool {
        self.intake.front().is_none_or(|at| at - end < self.span() / 2)
    }

    /// Live: drops frames whose poses are too old to be of use, and searches again after them.
    fn skip_backlog(&mut self) {
        let front = self.intake.front_or_alone().filter(|_| self.live.is_some());
        let (Some(front), Some(start)) = (front, self.start) else {
            return;
        };
        let end = start + Nanos::new(self.frame_period() as i64) * self.open_frames() as i64;
        let shape = (self.span() * self.config.shape_windows as i64).min(MAX_SHAPE);
        let most = MAX_BACKLOG.max(shape).max(self.span() + self.grace());
        if self.ended || front - end <= most {
            return;
        }
        let until = front - self.span();
        let waiting = self.intake.up_to(until).len() as u64;
        self.close_until(until);
        self.phase = Phase::Searching;
        self.is_closing = false;
        self.start_windows_at(self.intake.first());
        if waiting > 0 && !self.is_resuming() {
            let detail = format!("{:.1} s behind, searching anew", front.seconds_since(end));
            self.counted_event(EventKind::Dropped, until, None, waiting, detail);
        }
    }

    /// Nominal frames of the open window: several windows as long as the shape is unknown.
    pub(super) fn open_frames(&self) -> usize {
        let is_first = matches!(self.phase, Phase::Searching) && self.skeleton.is_none();
        let windows = if is_first { self.config.shape_windows.max(1) } else { 1 };
        self.at_rate().window() * windows
    }

    /// Adopts the cameras' frame rate. While somebody is tracked, only at the start of a window, and
    /// only a significant change.
    pub(super) fn follow_rate(&mut self, start: Timestamp) {
        if self.config.frame_rate_hz > 0.0 {
            return;
        }
        let searching = matches!(self.phase, Phase::Searching);
        let Some(found) = self.intake.rate().period() else { return };
        if self.period.is_none_or(|old| found.differs_from(old) || (searching && found.ns != old)) {
            self.period = Some(found.ns);
            let mut grid = Grid { origin: start, period_ns: found.ns };
            if let Some(frame) = self.intake.first().filter(|_| !searching) {
                // A window that ends between two frames would wait for the second one.
                let off = frame - grid.time(grid.nearest(frame));
                if off.abs() > self.tolerance() {
                    grid.origin = start + off;
                }
            }
            self.frames = Some(grid);
            self.ahead.clear();
        }
    }

    /// Uses [`FALLBACK_PERIOD`] if the frame rate cannot be measured: at the end, or live after [`NO_RATE`].
    fn fall_back(&mut self) {
        let waiting = self.intake.first().zip(self.intake.newest());
        let is_long = |(first, newest): &(Timestamp, Timestamp)| *newest - *first > NO_RATE;
        let waiting = waiting.filter(|_| self.live.is_some()).filter(is_long);
        if self.period.is_some() || !(self.ended || waiting.is_some()) {
            return;
        }
        self.period = Some(FALLBACK_PERIOD);
        if let Some((_, newest)) = waiting.filter(|_| !self.ended) {
            self.close_until(newest - self.span());
            self.start = None;
        }
    }

    /// The open window, on the frame grid; `None` until a frame and the frame rate are known.
    fn open_window(&mut self) -> Option<Window> {
        if let Some(start) = self.start.or_else(|| self.intake.first())
            && matches!(self.phase, Phase::Searching)
        {
            self.follow_rate(start);
        }
        self.fall_back();
        let (start, period) = (self.start.or_else(|| self.intake.first())?, self.period?);
        if self.start.is_none() || self.frames.is_none() {
            self.frames = Some(Grid { origin: start, period_ns: period });
            self.first_output = Some(start);
        }
        let grid = self.frames?;
        let searching = matches!(self.phase, Phase::Searching);
        let first = grid.nearest(start);
        let full = grid.time(first + self.open_frames() as i64);
        let end = match self.intake.last() {
            None if self.ended || self.live.is_none() => return None,
            Some(last) if self.ended && last <= start + self.tolerance() && !searching => {
                return None;
            }
            // The last frame's nominal time, or its own if it is far from that.
            Some(last) if self.ended && !searching => {
                let nominal = grid.time(grid.nearest(last));
                let is_near = (nominal - last).abs() <= self.tolerance();
                full.min(if is_near { nominal } else { last })
            }
            _ => full,
        };
        let publish = match searching || end < full {
            true => end,
            false => grid.time(first + self.final_frames(first)),
        };
        Some(Window { start, end, publish })
    }

    /// Nominal frames that are final of the window that begins at that frame of the grid: fewer in the
    /// first window if windows are staggered, so that they end at other frames than others' do.
    fn final_frames(&self, first: i64) -> i64 {
        let config = self.at_rate();
        let (publish, keyframe) = (config.publish() as i64, config.keyframe() as i64);
        let stagger = self.stagger as i64 * keyframe % publish;
        let early = if stagger > 0 { (first + stagger).rem_euclid(publish) } else { 0 };
        publish - (early - early % keyframe)
    }

    /// Frames up to this long after a window's end belong to it: a quarter of the frame period.
    pub(super) fn tolerance(&self) -> Nanos {
        Nanos::new(self.period.map_or(0, |period| (period / 4.0) as i64))
    }

    /// How long after its end a window waits for late cameras: `deadline_frames` plus the usual
    /// delay, limited by the latency.
    pub(super) fn grace(&self) -> Nanos {
        let asked = (self.config.deadline_frames as f64 * self.frame_period()) as i64;
        self.longest_wait().unwrap_or(Nanos::MAX).min(Nanos::new(asked) + self.delay)
    }

    /// How long the latency lets a window wait after its end, once it is declared.
    pub(in crate::core) fn longest_wait(&self) -> Option<Nanos> {
        let latency = self.latency?;
        // The window's first pose is one output period after its start.
        let output = self.output_grid().map_or(0.0, |grid| grid.period_ns) as i64;
        let wait = match self.look_ahead() {
            Some(frames) => Nanos::rounded(frames as f64 * self.frame_period()),
            None => self.span() - Nanos::new(output),
        };
        Some((latency.declared - wait - latency.reserve).max(Nanos::ZERO))
    }

    /// Closes the window at `end` if all expected cameras have passed it or its deadline has
    /// passed. Returns whether it did. Reports the missing cameras.
    fn try_close_window(&mut self, end: Timestamp) -> bool {
        if self.is_fed {
            return self.ended || self.complete >= Some(end - self.tolerance());
        }
        let behind = self.behind(end);
        let waited_for = behind.iter().any(|&camera| self.intake.waiting.is_waited_for(camera));
        // The clock of one camera may be fast: live the node's clock counts, else a time that two cameras have reached.
        let clock = if self.live.is_some() { self.now } else { self.intake.front_or_alone() };
        let is_overdue = clock.max(self.now) >= Some(end + self.grace());
        let is_overdue = is_overdue && !(self.live.is_some() && self.is_starved());
        if !(self.ended || (!waited_for && self.intake.waiting.any()) || is_overdue) {
            return false;
        }
        if !self.ended {
            self.close_without(&behind, end);
        }
        true
    }

    /// Cameras that may still send frames of a window. Live, those whose next frame is expected before
    /// its end: free-running cameras have frames at any time. A recording waits until they have passed
    /// the end.
    fn behind(&self, end: Timestamp) -> Vec<usize> {
        if self.live.is_none() {
            return self.intake.behind(end - self.tolerance()).collect();
        }
        let period = Nanos::rounded(self.frame_period());
        let is_behind =
            |camera: &usize| self.intake.next(*camera, period) <= Some(end + self.tolerance());
        (0..self.rig.cameras.len()).filter(is_behind).collect()
    }

    /// Whether a frame of a camera should have arrived by now.
    fn is_late(&self, camera: usize) -> bool {
        let Some(now) = self.now.filter(|_| self.live.is_some()) else { return true };
        let next = self.intake.next(camera, Nanos::rounded(self.frame_period()));
        next.is_none_or(|next| now > next + self.delay + self.tolerance())
    }

    /// Reports the cameras that a window closes without, and stops waiting for those that stay
    /// silent. If all stop at once, that is no camera's fault.
    fn close_without(&mut self, behind: &[usize], end: Timestamp) {
        if self.live.is_some() && behind.len() == self.rig.cameras.len() {
            return;
        }
        let late: Vec<usize> = behind.iter().copied().filter(|&c| self.is_late(c)).collect();
        let closing = Closing { end, waited: self.grace(), what: "window" };
        let waiting = &mut self.intake.waiting;
        let events = waiting.close_without(behind, closing, |camera| late.contains(&camera));
        let window = Some(self.window);
        self.outputs.extend(events.into_iter().map(|e| Output::Event(Event { window, ..e })));
    }

    /// The capture time up to which frame sets are complete: all expected cameras have reached it,
    /// or the first cameras are one frame past it. Where poses come from provisional fits, frame sets
    /// wait no longer than windows do.
    fn complete_until(&self) -> Option<Timestamp> {
        if self.is_fed {
            return self.complete;
        }
        let waiting = &self.intake.waiting;
        let cameras = (0..self.rig.cameras.len()).filter(|&c| waiting.is_waited_for(c));
        let complete = cameras.map(|camera| self.intake.watermark(camera)).min().flatten();
        let front = self.intake.front();
        let moved_on = front.map(|at| at - Nanos::new(self.frame_period() as i64));
        let overdue =
            self.now.filter(|_| self.look_ahead().is_some()).map(|now| now - self.grace());
        complete.max(moved_on).max(overdue.min(front))
    }

    /// The next window begins at a given time or with the next frame; the grid begins again.
    pub(super) fn start_windows_at(&mut self, start: Option<Timestamp>) {
        self.start = start;
        self.ahead.clear();
        self.newest = None;
        if let (Some(origin), Some(period_ns)) = (start, self.period) {
            self.frames = Some(Grid { origin, period_ns });
            self.first_output = Some(origin);
        }
    }

    /// Drops the frames up to `end` and refuses later arrivals of that time.
    pub(super) fn close_until(&mut self, end: Timestamp) {
        for event in self.intake.close(end) {
            if self.is_fed {
                continue;
            }
            self.outputs.push_back(Output::Event(Event { window: Some(self.window), ..event }));
        }
    }
}
