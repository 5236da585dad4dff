//! The machine driven by a recording: jobs are solved as they come, on this thread.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::failure::Failure;
use crate::body::{Skeleton, StampedPose, TrackingState};
use crate::camera::Rig;
use crate::time::Timestamp;
use crate::track::{Config, Event, EventKind, Input, Output, Solver, Task, Track, WindowReport};

/// Detected points of at most this confidence are left out of reported errors.
pub(super) const CONFIDENT: f64 = 0.3;

/// A window as the report shows it.
pub(super) struct WindowSummary {
    pub(super) start: Timestamp,
    pub(super) end: Timestamp,
    pub(super) latent_norm: f64,
    pub(super) iterations: usize,
    pub(super) cost: f64,
    pub(super) lost: bool,
    pub(super) solve_ms: f64,
}

/// Everything that a run gave and that is kept in memory: the poses (about 2 kB each), a line
/// for each window, and single numbers.
#[derive(Default)]
pub(super) struct Run {
    pub(super) skeleton: Option<Arc<Skeleton>>,
    pub(super) poses: Vec<StampedPose>,
    pub(super) windows: Vec<WindowSummary>,
    pub(super) events: BTreeMap<EventKind, u64>,
    /// By camera: capture time and error in pixels of each confident point of windows that are
    /// not lost.
    pub(super) errors_px: Vec<Vec<(Timestamp, f32)>>,
    /// Time spent in solving, windows and acquisitions.
    pub(super) solving: Duration,
    last_solve_ms: f64,
}

impl Run {
    /// Windows whose poses are flagged.
    pub(super) fn lost(&self) -> usize {
        self.windows.iter().filter(|window| window.lost).count()
    }

    /// How often an event of that kind happened.
    pub(super) fn count(&self, kind: EventKind) -> u64 {
        self.events.get(&kind).copied().unwrap_or(0)
    }

    /// Whether any pose can be used.
    pub(super) fn found_somebody(&self) -> bool {
        self.poses.iter().any(|pose| pose.state == TrackingState::Tracking)
    }

    fn keep(&mut self, output: &Output) {
        match output {
            Output::Skeleton(skeleton) => self.skeleton = Some(Arc::clone(skeleton)),
            Output::Pose(pose) => self.poses.push((**pose).clone()),
            Output::Event(event) => self.count_event(event),
            Output::Window(report) => self.keep_window(report),
            Output::Keyframe(_) | Output::Solve(_) => {}
        }
    }

    fn count_event(&mut self, event: &Event) {
        *self.events.entry(event.kind).or_default() += event.count;
    }

    fn keep_window(&mut self, report: &WindowReport) {
        if report.lost.is_none() {
            for residual in report.residuals.iter().filter(|r| r.confidence > CONFIDENT) {
                let error = (residual.capture, residual.error_px as f32);
                self.errors_px[residual.camera].push(error);
            }
        }
        self.windows.push(WindowSummary {
            start: report.start,
            end: report.end,
            latent_norm: report.latent_norm,
            iterations: report.summary.iterations,
            cost: report.summary.final_cost,
            lost: report.lost.is_some(),
            solve_ms: self.last_solve_ms,
        });
    }
}

/// The machine, its solver, and what came of it.
pub(super) struct Driver<S> {
    track: Track,
    solver: Solver,
    sink: S,
    pub(super) run: Run,
}

impl<S: FnMut(&Output) -> Result<(), Failure>> Driver<S> {
    /// `sink` is told every output but the jobs.
    pub(super) fn new(config: Config, rig: Arc<Rig>, solver: Solver, sink: S) -> Self {
        let errors_px = vec![Vec::new(); rig.cameras.len()];
        let run = Run { errors_px, ..Run::default() };
        Self { track: Track::new(config, rig), solver, sink, run }
    }

    /// Gives the machine an input and does all that it then wants.
    pub(super) fn feed(&mut self, input: Input) -> Result<(), Failure> {
        self.track.handle(input);
        while let Some(output) = self.track.poll() {
            if let Output::Solve(job) = &output {
                let begin = Instant::now();
                let solution = self.solver.solve(job);
                let took = begin.elapsed();
                self.run.solving += took;
                if matches!(job.task, Task::Track { .. }) {
                    self.run.last_solve_ms = took.as_secs_f64() * 1e3;
                }
                self.track.handle(Input::Solved(solution));
                continue;
            }
            self.run.keep(&output);
            (self.sink)(&output)?;
        }
        Ok(())
    }
}
