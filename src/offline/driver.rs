//! Drives the stage with a recording; jobs are solved at once, on this thread.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Error;
use crate::core::body::Skeleton;
use crate::core::stage::{Input, Known, Output as Of, Stage};
use crate::core::tracker::{BodyEstimator, Output, Solver, Task, Tracker};

/// The stage and its solver.
pub(crate) struct Driver {
    stage: Stage,
    solver: Solver,
    /// Solve time of the last window.
    pub(crate) window_solve: Duration,
}

impl Driver {
    pub(crate) fn new(stage: Stage, solver: Solver) -> Self {
        Self { stage, solver, window_solve: Duration::ZERO }
    }

    /// A performer's body with the newest keypoint offsets.
    pub(crate) fn skeleton(&self, performer: usize) -> Option<Arc<Skeleton>> {
        self.stage.trackers().get(performer)?.skeleton().cloned()
    }

    /// The estimate of a performer's body.
    pub(crate) fn body_estimate(&self, performer: usize) -> Option<&Arc<BodyEstimator>> {
        self.stage.trackers().get(performer).map(Tracker::body_estimate)
    }

    /// The bodies of all performers so far.
    pub(crate) fn skeletons(&self) -> Vec<Option<Arc<Skeleton>>> {
        self.stage.trackers().iter().map(|tracker| tracker.skeleton().cloned()).collect()
    }

    /// Nominal frame period of a performer's poses, ns.
    pub(crate) fn frame_period(&self, performer: usize) -> Option<f64> {
        self.stage.trackers().get(performer).map(Tracker::frame_period)
    }

    /// With several performers, what is known of them.
    pub(crate) fn known(&self) -> Vec<Known> {
        self.stage.known()
    }

    /// The most people at a time who were seen for a while and not solved.
    pub(crate) fn others(&self) -> usize {
        self.stage.others()
    }

    /// Passes in an input, solves the jobs, and passes all other outputs to `take`, with the number of
    /// their performer.
    pub(crate) fn feed(
        &mut self,
        input: Input,
        mut take: impl FnMut(&Self, usize, &Output) -> Result<(), Error>,
    ) -> Result<(), Error> {
        self.stage.handle(input);
        while let Some(output) = self.stage.poll_and_solve(|job| {
            let begin = Instant::now();
            let solution = self.solver.solve(job);
            if matches!(job.task, Task::Track { .. }) {
                self.window_solve = begin.elapsed();
            }
            solution
        }) {
            match output {
                Of::Performer(performer, output) => take(self, performer.0, &output)?,
                // What concerns the cameras is counted with the first performer.
                Of::Event(event) => take(self, 0, &Output::Event(event))?,
                Of::Frames(..) => {}
            }
        }
        Ok(())
    }
}
