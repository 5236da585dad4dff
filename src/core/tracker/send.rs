//! Jobs of windows and of provisional fits.

use std::sync::Arc;

use super::event::EventKind;
use super::job::{Job, Task};
use super::mending::Memory;
use super::port::Output;
use super::state_machine::{PendingJob, Phase, Tracker};
use super::window::Window;
use crate::core::calibration::Watchdog;
use crate::core::time::{Nanos, Timestamp};

/// Number of known keyframes of the open window that a provisional fit solves again with the new
/// ones, besides those of its look-ahead.
const SOLVED_AGAIN: usize = 3;

impl Tracker {
    /// Sends the job of a complete window: an acquisition or a solve.
    pub(super) fn send_window(&mut self, window: Window) {
        if self.use_next_rig() && !self.is_fed {
            let detail = format!("calibration {} from here on", self.rig.version);
            self.event(EventKind::Calibrated, window.start, None, detail);
        }
        let task = match &self.phase {
            Phase::Searching => Task::Acquire { skeleton: self.skeleton.clone() },
            Phase::Tracking { past, coasted } => {
                let Some(skeleton) = self.skeleton.clone() else { return };
                self.intake.refuse(window.publish + self.tolerance());
                let (past, coasted) = (past.clone(), *coasted);
                let (ahead, estimator) = (self.ahead.clone(), Arc::clone(&self.estimator));
                Task::Track { past, ahead, skeleton, estimator, coasted }
            }
        };
        self.send(window, task);
    }

    /// Uses the calibration that waits, if there is one. Returns whether there was.
    pub(in crate::core) fn use_next_rig(&mut self) -> bool {
        // This needs the calibration that waits, so it comes first.
        let left_out = self.left_out();
        let Some(rig) = self.next_rig.take() else { return false };
        let mut rig = Arc::unwrap_or_clone(rig);
        rig.shift_times(self.offsets.corrections());
        self.offsets.search_anew();
        self.watchdog = Watchdog::new(rig.cameras.len());
        self.mending.retain(|mending| left_out[mending.camera]);
        self.left_out = left_out;
        // A camera with a new pose has another view from here on.
        self.memory = Memory::default();
        self.rig = Arc::new(rig);
        true
    }

    /// Sends a provisional fit up to the last frame set that is complete at `complete_until`, if
    /// that set is new. Returns whether it did.
    pub(super) fn send_provisional(&mut self, window: Window, complete_until: Timestamp) -> bool {
        let Phase::Tracking { past, coasted: 0 } = &self.phase else { return false };
        let (Some(skeleton), Some(grid)) = (self.skeleton.clone(), self.frames) else {
            return false;
        };
        let is_needed = self.look_ahead().is_some();
        // Who has just entered catches up first.
        let is_behind = self.is_fed && self.is_resuming();
        let is_wanted = self.live.is_some_and(|live| live.provisional) && !is_behind;
        if !is_needed && (self.effort.provisional_iterations == 0 || !is_wanted) {
            return false;
        }
        let k = grid.at_or_before(complete_until + self.tolerance());
        // A late camera holds up the window, not the newest poses.
        let end = grid.time(k).min(window.end + self.span());
        let last = self.newest.unwrap_or(window.start).max(window.start);
        let from_start = k - grid.nearest(window.start);
        let stride = if is_needed { 1 } else { self.effort.stride.max(1) };
        if end <= last || from_start % stride as i64 != 0 {
            return false;
        }
        let look_ahead = self.look_ahead().unwrap_or(0).div_ceil(self.at_rate().keyframe());
        let again = SOLVED_AGAIN + look_ahead;
        let (past, ahead) = (past.clone(), self.ahead.clone());
        let task = Task::Provisional { past, ahead, skeleton, again };
        self.send(Window { end, publish: end, ..window }, task)
    }

    /// Sends the job of the open window, unless no frame has arrived yet. Returns whether it did.
    fn send(&mut self, window: Window, task: Task) -> bool {
        let Some(number) = self.push_job(window, task) else { return false };
        self.pending = Some(PendingJob { number, window });
        true
    }

    /// Sends a job, also one that no window waits for, unless no frame has arrived yet. Returns its number.
    pub(super) fn push_job(&mut self, window: Window, task: Task) -> Option<u64> {
        let format = self.intake.format()?;
        let number = self.jobs;
        self.jobs += 1;
        let pose_times = match (&task, self.output_grid()) {
            (Task::Provisional { .. }, _) => self.fit_times(window),
            (_, Some(grid)) => grid.between(window.start, window.publish).collect(),
            (_, None) => Vec::new(),
        };
        let mut frames = self.intake.up_to(window.end + self.tolerance());
        frames.retain(|frame| !self.is_left_out(frame.camera));
        self.outputs.push_back(Output::Solve(Box::new(Job {
            number,
            window: self.window,
            start: window.start,
            end: window.end,
            publish: window.publish,
            keyframe_times: self.keyframe_times(window),
            pose_times,
            frames,
            format,
            rig: Arc::clone(&self.rig),
            frame_period: Nanos::new((self.period.unwrap_or(0.0) / 2.0) as i64) * 2,
            effort: self.effort,
            noise: self.noise,
            task,
        })));
        Some(number)
    }

    /// The times of the window's keyframes.
    fn keyframe_times(&self, window: Window) -> Vec<Timestamp> {
        let Some(grid) = self.frames else { return vec![window.end] };
        let frames = self.at_rate().keyframe();
        let first = grid.nearest(window.start) + frames as i64;
        let on_grid = (first..).step_by(frames).map(|k| grid.time(k));
        let mut times: Vec<Timestamp> = on_grid.take_while(|time| *time < window.end).collect();
        times.push(window.end);
        times
    }
}
