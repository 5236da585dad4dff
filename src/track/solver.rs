//! The compute half of tracking: a job in, a solution out, nothing kept but memory.

use std::sync::Arc;

use super::acquire::{fit, sight};
use super::association::{extent, follow, median};
use super::config::Config;
use super::job::{Job, LiveFit, Outcome, Residual, Solution, Task, Tracked, Verdict};
use crate::body::{BodyPoint, Pose, Skeleton, fitted_points};
use crate::camera::Rig;
use crate::cost::{Knot, Moment, PathProblem, Scene, Workspace};
use crate::detect::Detections;
use crate::manifold::{Decoder, Keyframe};
use crate::solve::{Optimiser, Problem};
use crate::time::Timestamp;

/// A view counts when it shows this many points a frame.
const MIN_VIEW: usize = 4;
/// How far the last motion is carried on when the performer is hidden, in windows; then it stands.
const CARRY_ON: f64 = 0.5;

/// What a window's solve can start from.
#[derive(Clone, Copy)]
struct Starts<'a> {
    /// The keyframe at its start.
    from: &'a Keyframe,
    /// The one a window earlier.
    before: Option<&'a Keyframe>,
    /// A provisional one at its end.
    live: Option<&'a Keyframe>,
}

/// Solves jobs. Pure but for its memory: the same job always gives the same solution.
pub struct Solver {
    decoder: Decoder,
    config: Config,
    optimiser: Box<dyn Optimiser>,
    work: Workspace,
}

impl Solver {
    /// A solver on that manifold.
    pub fn new(decoder: Decoder, config: Config) -> Self {
        let optimiser = config.method.optimiser(config.change_threshold);
        Self { decoder, config, optimiser, work: Workspace::default() }
    }

    /// The manifold.
    pub fn decoder(&self) -> &Decoder {
        &self.decoder
    }

    /// Solves a job.
    pub fn solve(&mut self, job: &Job) -> Solution {
        let points = fitted_points(job.format);
        let outcome = match &job.task {
            Task::Acquire { skeleton } => self.acquire(job, &points, skeleton.as_ref()),
            Task::Track { from, before, live, skeleton, coasted } => {
                let starts = Starts { from, before: before.as_deref(), live: live.as_deref() };
                self.track(job, &points, starts, skeleton, *coasted)
            }
            Task::Live { from, before, last, skeleton } => {
                self.live(job, &points, from, before.as_deref(), last.as_ref(), skeleton)
            }
        };
        Solution { number: job.number, outcome }
    }

    /// The first frame set in which a performer is seen; the shape from all the job's windows.
    fn acquire(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Option<&Arc<Skeleton>>,
    ) -> Outcome {
        for (at, set) in frame_sets(&job.frames, job.half_frame) {
            let Some(sighting) = sight(&set, &job.rig, points, &self.config) else { continue };
            let scene = scene(&self.decoder, &self.config, &job.rig, points);
            let template = known.map_or_else(Skeleton::default, |skeleton| (**skeleton).clone());
            let found = fit(
                &sighting,
                scene,
                &template,
                known.is_none(),
                &self.config,
                &mut *self.optimiser,
                &mut self.work,
            );
            let Some((keyframe, rough)) = found else { continue };
            let (keyframe, skeleton) = match known {
                Some(skeleton) => (keyframe, Arc::clone(skeleton)),
                None => {
                    let (keyframe, skeleton) = self.fit_shape(job, points, at, keyframe, rough);
                    (keyframe, Arc::new(skeleton))
                }
            };
            let keyframe = keyframe.settled();
            let pose = Box::new(self.decoder.pose(&keyframe));
            return Outcome::Acquired { at, keyframe: Box::new(keyframe), skeleton, pose };
        }
        Outcome::NobodyFound
    }

    /// Refines the first keyframe and the shape over all the job's windows at once.
    fn fit_shape(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        at: Timestamp,
        keyframe: Keyframe,
        rough: Skeleton,
    ) -> (Keyframe, Skeleton) {
        let span = ((job.end - job.start) / self.config.shape_windows.max(1) as i64).max(1);
        let frames = job.frames.iter().filter(|frame| frame.capture >= at);
        let moments = self.follow(frames, points, &job.rig, &keyframe, &rough);
        let last = moments.last().map_or(at, |moment| moment.capture);
        let scene = scene(&self.decoder, &self.config, &job.rig, points);
        let mut knots = vec![Knot { capture: at, keyframe, free: true }];
        for window in 1..=self.config.shape_windows as i64 {
            let (start, end) = (at + span * (window - 1), at + span * window);
            let inside: Vec<Moment> = moments
                .iter()
                .filter(|moment| moment.capture > start && moment.capture <= end.min(last))
                .cloned()
                .collect();
            let Some(from) = knots.last().filter(|_| !inside.is_empty()) else { break };
            let from = Knot { free: false, ..from.clone() };
            let to = Knot { capture: end, keyframe: from.keyframe.clone(), free: true };
            let mut problem =
                PathProblem::new(scene, vec![from, to], &rough, false, &inside, &mut self.work);
            let mut x = problem.start();
            self.optimiser.minimise(&mut problem, &mut x, self.config.iterations);
            let (keyframes, _) = problem.solution(&x);
            knots.extend(keyframes.into_iter().skip(1).map(|keyframe| Knot {
                capture: end,
                keyframe,
                free: true,
            }));
        }
        let first = knots[0].keyframe.clone();
        let solved = knots.last().map_or(at, |knot| knot.capture);
        let known: Vec<Moment> = moments.into_iter().filter(|m| m.capture <= solved).collect();
        let mut problem = PathProblem::new(scene, knots, &rough, true, &known, &mut self.work);
        let mut x = problem.start();
        self.optimiser.minimise(&mut problem, &mut x, self.config.acquisition_iterations);
        let (keyframes, skeleton) = problem.solution(&x);
        (keyframes.into_iter().next().unwrap_or(first), skeleton)
    }

    fn follow<'d>(
        &self,
        frames: impl Iterator<Item = &'d Arc<Detections>>,
        points: &[BodyPoint],
        rig: &Rig,
        keyframe: &Keyframe,
        skeleton: &Skeleton,
    ) -> Vec<Moment> {
        let frames = frames.map(|frame| &**frame);
        follow(frames, points, rig, &self.decoder.pose(keyframe), skeleton, &self.config)
    }

    fn track(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        Starts { from, before, live }: Starts,
        skeleton: &Arc<Skeleton>,
        coasted: usize,
    ) -> Outcome {
        let moments = self.follow(job.used_frames(), points, &job.rig, from, skeleton);
        if let Some(hidden) = self.hidden(job, &moments) {
            // After a window without, perhaps the performer is seen elsewhere.
            let found = (coasted > 0).then(|| self.acquire(job, points, Some(skeleton)));
            let found = found.filter(|found| matches!(found, Outcome::Acquired { .. }));
            return found.unwrap_or_else(|| self.coast(job, from, before, coasted, hidden));
        }
        let scene = scene(&self.decoder, &self.config, &job.rig, points);
        let fixed = Knot { capture: job.start, keyframe: from.clone(), free: false };
        let start = Knot { capture: job.end, keyframe: from.clone(), free: true };
        let knots = vec![fixed, start];
        let mut problem = PathProblem::new(scene, knots, skeleton, false, &moments, &mut self.work);
        let mut x = problem.start();
        let interpolation = self.config.cost.interpolation;
        let onward = before
            .map(|before| Keyframe { z: from.z, ..interpolation.keyframe(before, from, 2.0) });
        for start in onward.iter().chain(live) {
            let candidate = problem.start_at(start);
            if problem.cost(&candidate) < problem.cost(&x) {
                x = candidate;
            }
        }
        if live.is_none() {
            // A fast limb can be further from the last keyframe than the loss reaches.
            problem.set_scale(scene.config.scale_px * self.config.loose_scale);
            self.optimiser.minimise(&mut problem, &mut x, job.effort.loose_iterations);
            problem.set_scale(scene.config.scale_px);
        }
        let summary = self.optimiser.minimise(&mut problem, &mut x, job.effort.iterations);
        let (keyframes, _) = problem.solution(&x);
        let keyframe = keyframes.into_iter().next_back().unwrap_or_else(|| from.clone()).settled();
        let at = |capture| self.pose_at(job, from, &keyframe, capture);
        let residuals = residuals(&moments, points, &job.rig, skeleton, at);
        let poses = job.pose_times.iter().map(|&capture| at(capture)).collect();
        let verdict = self.verdict(&keyframe, &residuals);
        let tracked = Tracked { keyframe, poses, summary: Some(summary), residuals, verdict };
        Outcome::Tracked(Box::new(tracked))
    }

    /// The pose at a time within the window whose keyframes those are.
    fn pose_at(&self, job: &Job, from: &Keyframe, to: &Keyframe, capture: Timestamp) -> Pose {
        let s = (capture - job.start) as f64 / (job.end - job.start).max(1) as f64;
        self.decoder.pose(&self.config.cost.interpolation.keyframe(from, to, s))
    }

    /// Carries the motion on: for a while, then it stands.
    fn coast(
        &self,
        job: &Job,
        from: &Keyframe,
        before: Option<&Keyframe>,
        coasted: usize,
        hidden: String,
    ) -> Outcome {
        let verdict = match coasted < self.config.coast_windows {
            true => Verdict::Coasted(hidden),
            false => Verdict::Lost(format!("{hidden}, for {} windows", coasted + 1)),
        };
        let interpolation = self.config.cost.interpolation;
        let keyframe = match before.filter(|_| coasted == 0) {
            Some(before) => interpolation.keyframe(before, from, 1.0 + CARRY_ON),
            None => from.clone(),
        }
        .settled();
        let at = |&capture| self.pose_at(job, from, &keyframe, capture);
        let poses = job.pose_times.iter().map(at).collect();
        let residuals = Vec::new();
        let tracked = Tracked { keyframe, poses, summary: None, residuals, verdict };
        Outcome::Tracked(Box::new(tracked))
    }

    /// A keyframe at the newest frame set of the open window, from the one found before it.
    fn live(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        from: &Keyframe,
        before: Option<&Keyframe>,
        last: Option<&(Timestamp, Box<Keyframe>)>,
        skeleton: &Skeleton,
    ) -> Outcome {
        let moments = self.follow(job.used_frames(), points, &job.rig, from, skeleton);
        let interpolation = self.config.cost.interpolation;
        let guess = match (last, before) {
            (Some((at, last)), _) if *at > job.start => {
                let s = (job.end - job.start) as f64 / (*at - job.start) as f64;
                interpolation.keyframe(from, last, s)
            }
            (_, Some(before)) => {
                let span = job.half_frame * 2 * self.config.window_frames.max(1) as i64;
                let s = 1.0 + (job.end - job.start) as f64 / span.max(1) as f64;
                Keyframe { z: from.z, ..interpolation.keyframe(before, from, s) }
            }
            _ => from.clone(),
        };
        if self.hidden(job, &moments).is_some() {
            let pose = self.decoder.pose(&guess);
            return Outcome::Live(Box::new(LiveFit { keyframe: guess, pose, hidden: true }));
        }
        let scene = scene(&self.decoder, &self.config, &job.rig, points);
        let fixed = Knot { capture: job.start, keyframe: from.clone(), free: false };
        let free = Knot { capture: job.end, keyframe: guess.clone(), free: true };
        let knots = vec![fixed, free];
        let mut problem = PathProblem::new(scene, knots, skeleton, false, &moments, &mut self.work);
        let mut x = problem.start();
        self.optimiser.minimise(&mut problem, &mut x, job.effort.live_iterations);
        let (keyframes, _) = problem.solution(&x);
        let keyframe = keyframes.into_iter().next_back().unwrap_or(guess);
        let pose = self.decoder.pose(&keyframe);
        Outcome::Live(Box::new(LiveFit { keyframe, pose, hidden: false }))
    }

    /// Why too little was seen of the performer to solve the window, if so.
    fn hidden(&self, job: &Job, moments: &[Moment]) -> Option<String> {
        let gate = &self.config.gate;
        let frames = job.used_count();
        let observed: usize = moments.iter().map(|moment| moment.observations().len()).sum();
        let per_frame = observed as f64 / frames as f64;
        if per_frame < gate.lost_observations {
            let least = gate.lost_observations;
            return Some(format!("{per_frame:.1} observations a frame, below {least}"));
        }
        let views = (0..job.rig.cameras.len())
            .filter(|&camera| {
                let seen = moments.iter().flat_map(|moment| moment.observations());
                seen.filter(|o| o.camera == camera).count() >= MIN_VIEW * frames
            })
            .count();
        (views < 2).then(|| format!("{views} cameras see the performer, 2 are needed"))
    }

    fn verdict(&self, keyframe: &Keyframe, residuals: &[Residual]) -> Verdict {
        let gate = &self.config.gate;
        let median_error =
            median(&mut residuals.iter().map(|r| r.error_relative).collect::<Vec<_>>());
        if median_error > gate.lost_residual {
            return Verdict::Lost(format!(
                "median residual is {median_error:.3} of the performer's height, above {}",
                gate.lost_residual
            ));
        }
        let latent = crate::manifold::norm(&keyframe.z);
        match latent > gate.lost_latent {
            true => {
                let most = gate.lost_latent;
                Verdict::Lost(format!("latent norm is {latent:.1}, above {most}"))
            }
            false => Verdict::Tracked,
        }
    }
}

fn scene<'a>(
    decoder: &'a Decoder,
    config: &'a Config,
    rig: &'a Rig,
    points: &'a [BodyPoint],
) -> Scene<'a> {
    Scene { decoder, rig, points, config: &config.cost }
}

fn residuals(
    moments: &[Moment],
    points: &[BodyPoint],
    rig: &Rig,
    skeleton: &Skeleton,
    pose_at: impl Fn(Timestamp) -> Pose,
) -> Vec<Residual> {
    let mut all = Vec::new();
    for moment in moments {
        let posture = pose_at(moment.capture).posture(skeleton);
        let world: Vec<_> =
            points.iter().map(|p| p.attachment.position(&posture, skeleton.shape())).collect();
        let heights: Vec<f64> = rig
            .cameras
            .iter()
            .map(|camera| extent(world.iter().filter_map(|point| camera.project(point))))
            .collect();
        all.extend(moment.observations().iter().map(|seen| {
            let error_px = rig.cameras[seen.camera]
                .project(&world[seen.point])
                .map_or(f64::INFINITY, |pixel| (pixel - seen.pixel).norm());
            Residual {
                capture: moment.capture,
                camera: seen.camera,
                point: points[seen.point].index,
                error_px,
                error_relative: error_px / heights[seen.camera].max(1.0),
                confidence: seen.confidence,
            }
        }));
    }
    all
}

/// Groups frames into sets of one time: each set holds frames of different cameras at most
/// `half_frame` after its first.
fn frame_sets(frames: &[Arc<Detections>], half_frame: i64) -> Vec<(Timestamp, Vec<&Detections>)> {
    let mut sets: Vec<(Timestamp, Vec<&Detections>)> = Vec::new();
    for frame in frames {
        match sets.last_mut() {
            Some((first, set))
                if frame.capture - *first <= half_frame
                    && set.iter().all(|other| other.camera != frame.camera) =>
            {
                set.push(frame);
            }
            _ => sets.push((frame.capture, vec![frame])),
        }
    }
    sets
}
