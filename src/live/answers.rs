//! What the core does with the solver's answers and with what its machine gives out.

use std::collections::BTreeMap;

use super::core::{Core, Output};
use super::events::Named;
use super::status::quantile;
use crate::core::body::StampedPose;
use crate::core::manifold::StampedKeyframe;
use crate::core::time::Timestamp;
use crate::core::tracker::{
    self, Effort, Event, EventKind, Outcome, Solution, Verdict, WindowReport,
};
use crate::io::wire::{self, Publication};

impl Core {
    pub(super) fn solved(&mut self, solution: Solution, took_ns: u64) {
        self.took_ns = i64::try_from(took_ns).unwrap_or(i64::MAX);
        let is_tracked = matches!(
            &solution.outcome,
            Outcome::Tracked(tracked) if tracked.verdict == Verdict::Tracked
        );
        if is_tracked {
            self.settle();
        }
        self.tell(tracker::Input::Solved(solution));
    }

    /// Declares the latency, and judges the effort, after a window was solved.
    fn settle(&mut self) {
        let Some(track) = &mut self.track else { return };
        let period = track.output_grid().map_or(0, |grid| grid.period_ns as i64);
        let wait = track.span() - period;
        let delay = if self.latency.declared_ns().is_none() { self.clock.delay_p999() } else { 0 };
        if let Some((latency, why)) = self.latency.solved(self.took_ns, wait, delay) {
            track.set_latency(latency);
            self.event(EventKind::Latency, None, why);
            return;
        }
        let Some(available) = self.latency.solve_ns() else { return };
        let trouble = self.trouble.take();
        let Some(why) = self.governor.solved(self.took_ns, available, trouble) else { return };
        let level = self.governor.level();
        let effort = Effort::at(level, &self.settings.tracker);
        track.set_effort(effort);
        let Effort { iterations, stride, .. } = effort;
        let detail = format!("level {level}: {iterations} iterations, stride {stride}; {why}");
        self.event(EventKind::Effort, None, detail);
    }

    /// Passes on what the machine gives out.
    pub(super) fn drain(&mut self) {
        while let Some(output) = self.track.as_mut().and_then(tracker::Tracker::poll) {
            match output {
                tracker::Output::Solve(job) => self.outputs.push_back(Output::Solve(job)),
                tracker::Output::Skeleton(skeleton) => {
                    let message = wire::Skeleton::from_core(&skeleton);
                    let now = self.clock.capture_time(self.now);
                    self.publish(self.topics.skeleton(), now, &message, None);
                }
                tracker::Output::Pose(pose) if pose.provisional => self.provisional(&pose),
                tracker::Output::Pose(pose) => self.pose(&pose),
                tracker::Output::Keyframe(keyframe) => self.keyframe(&keyframe),
                tracker::Output::Window(report) => self.window(&report),
                tracker::Output::Event(event) => self.machine_event(event),
            }
        }
    }

    fn pose(&mut self, pose: &StampedPose) {
        let Some(latency_ns) = self.latency.declared_ns() else { return };
        let publish = pose.capture + latency_ns;
        let publication = Publication { publish, latency_ns: latency_ns.max(0) as u64 };
        let due = self.clock.node_time(publish);
        self.send_pose(pose, self.topics.pose(), publication, Some(due));
    }

    fn provisional(&mut self, pose: &StampedPose) {
        let half = self.track.as_ref().map_or(0, |track| track.frame_period() as i64 / 2);
        let of_set = self.arrivals.iter().filter(|(at, _)| (*at - pose.capture).abs() <= half);
        if let Some((_, arrival)) = of_set.max_by_key(|(_, arrival)| *arrival) {
            let latency = (self.now - *arrival) / 1000;
            self.published.provisional(u32::try_from(latency).unwrap_or(u32::MAX));
        }
        let publish = self.clock.capture_time(self.now);
        let latency_ns = self.latency.declared_ns().unwrap_or(0).max(0) as u64;
        self.send_pose(pose, self.topics.provisional(), Publication { publish, latency_ns }, None);
    }

    fn send_pose(
        &mut self,
        pose: &StampedPose,
        topic: String,
        publication: Publication,
        due: Option<Timestamp>,
    ) {
        let Some(skeleton) = self.track.as_ref().and_then(tracker::Tracker::skeleton) else {
            return;
        };
        let message = wire::Pose::from_core(pose, skeleton, Some(publication));
        self.publish(topic, pose.capture, &message, due);
    }

    fn keyframe(&mut self, keyframe: &StampedKeyframe) {
        if self.track.as_ref().and_then(tracker::Tracker::skeleton).is_none() {
            return;
        }
        let message = wire::Keyframe::from_core(keyframe, &self.settings.weights);
        self.publish(self.topics.keyframe(), keyframe.capture, &message, None);
    }

    fn window(&mut self, report: &WindowReport) {
        self.windows.solved(report, self.took_ns);
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

    fn machine_event(&mut self, event: Event) {
        match event.kind {
            EventKind::Deadline => self.windows.incomplete(),
            EventKind::Overdue => self.trouble = Some("a pose was not solved when due"),
            _ => {}
        }
        let camera = event.camera.and_then(|index| self.cameras.get(index));
        self.emit(Named {
            kind: event.kind,
            capture: event.capture,
            camera: camera.map(|camera| camera.name().to_owned()),
            window: event.window,
            count: event.count,
            detail: event.detail,
        });
    }
}
