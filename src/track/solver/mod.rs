//! The compute half of tracking: a job in, a solution out, nothing kept but memory.

mod first_fit;

use std::sync::Arc;

use super::association::follow;
use super::config::Config;
use super::job::{
    Job, LiveFit, Outcome, Residual, Solution, Task, TimedKeyframe, Tracked, Verdict,
};
use super::marks::Learnt;
use super::team::Team;
use super::verdict::{hidden, residuals, verdict};
use crate::body::{BodyPoint, MARKS, Pose, Skeleton, fitted_points};
use crate::camera::Rig;
use crate::cost::{self, FreeBody, Knot, Moment, PathProblem, Scene, Workspace};
use crate::detect::Detections;
use crate::manifold::{Decoder, Interpolation, Keyframe};
use crate::solve::{Optimiser, Problem, Summary};
use crate::time::Timestamp;

/// A motion that is carried on while the performer is hidden dies away in this time, seconds.
const DECAY: f64 = 0.1;
/// Keyframes of the open window that a provisional fit goes over again, besides the new ones.
const LIVE_KEYFRAMES: usize = 2;
/// A window begins far from what was seen if its new frames cost this much more than those known before,
/// as parts of the most that they could.
const FAR: f64 = 0.3;
/// How the keyframes are found that a window is grown by: roughly, from afar.
const GROWTH: Steps = Steps { iterations: 1, looseness: 3.0 };
/// How much a window's first keyframe is what the window before said of it.
const FADE: f64 = 0.5;
/// A first fit, of which the shape stays, goes on until a step lowers the cost by less than this part.
const ACQUISITION_CHANGE: f64 = 1e-4;
/// How much of the prior on codes counts where marks are learnt.
const LEARNING_PRIOR: f64 = 0.1;

/// What is known of a window before it is solved.
#[derive(Clone, Copy)]
struct Known<'a> {
    /// The last final keyframes, the last at the window's start.
    past: &'a [TimedKeyframe],
    /// Keyframes of the window that were found before.
    ahead: &'a [TimedKeyframe],
    skeleton: &'a Skeleton,
}

/// How keyframes are solved.
#[derive(Clone, Copy)]
struct Steps {
    iterations: usize,
    /// What the scale of the loss is multiplied with.
    looseness: f64,
}

impl Steps {
    fn of(iterations: usize) -> Self {
        Self { iterations, looseness: 1.0 }
    }
}

impl Known<'_> {
    /// The time of the last keyframe known.
    fn end(&self, job: &Job) -> Timestamp {
        let last = self.ahead.last().or(self.past.last());
        last.map_or(job.start, |(at, _)| *at)
    }

    /// The last final keyframes, which stay.
    fn fixed(&self) -> impl Iterator<Item = Knot> {
        self.past.iter().map(|(capture, keyframe)| Knot {
            capture: *capture,
            keyframe: keyframe.clone(),
            free: false,
            frames: 0.0,
        })
    }

    /// The last two keyframes known, if there are two.
    fn last_two(&self) -> Option<[&TimedKeyframe; 2]> {
        let mut latest = self.past.iter().chain(self.ahead).rev();
        let (last, before) = (latest.next()?, latest.next()?);
        Some([before, last])
    }

    /// The keyframe at that time; the last one after all that are known.
    fn at(&self, time: Timestamp, interpolation: Interpolation) -> Option<Keyframe> {
        let mut earlier = self.past.last()?;
        for later in self.ahead {
            if time <= later.0 {
                let s = (time - earlier.0) as f64 / (later.0 - earlier.0).max(1) as f64;
                return Some(interpolation.keyframe(&earlier.1, &later.1, s.max(0.0)));
            }
            earlier = later;
        }
        Some(earlier.1.clone())
    }
}

/// Solves jobs. Pure but for its memory: the same job always gives the same solution.
pub struct Solver {
    decoder: Decoder,
    config: Config,
    optimiser: Box<dyn Optimiser>,
    /// That of first fits.
    acquirer: Box<dyn Optimiser>,
    work: Workspace,
    /// Who solves, if not this thread alone.
    team: Option<Team>,
}

impl Solver {
    /// A solver on that manifold. It starts the threads that `config` asks for; where the system
    /// refuses them, it does without.
    pub fn new(decoder: Decoder, config: Config) -> Self {
        let optimiser = config.method.optimiser(config.change_threshold);
        let acquirer = config.method.optimiser(config.change_threshold.min(ACQUISITION_CHANGE));
        let team = (config.threads > 1).then(|| Team::of(config.threads)).and_then(|team| {
            team.inspect_err(|error| tracing::warn!("one thread solves: {error}")).ok()
        });
        let work = match team {
            Some(_) => Workspace::in_parallel(),
            None => Workspace::default(),
        };
        Self { decoder, config, optimiser, acquirer, work, team }
    }

    /// The manifold.
    pub fn decoder(&self) -> &Decoder {
        &self.decoder
    }

    /// Solves a job.
    pub fn solve(&mut self, job: &Job) -> Solution {
        let outcome = match self.team.take() {
            None => self.outcome(job),
            Some(team) => {
                let mut outcome = Outcome::NobodyFound;
                team.run(|| outcome = self.outcome(job));
                self.team = Some(team);
                outcome
            }
        };
        Solution { number: job.number, outcome }
    }

    fn outcome(&mut self, job: &Job) -> Outcome {
        let points = fitted_points(job.format);
        match &job.task {
            Task::Acquire { skeleton } => self.acquire(job, &points, skeleton.as_ref()),
            Task::Track { past, ahead, skeleton, learnt, coasted } => {
                let known = Known { past, ahead, skeleton };
                self.track(job, &points, known, (skeleton, learnt), *coasted)
            }
            Task::Live { past, ahead, skeleton } => {
                self.live(job, &points, Known { past, ahead, skeleton })
            }
        }
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
        known: Known,
        (skeleton, learnt): (&Arc<Skeleton>, &Learnt),
        coasted: usize,
    ) -> Outcome {
        let Some((_, from)) = known.past.last() else { return Outcome::NobodyFound };
        let moments = self.follow(job.used_frames(), points, &job.rig, from, skeleton);
        if let Some(hidden) = hidden(&self.config.gate, job, &moments) {
            // After a window without, perhaps the performer is seen elsewhere.
            let found = (coasted > 0).then(|| self.acquire(job, points, Some(skeleton)));
            let found = found.filter(|found| matches!(found, Outcome::Acquired { .. }));
            return found.unwrap_or_else(|| self.coast(job, known, coasted, hidden));
        }
        let steps = Steps::of(job.effort.iterations);
        let (keyframes, summary) = self.keyframes(job, points, known, &job.knots, &moments, steps);
        let keyframes = self.fade(job, known, keyframes);
        let last = job.publish + job.half_frame;
        let final_moments: Vec<&Moment> = moments.iter().filter(|m| m.capture <= last).collect();
        let solved = Known { ahead: &keyframes, ..known };
        let times = final_moments.iter().map(|moment| moment.capture);
        let mut poses = self.poses_at(solved, times.chain(wanted_times(job)));
        let wanted = poses.split_off(final_moments.len());
        let seen = final_moments.into_iter().zip(poses);
        let residuals = residuals(seen, points, &job.rig, skeleton);
        let verdict = verdict(&self.config.gate, &keyframes, &residuals);
        let learns = matches!(verdict, Verdict::Tracked)
            && self.config.mark_windows > 0
            && !learnt.is_complete()
            && job.window.is_multiple_of(self.config.mark_windows as u64);
        let learnt = learns.then(|| self.learn(job, points, solved, &moments, learnt)).flatten();
        let tracked = tracked(solved, wanted, Some(summary), residuals, verdict);
        Outcome::Tracked(Box::new(Tracked { learnt: learnt.map(Arc::new), ..tracked }))
    }

    /// Adds what the solved window tells of where the detector marks points.
    fn learn(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        solved: Known,
        moments: &[Moment],
        learnt: &Learnt,
    ) -> Option<Learnt> {
        // What the prior pulls poses away from the detections must not be taken for marks.
        let cost = self.cost(job);
        let cost = cost::Config { prior: LEARNING_PRIOR * cost.prior, mark_prior: 0.0, ..cost };
        let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config: &cost };
        let frames = self.config.keyframe() as f64;
        let ahead = solved.ahead.iter().map(|(capture, keyframe)| {
            let keyframe = keyframe.clone();
            Knot { capture: *capture, keyframe, free: true, frames }
        });
        let knots = solved.fixed().chain(ahead).collect();
        let free = self.config.free_body();
        let mut problem =
            PathProblem::new(scene, knots, solved.skeleton, free, moments, &mut self.work);
        let told = problem.marginal(&problem.start(), MARKS)?;
        learnt.with(&told, solved.skeleton.marks(), self.config.cost.mark_prior)
    }

    /// Solves the keyframes at those of the times that are after the last final one, together.
    fn keyframes(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Known,
        times: &[Timestamp],
        moments: &[Moment],
        steps: Steps,
    ) -> (Vec<TimedKeyframe>, Summary) {
        let cost = self.cost(job);
        let cost = cost::Config { scale_px: cost.scale_px * steps.looseness, ..cost };
        let interpolation = cost.interpolation;
        let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config: &cost };
        let mut knots: Vec<Knot> = known.fixed().collect();
        let period = (2 * job.half_frame).max(1) as f64;
        let start = known.past.last().map_or(job.start, |(at, _)| *at);
        let free = || times.iter().copied().filter(|&capture| capture > start);
        let mut before = start;
        for capture in free() {
            let Some(keyframe) = known.at(capture, interpolation) else { continue };
            let frames = (capture - before) as f64 / period;
            knots.push(Knot { capture, keyframe, free: true, frames });
            before = capture;
        }
        let mut problem = PathProblem::new(
            scene,
            knots,
            known.skeleton,
            FreeBody::Fixed,
            moments,
            &mut self.work,
        );
        let mut x = problem.start();
        let cost = problem.cost(&x);
        let known_until = known.end(job) + job.half_frame;
        let mut misfits = problem.misfits(known_until);
        if let Some([(t0, a), (t1, b)]) = known.last_two() {
            // Or else: the root goes on as it did.
            let onward = problem.start_at(|_, knot| {
                let s = (knot.capture - *t0) as f64 / (*t1 - *t0).max(1) as f64;
                match knot.capture > *t1 {
                    true => Keyframe { z: b.z, ..interpolation.keyframe(a, b, s) },
                    false => knot.keyframe.clone(),
                }
            });
            if problem.cost(&onward) < cost {
                (x, misfits) = (onward, problem.misfits(known_until));
            }
        }
        let new = free().filter(|&at| at > known.end(job)).count();
        if new > 1 && misfits[1] - misfits[0] > FAR {
            let ahead = self.grow(job, points, known, times, moments);
            let known = Known { ahead: &ahead, ..known };
            return self.keyframes(job, points, known, times, moments, steps);
        }
        let summary = self.optimiser.minimise(&mut problem, &mut x, steps.iterations);
        let (solved, _) = problem.solution(&x);
        let solved = solved.into_iter().skip(known.past.len()).map(Keyframe::settled);
        (free().zip(solved).collect(), summary)
    }

    /// Where quick motion takes the body out of the loss's reach within a window: its keyframes with
    /// those that are not known yet roughly solved, one after the other.
    fn grow(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        known: Known,
        times: &[Timestamp],
        moments: &[Moment],
    ) -> Vec<TimedKeyframe> {
        let mut path = [known.past, known.ahead].concat();
        for &time in times.iter().filter(|&&time| time > known.end(job)) {
            let past = &path[path.len().saturating_sub(2)..];
            let step = Known { past, ahead: &[], ..known };
            let seen = between(moments, [step.end(job), time].map(|at| at + job.half_frame));
            path.extend(self.keyframes(job, points, step, &[time], seen, GROWTH).0);
        }
        path.split_off(known.past.len())
    }

    /// Has the final keyframes begin near what the window before said of them, less so from one to the
    /// next, so that the border between the two is no kink.
    fn fade(
        &self,
        job: &Job,
        known: Known,
        mut keyframes: Vec<TimedKeyframe>,
    ) -> Vec<TimedKeyframe> {
        let count = keyframes.iter().filter(|(at, _)| *at <= job.publish).count();
        let interpolation = self.config.cost.interpolation;
        for (k, (at, keyframe)) in keyframes[..count].iter_mut().enumerate() {
            let Some(before) = known.at(*at, interpolation).filter(|_| *at <= known.end(job))
            else {
                break;
            };
            let share = FADE * (count - k - 1) as f64 / count as f64;
            *keyframe = interpolation.keyframe(keyframe, &before, share).settled();
        }
        keyframes
    }

    /// The cost's weights, those of prior and stiffness by how the detections err.
    fn cost(&self, job: &Job) -> cost::Config {
        let Config { cost, noise_px, .. } = self.config;
        let factor = job.noise.factor(noise_px);
        let (prior, stiffness) = (cost.prior * factor, cost.stiffness.times(factor));
        cost::Config { prior, stiffness, ..cost }
    }

    /// The poses at times within a window whose keyframes are known; those at one time are decoded
    /// once.
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

    /// Carries the motion on: it dies away.
    fn coast(&self, job: &Job, known: Known, coasted: usize, hidden: String) -> Outcome {
        let verdict = match coasted < self.config.coast_windows {
            true => Verdict::Coasted(hidden),
            false => Verdict::Lost(format!("{hidden}, for {} windows", coasted + 1)),
        };
        let interpolation = self.config.cost.interpolation;
        let onward = |&capture: &Timestamp| {
            let keyframe = match known.past {
                [.., (t0, a), (t1, b)] => {
                    let ahead = capture.seconds_since(*t1);
                    let s = DECAY * (1.0 - libm::exp(-ahead / DECAY)) / t1.seconds_since(*t0);
                    interpolation.keyframe(a, b, 1.0 + s)
                }
                _ => known.at(capture, interpolation)?,
            };
            Some((capture, keyframe.settled()))
        };
        let final_knots = job.knots.iter().filter(|&&capture| capture <= job.publish);
        let keyframes: Vec<TimedKeyframe> = final_knots.filter_map(onward).collect();
        let known = Known { ahead: &keyframes, ..known };
        let poses = self.poses_at(known, wanted_times(job));
        Outcome::Tracked(Box::new(tracked(known, poses, None, Vec::new(), verdict)))
    }

    /// Keyframes up to the newest frame set of the open window: the last ones known stay free, those
    /// before them wait for the window's own solve.
    fn live(&mut self, job: &Job, points: &[BodyPoint], known: Known) -> Outcome {
        let Some((_, from)) = known.past.last() else { return Outcome::NobodyFound };
        let moments = self.follow(job.used_frames(), points, &job.rig, from, known.skeleton);
        let hidden = hidden(&self.config.gate, job, &moments).is_some();
        let keyframes = match hidden {
            true => known.ahead.to_vec(),
            false => {
                let settled = known.ahead.len().saturating_sub(LIVE_KEYFRAMES);
                let (settled, ahead) = known.ahead.split_at(settled);
                let mut path: Vec<TimedKeyframe> = known.past.to_vec();
                path.extend_from_slice(settled);
                let past = &path[path.len().saturating_sub(2)..];
                let start = past.last().map_or(job.start, |(at, _)| *at);
                let recent = between(&moments, [start, job.end].map(|at| at + job.half_frame));
                let window = Known { past, ahead, ..known };
                let steps = Steps::of(job.effort.live_iterations);
                let (solved, _) = self.keyframes(job, points, window, &job.knots, recent, steps);
                settled.iter().cloned().chain(solved).collect()
            }
        };
        let solved = Known { ahead: &keyframes, ..known };
        let pose = self.poses_at(solved, [job.end].into_iter()).pop().unwrap_or_else(Pose::rest);
        Outcome::Live(Box::new(LiveFit { keyframes, pose, hidden }))
    }
}

/// Times of the poses that a window gives: the final ones, then the newest.
fn wanted_times(job: &Job) -> impl Iterator<Item = Timestamp> {
    job.pose_times.iter().copied().chain([job.end])
}

/// A window of which the poses at [`wanted_times`] are known.
fn tracked(
    solved: Known,
    mut poses: Vec<Pose>,
    summary: Option<Summary>,
    residuals: Vec<Residual>,
    verdict: Verdict,
) -> Tracked {
    let keyframes = solved.ahead.to_vec();
    let newest = poses.pop().unwrap_or_else(Pose::rest);
    Tracked { newest, poses, keyframes, summary, residuals, verdict, learnt: None }
}

/// The moments after one time, up to another.
fn between(moments: &[Moment], [after, to]: [Timestamp; 2]) -> &[Moment] {
    let [first, end] = [after, to].map(|at| moments.partition_point(|m| m.capture <= at));
    &moments[first..end]
}
