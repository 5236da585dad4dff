//! What the core says and does about clocks and delays.

use super::Core;
use crate::core::stage;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::EventKind;
use crate::live::clock::camera::LeftOut;

/// The largest correction of capture times, milliseconds.
const MOST_CORRECTION_MS: f64 = 60_000.0;

/// After a step back by more, tracking begins anew.
const FAR: Nanos = Nanos::from_ms(250);

impl Core {
    /// The cameras' clock has stepped by `by` (0: another one was chosen at the start): tracking
    /// begins anew.
    pub(super) fn new_clock(&mut self, by: Nanos) {
        self.give(stage::Input::ClockJumped(-by));
        self.forget_due_times();
        if by != Nanos::ZERO {
            let (by, kind) = (-by.seconds(), self.clock.told());
            let detail = format!("stepped by {by:+.3} s, tracking begins anew; {kind}");
            self.event(EventKind::ClockJump, None, detail);
        }
    }

    /// The due times of the poses so far are of another clock.
    pub(super) fn forget_due_times(&mut self) {
        for performer in &mut self.performers {
            performer.leaves = Timestamp::default();
        }
    }

    /// What is added to the capture times of a camera, beyond its calibration.
    pub(super) fn time_correction(&self, camera: usize) -> Nanos {
        let corrections = self.stage.as_ref().map(stage::Stage::time_corrections);
        corrections.and_then(|all| all.get(camera)).copied().unwrap_or_default()
    }

    /// What is added to the capture times of a camera: the offset of the calibration and the correction.
    pub(super) fn time_offset(&self, camera: usize) -> Nanos {
        let rig = self.stage.as_ref().map(stage::Stage::rig);
        let known = rig.and_then(|rig| rig.cameras.get(camera)).map(|camera| camera.time_offset);
        known.unwrap_or_default()
    }

    /// Corrects the capture times of a camera by so many milliseconds, in place of the correction so far. Returns what
    /// was done.
    pub(super) fn correct_times(&mut self, name: &str, ms: f64) -> Result<String, String> {
        let camera = self.cameras.iter().position(|camera| camera.name() == name);
        let camera = camera.ok_or_else(|| format!("no camera has the name {name:?}"))?;
        if ms.is_nan() || ms.abs() > MOST_CORRECTION_MS {
            return Err(format!("{ms} ms is too much; at most {MOST_CORRECTION_MS} ms"));
        }
        if ms == 0.0 {
            self.undo_lowering(camera);
        }
        self.set_correction(camera, Nanos::rounded(ms * 1e6));
        let detail = format!("{ms:+.1} ms are added to its capture times from now on");
        self.event(EventKind::TimeOffset, Some(name), detail.clone());
        Ok(format!("{name}: {detail}"))
    }

    /// The correction of a camera is undone. If those of all others are below zero, they were lowered with it: they are
    /// raised until the largest is zero.
    fn undo_lowering(&mut self, undone: usize) {
        let others: Vec<usize> = (0..self.cameras.len()).filter(|&one| one != undone).collect();
        let most = others.iter().map(|&camera| self.time_correction(camera)).max();
        let Some(by) = most.filter(|most| *most < Nanos::ZERO) else { return };
        self.lower_corrections(&others, by);
        let detail =
            format!("the corrections of the other cameras are raised by {:.1} ms", -by.ms());
        self.event(EventKind::TimeOffset, None, detail);
    }

    fn lower_corrections(&mut self, cameras: &[usize], by: Nanos) {
        for &camera in cameras {
            self.set_correction(camera, self.time_correction(camera) - by);
        }
        if by.abs() > FAR {
            // Otherwise all frames would be late until the last solved frame is reached again.
            self.give(stage::Input::ClockJumped(-by));
            self.forget_due_times();
        }
    }

    /// If a correction makes the frames of a camera come before their capture time, the other cameras are late: all
    /// corrections are lowered by as much.
    fn keep_frames_after_capture(&mut self) {
        let Some(by) = self.clock.too_early() else { return };
        self.lower_corrections(&(0..self.cameras.len()).collect::<Vec<_>>(), by);
        let detail = format!(
            "all corrections are lowered by {:.1} ms: no frame comes before its capture",
            by.ms()
        );
        self.event(EventKind::TimeOffset, None, detail);
    }

    fn set_correction(&mut self, camera: usize, correction: Nanos) {
        // Frames that were given have the times from before.
        self.drain();
        if let Some(stage) = &mut self.stage {
            stage.correct_times(camera, correction);
        }
        self.clock.correct(camera, self.time_offset(camera));
    }

    /// Reports single frames with a wrong time.
    pub(super) fn report_strays(&mut self) {
        for (camera, by, count) in self.clock.take_strays() {
            let Some(name) = self.cameras.get(camera).map(|c| c.name().to_owned()) else {
                continue;
            };
            let detail = format!("not used: {} the clock", off_by(by));
            self.events(EventKind::ClockJump, Some(&name), count.into(), detail);
        }
    }

    /// After each quarter of a second: cameras that are too late, the usual delay, and whether the
    /// latency allows for it.
    pub(super) fn review_delays(&mut self) {
        if !self.clock.takes_review() {
            return;
        }
        self.clock.leave_out_late();
        if let Some(by) = self.clock.absorb_delay() {
            self.new_clock(by);
        }
        self.raise_latency();
        let delay = self.clock.usual_delay();
        if let Some(stage) = &mut self.stage {
            stage.set_delay(delay);
        }
    }

    /// Once a second: reports people who are above the number of performers.
    pub(super) fn watch_crowd(&mut self) {
        let others = self.stage.as_ref().map_or(0, stage::Stage::others);
        if others > std::mem::replace(&mut self.others, others) {
            let fix = match self.count_followed() < self.settings.stage.performers.limit() {
                true => "`bundlemocap take follow X,Z` makes one a performer",
                false => "raise [stage] performers; if nobody else is there, check the cameras",
            };
            let detail = format!("{others} more people were seen, not solved; {fix}");
            self.event(EventKind::Crowd, None, detail);
        }
    }

    /// Once a second: keeps frames after their capture, and reports the kind of the clock, cameras that are left out,
    /// and those whose clocks are off from the others' by more than a quarter of a frame period.
    pub(super) fn watch_clocks(&mut self) {
        self.keep_frames_after_capture();
        if let Some(detail) = self.clock.news(self.now) {
            self.event(EventKind::Clock, None, detail);
        }
        for (camera, why) in self.clock.take_left_out() {
            let Some(known) = self.cameras.get_mut(camera) else { continue };
            known.is_off = false;
            let name = known.name().to_owned();
            let detail = match why {
                None => "its frames agree with the other cameras' again and are used".to_owned(),
                Some(LeftOut::Clock(by)) => {
                    format!("left out until it agrees: {} the other cameras'", off_by(by))
                }
                Some(LeftOut::Late(by)) => format!(
                    "left out: its frames come {by:.0} after the other cameras', too late to wait for"
                ),
            };
            self.event(EventKind::ClockOffset, Some(&name), detail);
        }
        let Some(stage) = &mut self.stage else { return };
        let quarter = stage.frame_period() * 0.25e-9;
        for (camera, off) in self.clock.deviations() {
            let Some(known) = self.cameras.get_mut(camera) else { continue };
            let limit = if known.is_off { 0.5 * quarter } else { quarter };
            if (off.abs() > limit) == known.is_off {
                continue;
            }
            known.is_off = !known.is_off;
            let (off_ms, limit_ms) = (off * 1e3, limit * 1e3);
            let again = if known.is_off { "" } else { "in time again: " };
            let name = known.name().to_owned();
            let detail =
                format!("{again}{off_ms:+.1} ms off from the other cameras, limit {limit_ms:.1}");
            self.event(EventKind::ClockOffset, Some(&name), detail);
        }
    }
}

/// A clock that is off: an offset that grew by `by` is a clock that is behind.
fn off_by(by: Nanos) -> String {
    let (by, than) = (by.seconds().abs(), if by < Nanos::ZERO { "ahead of" } else { "behind" });
    format!("its clock is {by:.3} s {than}")
}
