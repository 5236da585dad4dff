//! Passes solutions to the tracker and turns its outputs into publications.

use std::sync::Arc;

use super::Core;
use super::port::Output;
use super::publication::{Content, Publication};
use crate::core::body::{Skeleton, StampedPose, TrackingState};
use crate::core::detections::Detections;
use crate::core::manifold::StampedKeyframe;
use crate::core::stage::{self, PerformerFrames, PerformerId, Stage};
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{
    self, Effort, Event, EventKind, Job, Latency, Outcome, Solution, Task, Tracker, Verdict,
    WindowReport,
};
use crate::io::wire::{self, KeypointFrame, KeypointSet, LiveStamp};
use crate::metrics::set_residuals;

/// How long each kind of job may take, from being sent: provisional fits, windows whose poses are overdue,
/// searches.
const PROVISIONAL: Nanos = Nanos::from_ms(8);
const OVERDUE: Nanos = Nanos::from_ms(60);
const SEARCH: Nanos = Nanos::from_ms(250);

impl Core {
    pub(super) fn solved(&mut self, performer: PerformerId, solution: Solution, took: Nanos) {
        self.took = took;
        let is_tracked = matches!(
            &solution.outcome,
            Outcome::Tracked(tracked) if tracked.verdict == Verdict::Tracked
        );
        if is_tracked {
            self.settle(performer);
        }
        if let Some(stage) = &mut self.stage {
            stage.solved(performer, solution);
        }
    }

    /// Declares the latency and adjusts the effort after a solved window.
    fn settle(&mut self, performer: PerformerId) {
        let delay = self.clock.delay();
        let tracker = self.trackers().get(performer.0);
        let Some(times) = tracker.and_then(|tracker| latency_times(tracker, delay)) else { return };
        let config = self.settings.tracker;
        let found = self.latency.solved(self.took, times, &config);
        if found.is_some() {
            return self.declare(found);
        }
        let [.., period] = times;
        let Some(available) = self.latency.solve_time(period) else { return };
        let is_resuming = self.trackers().get(performer.0).is_some_and(Tracker::is_resuming);
        let mut took = self.took;
        if self.is_several() {
            // A job also waits for those of the others.
            took = self.performer(performer).sent.map_or(took, |sent| self.now - sent);
            if took > available {
                self.late(1, "solves are too slow");
                took = available;
            }
            if is_resuming {
                return;
            }
        }
        // What waited while nothing came is no measure of the solver.
        let trouble = self.trouble.take().filter(|_| !is_resuming);
        self.governor.performers = self.count_followed() as u32;
        let Some(why) = self.governor.solved(took, available, trouble) else { return };
        self.set_effort(&why);
    }

    /// Poses or windows were late. Of several performers that is trouble if it happens more often in a
    /// second than there are performers.
    fn late(&mut self, count: u64, why: &'static str) {
        self.overdue += count;
        if !self.is_several() || self.overdue > self.count_followed() as u64 {
            self.trouble = Some(why);
        }
    }

    /// Uses the governor's level from now on.
    fn set_effort(&mut self, why: &str) {
        let level = self.governor.level();
        let effort = Effort::at(level, &self.settings.tracker);
        if let Some(stage) = &mut self.stage {
            stage.set_effort(effort);
        }
        let Effort { iterations, stride, .. } = effort;
        let detail = format!("level {level}: {iterations} iterations, stride {stride}; {why}");
        self.event(EventKind::Effort, None, detail);
    }

    /// The times of the performer whose times hold for all.
    fn latency_times(&self, delay: Nanos) -> Option<[Nanos; 3]> {
        latency_times(self.stage.as_ref()?.lead(), delay)
    }

    /// Declares a latency, if one was found.
    fn declare(&mut self, found: Option<(Latency, String)>) {
        let (Some((latency, why)), Some(stage)) = (found, &mut self.stage) else { return };
        stage.set_latency(latency);
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

    /// Turns outputs of the stage into outputs of the core.
    pub(super) fn drain(&mut self) {
        while let Some(output) = self.stage.as_mut().and_then(Stage::poll) {
            match output {
                stage::Output::Performer(performer, output) => self.of_performer(performer, output),
                stage::Output::Event(event) => self.camera_event(&event),
                stage::Output::Frames(performer, frames) => self.frames_of(performer, &frames),
            }
        }
    }

    fn of_performer(&mut self, performer: PerformerId, output: tracker::Output) {
        match output {
            tracker::Output::Solve(job) => {
                self.jobs += 1;
                if !job.is_aside() {
                    self.performer(performer).sent = Some(self.now);
                }
                self.count_age(performer, &job);
                let deadline = self.deadline(&job);
                self.outputs.push_back(Output::Solve { performer, job, deadline });
            }
            tracker::Output::Skeleton(skeleton) => self.skeleton(performer, skeleton),
            tracker::Output::HandOver(state) => self.handed_over(performer, &state),
            tracker::Output::Pose(pose) if pose.provisional => self.provisional(performer, &pose),
            tracker::Output::Pose(pose) => self.pose(performer, &pose),
            tracker::Output::Keyframe(keyframe) => self.keyframe(performer, &keyframe),
            tracker::Output::Window(report) => self.window(performer, &report),
            tracker::Output::Event(event) => self.performer_event(performer, &event),
            tracker::Output::Placed { camera, placed } => {
                self.placed(camera, placed.map(|placed| *placed));
            }
        }
    }

    /// Counts the age of a window that is given to the solvers.
    fn count_age(&mut self, performer: PerformerId, job: &Job) {
        let (Task::Track { .. }, Some(first)) = (&job.task, job.pose_times.first()) else { return };
        let first = self.clock.node_time(*first);
        // Windows from before the performer was found catch up; those of a silence waited for frames.
        let is_resuming = self.trackers().get(performer.0).is_some_and(Tracker::is_resuming);
        let age = self.now - first;
        let performer = self.performer(performer);
        if first > performer.found && !is_resuming {
            performer.windows.given(age);
        }
    }

    /// When a job should be solved: a provisional fit at once, a window before its first pose is due, or,
    /// if that is past, after those that can still be in time; a search can wait.
    fn deadline(&self, job: &Job) -> Timestamp {
        let latency = self.latency.declared().unwrap_or_default();
        let due = self.clock.node_time(job.start + latency);
        match job.task {
            Task::Provisional { .. } => self.now + PROVISIONAL,
            Task::Track { .. } if due > self.now => due,
            Task::Track { .. } => self.now + OVERDUE,
            Task::Acquire { .. } | Task::Mend { .. } => self.now + SEARCH,
        }
    }

    /// Publishes a performer's detections, for other nodes.
    fn frames_of(&mut self, performer: PerformerId, frames: &PerformerFrames) {
        let Some(of) = &self.calibration else { return };
        let (rig, rig_hash) = (Arc::clone(&of.rig), of.hash);
        let frame = |frame: &Detections| {
            let camera = rig.cameras.get(frame.camera)?;
            let size = [camera.width, camera.height];
            Some(KeypointFrame::from_core(frame, &camera.name, size))
        };
        let label = self.label_of(performer.0).cloned();
        let number = &mut self.performer(performer).sets;
        *number = if frames.enters { 1 } else { *number + 1 };
        let message = KeypointSet {
            performer: performer.0 as u32,
            frames: frames.frames.iter().filter_map(frame).collect(),
            complete_ns: frames.complete.ns(),
            returns: frames.returns,
            enters: frames.enters,
            number: *number,
            label,
            run_id: self.run_id,
            rig_hash,
        };
        let topic = self.performer(performer).topics.actor_keypoints();
        self.publish(topic, frames.complete, Content::Keypoints(message));
    }

    pub(super) fn skeleton(&mut self, performer: PerformerId, skeleton: Arc<Skeleton>) {
        let message = wire::Skeleton::from_core(&skeleton);
        let message = wire::Skeleton { run_id: self.run_id, ..message };
        let now = self.clock.capture_time(self.now);
        let performer = self.performer(performer);
        performer.skeleton = Some(skeleton);
        let topic = performer.topics.skeleton();
        self.publish(topic, now, Content::Skeleton(message));
    }

    fn pose(&mut self, performer: PerformerId, pose: &StampedPose) {
        let Some(latency) = self.latency.declared() else { return };
        let due = pose.capture + latency;
        let leaves = self.clock.node_time(due);
        // No pose overtakes another where the latency falls.
        let held = (self.performer(performer).leaves - leaves).max(Nanos::ZERO);
        let Some(message) = self.pose_message(performer, pose, Some(due + held)) else { return };
        let performer = self.performer(performer);
        if pose.state == TrackingState::Tracking {
            let root = pose.pose.root_position;
            performer.tracked = Some(([root.x, root.z], pose.capture));
        }
        performer.poses.published += 1;
        performer.leaves = leaves + held;
        let due = Some(performer.leaves);
        let (topic, content) = (performer.topics.pose().into(), Content::Pose(message));
        let publication = Publication { topic, capture: pose.capture, due, content };
        self.outputs.push_back(Output::Publish(publication));
    }

    fn provisional(&mut self, performer: PerformerId, pose: &StampedPose) {
        let period = self.trackers().get(performer.0).map_or(0.0, Tracker::frame_period);
        let half = Nanos::new(period as i64 / 2);
        let of_set = self.arrivals.iter().filter(|(at, _)| (*at - pose.capture).abs() <= half);
        if let Some((_, arrival)) = of_set.max_by_key(|(_, arrival)| *arrival) {
            let latency = (self.now - *arrival).ns() / 1000;
            self.published.provisional(u32::try_from(latency).unwrap_or(u32::MAX));
        }
        let Some(message) = self.pose_message(performer, pose, None) else { return };
        let performer = self.performer(performer);
        performer.poses.provisional += 1;
        let topic = performer.topics.provisional();
        self.publish(topic, pose.capture, Content::Pose(message));
    }

    fn pose_message(
        &self,
        performer: PerformerId,
        pose: &StampedPose,
        due: Option<Timestamp>,
    ) -> Option<wire::Pose> {
        let skeleton = self.performers.get(performer.0)?.skeleton.as_ref()?;
        let latency = self.latency.declared().unwrap_or_default();
        let live = LiveStamp { due, latency, run_id: self.run_id };
        let message = wire::Pose::from_core(pose, skeleton, Some(live));
        Some(message.labelled(self.settings.timecode))
    }

    fn keyframe(&mut self, performer: PerformerId, keyframe: &StampedKeyframe) {
        let performer = self.performer(performer);
        if performer.skeleton.is_none() {
            return;
        }
        let topic = performer.topics.keyframe();
        let message = wire::Keyframe::from_core(keyframe, &self.settings.weights);
        let message = wire::Keyframe { run_id: self.run_id, ..message };
        self.publish(topic, keyframe.capture, Content::Keyframe(message));
    }

    fn window(&mut self, performer: PerformerId, report: &WindowReport) {
        let took = self.took;
        self.performer(performer).windows.solved(report, took);
        let residual_px = set_residuals(&mut self.cameras, report);
        self.performer(performer).residual_px = residual_px;
    }

    fn performer_event(&mut self, performer: PerformerId, event: &Event) {
        match event.kind {
            EventKind::Deadline => self.performer(performer).windows.incomplete(),
            EventKind::Dropped => self.fell_behind(&event.detail),
            EventKind::Overdue
                if self.trackers().get(performer.0).is_some_and(|t| !t.is_resuming()) =>
            {
                self.late(event.count, "a pose was not solved when due");
            }
            EventKind::Acquired => self.performer(performer).found = self.now,
            EventKind::Entered => self.entered(performer),
            EventKind::Vacated => self.put_out_bodies(),
            _ => {}
        }
        self.is_changed |= matches!(
            event.kind,
            EventKind::Entered | EventKind::Reentered | EventKind::Vacated | EventKind::Merged
        );
        self.performer(performer);
        self.emit_of(event, self.one_of_several(performer));
    }

    /// An event of the cameras, which concerns all performers.
    fn camera_event(&mut self, event: &Event) {
        self.emit_of(event, None);
    }

    fn emit_of(&mut self, event: &Event, performer: Option<PerformerId>) {
        let camera = event.camera.and_then(|index| self.cameras.get(index));
        let camera = camera.map(|camera| camera.name().to_owned());
        self.emit(event, performer, camera.as_deref());
    }
}

/// Time of a window from its first pose, delay of the network, and frame period; `None` if the frame rate is not known, as
/// after a reset.
fn latency_times(tracker: &Tracker, delay: Nanos) -> Option<[Nanos; 3]> {
    let output = Nanos::new(tracker.output_grid()?.period_ns as i64);
    Some([tracker.span() - output, delay, Nanos::rounded(tracker.frame_period())])
}
