//! The machine driven by a recording: jobs are solved as they come, on this thread.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::kept::KeptPose;
use crate::cli::failure::Failure;
use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::time::Timestamp;
use crate::core::tracker::{
    Config, Event, EventKind, Input, Output, Residual, Solver, Task, Tracker, Verdict, WindowReport,
};
use crate::metrics::statistics::percentiles;
use crate::offline::CONFIDENT;

/// A window as the report shows it.
pub(crate) struct WindowSummary {
    pub(crate) start: Timestamp,
    pub(crate) end: Timestamp,
    pub(crate) latent_norm: f64,
    pub(crate) iterations: usize,
    pub(crate) cost: f64,
    pub(crate) lost: bool,
    pub(crate) solve_ms: f64,
}

/// What a camera's points were off by, in windows that are not lost; pixels.
#[derive(Clone, Debug, Default)]
pub(crate) struct CameraErrors {
    /// Of every confident point.
    pub(crate) all: Vec<f32>,
    /// Quartiles of every frame.
    pub(crate) frames: Vec<(Timestamp, [f32; 3])>,
}

/// Everything that a run gave and that is kept in memory. With a truth and what the figures need
/// while they are made, a solve takes about 3.5 kB a frame for four cameras of 25 points: 80 MB in
/// all for five minutes at 60 fps.
#[derive(Default)]
pub(crate) struct Run {
    pub(crate) skeleton: Option<Arc<Skeleton>>,
    /// One for each capture time; a pose given anew takes the place of the old one.
    pub(crate) poses: Vec<KeptPose>,
    pub(crate) windows: Vec<WindowSummary>,
    pub(crate) events: BTreeMap<EventKind, u64>,
    /// By camera.
    pub(crate) errors_px: Vec<CameraErrors>,
    /// Time spent in solving, windows and acquisitions.
    pub(crate) solving: Duration,
    last_solve_ms: f64,
}

impl Run {
    /// Windows whose poses are flagged.
    pub(crate) fn lost(&self) -> usize {
        self.windows.iter().filter(|window| window.lost).count()
    }

    /// How often an event of that kind happened.
    pub(crate) fn count(&self, kind: EventKind) -> u64 {
        self.events.get(&kind).copied().unwrap_or(0)
    }

    /// Whether any pose can be used.
    pub(crate) fn found_somebody(&self) -> bool {
        self.poses.iter().any(KeptPose::is_tracked)
    }

    fn keep(&mut self, output: &Output) {
        match output {
            Output::Skeleton(skeleton) => self.skeleton = Some(Arc::clone(skeleton)),
            Output::Pose(pose) => self.keep_pose(pose.as_ref().into()),
            Output::Event(event) => self.count_event(event),
            Output::Window(report) => self.keep_window(report),
            Output::Keyframe(_) | Output::Solve(_) => {}
        }
    }

    fn count_event(&mut self, event: &Event) {
        *self.events.entry(event.kind).or_default() += event.count;
    }

    fn keep_pose(&mut self, pose: KeptPose) {
        match self.poses.last_mut() {
            Some(last) if last.capture == pose.capture => *last = pose,
            _ => self.poses.push(pose),
        }
    }

    fn keep_errors(&mut self, report: &WindowReport) {
        for (camera, errors) in self.errors_px.iter_mut().enumerate() {
            let confident = |r: &&Residual| r.camera == camera && r.confidence > CONFIDENT;
            let mut seen: Vec<&Residual> = report.residuals.iter().filter(confident).collect();
            seen.sort_by_key(|residual| residual.capture);
            errors.all.extend(seen.iter().map(|residual| residual.error_px as f32));
            for frame in seen.chunk_by(|a, b| a.capture == b.capture) {
                let values: Vec<f64> = frame.iter().map(|residual| residual.error_px).collect();
                let quartiles = percentiles(&values, [25.0, 50.0, 75.0]);
                errors.frames.extend(
                    quartiles.map(|quartiles| (frame[0].capture, quartiles.map(|q| q as f32))),
                );
            }
        }
    }

    fn keep_window(&mut self, report: &WindowReport) {
        if report.verdict == Verdict::Tracked {
            self.keep_errors(report);
        }
        self.windows.push(WindowSummary {
            start: report.start,
            end: report.end,
            latent_norm: report.latent_norm,
            iterations: report.summary.map_or(0, |summary| summary.iterations),
            cost: report.summary.map_or(f64::NAN, |summary| summary.final_cost),
            lost: report.verdict != Verdict::Tracked,
            solve_ms: self.last_solve_ms,
        });
    }
}

/// The machine, its solver, and what came of it.
pub(crate) struct Driver<S> {
    track: Tracker,
    solver: Solver,
    sink: S,
    pub(crate) run: Run,
}

impl<S: FnMut(&Output) -> Result<(), Failure>> Driver<S> {
    /// `sink` is told every output but the jobs.
    pub(crate) fn new(config: Config, rig: Arc<Rig>, solver: Solver, sink: S) -> Self {
        let errors_px = vec![CameraErrors::default(); rig.cameras.len()];
        let run = Run { errors_px, ..Run::default() };
        Self { track: Tracker::new(config, rig), solver, sink, run }
    }

    /// Gives the machine an input and does all that it then wants.
    pub(crate) fn feed(&mut self, input: Input) -> Result<(), Failure> {
        self.track.handle(input);
        while let Some(output) = self.track.poll_and_solve(|job| {
            let begin = Instant::now();
            let solution = self.solver.solve(job);
            let took = begin.elapsed();
            self.run.solving += took;
            if matches!(job.task, Task::Track { .. }) {
                self.run.last_solve_ms = took.as_secs_f64() * 1e3;
            }
            solution
        }) {
            self.run.keep(&output);
            (self.sink)(&output)?;
        }
        Ok(())
    }
}
