//! MuVS: every frame on its own \[Huang 2017, the first stage\].
//!
//! cost = data term + prior on z of one frame, starting from the solution of the frame before.
//! Differences: the publication fits SMPL with silhouettes and its own pose prior, and starts from a
//! regressor's poses. Here all methods share body, manifold and data term.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::frames::{Cut, Given, is_enough};
use super::path::{FramePath, Term};
use super::{Delay, Method, Motion, Solved, Start, Take, start};
use crate::core::body::fitted_points;
use crate::core::cost::{
    self, FrameObservations, FreeBody, PathKeyframe, PathProblem, Scene, Workspace,
};
use crate::core::manifold::{Decoder, Keyframe, TimedKeyframe};
use crate::core::optimise::{LevenbergMarquardt, Optimiser};
use crate::core::time::Timestamp;
use crate::core::tracker::Config;

/// After this many frames without the performer, the search for a new first keyframe starts.
const PATIENCE: usize = 10;

/// Weights of [`MuVs`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MuVsWeights {
    /// Weight of |z|^2 in each frame, square pixels.
    pub prior: f64,
    /// Scale of the Geman-McClure loss, pixels.
    pub scale_px: f64,
    /// Maximum iterations per frame.
    pub iterations: usize,
    /// Iterations with a loss of a larger scale that come first, as in the windows.
    pub loose_iterations: usize,
    /// Factor on the scale of the loss in these iterations.
    pub loose_scale: f64,
}

impl Default for MuVsWeights {
    fn default() -> Self {
        Self { prior: 90.0, scale_px: 60.0, iterations: 30, loose_iterations: 3, loose_scale: 3.0 }
    }
}

/// Every frame on its own.
#[derive(Clone, Debug, Default)]
pub struct MuVs {
    weights: MuVsWeights,
}

impl MuVs {
    /// The method with the given weights.
    pub fn new(weights: MuVsWeights) -> Self {
        Self { weights }
    }
}

/// A take solved frame by frame; the other methods start from it.
#[derive(Clone, Debug)]
pub(super) struct PerFrame {
    pub(super) start: Start,
    /// Nominal time of each frame.
    pub(super) times: Vec<Timestamp>,
    /// What was seen of the performer in each frame, expected at its solution; empty where it was
    /// too little to solve it.
    pub(super) observations: Vec<Vec<FrameObservations>>,
    /// The solution of each frame.
    pub(super) keyframes: Vec<Keyframe>,
    pub(super) config: Config,
}

impl PerFrame {
    /// The keyframes of some frames after so many iterations from `initial`. `observations` and `initial` are by frame;
    /// `free`: whether codes and roots are solved for, in that order.
    pub(super) fn minimised<'a>(
        &'a self,
        scene: Scene<'a>,
        (observations, initial): (&'a [Vec<FrameObservations>], &'a [Keyframe]),
        terms: &'a [Box<dyn Term + 'a>],
        free: [bool; 2],
        iterations: usize,
    ) -> Vec<Keyframe> {
        let mut path = FramePath::new(scene, &self.start.skeleton, observations, initial, terms);
        path.free = free;
        let mut x = path.start();
        LevenbergMarquardt::default().minimise(&mut path, &mut x, iterations);
        path.keyframes(&x)
    }

    /// Solves every frame on its own; `None` if no performer is found.
    pub(super) fn solve(take: &Take, decoder: &Decoder, weights: &MuVsWeights) -> Option<Self> {
        let mut config = Config { frame_rate_hz: take.fps, ..Config::default() };
        let start = start(take, decoder, &config)?;
        config.cost = weights.cost();
        let points = fitted_points(take.format);
        let given = Given { take, decoder, start: &start, points: &points, config: &config };
        let cut = Cut::new(take, start.at);
        let keyframes = one_by_one(&cut, &given, weights);
        let cameras = take.rig.cameras.len();
        let seen = |frame: usize| {
            let observations = cut.observations(frame, &keyframes[frame], &given);
            if is_enough(&observations, cameras, &config) { observations } else { Vec::new() }
        };
        let observations = (0..keyframes.len()).map(seen).collect();
        Some(Self { times: cut.times, observations, keyframes, start, config })
    }

    /// The poses of `keyframes`, one per frame, and the borders between segments of `segment`
    /// frames.
    pub(super) fn solved(
        &self,
        decoder: &Decoder,
        keyframes: &[Keyframe],
        segment: usize,
    ) -> Solved {
        let pose = |(at, keyframe): (&Timestamp, &Keyframe)| (*at, decoder.pose(keyframe));
        Solved {
            motion: Motion::Poses(
                Arc::clone(&self.start.skeleton),
                self.times.iter().zip(keyframes).map(pose).collect(),
            ),
            deviations: Vec::new(),
            borders: self.times.iter().copied().step_by(segment).skip(1).collect(),
            not_followed: None,
        }
    }
}

impl MuVsWeights {
    pub(super) fn cost(&self) -> cost::Config {
        let (prior, scale_px) = (self.prior, self.scale_px);
        let loss = cost::LossKind::GemanMcClure;
        cost::Config { loss, prior, prior_dof: 0.0, scale_px, ..cost::Config::default() }
    }
}

fn one_by_one(cut: &Cut, given: &Given, weights: &MuVsWeights) -> Vec<Keyframe> {
    let scene = Scene {
        decoder: given.decoder,
        rig: &given.take.rig,
        points: given.points,
        config: &given.config.cost,
    };
    let (mut work, mut optimiser) = (Workspace::default(), LevenbergMarquardt::default());
    let mut last = given.start.keyframe.clone();
    let (mut hidden, mut found) = (0, None::<Start>);
    let mut keyframes = Vec::with_capacity(cut.times.len());
    for (frame, &capture) in cut.times.iter().enumerate() {
        if let Some(again) = found.take_if(|found| found.at <= capture) {
            (last, hidden) = (again.keyframe, 0);
        }
        let observations = cut.observations(frame, &last, given);
        if is_enough(&observations, given.take.rig.cameras.len(), given.config) {
            hidden = 0;
            let at = TimedKeyframe::new(capture, last.clone());
            let path = vec![PathKeyframe::free(at, 1.0)];
            let skeleton = &given.start.skeleton;
            let mut problem =
                PathProblem::new(scene, path, skeleton, FreeBody::Fixed, &observations, &mut work);
            let mut x = problem.start();
            problem.set_scale(weights.scale_px * weights.loose_scale);
            optimiser.minimise(&mut problem, &mut x, weights.loose_iterations);
            problem.set_scale(weights.scale_px);
            optimiser.minimise(&mut problem, &mut x, weights.iterations);
            last = problem.solution(&x).0.pop().unwrap_or(last);
        } else {
            hidden += 1;
            if hidden == PATIENCE {
                found = found_again(given, capture);
            }
        }
        keyframes.push(last.clone());
    }
    keyframes
}

/// Looks for the performer in the rest of the take.
fn found_again(given: &Given, from: Timestamp) -> Option<Start> {
    let rest = given.take.frames.iter().filter(|frame| frame.capture >= from).cloned();
    let rest = Take { frames: rest.collect(), ..given.take.clone() };
    start(&rest, given.decoder, given.config)
}

impl Method for MuVs {
    fn name(&self) -> String {
        "MuVS".to_owned()
    }

    fn delay(&self, _: f64) -> Delay {
        Delay::Frames(0)
    }

    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        let found = PerFrame::solve(take, decoder, &self.weights)?;
        Some(Solved { borders: Vec::new(), ..found.solved(decoder, &found.keyframes, 1) })
    }
}
