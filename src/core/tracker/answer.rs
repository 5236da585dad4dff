//! What the machine does with the answer to a job.

use std::sync::Arc;

use super::event::EventKind;
use super::job::{Outcome, ProvisionalFit, Solution, TimedKeyframe, Tracked, Verdict};
use super::noise::Noise;
use super::port::{KeyframeAt, Output, WindowReport};
use super::tracker::{Out, Phase, Tracker, Window};
use crate::core::body::{Pose, Skeleton, StampedPose, TrackingState};
use crate::core::manifold::Keyframe;
use crate::core::time::{Grid, Timestamp};

/// A live machine that is this far behind, ns, does not make up for the poses between.
const MAX_CATCH_UP: i64 = 1_000_000_000;

impl Tracker {
    pub(super) fn take(&mut self, solution: Solution) {
        let Some(Out { window, .. }) = self.out.filter(|out| out.number == solution.number) else {
            return;
        };
        self.out = None;
        match solution.outcome {
            Outcome::Acquired { at, keyframe, skeleton, pose } => {
                self.acquired(window, at, keyframe, skeleton, *pose);
            }
            Outcome::NobodyFound => self.nobody_found(window),
            Outcome::Tracked(tracked) => self.tracked(window, *tracked),
            Outcome::Provisional(fit) => self.fitted(window.end, *fit),
        }
    }

    fn acquired(
        &mut self,
        window: Window,
        at: Timestamp,
        keyframe: Box<Keyframe>,
        skeleton: Arc<Skeleton>,
        pose: Pose,
    ) {
        self.hold(window.start, at + -self.tolerance());
        if self.skeleton.is_none() && !self.ended && at > window.start + self.span() {
            // Too few frames are left for the shape: gather anew from here.
            self.close(at + -self.tolerance());
            self.begin_at(Some(at));
            return;
        }
        self.close(at + self.tolerance());
        if self.skeleton.is_none() {
            self.outputs.push_back(Output::Skeleton(Arc::clone(&skeleton)));
            (self.estimator, self.noise) = (Arc::default(), Noise::default());
        }
        self.event(EventKind::Acquired, at, None, "performer found".to_owned());
        self.skeleton = Some(skeleton);
        self.begin_at(Some(at));
        self.keyframe(at, at, &keyframe, TrackingState::Tracking);
        self.give(at, &pose, TrackingState::Tracking);
        self.playout.begin_anew();
        self.phase = Phase::Tracking { past: vec![(at, *keyframe)], coasted: 0 };
    }

    /// Goes on searching one window later.
    fn nobody_found(&mut self, window: Window) {
        let span = self.span();
        let end = window.end.min(window.start + span);
        let end = self.intake.last().filter(|_| self.ended).map_or(end, |last| end.min(last));
        self.hold(window.start, end);
        self.event(EventKind::NobodyFound, end, None, "no person seen by two cameras".to_owned());
        let saw_nothing = self.intake.first().is_none_or(|first| first > end + span);
        self.close(end + self.tolerance());
        // The grid of pose times goes on, but for a gap in the stream, which is skipped.
        match saw_nothing {
            true => self.begin_at(self.intake.first()),
            false => self.start = Some(end),
        }
        self.window += 1;
    }

    fn tracked(&mut self, window: Window, tracked: Tracked) {
        self.close(window.publish + self.tolerance());
        if let (Some(estimator), Some(skeleton)) = (tracked.estimator, &self.skeleton) {
            self.skeleton =
                Some(Arc::new(Skeleton::clone(skeleton).with_keypoint_offsets(estimator.offsets)));
            self.estimator = estimator;
        }
        if tracked.verdict == Verdict::Tracked {
            self.noise = self.noise.with(&tracked.residuals);
        }
        let state = match &tracked.verdict {
            Verdict::Tracked => TrackingState::Tracking,
            Verdict::Coasted(_) => TrackingState::Coasting,
            Verdict::Lost(_) => TrackingState::Lost,
        };
        let grid = self.output_grid();
        let times = grid.iter().flat_map(|g| g.between(window.start, window.publish));
        let times: Vec<Timestamp> = times.collect();
        let is_given = self.newest >= Some(window.end);
        if state == TrackingState::Tracking && self.is_newest(window.end) && !is_given {
            self.give_provisional(window.end, &tracked.newest, state);
            self.newest = Some(window.end);
        }
        for (capture, pose) in times.into_iter().zip(&tracked.poses) {
            self.give(capture, pose, state);
        }
        let (done, ahead): (Vec<_>, Vec<_>) =
            tracked.keyframes.into_iter().partition(|(at, _)| *at <= window.publish);
        let mut start = window.start;
        for (at, keyframe) in &done {
            self.keyframe(start, *at, keyframe, state);
            start = *at;
        }
        self.say(window.publish, &tracked.verdict);
        self.outputs.push_back(Output::Window(Box::new(WindowReport {
            window: self.window,
            start: window.start,
            end: window.publish,
            summary: tracked.summary,
            latent_norm: done
                .last()
                .map_or(0.0, |(_, keyframe)| crate::core::manifold::norm(&keyframe.z)),
            residuals: tracked.residuals,
            verdict: tracked.verdict,
        })));
        self.go_on(done, ahead, state);
        self.start = Some(window.publish);
        self.window += 1;
    }

    /// Says why a window is not tracked.
    fn say(&mut self, at: Timestamp, verdict: &Verdict) {
        let hidden = matches!(&self.phase, Phase::Tracking { coasted, .. } if *coasted > 0);
        match verdict {
            Verdict::Tracked => {}
            Verdict::Coasted(why) => self.event(EventKind::Coasted, at, None, why.clone()),
            Verdict::Lost(why) => {
                let kind = if hidden { EventKind::Left } else { EventKind::Lost };
                self.event(kind, at, None, why.clone());
            }
        }
    }

    /// The phase after a window in that state, of those final keyframes.
    fn go_on(&mut self, done: Vec<TimedKeyframe>, ahead: Vec<TimedKeyframe>, state: TrackingState) {
        let previous = std::mem::replace(&mut self.phase, Phase::Searching);
        let Phase::Tracking { mut past, coasted } = previous else { return };
        past.extend(done);
        past.drain(..past.len().saturating_sub(2));
        self.ahead = ahead;
        match state {
            TrackingState::Tracking => {
                self.is_proven = true;
                self.phase = Phase::Tracking { past, coasted: 0 };
            }
            TrackingState::Coasting => {
                self.phase = Phase::Tracking { past, coasted: coasted + 1 };
            }
            TrackingState::Lost => self.ahead.clear(),
        }
        if !self.is_proven {
            // The body was found together with a pose that was wrong at once.
            (self.skeleton, self.phase) = (None, Phase::Searching);
        }
    }

    /// A fit of the open window.
    fn fitted(&mut self, at: Timestamp, fit: ProvisionalFit) {
        let state = if fit.hidden { TrackingState::Coasting } else { TrackingState::Tracking };
        self.give_provisional(at, &fit.pose, state);
        self.newest = Some(at);
        self.ahead = fit.keyframes;
    }

    /// Windows begin there from now on, or with the next frame that comes.
    pub(super) fn begin_at(&mut self, start: Option<Timestamp>) {
        self.start = start;
        self.ahead.clear();
        self.newest = None;
        if let (Some(origin), Some(period_ns)) = (start, self.period) {
            self.frames = Some(Grid { origin, period_ns });
        }
    }

    fn keyframe(
        &mut self,
        start: Timestamp,
        capture: Timestamp,
        value: &Keyframe,
        state: TrackingState,
    ) {
        let Some(grid) = self.output_grid() else { return };
        self.outputs.push_back(Output::Keyframe(Box::new(KeyframeAt {
            capture,
            start,
            window: self.window,
            keyframe: value.clone(),
            grid,
            state,
            rig_version: self.rig.version,
        })));
    }

    /// Gives a final pose out; live, if it is not due already.
    fn give(&mut self, capture: Timestamp, pose: &Pose, state: TrackingState) {
        self.playout.know(capture, pose);
        if self.live.is_some() {
            let Some(latency) = self.latency else { return };
            let is_due = self.now.is_some_and(|now| now > capture + latency.declared_ns);
            let grid = self.output_grid();
            let is_given = grid.is_some_and(|grid| self.playout.is_given(capture, &grid));
            if is_due || is_given {
                self.playout.missed += u64::from(self.playout.given.is_some());
                return;
            }
        }
        self.publish(capture, pose.clone(), state, false);
    }

    fn give_provisional(&mut self, capture: Timestamp, pose: &Pose, state: TrackingState) {
        if self.live.is_some_and(|live| live.provisional) {
            self.playout.know_live(capture, pose);
            self.publish(capture, pose.clone(), state, true);
        }
    }

    fn publish(&mut self, capture: Timestamp, pose: Pose, state: TrackingState, provisional: bool) {
        if !provisional {
            self.playout.given = Some(capture);
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
        })));
    }

    /// Repeats the last pose, flagged lost, at the times of poses after `start` up to `end`.
    fn hold(&mut self, start: Timestamp, end: Timestamp) {
        let (Some(held), Some(grid)) = (self.playout.last().cloned(), self.output_grid()) else {
            return;
        };
        for capture in grid.between(start, end) {
            self.give(capture, &held, TrackingState::Lost);
        }
    }

    /// When the next pose is due, on the capture clock; `None` while nothing is in motion.
    pub(super) fn due(&self) -> Option<Timestamp> {
        let next = self.start.and(self.playout.next(&self.output_grid()?))?;
        Some(next + self.latency?.declared_ns)
    }

    /// Live: carries the motion on where a pose is due that has not been solved.
    pub(super) fn play(&mut self) {
        let (Some(now), Some(latency)) = (self.now, self.latency) else { return };
        while let Some(due) = self.due().filter(|due| *due <= now + super::playout::MARGIN) {
            let capture = due + -latency.declared_ns;
            if now - due > MAX_CATCH_UP {
                let until = now + -latency.declared_ns;
                let grid = self.output_grid();
                let skipped =
                    grid.map_or(1, |g| g.at_or_before(until) - g.at_or_before(capture) + 1);
                let skipped = skipped.max(1) as u64;
                let detail = "too far behind, skipped".to_owned();
                self.event_of(EventKind::Overdue, capture, None, skipped, detail);
                self.playout.missed += skipped;
                self.playout.given = Some(until);
                return;
            }
            let Some(pose) = self.playout.carry_on(capture) else { return };
            let state = match self.phase {
                Phase::Searching => TrackingState::Lost,
                Phase::Tracking { .. } => TrackingState::Coasting,
            };
            self.playout.carried += 1;
            let detail = "not solved when due, carried on".to_owned();
            self.event(EventKind::Overdue, capture, None, detail);
            self.publish(capture, pose, state, false);
        }
    }
}
