//! Drives the stage with a recording. Several threads solve the performers in parallel: offline, none of them depends on
//! the poses of another one. The result is the same with any number of threads.

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

/// Number of items of the recording that are solved together.
const BATCH: usize = 512;

/// Steps or inputs, each with its number. The numbers give the order of all.
type Numbered<T> = Vec<(usize, T)>;

/// The stage and its solvers.
pub(crate) struct Driver {
    stage: Stage,
    /// By performer.
    solvers: Vec<TimedSolver>,
    decoder: Decoder,
    config: Config,
    /// `None`: the calling thread solves alone.
    threads: Option<ThreadPool>,
    /// Items that wait.
    batch: Vec<Item>,
    /// What happened before them.
    steps: Vec<Step>,
}

/// What happened, in order.
pub(crate) enum Step {
    /// The recording has come to this item.
    Item(Item),
    /// An output, with the number of its performer. Outputs about the cameras have the number of the first performer.
    Output(usize, Output, State),
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
    /// `threads`: 0 is one for each processor.
    pub(crate) fn new(stage: Stage, decoder: Decoder, config: Config, threads: usize) -> Self {
        let new = || ThreadPoolBuilder::new().num_threads(threads).build();
        let threads = (threads != 1).then(new).and_then(|pool| {
            pool.inspect_err(|error| tracing::warn!("solving on one thread: {error}")).ok()
        });
        // More threads for a window would slow down the other performers.
        let config = Config { threads: 1, ..config };
        let (solvers, batch, steps) = (Vec::new(), Vec::new(), Vec::new());
        Self { stage, solvers, decoder, config, threads, batch, steps }
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

    /// Takes the next item of the recording; `None` is its end. Items are solved in batches. While a batch is solved, the
    /// steps of the batch before it are passed to `take`. The steps have the order of a solve on one thread.
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
        let before = std::mem::take(&mut self.steps);
        let (mut steps, inputs) = self.route(is_end);
        let Self { stage, solvers, decoder, config, threads, .. } = self;
        let new = || TimedSolver::new(decoder.clone(), *config);
        solvers.resize_with(solvers.len().max(inputs.len()), new);
        let all = stage.trackers_mut().iter_mut().zip(solvers).zip(inputs);
        let all: Vec<_> = all.enumerate().collect();
        let solve = |(performer, ((tracker, solver), inputs)): (_, ((_, &mut TimedSolver), _))| {
            solver.run(performer, tracker, inputs)
        };
        let mut solved = Vec::new();
        match threads {
            None => {
                before.into_iter().try_for_each(&mut take)?;
                solved.extend(all.into_iter().map(solve));
            }
            Some(threads) => threads.in_place_scope(|scope| {
                scope.spawn(|_| solved.par_extend(all.into_par_iter().map(solve)));
                before.into_iter().try_for_each(&mut take)
            })?,
        }
        steps.extend(solved.into_iter().flatten());
        steps.sort_by_key(|(number, _)| *number);
        self.steps = steps.into_iter().map(|(_, step)| step).collect();
        match is_end {
            true => std::mem::take(&mut self.steps).into_iter().try_for_each(take),
            false => Ok(()),
        }
    }

    /// The steps of the waiting items without those of the trackers, and the inputs of the trackers by performer.
    fn route(&mut self, is_end: bool) -> (Numbered<Step>, Vec<Numbered<tracker::Input>>) {
        let (mut steps, mut inputs, mut number) = (Vec::new(), Vec::new(), 0);
        let end = is_end.then_some(None);
        for item in std::mem::take(&mut self.batch).into_iter().map(Some).chain(end) {
            let input = match &item {
                Some(Item::Detections(frame, _)) => Some(Input::Detections(frame.clone())),
                Some(_) => None,
                None => Some(Input::End),
            };
            steps.extend(item.map(|item| (number, Step::Item(item))));
            for next in input.into_iter().flat_map(|input| self.stage.route(input)) {
                number += 1;
                let (performer, output) = match next {
                    Next::Output(Of::Performer(performer, output)) => (performer.0, output),
                    Next::Output(Of::Event(event)) => (0, Output::Event(event)),
                    Next::Output(Of::Frames(..)) => continue,
                    Next::Tracker(performer, input) => {
                        inputs.resize_with(inputs.len().max(performer + 1), Vec::new);
                        inputs[performer].push((number, input));
                        continue;
                    }
                };
                steps.push((number, Step::Output(performer, output, State::default())));
            }
            number += 1;
        }
        (steps, inputs)
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

    /// Gives inputs to the tracker of a performer. Returns its outputs.
    fn run(
        &mut self,
        performer: usize,
        tracker: &mut Tracker,
        inputs: Numbered<tracker::Input>,
    ) -> Numbered<Step> {
        let mut steps = Vec::new();
        for (number, input) in inputs {
            tracker.handle(input);
            while let Some(output) = tracker.poll_and_solve(|job| self.solve(job)) {
                let state = State {
                    skeleton: tracker.skeleton().cloned(),
                    estimate: Arc::clone(tracker.body_estimate()),
                    window_solve: self.window_solve,
                };
                steps.push((number, Step::Output(performer, output, state)));
            }
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

#[cfg(all(test, feature = "research"))]
mod tests {
    use super::*;
    use crate::core::body::Shape;
    use crate::core::camera::Rig;
    use crate::core::detections::Detections;
    use crate::core::stage::Performers;
    use crate::research::synth::{Crowd, Meeting, Noise, Recording};

    /// The crossing of three people.
    fn crossing() -> (Rig, Vec<Detections>) {
        let meeting = Meeting { people: 3, distance: None };
        let rig = meeting.rig(4).unwrap();
        let recording = |person| {
            let (body, motion) = meeting.person(person, 1);
            let mut recording = Recording::new(rig.clone(), body, motion);
            (recording.fps, recording.frames) = (60.0, 240);
            (recording.noise, recording.seed) = (Noise::studio(), 1 + person as u64);
            recording
        };
        let crowd = Crowd::new((0..3).map(recording).collect());
        let frames = crowd.detections().map(|(frame, _)| frame).collect();
        (rig, frames)
    }

    #[test]
    fn all_happens_in_the_order_of_one_thread_that_solves_each_job_at_once() {
        let (rig, frames) = crossing();
        let (decoder, config) = (Decoder::embedded().unwrap(), Config::default());
        let tracker = Tracker::new(config, Arc::new(rig));
        let body = Some(Arc::new(Skeleton::new(Shape::symmetric([0.5; 10]))));
        let stage = || {
            Stage::new(tracker.clone(), Performers::Auto, None)
                .with_bodies(vec![None, body.clone()])
        };
        let of = |performer: usize, output: &Output| format!("{performer}: {output:?}");
        let (mut stage_alone, mut solver) = (stage(), Solver::new(decoder.clone(), config));
        let mut alone = Vec::new();
        for frame in frames.iter().map(Some).chain([None]) {
            alone.extend(frame.map(|frame| format!("{frame:?}")));
            stage_alone.handle(frame.cloned().map_or(Input::End, Input::Detections));
            while let Some(output) = stage_alone.poll_and_solve(|job| solver.solve(job)) {
                alone.extend(match output {
                    Of::Performer(performer, output) => Some(of(performer.0, &output)),
                    Of::Event(event) => Some(of(0, &Output::Event(event))),
                    Of::Frames(..) => None,
                });
            }
        }
        for threads in [1, 3] {
            let mut driver = Driver::new(stage(), decoder.clone(), config, threads);
            let mut steps = Vec::new();
            for frame in frames.iter().map(Some).chain([None]) {
                let item = frame.map(|frame| Item::Detections(frame.clone(), 0));
                let take = |step| {
                    steps.push(match step {
                        Step::Item(Item::Detections(frame, _)) => format!("{frame:?}"),
                        Step::Item(_) => unreachable!("no truth is given"),
                        Step::Output(performer, output, _) => of(performer, &output),
                    });
                    Ok(())
                };
                driver.feed(item, take).unwrap();
            }
            let poses = steps.iter().filter(|step| step.starts_with("2: Pose")).count();
            assert!(poses > 200, "{poses}");
            assert!(steps == alone, "{threads} threads");
        }
    }
}
