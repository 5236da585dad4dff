//! Solves the keyframes of a window together.

use super::Solver;
use super::catch_up::widened;
use super::known::Known;
use crate::core::body::BodyPoint;
use crate::core::cost::{self, FrameObservations, FreeBody, PathKeyframe, PathProblem, Scene};
use crate::core::manifold::{Interpolation, Keyframe, TimedKeyframe};
use crate::core::optimise::{Problem, Summary};
use crate::core::time::Timestamp;
use crate::core::tracker::config::Config;
use crate::core::tracker::job::Job;

/// A window's start values are too far from the detections if its new frames cost this much more
/// than the known ones, as a fraction of the largest possible cost.
const FAR: f64 = 0.3;
/// Then its keyframes are solved roughly, one after the other, with a wide loss.
const ONE_BY_ONE: Steps = Steps { iterations: 1, scale_factor: 3.0, may_catch_up: false };

/// A window has iterations with a wide loss at most so often.
const CATCH_UPS: usize = 2;

/// Smallest scale of a loss that follows the detections, pixels: below it are the errors of our model.
const LEAST_SCALE_PX: f64 = 6.0;

/// Settings of a keyframe solve.
#[derive(Clone, Copy)]
pub(super) struct Steps {
    /// Most iterations.
    iterations: usize,
    /// Factor of the loss's scale.
    scale_factor: f64,
    /// Whether iterations with a wide loss may come first.
    may_catch_up: bool,
}

impl Steps {
    pub(super) fn of(iterations: usize) -> Self {
        Self { iterations, scale_factor: 1.0, may_catch_up: true }
    }
}

impl Solver {
    /// Solves the keyframes at those `times` that are after the last final one, together.
    pub(super) fn keyframes(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Known,
        times: &[Timestamp],
        observations: &[FrameObservations],
        steps: Steps,
    ) -> (Vec<TimedKeyframe>, Summary) {
        let cost = self.cost(job);
        let scale_px = cost.scale_px * steps.scale_factor;
        let cost = cost::Config { scale_px, ..cost };
        let interpolation = cost.interpolation;
        let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config: &cost };
        let start = known.past.last().map_or(job.start, |last| last.capture);
        let free = || times.iter().copied().filter(|&capture| capture > start);
        let path = path(job, known, free(), interpolation);
        let (body, work) = (FreeBody::Fixed, &mut self.work);
        let mut problem = PathProblem::new(scene, path, known.skeleton, body, observations, work);
        let mut x = problem.start();
        let cost = problem.cost(&x);
        let known_until = known.end(job) + job.half_period();
        let mut misfits = problem.misfits(known_until);
        if let Some(last_two) = known.last_two() {
            let moved_on = problem
                .start_at(|_, keyframe| extrapolated_root(last_two, interpolation, keyframe));
            if problem.cost(&moved_on) < cost {
                (x, misfits) = (moved_on, problem.misfits(known_until));
            }
        }
        let new = free().filter(|&at| at > known.end(job)).count();
        if new > 1 && misfits[1] - misfits[0] > FAR {
            let ahead = self.one_by_one(job, points, known, times, observations);
            let known = Known { ahead: &ahead, ..known };
            return self.keyframes(job, points, known, times, observations, steps);
        }
        let catch_up = self.config.catch_up_iterations.min(steps.iterations);
        let may_catch_up = steps.may_catch_up
            && catch_up > 0
            && job.effort.has_time(&self.config)
            && job.noise.is_settled();
        let catch_ups = if may_catch_up { CATCH_UPS } else { 0 };
        for _ in 0..catch_ups {
            let Some(wide) = widened(&mut problem, &x, observations, &job.rig, scale_px) else {
                break;
            };
            problem.replace_observations(Some(wide));
            self.optimiser.minimise(&mut problem, &mut x, catch_up);
            problem.replace_observations(None);
        }
        let summary = self.optimiser.minimise(&mut problem, &mut x, steps.iterations);
        let (solved, _) = problem.solution(&x);
        let solved = solved.into_iter().skip(known.past.len()).map(Keyframe::quantised);
        (
            free().zip(solved).map(|(at, keyframe)| TimedKeyframe::new(at, keyframe)).collect(),
            summary,
        )
    }

    /// The keyframes of a window, the new ones solved roughly, one after the other. For quick
    /// motion: there the body leaves the range of the loss within a window.
    fn one_by_one(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Known,
        times: &[Timestamp],
        observations: &[FrameObservations],
    ) -> Vec<TimedKeyframe> {
        let mut path = [known.past, known.ahead].concat();
        for &time in times.iter().filter(|&&time| time > known.end(job)) {
            let past = &path[path.len().saturating_sub(2)..];
            let step = Known { past, ahead: &[], ..known };
            let seen =
                between(observations, [step.end(job), time].map(|at| at + job.half_period()));
            path.extend(self.keyframes(job, points, step, &[time], seen, ONE_BY_ONE).0);
        }
        path.split_off(known.past.len())
    }

    /// The settings at the cameras' frame rate.
    pub(super) fn at_rate(&self, job: &Job) -> Config {
        self.config.at_period(job.frame_period.ns() as f64)
    }

    /// The cost's weights, with priors and stiffness scaled by the variance of the detections, and the
    /// loss by their median error.
    pub(super) fn cost(&self, job: &Job) -> cost::Config {
        let Config { cost, reference_residual_px, relative_scale, .. } = self.config;
        let factor = job.noise.factor(reference_residual_px);
        let error_px = job.noise.error_px().filter(|_| relative_scale > 0.0);
        let scale_px = error_px.map_or(cost.scale_px, |error_px| {
            (relative_scale * error_px).max(LEAST_SCALE_PX).min(cost.scale_px)
        });
        let (prior, stiffness) = (cost.prior * factor, cost.stiffness.times(factor));
        let [correction_prior, foot_contact] =
            [cost.correction_prior, cost.foot_contact].map(|weight| weight * factor);
        cost::Config { scale_px, prior, correction_prior, foot_contact, stiffness, ..cost }
    }
}

/// The path of a window: the fixed final keyframes, then free ones at `times`, from known values.
fn path(
    job: &Job,
    known: Known,
    times: impl Iterator<Item = Timestamp>,
    interpolation: Interpolation,
) -> Vec<PathKeyframe> {
    let mut path: Vec<PathKeyframe> = known.fixed().collect();
    let period = job.used_period();
    let mut before = known.past.last().map_or(job.start, |last| last.capture);
    for capture in times {
        let Some(keyframe) = known.at(capture, interpolation) else { continue };
        let frames = (capture - before).ns() as f64 / period;
        path.push(PathKeyframe::free(TimedKeyframe::new(capture, keyframe), frames));
        before = capture;
    }
    path
}

/// A start value: the code of the last keyframe, and the root's motion over the last two,
/// extrapolated.
fn extrapolated_root(
    [before, last]: [&TimedKeyframe; 2],
    interpolation: Interpolation,
    keyframe: &PathKeyframe,
) -> Keyframe {
    let at = &keyframe.timed;
    if at.capture <= last.capture {
        return at.keyframe.clone();
    }
    let s = at.capture.fraction(before.capture, last.capture);
    let z = last.keyframe.z;
    Keyframe { z, ..interpolation.keyframe(&before.keyframe, &last.keyframe, s) }
}

/// The observations after one time, up to another.
pub(super) fn between(
    observations: &[FrameObservations],
    [after, to]: [Timestamp; 2],
) -> &[FrameObservations] {
    let [first, end] =
        [after, to].map(|at| observations.partition_point(|frame| frame.capture <= at));
    &observations[first..end]
}
