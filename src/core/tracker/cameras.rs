//! What the performer's motion says about the cameras: shifted clocks, and cameras that were moved.

use std::sync::Arc;

use super::event::EventKind;
use super::job::{Placed, PoseAt, Task};
use super::mending::Mending;
use super::port::Output;
use super::state_machine::Tracker;
use super::window::Window;
use crate::core::body::Pose;
use crate::core::calibration::{Finding, News, Seen, limbs};
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};

/// Poses that are farther apart tell little of the time between them.
const LONGEST_STEP: Nanos = Nanos::from_ms(250);
/// One of several performers: how long frames are kept to watch the cameras with.
const KEPT: Nanos = Nanos::from_ms(2000);

impl Tracker {
    /// Live: corrects the time offsets of cameras, as the performer's motion shows them.
    pub(super) fn correct_clocks(&mut self, window: Window, pose: &Pose) {
        let is_on = self.live.is_some_and(|live| live.time_offsets);
        let Some(skeleton) = self.skeleton.clone().filter(|_| is_on) else { return };
        for frame in self.intake.up_to(window.publish + self.tolerance()) {
            self.offsets.add(&frame, &self.rig, pose, &skeleton);
        }
        let step = Nanos::rounded(self.frame_period());
        let before = self.time_corrections().to_vec();
        let news = self.offsets.correct(Arc::make_mut(&mut self.rig), step);
        for (camera, before) in before.into_iter().enumerate() {
            self.shift_waiting(camera, self.time_corrections()[camera] - before);
        }
        for news in news {
            let (camera, detail) = match news {
                News::Shifted(camera) => {
                    (camera, "its capture times are off, and are corrected step by step".to_owned())
                }
                News::AtOnce(camera, by) => (
                    camera,
                    format!("{:+.1} ms are added to its capture times from now on", by.ms()),
                ),
                News::InSync(camera, by) => {
                    (camera, format!("in time again: corrected by {:+.1} ms", by.ms()))
                }
            };
            self.event(EventKind::TimeOffset, window.publish, Some(camera), detail);
        }
    }

    /// Live: leaves out cameras that were moved, until they fit again.
    pub(super) fn watch_cameras(&mut self, window: Window, poses: &[Pose]) {
        let is_on = self.live.is_some_and(|live| live.watch_cameras)
            && (self.estimator.is_complete() || self.watchdog.has_begun());
        let (Some(skeleton), Some(grid)) = (self.skeleton.clone(), self.output_grid()) else {
            return;
        };
        // With the pose before: slow outputs have few in a window.
        let period = Nanos::rounded(1.5 * grid.period_ns).min(LONGEST_STEP);
        let is_next = |(at, _): &&PoseAt| (Nanos::ZERO..period).contains(&(window.start - *at));
        let before = self.playout.last_final().filter(is_next).cloned();
        let own = grid.between(window.start, window.publish).zip(poses.iter().cloned());
        let (times, poses): (Vec<Timestamp>, Vec<Pose>) = before.into_iter().chain(own).unzip();
        if !is_on || poses.len() < 2 {
            return;
        }
        let frames = self.frames_to_watch(window);
        for frame in &frames {
            let after = times.partition_point(|time| *time < frame.capture);
            let k = after.clamp(1, poses.len() - 1);
            let s = frame.capture.fraction(times[k - 1], times[k]);
            let pose = poses[k - 1].interpolate(&poses[k], s);
            self.watchdog.add(frame, &self.rig, &pose, &skeleton);
        }
        let limbs = poses.iter().map(|pose| limbs(pose, &skeleton));
        let limbs = times.into_iter().zip(limbs).collect();
        self.watch_moved(window, Seen { frames, limbs });
        let Some(finding) = self.watchdog.judge(window.publish, &self.rig) else { return };
        let (camera, detail) = match finding {
            Finding::Moved(camera, pixels) => {
                // Of a camera that was left out before, the watchdog knows no calibrated view.
                if !self.left_out.get(camera).copied().unwrap_or(false) {
                    self.mending.extend(Mending::new(camera, &self.memory, window.publish));
                }
                let by = match pixels {
                    Some(pixels) => {
                        format!("its image shifted by {pixels:.1} px against the others'")
                    }
                    None => "it sees nobody where the performer is".to_owned(),
                };
                let fix = "put it back or publish a new calibration";
                (Some(camera), format!("moved: {by}, it is left out; {fix}"))
            }
            Finding::FitsAgain(camera) => {
                self.mending.retain(|mending| mending.camera != camera);
                self.outputs.push_back(Output::Placed { camera, placed: None });
                (Some(camera), "fits again and is used".to_owned())
            }
            Finding::OneMoved(cameras, pixels) => {
                let [first, second] = cameras.map(|camera| &self.rig.cameras[camera].name);
                let detail = format!("{first} or {second} moved: {pixels:.1} px between them");
                (None, detail)
            }
        };
        self.event(EventKind::CameraMoved, window.publish, camera, detail);
    }

    /// Keeps a frame to watch the cameras with.
    pub(super) fn push_watch_frame(&mut self, frame: Detections) {
        let oldest = frame.capture - KEPT;
        self.watch_frames.push_back(Arc::new(frame));
        while self.watch_frames.front().is_some_and(|frame| frame.capture < oldest) {
            self.watch_frames.pop_front();
        }
    }

    /// The frames of a window that show who may be the performer.
    fn frames_to_watch(&mut self, window: Window) -> Vec<Arc<Detections>> {
        let until = window.publish + self.tolerance();
        if !self.is_fed {
            return self.intake.up_to(until);
        }
        let count = self.watch_frames.partition_point(|frame| frame.capture <= until);
        let frames = self.watch_frames.drain(..count);
        frames.filter(|frame| frame.capture > window.start).collect()
    }

    /// Adds the data of a window to each moved camera, and sends a job to the solver when there is enough.
    fn watch_moved(&mut self, window: Window, seen: Seen) {
        let Some(seen) = self.memory.add(seen).cloned() else { return };
        let mut all = std::mem::take(&mut self.mending);
        all.retain(|mending| self.is_left_out(mending.camera));
        for mending in &mut all {
            if let Some(seen) = mending.add(&seen) {
                mending.job = self.push_job(window, Task::Mend { camera: mending.camera, seen });
            }
        }
        self.mending = all;
    }

    /// Applies the answer to the job of a moved camera. Others are ignored.
    pub(super) fn placed(&mut self, job: u64, placed: Option<Placed>) {
        let asked = self.mending.iter_mut().find(|mending| mending.job == Some(job));
        let Some(mending) = asked else { return };
        let (camera, is_new) = (mending.camera, mending.answer(placed));
        let Some(placed) = mending.known.clone() else { return };
        if is_new {
            let name = &placed.camera.name;
            let fix =
                format!("put it back, or correct its calibration: bundlemocap take mend {name}");
            let detail = format!("{placed}; it is left out; {fix}");
            let at = self.start.or(self.now).unwrap_or_default();
            self.event(EventKind::CameraMoved, at, Some(camera), detail);
        }
        self.outputs.push_back(Output::Placed { camera, placed: Some(Box::new(placed)) });
    }
}
