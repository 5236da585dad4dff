//! Drives the tracker with a recording; jobs are solved at once, on this thread.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Error;
use crate::core::body::Skeleton;
use crate::core::tracker::{Input, Output, Solver, Task, Tracker};

/// The tracker and its solver.
pub(crate) struct Driver {
    tracker: Tracker,
    solver: Solver,
    /// Solve time of the last window.
    pub(crate) window_solve: Duration,
}

impl Driver {
    pub(crate) fn new(tracker: Tracker, solver: Solver) -> Self {
        Self { tracker, solver, window_solve: Duration::ZERO }
    }

    /// The body with the newest keypoint offsets.
    pub(crate) fn skeleton(&self) -> Option<Arc<Skeleton>> {
        self.tracker.skeleton().cloned()
    }

    /// Nominal frame period, ns.
    pub(crate) fn frame_period(&self) -> f64 {
        self.tracker.frame_period()
    }

    /// Passes in an input, solves the jobs, and passes all other outputs to `take`.
    pub(crate) fn feed(
        &mut self,
        input: Input,
        mut take: impl FnMut(&Self, &Output) -> Result<(), Error>,
    ) -> Result<(), Error> {
        self.tracker.handle(input);
        while let Some(output) = self.tracker.poll_and_solve(|job| {
            let begin = Instant::now();
            let solution = self.solver.solve(job);
            if matches!(job.task, Task::Track { .. }) {
                self.window_solve = begin.elapsed();
            }
            solution
        }) {
            take(self, &output)?;
        }
        Ok(())
    }
}
