//! Drives the stage with a recording. Several performers are solved beside each other, on several threads: offline, none
//! of them depends on another one's poses. The result is the same with any number of threads.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rayon::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use super::Error;
use super::recording::Item;
use crate::core::body::Skeleton;
use crate::core::manifold::Decoder;
use crate::core::stage::{Input, Known, Next, Output as Of, Stage};
use crate::core::tracker::{
    self, BodyEstimator, Config, Job, Output, Solution, Solver, Task, Tracker,
};

/// So many items of the recording are solved together.
const BATCH: usize = 512;

/// The stage and its solvers.
pub(crate) struct Driver {
    stage: Stage,
    decoder: Decoder,
    config: Config,
    /// By performer.
    solvers: Vec<TimedSolver>,
    /// `None`: the calling thread solves alone.
    threads: Option<ThreadPool>,
    batch: Vec<Item>,
}

/// What happened, in order.
pub(crate) enum Step {
    /// The recording has come to this item.
    Item(Item),
    /// The stage has put this out, with the number of the performer. What concerns the cameras is counted with the first.
    Output(usize, Output, State),
}

/// What happened, or the place of what a tracker puts out at its next input.
enum Place {
    Step(Step),
    Tracker(usize),
}

/// What is known of a performer at an output.
#[derive(Clone, Default)]
pub(crate) struct State {
    /// The body with the newest keypoint offsets.
    pub(crate) skeleton: Option<Arc<Skeleton>>,
    /// The estimate of the body.
    pub(crate) estimate: Arc<BodyEstimator>,
    /// Solve time of the last window.
    pub(crate) window_solve: Duration,
}

impl Driver {
    /// `threads`: for several performers; 0: one for each processor.
    pub(crate) fn new(stage: Stage, decoder: Decoder, config: Config, threads: usize) -> Self {
        let new = || ThreadPoolBuilder::new().num_threads(threads).build();
        let threads = (threads != 1 && stage.has_several()).then(new).and_then(|pool| {
            pool.inspect_err(|error| tracing::warn!("solving on one thread: {error}")).ok()
        });
        // A performer's solver needs no threads beside those of the others.
        let config = if threads.is_some() { Config { threads: 1, ..config } } else { config };
        Self { stage, decoder, config, solvers: Vec::new(), threads, batch: Vec::new() }
    }

    /// The bodies of all performers so far.
    pub(crate) fn skeletons(&self) -> Vec<Option<Arc<Skeleton>>> {
        self.stage.trackers().iter().map(|tracker| tracker.skeleton().cloned()).collect()
    }

    /// Nominal frame periods of the performers' poses, ns.
    pub(crate) fn frame_periods(&self) -> Vec<f64> {
        self.stage.trackers().iter().map(Tracker::frame_period).collect()
    }

    /// With several performers, what is known of them.
    pub(crate) fn known(&self) -> Vec<Known> {
        self.stage.known()
    }

    /// The most people at a time who were seen for a while and not solved.
    pub(crate) fn others(&self) -> usize {
        self.stage.others()
    }

    /// Passes in an item of the recording, or its end. Passes on what happened, in the order of one thread that solves each
    /// job at once, as soon as enough items are there.
    pub(crate) fn feed(
        &mut self,
        item: Option<Item>,
        mut take: impl FnMut(Step) -> Result<(), Error>,
    ) -> Result<(), Error> {
        let is_end = item.is_none();
        self.batch.extend(item);
        if !is_end && self.batch.len() < BATCH {
            return Ok(());
        }
        let (mut places, mut inputs) = (Vec::new(), Vec::new());
        let end = is_end.then_some(None);
        for item in std::mem::take(&mut self.batch).into_iter().map(Some).chain(end) {
            let input = match &item {
                Some(Item::Detections(frame, _)) => Some(Input::Detections(frame.clone())),
                Some(_) => None,
                None => Some(Input::End),
            };
            places.extend(item.map(|item| Place::Step(Step::Item(item))));
            for next in input.into_iter().flat_map(|input| self.stage.route(input)) {
                places.push(match next {
                    Next::Tracker(performer, input) => {
                        inputs.resize_with(inputs.len().max(performer + 1), Vec::new);
                        inputs[performer].push(input);
                        Place::Tracker(performer)
                    }
                    Next::Output(Of::Performer(performer, output)) => {
                        Place::Step(Step::Output(performer.0, output, State::default()))
                    }
                    Next::Output(Of::Event(event)) => {
                        Place::Step(Step::Output(0, Output::Event(event), State::default()))
                    }
                    Next::Output(Of::Frames(..)) => continue,
                });
            }
        }
        let mut outputs = self.solve(inputs);
        for place in places {
            match place {
                Place::Step(step) => take(step)?,
                Place::Tracker(performer) => {
                    let steps = outputs[performer].pop_front().into_iter().flatten();
                    steps.into_iter().try_for_each(&mut take)?;
                }
            }
        }
        Ok(())
    }

    /// Gives each tracker its inputs. Returns what each of them puts out, by performer and input.
    fn solve(&mut self, mut inputs: Vec<Vec<tracker::Input>>) -> Vec<VecDeque<Vec<Step>>> {
        let Self { stage, decoder, config, solvers, threads, .. } = self;
        let trackers = stage.trackers_mut();
        inputs.resize_with(trackers.len(), Vec::new);
        solvers.resize_with(trackers.len(), || TimedSolver::new(decoder.clone(), *config));
        let mut all: Vec<_> = trackers.iter_mut().zip(solvers).zip(inputs).enumerate().collect();
        let work = |(performer, ((tracker, solver), inputs)): &mut (
            usize,
            ((&mut Tracker, &mut TimedSolver), Vec<_>),
        )| {
            inputs.drain(..).map(|input| solver.run(*performer, tracker, input)).collect()
        };
        match threads {
            None => all.iter_mut().map(work).collect(),
            Some(threads) => threads.install(|| all.par_iter_mut().map(work).collect()),
        }
    }
}

/// A solver, and the time that it took for the last window.
struct TimedSolver {
    solver: Solver,
    window_solve: Duration,
}

impl TimedSolver {
    fn new(decoder: Decoder, config: Config) -> Self {
        Self { solver: Solver::new(decoder, config), window_solve: Duration::ZERO }
    }

    /// What the tracker of a performer puts out at an input.
    fn run(&mut self, performer: usize, tracker: &mut Tracker, input: tracker::Input) -> Vec<Step> {
        tracker.handle(input);
        let mut steps = Vec::new();
        while let Some(output) = tracker.poll_and_solve(|job| self.solve(job)) {
            let (skeleton, estimate) =
                (tracker.skeleton().cloned(), tracker.body_estimate().clone());
            let state = State { skeleton, estimate, window_solve: self.window_solve };
            steps.push(Step::Output(performer, output, state));
        }
        steps
    }

    fn solve(&mut self, job: &Job) -> Solution {
        let begin = Instant::now();
        let solution = self.solver.solve(job);
        if matches!(job.task, Task::Track { .. }) {
            self.window_solve = begin.elapsed();
        }
        solution
    }
}
