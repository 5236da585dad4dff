//! How the tracker applies the solution of a job.

use std::sync::Arc;

use super::agreement::worst_in_words;
use super::body_estimator::BodyEstimator;
use super::event::EventKind;
use super::job::{Outcome, ProvisionalFit, Solution, Tracked, Verdict};
use super::noise::Noise;
use super::port::{Output, WindowReport};
use super::state_machine::{PendingJob, Phase, Tracker};
use super::window::Window;
use crate::core::body::{Pose, Skeleton, TrackingState};
use crate::core::manifold::{self, StampedKeyframe, TimedKeyframe, in_order};
use crate::core::time::{Nanos, Timestamp};

/// A person who is found again within this time and distance, metres, is the same performer.
const SOON: Nanos = Nanos::SECOND;
const NEAR_M: f64 = 2.0;

/// A body is checked if the detections fit it this many times worse than at first.
const DOUBT: f64 = 1.4;

impl Tracker {
    /// Applies the solution of the pending job; any other is ignored.
    pub(super) fn apply(&mut self, solution: Solution) {
        if let Outcome::Mended(placed) = solution.outcome {
            return self.placed(solution.number, placed.map(|placed| *placed));
        }
        let Some(PendingJob { window, .. }) =
            self.pending.filter(|job| job.number == solution.number)
        else {
            return;
        };
        self.pending = None;
        match solution.outcome {
            Outcome::Acquired { first, skeleton, pose } => {
                self.acquired(window, *first, skeleton, &pose);
            }
            Outcome::NobodyFound => self.nobody_found(window),
            Outcome::Tracked(tracked) => self.tracked(window, *tracked),
            Outcome::Provisional(fit) => self.fitted(window, *fit),
            Outcome::Mended(_) => {}
        }
    }

    fn acquired(
        &mut self,
        window: Window,
        first: TimedKeyframe,
        skeleton: Arc<Skeleton>,
        pose: &Pose,
    ) {
        let at = first.capture;
        self.seen(at);
        self.repeat_last_pose(window.start, at - self.tolerance());
        if self.skeleton.is_none() && !self.ended && at > window.start + self.span() {
            // Too few frames are left for the shape: collect frames again from here.
            self.close_until(at - self.tolerance());
            self.start_windows_at(Some(at));
            return;
        }
        self.close_until(at + self.tolerance());
        let is_in_view = matches!(self.phase, Phase::Tracking { coasted: 0, .. });
        if self.skeleton.is_none() {
            self.outputs.push_back(Output::Skeleton(Arc::clone(&skeleton)));
            (self.estimator, self.noise) = (Arc::default(), Noise::default());
        } else if self.config.body_windows > 0
            && (self.estimator.is_early() || !(is_in_view || self.estimate_continues(&first)))
        {
            // It may be another performer, or the estimate is from a wrong pose.
            self.estimator = Arc::new(self.estimator.after_a_break());
        }
        let detail = match is_in_view {
            true => "a fresh fit replaces a wrong pose",
            false => "performer found",
        };
        self.event(EventKind::Acquired, at, None, detail.to_owned());
        self.skeleton = Some(skeleton);
        self.start_windows_at(Some(at));
        if self.is_fed {
            // The frames of the search have waited.
            self.resume();
        }
        self.publish_keyframe(at, &first, TrackingState::Tracking);
        self.publish_final(at, pose, TrackingState::Tracking, None);
        self.playout.begin_path();
        // Those of the path before say nothing of this one.
        self.deviations = None;
        self.phase = Phase::Tracking { past: vec![first], coasted: 0 };
    }

    /// Whether an incomplete estimate of the body continues: the person is the same performer. The stage knows this for one
    /// of several performers; for a single one, time and place tell.
    fn estimate_continues(&self, found: &TimedKeyframe) -> bool {
        let is_near = |last: &TimedKeyframe| {
            let moved = found.keyframe.root_position - last.keyframe.root_position;
            found.capture - last.capture < SOON && moved.norm() < NEAR_M
        };
        !self.estimator.is_complete()
            && (self.is_fed || self.last_seen.as_ref().is_some_and(is_near))
    }

    /// Continues the search one window later.
    fn nobody_found(&mut self, window: Window) {
        let span = self.span();
        let end = window.end.min(window.start + span);
        let end = self.intake.last().filter(|_| self.ended).map_or(end, |last| end.min(last));
        self.repeat_last_pose(window.start, end);
        if self.watch_unseen(window.start, end) {
            let detail = "no person seen by two cameras".to_owned();
            self.event(EventKind::NobodyFound, end, None, detail);
        }
        let saw_nothing = self.intake.first().is_none_or(|first| first > end + span);
        self.close_until(end + self.tolerance());
        // Keeps the grid of pose times, but skips a gap in the stream.
        match saw_nothing {
            true => self.start_windows_at(self.intake.first()),
            false => self.start = Some(end),
        }
        self.window += 1;
    }

    fn tracked(&mut self, window: Window, tracked: Tracked) {
        if tracked.verdict == Verdict::Tracked {
            self.correct_clocks(window, &tracked.newest);
            self.watch_cameras(window, &tracked.poses);
        }
        self.close_until(window.publish + self.tolerance());
        let state = tracked.verdict.state();
        if state == TrackingState::Tracking {
            self.noise = self.noise.with(&tracked.residuals);
            self.doubt_body();
        }
        let before = self.outputs.len();
        self.publish_poses(window, &tracked, state);
        let (done, ahead): (Vec<_>, Vec<_>) =
            tracked.keyframes.into_iter().partition(|at| at.capture <= window.publish);
        let mut start = window.start;
        for at in in_order(&done, &tracked.between) {
            self.publish_keyframe(start, &at, state);
            start = at.capture;
        }
        let is_fitted = !tracked.residuals.is_empty();
        self.report_verdict(window.publish, &tracked.verdict);
        if let Some((frames, detail)) =
            worst_in_words(&tracked.unfollowed).filter(|_| state == TrackingState::Tracking)
        {
            let kind = EventKind::NotFollowed;
            self.counted_event(kind, window.publish, None, frames as u64, detail);
        }
        self.outputs.push_back(Output::Window(Box::new(WindowReport {
            window: self.window,
            start: window.start,
            end: window.publish,
            summary: tracked.summary,
            latent_norm: done.last().map_or(0.0, |at| manifold::norm(&at.keyframe.z)),
            residuals: tracked.residuals,
            unfollowed: tracked.unfollowed,
            verdict: tracked.verdict,
        })));
        self.is_proven |= state == TrackingState::Tracking;
        if let Some(estimator) = tracked.estimator {
            self.improve_body(window.publish, estimator);
        }
        if state == TrackingState::Tracking {
            self.last_seen = done.last().cloned();
        }
        self.enter_phase(done, ahead, state, is_fitted);
        self.start = Some(window.publish);
        self.follow_rate(window.publish);
        self.window += 1;
        self.put_out_state(before);
    }

    /// Checks a complete body again if the detections fit it worse than at first.
    fn doubt_body(&mut self) {
        if self.config.body_windows == 0 || !self.estimator.is_complete() {
            self.first_fit = None;
            return;
        }
        let fit = self.noise.relative();
        let first = *self.first_fit.get_or_insert(fit);
        if fit > DOUBT * first {
            self.estimator = Arc::new(BodyEstimator::check());
        }
    }

    /// Uses the estimator's body from the next window on, if it has a new one.
    fn improve_body(&mut self, at: Timestamp, estimator: Arc<BodyEstimator>) {
        if self.estimator.is_given() && !estimator.is_given() {
            let detail = "another body fits clearly better; it is estimated anew".to_owned();
            self.event(EventKind::Body, at, None, detail);
            // From a wrong body the estimate converges to a wrong one, so it begins with a search.
            self.is_proven = false;
            return;
        }
        let body = self.skeleton.as_ref().and_then(|body| estimator.new_body(body)).map(Arc::new);
        self.outputs.extend(body.clone().map(Output::Skeleton));
        self.skeleton = body.or(self.skeleton.take());
        self.estimator = estimator;
    }

    /// Publishes the newest pose as a provisional one if it has none yet, and then the final poses.
    fn publish_poses(&mut self, window: Window, tracked: &Tracked, state: TrackingState) {
        let Tracked { newest, poses, deviations, .. } = tracked;
        let is_published = self.newest >= Some(window.end);
        if state == TrackingState::Tracking && self.is_newest(window.end) && !is_published {
            self.publish_provisional(window.end, newest, state);
            self.newest = Some(window.end);
        }
        let before = std::mem::replace(&mut self.deviations, *deviations);
        let Some(grid) = self.output_grid() else { return };
        for (capture, pose) in grid.between(window.start, window.publish).zip(poses) {
            let s = capture.fraction(window.start, window.publish);
            let deviations = deviations.map(|last| {
                let first = before.unwrap_or(last);
                std::array::from_fn(|j| first[j] + s * (last[j] - first[j]))
            });
            self.publish_final(capture, pose, state, deviations);
        }
    }

    /// Reports why a window is not tracked.
    fn report_verdict(&mut self, at: Timestamp, verdict: &Verdict) {
        let was_coasting = self.state() == Some(TrackingState::Coasting);
        match verdict {
            Verdict::Tracked => {}
            Verdict::Coasted(why) => self.event(EventKind::Coasted, at, None, why.clone()),
            Verdict::Lost(why) => {
                let kind = if was_coasting { EventKind::Left } else { EventKind::Lost };
                self.event(kind, at, None, why.clone());
            }
        }
    }

    /// The phase after a window with that verdict, from its final keyframes and the look-ahead
    /// ones.
    fn enter_phase(
        &mut self,
        done: Vec<TimedKeyframe>,
        ahead: Vec<TimedKeyframe>,
        state: TrackingState,
        is_fitted: bool,
    ) {
        if state != TrackingState::Tracking {
            self.playout.forget_provisionals();
        }
        let previous = std::mem::replace(&mut self.phase, Phase::Searching);
        let Phase::Tracking { mut past, coasted } = previous else { return };
        past.extend(done);
        past.drain(..past.len().saturating_sub(2));
        self.ahead = ahead;
        match state {
            TrackingState::Tracking => self.phase = Phase::Tracking { past, coasted: 0 },
            TrackingState::Coasting => {
                self.phase = Phase::Tracking { past, coasted: coasted + 1 };
            }
            TrackingState::Lost => {
                self.ahead.clear();
                let is_estimated = self.config.body_windows > 0;
                self.is_proven &= !(is_fitted && is_estimated && self.estimator.is_early());
            }
        }
        if !self.is_proven {
            // The body was found together with a wrong pose, or is that of somebody else.
            self.ahead.clear();
            (self.skeleton, self.phase) = (None, Phase::Searching);
        }
    }

    /// A provisional fit of the open window.
    fn fitted(&mut self, window: Window, fit: ProvisionalFit) {
        let state = if fit.hidden { TrackingState::Coasting } else { TrackingState::Tracking };
        self.publish_fit(window, &fit.poses, state);
        self.newest = Some(window.end);
        self.ahead = fit.keyframes;
    }

    fn publish_keyframe(&mut self, start: Timestamp, at: &TimedKeyframe, state: TrackingState) {
        let (Some(grid), Some(skeleton)) = (self.output_grid(), &self.skeleton) else { return };
        self.outputs.push_back(Output::Keyframe(Box::new(StampedKeyframe {
            capture: at.capture,
            start,
            window: self.window,
            keyframe: at.keyframe.clone(),
            shape: *skeleton.shape(),
            interpolation: self.config.cost.interpolation,
            grid,
            state,
            rig_version: self.rig.version,
        })));
    }
}
