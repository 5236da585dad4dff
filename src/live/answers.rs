//! Passes solutions to the tracker and turns its outputs into publications.

use std::collections::BTreeMap;

use super::core::Core;
use super::port::Output;
use super::publication::{Content, Publication};
use super::status::quantile;
use crate::core::body::StampedPose;
use crate::core::manifold::StampedKeyframe;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{
    self, Effort, Event, EventKind, Latency, Outcome, Solution, Tracker, Verdict, WindowReport,
};
use crate::io::wire::{self, LiveStamp};

impl Core {
    pub(super) fn solved(&mut self, solution: Solution, took: Nanos) {
        self.took = took;
        let is_tracked = matches!(
            &solution.outcome,
            Outcome::Tracked(tracked) if tracked.verdict == Verdict::Tracked
        );
        if is_tracked {
            self.settle();
        }
        self.give(tracker::Input::Solved(solution));
    }

    /// Declares the latency and adjusts the effort after a solved window.
    fn settle(&mut self) {
        let Some(times) = self.latency_times(self.clock.delay()) else { return };
        let config = self.settings.tracker;
        let found = self.latency.solved(self.took, times, &config);
        if found.is_some() {
            return self.declare(found);
        }
        let [.., period] = times;
        let Some(track) = &mut self.track else { return };
        let Some(available) = self.latency.solve_time(period) else { return };
        // What waited while nothing came is no measure of the solver.
        let trouble = self.trouble.take().filter(|_| !track.is_resuming());
        let Some(why) = self.governor.solved(self.took, available, trouble) else { return };
        self.set_effort(&why);
    }

    /// Uses the governor's level from now on.
    fn set_effort(&mut self, why: &str) {
        let level = self.governor.level();
        let effort = Effort::at(level, &self.settings.tracker);
        if let Some(track) = &mut self.track {
            track.set_effort(effort);
        }
        let Effort { iterations, stride, .. } = effort;
        let detail = format!("level {level}: {iterations} iterations, stride {stride}; {why}");
        self.event(EventKind::Effort, None, detail);
    }

    /// Time of a window from its first pose, delay of the network, and frame period.
    fn latency_times(&self, delay: Nanos) -> Option<[Nanos; 3]> {
        let track = self.track.as_ref()?;
        let output = Nanos::new(track.output_grid().map_or(0, |grid| grid.period_ns as i64));
        let period = Nanos::rounded(track.frame_period());
        Some([track.span() - output, delay, period])
    }

    /// Declares a latency, if one was found.
    fn declare(&mut self, found: Option<(Latency, String)>) {
        let (Some((latency, why)), Some(track)) = (found, &mut self.track) else { return };
        track.set_latency(latency);
        self.event(EventKind::Latency, None, why);
    }

    /// Declares a longer latency if frames stay later than it allows.
    pub(super) fn raise_latency(&mut self) {
        let [lasting, most] = self.clock.lasting_delay();
        let Some(times) = self.latency_times(most + self.clock.growth()) else { return };
        let config = self.settings.tracker;
        let found = self.latency.raise(lasting, times, &config);
        self.declare(found);
    }

    /// Declares a shorter latency if that would have done for long; called once a second.
    pub(super) fn lower_latency(&mut self) {
        let delay = self.clock.delay() + self.clock.growth();
        let Some(times) = self.latency_times(delay) else { return };
        let found = self.latency.lower(times, &self.settings.tracker);
        self.declare(found);
    }

    /// The tracker dropped frames that waited for too long: it gets fewer frames of every camera.
    fn fell_behind(&mut self, why: &str) {
        if self.governor.fell_behind() {
            self.set_effort(why);
        }
    }

    /// Turns outputs of the tracker into outputs of the core.
    pub(super) fn drain(&mut self) {
        while let Some(output) = self.track.as_mut().and_then(Tracker::poll) {
            match output {
                tracker::Output::Solve(job) => {
                    self.is_solving = true;
                    self.outputs.push_back(Output::Solve(job));
                }
                tracker::Output::Skeleton(skeleton) => {
                    let message = wire::Skeleton::from_core(&skeleton);
                    let message = wire::Skeleton { run_id: self.run_id, ..message };
                    self.skeleton = Some(skeleton);
                    let now = self.clock.capture_time(self.now);
                    self.publish(self.topics.skeleton(), now, Content::Skeleton(message));
                }
                tracker::Output::Pose(pose) if pose.provisional => self.provisional(&pose),
                tracker::Output::Pose(pose) => self.pose(&pose),
                tracker::Output::Keyframe(keyframe) => self.keyframe(&keyframe),
                tracker::Output::Window(report) => self.window(&report),
                tracker::Output::Event(event) => self.tracker_event(&event),
            }
        }
    }

    fn pose(&mut self, pose: &StampedPose) {
        let Some(latency) = self.latency.declared() else { return };
        let due = pose.capture + latency;
        let Some(message) = self.pose_message(pose, Some(due)) else { return };
        self.outputs.push_back(Output::Publish(Publication {
            topic: self.topics.pose().into(),
            capture: pose.capture,
            due: Some(self.clock.node_time(due)),
            content: Content::Pose(message),
        }));
    }

    fn provisional(&mut self, pose: &StampedPose) {
        let half = self.track.as_ref().map_or(0, |track| track.frame_period() as i64 / 2);
        let half = Nanos::new(half);
        let of_set = self.arrivals.iter().filter(|(at, _)| (*at - pose.capture).abs() <= half);
        if let Some((_, arrival)) = of_set.max_by_key(|(_, arrival)| *arrival) {
            let latency = (self.now - *arrival).ns() / 1000;
            self.published.provisional(u32::try_from(latency).unwrap_or(u32::MAX));
        }
        let Some(message) = self.pose_message(pose, None) else { return };
        self.publish(self.topics.provisional(), pose.capture, Content::Pose(message));
    }

    fn pose_message(&self, pose: &StampedPose, due: Option<Timestamp>) -> Option<wire::Pose> {
        let skeleton = self.skeleton.as_ref()?;
        let latency = self.latency.declared().unwrap_or_default();
        let live = LiveStamp { due, latency, run_id: self.run_id };
        let timecode = self.settings.timecode.map(|house| house.label(pose.capture));
        let message = wire::Pose::from_core(pose, skeleton, Some(live));
        Some(wire::Pose { timecode: timecode.unwrap_or_default(), ..message })
    }

    fn keyframe(&mut self, keyframe: &StampedKeyframe) {
        if self.skeleton.is_none() {
            return;
        }
        let message = wire::Keyframe::from_core(keyframe, &self.settings.weights);
        let message = wire::Keyframe { run_id: self.run_id, ..message };
        self.publish(self.topics.keyframe(), keyframe.capture, Content::Keyframe(message));
    }

    fn window(&mut self, report: &WindowReport) {
        self.windows.solved(report, self.took);
        let mut errors: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
        for residual in report.residuals.iter().filter(|residual| residual.error_px.is_finite()) {
            errors.entry(residual.camera).or_default().push(residual.error_px);
        }
        for (camera, mut errors) in errors {
            if let Some(camera) = self.cameras.get_mut(camera) {
                camera.residual(quantile(&mut errors, 0.5));
            }
        }
    }

    fn tracker_event(&mut self, event: &Event) {
        match event.kind {
            EventKind::Deadline => self.windows.incomplete(),
            EventKind::Dropped => self.fell_behind(&event.detail),
            EventKind::Overdue if self.track.as_ref().is_some_and(|t| !t.is_resuming()) => {
                self.trouble = Some("a pose was not solved when due")
            }
            _ => {}
        }
        let camera = event.camera.and_then(|index| self.cameras.get(index));
        let camera = camera.map(|camera| camera.name().to_owned());
        self.emit(event, camera.as_deref());
    }
}
