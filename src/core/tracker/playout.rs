//! When poses are published, and the replacement of a pose that is not solved in time.
//!
//! Offline, every pose is published as soon as it is solved. Live, the pose of capture time t is
//! due at t + the declared latency. Each time of the output grid gets a pose by its due time: if
//! it is not solved, the motion is extrapolated and the pose is flagged.
//!
//! A latency that is long enough for windows gives the poses of their solves. With a shorter one, the
//! poses come from the provisional fits, as many frames later as the latency allows.

use std::collections::BTreeSet;

use super::config::Config;
use super::event::EventKind;
use super::job::PoseAt;
use super::port::Output;
use super::published::Published;
use super::state_machine::{Phase, Tracker};
use super::window::Window;
use crate::core::body::{JointDeviations, Pose, StampedPose, TrackingState};
use crate::core::time::{Grid, Nanos, Timestamp};

/// A pose is extrapolated this long before its due time, so that its message arrives in time.
pub(super) const MARGIN: Nanos = Nanos::from_ms(3);
/// The times of a grid are rounded by less than this.
pub(super) const ROUNDING: Nanos = Nanos::new(1000);
/// Time constant of the decay of an extrapolated motion, seconds.
const DECAY: f64 = 0.1;
/// Time constant of the offset of provisional poses from the newest fit, seconds, at the reference
/// error of the detections times their confidence. Smaller errors need less smoothing.
const OFFSET_DECAY: f64 = 0.042;
/// A live tracker that is this far behind skips the poses in between.
const MAX_CATCH_UP: Nanos = Nanos::SECOND;

/// Settings of a live tracker.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Live {
    /// Whether the open window is fitted and its newest pose published as provisional.
    pub provisional: bool,
    /// Whether the cameras' time offsets are estimated and corrected.
    pub time_offsets: bool,
    /// Whether cameras that were moved are found and left out.
    pub watch_cameras: bool,
    /// Poses per second; 0: one for each nominal frame.
    pub output_rate_hz: f64,
}

/// The latency of a live tracker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Latency {
    /// From the capture of a pose to its publication.
    pub declared: Nanos,
    /// The share for solving and publishing: a window or a frame set closes at least this long
    /// before its first pose is due.
    pub reserve: Nanos,
    /// Frames after a pose that it waits for; `None`: all frames of its window.
    pub look_ahead: Option<usize>,
}

impl Latency {
    /// The smallest latency without delay: the least time to solve and publish a provisional fit.
    pub const LEAST: Nanos = Nanos::from_ms(6);
    /// Usual time to solve and publish a provisional fit.
    const FIT_RESERVE: Nanos = Nanos::from_ms(8);

    /// A declared latency with as much look-ahead as it allows. `wait` is the time from the first
    /// pose of a window to its end, `reserve` is the time to solve and publish a window, `delay`
    /// that from the capture of a frame to its arrival.
    pub fn new(
        declared: Nanos,
        [wait, reserve, delay]: [Nanos; 3],
        period: Nanos,
        config: &Config,
    ) -> Self {
        if declared >= wait + reserve + delay {
            return Self { declared, reserve, look_ahead: None };
        }
        let reserve = (declared - delay).clamp(Self::LEAST, Self::FIT_RESERVE);
        let frames = (declared - delay - reserve).ns() / period.ns().max(1);
        let config = config.at_period(period.ns() as f64);
        let most = config.window() - config.publish();
        Self { declared, reserve, look_ahead: Some((frames.max(0) as usize).min(most)) }
    }
}

/// The published poses, and the poses to extrapolate from.
#[derive(Clone, Debug, Default)]
pub(super) struct Playout {
    /// The capture time of the last final pose that was published.
    published: Option<Timestamp>,
    /// The first and the last time of the poses that were skipped last.
    skipped: Option<[Timestamp; 2]>,
    /// The known final poses, published or not.
    finals: Published,
    /// The published final poses.
    shown: Published,
    /// The provisional poses.
    provisionals: Published,
    /// Capture times of provisional poses without a final one yet.
    provisional: BTreeSet<Timestamp>,
    /// There are no poses until one is solved again: nothing came for long, or the latency fell.
    is_stopped: bool,
    /// Number of poses that were extrapolated because no solved pose was there in time.
    pub(super) extrapolated: u64,
    /// Number of poses that were solved after they were due.
    pub(super) missed: u64,
}

impl Playout {
    /// The last final pose, published or not, and its time.
    pub(super) fn last_final(&self) -> Option<&PoseAt> {
        self.finals.last()
    }

    /// Whether the final pose of a time replaces a provisional one. Call it once for each time, in
    /// order of time.
    fn supersedes(&mut self, capture: Timestamp) -> bool {
        let later = self.provisional.split_off(&capture);
        self.provisional = later;
        self.provisional.remove(&capture)
    }

    /// The last final pose begins a path: do not continue from the poses before it.
    pub(super) fn begin_path(&mut self) {
        self.finals.begin_path();
        self.shown.begin_path();
        self.forget_provisionals();
    }

    /// Poses stop until one is solved in time.
    pub(super) fn stop(&mut self) {
        self.is_stopped = true;
    }

    /// The provisional poses begin anew.
    pub(super) fn forget_provisionals(&mut self) {
        self.provisionals = Published::default();
    }

    /// The time of the next pose to publish.
    fn next(&self, grid: &Grid) -> Option<Timestamp> {
        self.published.map(|last| grid.time(grid.at_or_before(last + same_time(grid)) + 1))
    }

    /// Whether the pose of a time was published, perhaps at a time of another grid.
    fn is_published(&self, capture: Timestamp, grid: &Grid) -> bool {
        self.published.is_some_and(|last| last + same_time(grid) >= capture)
    }

    /// A pose at `capture`: interpolated towards the newest provisional pose, or else extrapolated
    /// from the known ones.
    fn extrapolate(&self, capture: Timestamp) -> Option<Pose> {
        let (at, last) = self.finals.last()?;
        let newest = self.provisionals.last().filter(|(newest, _)| newest > at);
        if let Some((newest_at, newest)) = newest {
            let s = capture.fraction(*at, *newest_at);
            return Some(last.interpolate(newest, s.clamp(0.0, 1.0)));
        }
        let Some((before_at, before)) = self.finals.before() else { return Some(last.clone()) };
        let step = at.seconds_since(*before_at);
        let ahead = capture.seconds_since(*at).max(0.0);
        let s = DECAY * (1.0 - libm::exp(-ahead / DECAY)) / step;
        Some(before.interpolate(last, 1.0 + s))
    }
}

/// Times less than this apart belong to the same pose.
fn same_time(grid: &Grid) -> Nanos {
    Nanos::new((grid.period_ns / 4.0) as i64)
}

impl Tracker {
    /// Publishes a final pose. Live, only if it is not overdue and its time has no pose.
    pub(super) fn publish_final(
        &mut self,
        capture: Timestamp,
        pose: &Pose,
        state: TrackingState,
        deviations: Option<JointDeviations>,
    ) {
        self.playout.finals.add(capture, pose);
        if self.live.is_some() {
            let Some(latency) = self.latency else { return };
            let is_due = self.now.is_some_and(|now| now > capture + latency.declared);
            let grid = self.output_grid();
            if is_due || grid.is_some_and(|grid| self.playout.is_published(capture, &grid)) {
                // A window's poses have been published before if the look-ahead is shorter. Skipped ones have been counted.
                let is_counted = |[first, last]: [Timestamp; 2]| (first..=last).contains(&capture);
                let is_shown = self.playout.published.is_some()
                    && !self.is_resuming()
                    && !self.playout.skipped.is_some_and(is_counted);
                self.playout.missed += u64::from(latency.look_ahead.is_none() && is_shown);
                return;
            }
        }
        self.push_pose(capture, pose.clone(), (state, deviations), false);
    }

    /// The frames after a pose that it waits for, where poses come from provisional fits.
    pub(super) fn look_ahead(&self) -> Option<usize> {
        self.latency.filter(|_| self.live.is_some())?.look_ahead
    }

    /// The times of the final poses of a provisional fit of `window` up to its end: those without a
    /// pose that have their look-ahead, or all but less than a frame of it.
    pub(super) fn final_times(&self, window: Window) -> Vec<Timestamp> {
        let (Some(frames), Some(grid)) = (self.look_ahead(), self.output_grid()) else {
            return Vec::new();
        };
        let ahead = |frames: usize| Nanos::rounded(frames as f64 * self.frame_period());
        let until = match frames {
            0 => window.end + ROUNDING,
            _ => window.end - ahead(frames - 1) - ROUNDING,
        };
        let published = self.playout.published.map(|last| last + same_time(&grid));
        let after = published.unwrap_or(until - Nanos::rounded(grid.period_ns));
        grid.between(after.max(window.start + same_time(&grid)), until).collect()
    }

    /// The times of a provisional fit's poses: its end and the final ones, and the last published
    /// ones before them.
    pub(super) fn fit_times(&self, window: Window) -> Vec<Timestamp> {
        let Playout { shown, provisionals, .. } = &self.playout;
        let before = shown.times().chain(provisionals.times());
        before.chain(self.final_times(window)).chain([window.end]).collect()
    }

    /// Publishes the poses of a provisional fit of `window` up to its end.
    pub(super) fn publish_fit(&mut self, window: Window, fit: &[PoseAt], state: TrackingState) {
        let noise = self.noise.factor(self.config.reference_residual_px);
        let decay = OFFSET_DECAY * libm::sqrt(noise.min(1.0));
        if let Some(newest) = self.playout.provisionals.continued(window.end, fit, decay) {
            self.publish_provisional(window.end, &newest, state);
        }
        // Fits revise poses with look-ahead less.
        let decay = decay / (1.0 + 0.5 * self.look_ahead().unwrap_or(0) as f64);
        for capture in self.final_times(window) {
            if let Some(pose) = self.playout.shown.continued(capture, fit, decay) {
                self.publish_final(capture, &pose, state, None);
            }
        }
    }

    /// Publishes a provisional pose of a live tracker, if enabled.
    pub(super) fn publish_provisional(
        &mut self,
        capture: Timestamp,
        pose: &Pose,
        state: TrackingState,
    ) {
        if self.live.is_some_and(|live| live.provisional) {
            self.playout.provisionals.add(capture, pose);
            self.playout.provisional.insert(capture);
            self.push_pose(capture, pose.clone(), (state, None), true);
        }
    }

    fn push_pose(
        &mut self,
        capture: Timestamp,
        pose: Pose,
        (state, deviations): (TrackingState, Option<JointDeviations>),
        provisional: bool,
    ) {
        if !provisional {
            (self.playout.published, self.playout.is_stopped) = (Some(capture), false);
            self.playout.shown.add(capture, &pose);
        }
        let supersedes = !provisional && self.playout.supersedes(capture);
        self.outputs.push_back(Output::Pose(Box::new(StampedPose {
            capture,
            pose,
            state,
            window: self.window,
            rig_version: self.rig.version,
            provisional,
            revision: u32::from(supersedes),
            deviations,
        })));
    }

    /// Repeats the last pose, flagged lost, at the pose times after `start` up to `end`.
    pub(super) fn repeat_last_pose(&mut self, start: Timestamp, end: Timestamp) {
        let last = self.playout.finals.last().map(|(_, pose)| pose.clone());
        let (Some(last), Some(grid)) = (last, self.output_grid()) else { return };
        for capture in grid.between(start, end) {
            self.publish_final(capture, &last, TrackingState::Lost, None);
        }
    }

    /// When the next pose is due, on the capture clock; `None` while no window is open.
    pub(super) fn due(&self) -> Option<Timestamp> {
        let start = self.start.filter(|_| !self.playout.is_stopped);
        let next = start.and(self.playout.next(&self.output_grid()?))?;
        Some(next + self.latency?.declared)
    }

    /// Live: extrapolates the poses that are due and not solved. While nothing comes to solve, that is
    /// no fault, and it ends after a while.
    pub(super) fn play(&mut self) {
        let (Some(now), Some(latency)) = (self.now, self.latency) else { return };
        while let Some(due) = self.due().filter(|due| *due <= now + MARGIN) {
            let capture = due - latency.declared;
            let is_idle = self.is_starved() || self.is_resuming();
            if is_idle
                && self.playout.finals.last().is_none_or(|(at, _)| capture - *at > self.coast())
            {
                return self.playout.stop();
            }
            if now - due > MAX_CATCH_UP {
                return self.skip_poses(capture, now - latency.declared);
            }
            let Some(pose) = self.playout.extrapolate(capture) else { return };
            let state = match self.phase {
                Phase::Searching => TrackingState::Lost,
                Phase::Tracking { .. } => TrackingState::Coasting,
            };
            self.playout.extrapolated += 1;
            if !is_idle {
                let detail = "not solved when due, extrapolated".to_owned();
                self.event(EventKind::Overdue, capture, None, detail);
            }
            self.push_pose(capture, pose, (state, None), false);
        }
    }

    /// How long a performer may be hidden.
    fn coast(&self) -> Nanos {
        let frames = self.config.coast_windows * self.at_rate().publish();
        Nanos::rounded(frames as f64 * self.frame_period())
    }

    /// Skips the poses from `capture` to `until`.
    fn skip_poses(&mut self, capture: Timestamp, until: Timestamp) {
        let grid = self.output_grid();
        let skipped = grid.map_or(1, |g| g.at_or_before(until) - g.at_or_before(capture) + 1);
        let skipped = skipped.max(1) as u64;
        let detail = "too far behind, skipped".to_owned();
        self.counted_event(EventKind::Overdue, capture, None, skipped, detail);
        self.playout.missed += skipped;
        (self.playout.published, self.playout.skipped) = (Some(until), Some([capture, until]));
    }
}
