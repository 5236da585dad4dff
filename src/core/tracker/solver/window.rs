//! Solves a window, and fits the open one provisionally.

use std::sync::Arc;

use super::Solver;
use super::keyframes::{Steps, between};
use super::known::Known;
use crate::core::body::{BODY_COEFFICIENTS, BodyPoint, OffsetPrior, Pose, Skeleton};
use crate::core::cost::{
    self, CorrectionProblem, FrameObservations, PathKeyframe, PathProblem, Scene,
};
use crate::core::manifold::{Correction, Keyframe, TimedKeyframe, in_order};
use crate::core::optimise::Summary;
use crate::core::time::Timestamp;
use crate::core::tracker::agreement::{Unfollowed, unfollowed};
use crate::core::tracker::body_estimator::BodyEstimator;
use crate::core::tracker::job::{Job, Outcome, ProvisionalFit, Tracked, Verdict};
use crate::core::tracker::noise::Residual;
use crate::core::tracker::verdict::{hidden, residuals, verdict};

/// Time constant of the decay of an extrapolated motion, seconds.
const DECAY: f64 = 0.1;
/// The share of the previous window in the first keyframes falls from this to 0.
const BLEND: f64 = 0.5;
/// Smallest variance of the detections, relative to the reference level, when the body is estimated:
/// much of their error is constant.
const LEAST_BODY_NOISE: f64 = 0.3;
/// Factor of the prior on codes when the body is estimated.
const CODE_PRIOR_FACTOR: f64 = 0.1;

impl Solver {
    /// Solves the keyframes of a window and gives the verdict on them.
    pub(super) fn track(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Known,
        (skeleton, estimator): (&Arc<Skeleton>, &BodyEstimator),
        coasted: usize,
    ) -> Outcome {
        let Some(from) = known.past.last() else { return Outcome::NobodyFound };
        let used = (job.used_frames(), job.effort.stride);
        let observations = self.follow(job, used, points, &from.keyframe, skeleton);
        if let Some(hidden) = hidden(&self.config.gate, job, &observations) {
            // After a window without the performer, there may be a person elsewhere.
            let found = (coasted > 0).then(|| self.acquire(job, points, Some(skeleton)));
            let found = found.filter(|found| matches!(found, Outcome::Acquired { .. }));
            return found.unwrap_or_else(|| self.coast(job, known, coasted, hidden));
        }
        let (times, steps) = (&job.keyframe_times, Steps::of(job.effort.iterations));
        let (keyframes, summary) = self.keyframes(job, points, known, times, &observations, steps);
        let solved = Known { ahead: &keyframes, ..known };
        if let Some(found) = self.fresh_fit(job, points, solved, skeleton, &observations) {
            return found;
        }
        let keyframes = self.correct(job, points, known, keyframes, &observations);
        let keyframes = self.blend(job, known, keyframes);
        let solved = Known { ahead: &keyframes, ..known };
        let between = self.between(job, solved);
        let path = in_order(&keyframes, &between);
        let (residuals, unfollowed, poses) =
            self.judge(job, points, Known { ahead: &path, ..known }, &observations);
        let verdict = verdict(&self.config.gate, &keyframes, &residuals);
        let is_estimating = matches!(verdict, Verdict::Tracked)
            && self.config.body_windows > 0
            && !estimator.is_complete()
            && job.window.is_multiple_of(self.config.body_windows as u64);
        let estimator = is_estimating
            .then(|| self.estimate_body(job, points, solved, &observations, estimator))
            .flatten();
        let deviations = (job.effort.deviations && matches!(verdict, Verdict::Tracked))
            .then(|| self.deviations(job, points, solved, &residuals))
            .flatten();
        let tracked = tracked(solved, poses, Some(summary), residuals, verdict);
        let estimator = estimator.map(Arc::new);
        Outcome::Tracked(Box::new(Tracked {
            between,
            estimator,
            unfollowed,
            deviations,
            ..tracked
        }))
    }

    /// Keyframes between the solved ones, at the times of poses, on a smooth path. None if the settings ask for fewer
    /// keyframes than frames: then the path between them is a part of the method.
    fn between(&self, job: &Job, solved: Known) -> Vec<TimedKeyframe> {
        if self.config.keyframe_frames > 1 {
            return Vec::new();
        }
        let interpolation = self.config.cost.interpolation;
        let keyframe = |&time: &Timestamp| {
            Some(TimedKeyframe::new(time, solved.between(time, interpolation)?.quantised()))
        };
        job.pose_times.iter().filter_map(keyframe).collect()
    }

    /// Adds corrections beside the manifold to solved keyframes.
    fn correct(
        &self,
        job: &Job,
        points: &[BodyPoint],
        known: Known,
        keyframes: Vec<TimedKeyframe>,
        observations: &[FrameObservations],
    ) -> Vec<TimedKeyframe> {
        let cost = self.cost(job);
        if cost.correction_prior == 0.0 || keyframes.is_empty() {
            return keyframes;
        }
        let start = known.past.last().map_or(job.start, |last| last.capture);
        let seen = between(observations, [start, job.end].map(|at| at + job.half_period()));
        let all = on_manifold(&[known.past, &keyframes].concat());
        let (first, others) = all.split_at(1);
        let solved = Known { past: first, ahead: others, ..known };
        let (times, stands) = (seen.iter().map(|frame| frame.capture), cost.foot_contact > 0.0);
        let standing = all.iter().filter(|_| stands).map(|at| at.capture);
        let mut poses = self.poses_at(solved, times.chain(standing));
        let standing = poses.split_off(seen.len());
        let mut before = start;
        let free = keyframes.into_iter().map(|at| {
            let period = job.frame_period.ns().max(1) as f64;
            let frames = libm::round((at.capture - before).ns() as f64 / period).max(1.0);
            before = at.capture;
            PathKeyframe::free(at, frames * period / job.used_period())
        });
        let path = known.fixed().chain(free).collect();
        let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config: &cost };
        CorrectionProblem::new(scene, path, known.skeleton, seen, poses, standing).solve()
    }

    /// The residuals of the final part of a solved window, its points that are seen and not followed,
    /// and the poses at [`wanted_times`].
    fn judge(
        &self,
        job: &Job,
        points: &[BodyPoint],
        solved: Known,
        observations: &[FrameObservations],
    ) -> (Vec<Residual>, Vec<Unfollowed>, Vec<Pose>) {
        let last = job.publish + job.half_period();
        let seen: Vec<&FrameObservations> =
            observations.iter().filter(|frame| frame.capture <= last).collect();
        let times = seen.iter().map(|frame| frame.capture);
        let mut poses = self.poses_at(solved, times.chain(wanted_times(job)));
        let wanted = poses.split_off(seen.len());
        let seen = || seen.iter().copied().zip(&poses);
        let residuals = residuals(seen(), points, &job.rig, solved.skeleton);
        let (world, scale_px) = ((&*job.rig, solved.skeleton), self.cost(job).scale_px);
        let unfollowed = unfollowed(seen(), &residuals, points, world, scale_px);
        (residuals, unfollowed, wanted)
    }

    /// The estimate of the body after one more solved window.
    fn estimate_body(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        solved: Known,
        observations: &[FrameObservations],
        estimator: &BodyEstimator,
    ) -> Option<BodyEstimator> {
        // The prior pulls poses away from the detections; the body must not absorb that.
        let cost = self.cost(job);
        let noise = job.noise.factor(self.config.reference_residual_px).max(LEAST_BODY_NOISE);
        let prior = CODE_PRIOR_FACTOR * noise * self.config.cost.prior;
        // The estimator has the priors of the body.
        let cost = cost::Config { prior, offset_prior: 0.0, shape_prior: 0.0, ..cost };
        let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config: &cost };
        let frames = self.at_rate(job).keyframe() as f64 * job.frame_period.ns().max(1) as f64;
        let frames = frames / job.used_period();
        let ahead = solved.ahead.iter().cloned().map(|at| PathKeyframe::free(at, frames));
        let path = solved.fixed().chain(ahead).collect();
        let (free, work) = (self.config.free_body(), &mut self.work);
        let mut problem = PathProblem::new(scene, path, solved.skeleton, free, observations, work);
        // The frames of fast cameras are not independent: they tell no more of the body.
        let alike = (self.config.keyframe() as f64 / frames).min(1.0);
        let marginal = problem.marginal(&problem.start(), BODY_COEFFICIENTS)?.scaled(alike);
        let prior = (&OffsetPrior::of(job.format), self.config.cost.offset_prior);
        estimator.with(&marginal, solved.skeleton, noise, prior)
    }

    /// Blends the first final keyframes with those of the previous window, with decreasing shares,
    /// so that the path has no kink between windows.
    fn blend(
        &self,
        job: &Job,
        known: Known,
        mut keyframes: Vec<TimedKeyframe>,
    ) -> Vec<TimedKeyframe> {
        let count = keyframes.iter().filter(|at| at.capture <= job.publish).count();
        let interpolation = self.config.cost.interpolation;
        for (k, TimedKeyframe { capture, keyframe }) in keyframes[..count].iter_mut().enumerate() {
            let Some(before) =
                known.at(*capture, interpolation).filter(|_| *capture <= known.end(job))
            else {
                break;
            };
            let share = BLEND * (count - k - 1) as f64 / count as f64;
            *keyframe = interpolation.keyframe(keyframe, &before, share).quantised();
        }
        keyframes
    }

    /// A window with too few detections: the motion is extrapolated and comes to rest.
    fn coast(&self, job: &Job, known: Known, coasted: usize, hidden: String) -> Outcome {
        let verdict = match coasted < self.config.coast_windows {
            true => Verdict::Coasted(hidden),
            false => Verdict::Lost(format!("{hidden}, for {} windows", coasted + 1)),
        };
        let interpolation = self.config.cost.interpolation;
        let extrapolated = |&capture: &Timestamp| {
            let keyframe = match known.past {
                [.., before, last] => {
                    let ahead = capture.seconds_since(last.capture);
                    let step = last.capture.seconds_since(before.capture);
                    let s = DECAY * (1.0 - libm::exp(-ahead / DECAY)) / step;
                    interpolation.keyframe(&before.keyframe, &last.keyframe, 1.0 + s)
                }
                _ => known.at(capture, interpolation)?,
            };
            Some(TimedKeyframe::new(capture, keyframe.quantised()))
        };
        let times = job.keyframe_times.iter().filter(|&&capture| capture <= job.publish);
        let keyframes: Vec<TimedKeyframe> = times.filter_map(extrapolated).collect();
        let known = Known { ahead: &keyframes, ..known };
        let poses = self.poses_at(known, wanted_times(job));
        Outcome::Tracked(Box::new(tracked(known, poses, None, Vec::new(), verdict)))
    }

    /// Fits the open window up to its newest frame set. Only the last known keyframes and the new
    /// ones are free; the window's own solve frees the others.
    pub(super) fn provisional(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Known,
        again: usize,
    ) -> Outcome {
        let Some(from) = known.past.last() else { return Outcome::NobodyFound };
        let used = (job.used_frames(), job.effort.stride);
        let observations = self.follow(job, used, points, &from.keyframe, known.skeleton);
        let hidden = hidden(&self.config.gate, job, &observations).is_some();
        let keyframes = match hidden {
            true => known.ahead.to_vec(),
            false => self.fit_newest(job, points, known, again, &observations),
        };
        let solved = Known { ahead: &keyframes, ..known };
        let times = job.pose_times.iter().copied().filter(|time| *time >= known.past[0].capture);
        let path = in_order(&keyframes, &self.between(job, solved));
        let path = Known { ahead: &path, ..known };
        let poses = times.clone().zip(self.poses_at(path, times)).collect();
        Outcome::Provisional(Box::new(ProvisionalFit { keyframes, poses, hidden }))
    }

    fn fit_newest(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Known,
        again: usize,
        observations: &[FrameObservations],
    ) -> Vec<TimedKeyframe> {
        let kept = known.ahead.len().saturating_sub(again);
        let (kept, ahead) = known.ahead.split_at(kept);
        let path = [known.past, kept].concat();
        let past = &path[path.len().saturating_sub(2)..];
        let start = past.last().map_or(job.start, |last| last.capture);
        let recent = between(observations, [start, job.end].map(|at| at + job.half_period()));
        let window = Known { past, ahead, ..known };
        let steps = Steps::of(job.effort.provisional_iterations.max(1));
        let (solved, _) = self.keyframes(job, points, window, &job.keyframe_times, recent, steps);
        let solved = self.correct(job, points, window, solved, recent);
        kept.iter().cloned().chain(solved).collect()
    }
}

/// The times of a window's poses: the final ones, then the newest.
fn wanted_times(job: &Job) -> impl Iterator<Item = Timestamp> {
    job.pose_times.iter().copied().chain([job.end])
}

/// A window with its poses at [`wanted_times`].
fn tracked(
    solved: Known,
    mut poses: Vec<Pose>,
    summary: Option<Summary>,
    residuals: Vec<Residual>,
    verdict: Verdict,
) -> Tracked {
    let keyframes = solved.ahead.to_vec();
    let newest = poses.pop().unwrap_or_else(Pose::rest);
    let (deviations, unfollowed, estimator, between) = (None, Vec::new(), None, Vec::new());
    Tracked {
        newest,
        poses,
        deviations,
        keyframes,
        between,
        summary,
        residuals,
        unfollowed,
        verdict,
        estimator,
    }
}

/// The keyframes without their corrections.
fn on_manifold(keyframes: &[TimedKeyframe]) -> Vec<TimedKeyframe> {
    let plain = |TimedKeyframe { capture, keyframe }: &TimedKeyframe| {
        let keyframe = Keyframe { correction: Correction::default(), ..keyframe.clone() };
        TimedKeyframe::new(*capture, keyframe)
    };
    keyframes.iter().map(plain).collect()
}
