//! The solver: solves jobs. It keeps only scratch memory.

mod acquisition;
mod catch_up;
mod deviations;
mod fresh_fit;
mod keyframes;
mod known;
mod window;

use std::fmt;
use std::sync::Arc;

use super::association::follow;
use super::config::{Config, MOST_THREADS};
use super::job::{Job, Outcome, Placed, Solution, Task};
use super::spin_pool::SpinPool;
use crate::core::body::{BodyPoint, Pose, Skeleton, fitted_points};
use crate::core::calibration::mend;
use crate::core::cost::{FrameObservations, Workspace};
use crate::core::detections::Detections;
use crate::core::manifold::{Decoder, Keyframe};
use crate::core::optimise::Optimiser;
use crate::core::time::Timestamp;
use known::Known;

/// The acquisition stops if a step lowers the cost by less than this fraction; small, because the
/// shape comes from it.
const ACQUISITION_CHANGE: f64 = 1e-4;

/// Solves a [`Task::Mend`], which no pose waits for; it needs no [`Solver`]. Any other task gives
/// `Outcome::Mended(None)`.
pub fn solve_aside(job: &Job) -> Solution {
    let placed = match &job.task {
        Task::Mend { camera, seen: [before, after] } => {
            let original = job.rig.cameras.get(*camera);
            original.and_then(|original| mend([before, after], original, *camera))
        }
        _ => None,
    };
    let placed = placed.map(|(camera, by)| Box::new(Placed { camera, by }));
    Solution { number: job.number, outcome: Outcome::Mended(placed) }
}

/// Solves jobs. The same job always gives the same solution.
pub struct Solver {
    decoder: Decoder,
    config: Config,
    optimiser: Box<dyn Optimiser>,
    acquisition_optimiser: Box<dyn Optimiser>,
    work: Workspace,
    /// The pool of solver threads; `None` if the calling thread solves alone.
    pool: Option<SpinPool>,
}

impl fmt::Debug for Solver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Solver").field("config", &self.config).finish_non_exhaustive()
    }
}

impl Solver {
    /// A solver with a manifold. Starts the threads in `config`; if the system refuses them, it
    /// solves on the calling thread.
    pub fn new(decoder: Decoder, config: Config) -> Self {
        let optimiser = config.optimiser.optimiser(config.change_threshold);
        let change = config.change_threshold.min(ACQUISITION_CHANGE);
        let acquisition_optimiser = config.optimiser.optimiser(change);
        let threads = config.threads.min(MOST_THREADS);
        let pool = (threads > 1).then(|| SpinPool::of(threads)).and_then(|pool| {
            pool.inspect_err(|error| tracing::warn!("solving on one thread: {error}")).ok()
        });
        let work = match pool {
            Some(_) => Workspace::in_parallel(),
            None => Workspace::default(),
        };
        Self { decoder, config, optimiser, acquisition_optimiser, work, pool }
    }

    /// The manifold.
    pub fn decoder(&self) -> &Decoder {
        &self.decoder
    }

    /// Solves a job.
    pub fn solve(&mut self, job: &Job) -> Solution {
        let outcome = match self.pool.take() {
            None => self.outcome(job),
            Some(pool) => {
                let mut outcome = Outcome::NobodyFound;
                pool.run(|| outcome = self.outcome(job));
                self.pool = Some(pool);
                outcome
            }
        };
        Solution { number: job.number, outcome }
    }

    fn outcome(&mut self, job: &Job) -> Outcome {
        let points = fitted_points(job.format);
        match &job.task {
            Task::Acquire { skeleton } => self.acquire(job, &points, skeleton.as_ref()),
            Task::Track { past, ahead, skeleton, estimator, coasted } => {
                let known = Known { past, ahead, skeleton };
                self.track(job, &points, known, (skeleton, estimator), *coasted)
            }
            Task::Provisional { past, ahead, skeleton, again } => {
                self.provisional(job, &points, Known { past, ahead, skeleton }, *again)
            }
            Task::Mend { .. } => solve_aside(job).outcome,
        }
    }

    /// The performer's observations in `frames` of a job, every `stride`th of a camera, followed from the
    /// pose of `keyframe`.
    fn follow<'d>(
        &self,
        job: &Job,
        (frames, stride): (impl Iterator<Item = &'d Arc<Detections>>, usize),
        points: &[BodyPoint],
        keyframe: &Keyframe,
        skeleton: &Skeleton,
    ) -> Vec<FrameObservations> {
        let (frames, pose) = (frames.map(|frame| &**frame), self.decoder.pose(keyframe));
        let spacing = job.frame_period * stride as i64;
        follow(frames, spacing, points, &job.rig, &pose, skeleton, &self.config)
    }

    /// The poses at `times` of a window with known keyframes. Equal times are decoded once.
    fn poses_at(&self, window: Known, times: impl Iterator<Item = Timestamp>) -> Vec<Pose> {
        let interpolation = self.config.cost.interpolation;
        let times: Vec<Timestamp> = times.collect();
        let mut once = times.clone();
        once.sort_unstable();
        once.dedup();
        let keyframes: Option<Vec<Keyframe>> =
            once.iter().map(|&capture| window.at(capture, interpolation)).collect();
        let poses = keyframes.map_or_else(Vec::new, |keyframes| self.decoder.poses(&keyframes));
        let pose = |time: &Timestamp| poses.get(once.binary_search(time).ok()?).cloned();
        times.iter().filter_map(pose).collect()
    }
}
