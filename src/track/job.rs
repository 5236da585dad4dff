//! The compute half of tracking: a job in, a solution out, nothing kept but memory.

use std::sync::Arc;

use super::acquire::{fit, sight};
use super::association::{Expected, Follower, extent, median};
use super::config::Config;
use crate::body::{BodyPoint, Pose, Skeleton, fitted_points};
use crate::camera::Rig;
use crate::cost::{Knot, Moment, PathProblem, Scene, Workspace};
use crate::detect::{Detections, KeypointFormat};
use crate::manifold::{Decoder, Keyframe};
use crate::solve::{Optimiser, Problem, Summary};
use crate::time::Timestamp;

/// A view counts when it shows this many points a frame.
const MIN_VIEW: usize = 4;

/// What is to be solved.
#[derive(Clone, Debug)]
pub struct Job {
    /// Number of the window, from 0.
    pub window: u64,
    /// The window: after `start`, up to `end`.
    pub start: Timestamp,
    /// Its end.
    pub end: Timestamp,
    /// Times at which poses are wanted, from `start` on.
    pub pose_times: Vec<Timestamp>,
    /// Detections in order of capture time.
    pub frames: Vec<Arc<Detections>>,
    /// The order of the detectors' points.
    pub format: KeypointFormat,
    /// The cameras.
    pub rig: Arc<Rig>,
    /// What is known already.
    pub task: Task,
}

/// What kind of job it is, with what it stands on.
#[derive(Clone, Debug)]
pub enum Task {
    /// Find the performer; and the shape, if it is not known.
    Acquire {
        /// The body, once known.
        skeleton: Option<Arc<Skeleton>>,
        /// Detections of less than this apart belong to one frame set, ns.
        half_frame: i64,
    },
    /// Solve the keyframe at the end of the window.
    Track {
        /// The keyframe at its start, fixed.
        from: Box<Keyframe>,
        /// The keyframe one window earlier, to extrapolate from.
        before: Option<Box<Keyframe>>,
        /// The body.
        skeleton: Arc<Skeleton>,
    },
}

/// The answer to a job.
#[derive(Clone, Debug)]
pub struct Solution {
    /// The job's window.
    pub window: u64,
    /// What came of it.
    pub outcome: Outcome,
}

/// What came of a job.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// The performer was found.
    Acquired {
        /// The time of the keyframe.
        at: Timestamp,
        /// The first keyframe.
        keyframe: Box<Keyframe>,
        /// The body.
        skeleton: Arc<Skeleton>,
        /// Its pose.
        pose: Box<Pose>,
    },
    /// Nobody was seen well enough by two cameras.
    NobodyFound,
    /// A window was solved, well or badly.
    Tracked(Box<Tracked>),
}

/// A solved window.
#[derive(Clone, Debug)]
pub struct Tracked {
    /// The keyframe at its end.
    pub keyframe: Keyframe,
    /// Poses at the job's times.
    pub poses: Vec<Pose>,
    /// What the optimiser did.
    pub summary: Summary,
    /// Where each observation ended up.
    pub residuals: Vec<Residual>,
    /// Why the window is lost, if it is.
    pub lost: Option<String>,
}

/// The distance of a detected point from the solved body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residual {
    /// Capture time of the detection.
    pub capture: Timestamp,
    /// Index of the camera.
    pub camera: usize,
    /// Index of the point in the format.
    pub point: usize,
    /// Distance in the image, pixels; infinite for a point behind the camera.
    pub error_px: f64,
    /// The same as a part of the performer's height in that image.
    pub error_relative: f64,
    /// The detector's confidence.
    pub confidence: f64,
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
            Task::Acquire { skeleton, half_frame } => {
                self.acquire(job, &points, skeleton.as_ref(), *half_frame)
            }
            Task::Track { from, before, skeleton } => Outcome::Tracked(Box::new(self.track(
                job,
                &points,
                from,
                before.as_deref(),
                skeleton,
            ))),
        };
        Solution { window: job.window, outcome }
    }

    /// The first frame set in which a performer is seen; the shape from all the job's windows.
    fn acquire(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Option<&Arc<Skeleton>>,
        half_frame: i64,
    ) -> Outcome {
        for (at, set) in frame_sets(&job.frames, half_frame) {
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
        let expected = expected_points(&self.decoder, points, rig, keyframe, skeleton);
        Follower::new(points, &self.config, expected).moments(frames.map(|frame| &**frame))
    }

    fn track(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        from: &Keyframe,
        before: Option<&Keyframe>,
        skeleton: &Skeleton,
    ) -> Tracked {
        let moments = self.follow(job.frames.iter(), points, &job.rig, from, skeleton);
        let scene = scene(&self.decoder, &self.config, &job.rig, points);
        let fixed = Knot { capture: job.start, keyframe: from.clone(), free: false };
        let start = Knot { capture: job.end, keyframe: from.clone(), free: true };
        let knots = vec![fixed, start];
        let mut problem = PathProblem::new(scene, knots, skeleton, false, &moments, &mut self.work);
        let mut x = problem.start();
        if let Some(before) = before {
            let interpolation = self.config.cost.interpolation;
            let onward = interpolation.keyframe(before, from, 2.0);
            let mut candidate = problem.start_at(&onward);
            candidate[..from.z.len()].copy_from_slice(&from.z);
            if problem.cost(&candidate) < problem.cost(&x) {
                x = candidate;
            }
        }
        // A fast limb can be further from the last keyframe than the loss reaches.
        problem.set_scale(scene.config.scale_px * self.config.loose_scale);
        self.optimiser.minimise(&mut problem, &mut x, self.config.loose_iterations);
        problem.set_scale(scene.config.scale_px);
        let summary = self.optimiser.minimise(&mut problem, &mut x, self.config.iterations);
        let (keyframes, _) = problem.solution(&x);
        let keyframe = keyframes.into_iter().next_back().unwrap_or_else(|| from.clone());
        let at = |capture: Timestamp| {
            let s = (capture - job.start) as f64 / (job.end - job.start).max(1) as f64;
            self.decoder.pose(&self.config.cost.interpolation.keyframe(from, &keyframe, s))
        };
        let residuals = residuals(&moments, points, &job.rig, skeleton, at);
        let poses = job.pose_times.iter().map(|&capture| at(capture)).collect();
        let lost = self.verdict(job, &keyframe, &residuals);
        Tracked { keyframe, poses, summary, residuals, lost }
    }

    /// Why the window is lost, if it is.
    fn verdict(&self, job: &Job, keyframe: &Keyframe, residuals: &[Residual]) -> Option<String> {
        let gate = &self.config.gate;
        let frames = job.pose_times.len().max(1);
        let per_frame = residuals.len() as f64 / frames as f64;
        if per_frame < gate.lost_observations {
            return Some(format!(
                "{per_frame:.1} observations a frame, below {}",
                gate.lost_observations
            ));
        }
        let views = (0..job.rig.cameras.len())
            .filter(|&camera| {
                residuals.iter().filter(|r| r.camera == camera).count() >= MIN_VIEW * frames
            })
            .count();
        if views < 2 {
            return Some(format!("{views} cameras see the performer, 2 are needed"));
        }
        let median_error =
            median(&mut residuals.iter().map(|r| r.error_relative).collect::<Vec<_>>());
        if median_error > gate.lost_residual {
            return Some(format!(
                "median residual is {median_error:.3} of the performer's height, above {}",
                gate.lost_residual
            ));
        }
        let latent = crate::manifold::norm(&keyframe.z);
        (latent > gate.lost_latent)
            .then(|| format!("latent norm is {latent:.1}, above {}", gate.lost_latent))
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

/// Where the points of a keyframe's pose are in each camera.
fn expected_points(
    decoder: &Decoder,
    points: &[BodyPoint],
    rig: &Rig,
    keyframe: &Keyframe,
    skeleton: &Skeleton,
) -> Vec<Expected> {
    let posture = decoder.pose(keyframe).posture(skeleton);
    let world: Vec<_> =
        points.iter().map(|p| p.attachment.position(&posture, skeleton.shape())).collect();
    rig.cameras
        .iter()
        .map(|camera| world.iter().map(|point| camera.project(point)).collect())
        .collect()
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
