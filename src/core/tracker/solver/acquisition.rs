//! Acquisition: the first keyframe, and the body shape.

use std::sync::Arc;

use super::Solver;
use super::keyframes::between;
use crate::core::body::{BodyPoint, Skeleton};
use crate::core::cost::{
    self, FrameObservations, FreeBody, PathKeyframe, PathProblem, Scene, Stiffness, Workspace,
};
use crate::core::detections::Detections;
use crate::core::manifold::{Keyframe, TimedKeyframe};
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::acquire::{find_performer, fit};
use crate::core::tracker::job::{Job, Outcome};

/// Most keyframes in the solve of the shape.
const SHAPE_KEYFRAMES: usize = 10;
/// About the most frames, of all cameras together, that the shape is solved from: all of 16 cameras
/// at the default windows.
const SHAPE_FRAMES: usize = 480;

impl Solver {
    /// Finds the performer in the first frame set that shows one; if the shape is unknown, solves
    /// it from all windows of the job.
    pub(super) fn acquire(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Option<&Arc<Skeleton>>,
    ) -> Outcome {
        for (at, set) in frame_sets(&job.frames, job.half_period()) {
            let Some(seen) = find_performer(&set, &job.rig, points, &self.config) else { continue };
            let config = &self.config.cost;
            let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config };
            let template = known.map_or_else(Skeleton::default, |skeleton| (**skeleton).clone());
            let free = if known.is_none() { self.config.free_body() } else { FreeBody::Fixed };
            let (optimiser, work) = (&mut *self.acquisition_optimiser, &mut self.work);
            let found = fit(&seen, scene, &template, free, &self.config, optimiser, work);
            let Some((keyframe, rough)) = found else { continue };
            let first = TimedKeyframe::new(at, keyframe);
            let (keyframe, skeleton) = match known {
                Some(skeleton) => (first.keyframe, Arc::clone(skeleton)),
                None => {
                    let (keyframe, skeleton) = self.fit_shape(job, points, first, &rough);
                    (keyframe, Arc::new(skeleton))
                }
            };
            let keyframe = keyframe.quantised();
            let pose = Box::new(self.decoder.pose(&keyframe));
            let first = Box::new(TimedKeyframe::new(at, keyframe));
            return Outcome::Acquired { first, skeleton, pose };
        }
        Outcome::NobodyFound
    }

    /// Refines the first keyframe and the shape over all windows of the job at once. Before that,
    /// the later keyframes are solved one after the other.
    fn fit_shape(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        first: TimedKeyframe,
        rough: &Skeleton,
    ) -> (Keyframe, Skeleton) {
        let config = self.at_rate(job);
        let frames = config.window() * config.shape_windows.max(1);
        let spacing = frames.div_ceil(SHAPE_KEYFRAMES).max(config.keyframe());
        let steps = frames.div_ceil(spacing) as i64;
        let step = ((job.end - job.start) / steps).max(Nanos::new(1));
        let stride = job.frames.len().div_ceil(SHAPE_FRAMES).max(job.effort.stride).max(1);
        let frames = spacing as f64 / stride as f64;
        let used = job.every(stride).filter(|frame| frame.capture >= first.capture);
        let mut observations = self.follow(job, (used, stride), points, &first.keyframe, rough);
        // Only the shape and the first keyframe are kept, so few keyframes and no stiffness are
        // enough.
        let cost = cost::Config { stiffness: Stiffness::NONE, ..self.config.cost };
        let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config: &cost };
        let times = (0..=steps).map(|k| first.capture + step * k).collect::<Vec<_>>();
        let (optimiser, iterations) = (&mut self.acquisition_optimiser, self.config.iterations);
        let minimise = |problem: &mut PathProblem, x: &mut [f64]| {
            optimiser.minimise(problem, x, iterations);
        };
        let path = path_by_steps(
            scene,
            rough,
            &first,
            (&times, frames),
            &observations,
            &mut self.work,
            minimise,
        );
        let solved = path.last().map_or(first.capture, |last| last.capture);
        observations.retain(|frame| frame.capture <= solved);
        let path = path.into_iter().map(|at| PathKeyframe::free(at, frames)).collect();
        let (free, work) = (self.config.free_body(), &mut self.work);
        let mut problem = PathProblem::new(scene, path, rough, free, &observations, work);
        let mut x = problem.start();
        let iterations = self.config.acquisition_iterations;
        self.acquisition_optimiser.minimise(&mut problem, &mut x, iterations);
        let (keyframes, skeleton) = problem.solution(&x);
        (keyframes.into_iter().next().unwrap_or(first.keyframe), skeleton)
    }
}

/// Keyframes from `first` on, at the keyframe times among `times` that observations reach. Each is
/// solved alone, starting from the one before. Each stands for `frames` frames that are used.
fn path_by_steps(
    scene: Scene,
    skeleton: &Skeleton,
    first: &TimedKeyframe,
    (times, frames): (&[Timestamp], f64),
    observations: &[FrameObservations],
    work: &mut Workspace,
    mut minimise: impl FnMut(&mut PathProblem, &mut [f64]),
) -> Vec<TimedKeyframe> {
    let mut path = vec![first.clone()];
    for step in times.windows(2) {
        let inside = between(observations, [step[0], step[1]]);
        let Some(from) = path.last().filter(|_| !inside.is_empty()).cloned() else { continue };
        let to = PathKeyframe::free(TimedKeyframe::new(step[1], from.keyframe.clone()), frames);
        let both = vec![PathKeyframe::fixed(from), to];
        let mut problem = PathProblem::new(scene, both, skeleton, FreeBody::Fixed, inside, work);
        let mut x = problem.start();
        minimise(&mut problem, &mut x);
        let (keyframes, _) = problem.solution(&x);
        let solved = keyframes.into_iter().skip(1);
        path.extend(solved.map(|keyframe| TimedKeyframe::new(step[1], keyframe)));
    }
    path
}

/// Groups frames into sets: a set holds frames of different cameras, at most `half_period` after
/// its first frame.
fn frame_sets(
    frames: &[Arc<Detections>],
    half_period: Nanos,
) -> Vec<(Timestamp, Vec<&Detections>)> {
    let mut sets: Vec<(Timestamp, Vec<&Detections>)> = Vec::new();
    for frame in frames {
        match sets.last_mut() {
            Some((first, set))
                if frame.capture - *first <= half_period
                    && set.iter().all(|other| other.camera != frame.camera) =>
            {
                set.push(frame);
            }
            _ => sets.push((frame.capture, vec![frame])),
        }
    }
    sets
}
