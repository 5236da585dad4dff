//! BundleMoCap: one latent keyframe per window, by the tracker itself; and the steps from there to the
//! default settings.

use std::sync::Arc;

use super::{Delay, Method, Motion, Solved, Take};
use crate::core::cost::{self, LossKind};
use crate::core::manifold::Decoder;
use crate::core::optimise::OptimiserKind;
use crate::core::tracker::{Config, Output, Solver, Tracker, run_to_end};
use crate::metrics::FollowedSums;

/// Prior of a keyframe as published in \[Albanis 2023\], and a loss scale, pixels, which the paper does not give.
const PUBLISHED: (f64, f64) = (10.76, 100.0);
/// Iterations and relative change of the cost that let Levenberg-Marquardt converge.
const CONVERGED: (usize, f64) = (100, 1e-6);

/// The tracker with those settings.
#[derive(Clone, Debug)]
pub struct Windows {
    name: String,
    config: Config,
    own_body: bool,
}

impl Windows {
    /// The tracker with settings under a name, and with the body of the take.
    pub fn new(name: &str, config: Config) -> Self {
        Self { name: name.to_owned(), config, own_body: false }
    }

    /// The tracker with a body that it finds in one pass, as the live node does.
    pub fn with_own_body(self) -> Self {
        Self { own_body: true, ..self }
    }

    /// The same with other settings.
    pub(crate) fn with_config(self, config: Config) -> Self {
        Self { config, ..self }
    }

    /// The tracker's settings.
    pub fn config(&self) -> Config {
        self.config
    }

    /// The publication: its prior and loss scale, 30 iterations of L-BFGS, the shape of its first
    /// windows and no keypoint offsets.
    pub fn paper() -> Self {
        let paper = Config::paper();
        let (prior, scale_px) = PUBLISHED;
        // Our prior is of a frame, and a keyframe counts for its frames.
        let prior = prior / paper.keyframe_frames as f64;
        let cost = cost::Config { prior, scale_px, ..paper.cost };
        Self::new("BundleMoCap (paper)", Config { cost, ..paper }).with_own_body()
    }

    /// The publication at its minimum: with Levenberg-Marquardt and more iterations.
    pub fn paper_converged() -> Self {
        let (iterations, change_threshold) = CONVERGED;
        let optimiser = OptimiserKind::LevenbergMarquardt;
        let config = Config { optimiser, iterations, change_threshold, ..Self::paper().config };
        Self::new("BundleMoCap (paper, converged)", config).with_own_body()
    }

    /// The same with the body of the take.
    pub fn paper_with_body() -> Self {
        Self::new("BundleMoCap (paper, converged, body)", Self::paper_converged().config)
    }

    /// The same with the weights of a sweep.
    pub fn tuned() -> Self {
        let config = Self::paper_converged().config;
        let cost = cost::Config { prior: 30.0, scale_px: 60.0, ..config.cost };
        Self::new("+ tuned weights", Config { cost, ..config })
    }

    /// A keyframe in each frame, with the stiffness, prior and loss scale of the default.
    pub fn frames() -> Self {
        let config = Self::fixed().config;
        let cost = cost::Config { prior_dof: 0.0, ..config.cost };
        let publish_frames = config.window_frames;
        Self::new("+ keyframe in each frame, stiffness", Config { publish_frames, cost, ..config })
    }

    /// The same with windows that overlap.
    pub fn overlapping() -> Self {
        let Config { publish_frames, .. } = Config::default();
        Self::new("+ windows overlap", Config { publish_frames, ..Self::frames().config })
    }

    /// The default with fixed weights, and on the manifold.
    pub fn fixed() -> Self {
        let config = Self::weighted().config;
        let config = Config { reference_residual_px: 0.0, ..config };
        Self::new("bundlemocap (fixed weights)", config)
    }

    /// The same with weights that follow the detector.
    pub fn weighted() -> Self {
        let config = Self::on_manifold().config;
        let cost = cost::Config { loss: LossKind::GemanMcClure, ..config.cost };
        Self::new("+ weights follow the detector", Config { relative_scale: 0.0, cost, ..config })
    }

    /// The same with a Cauchy loss whose scale follows the detector.
    pub fn on_manifold() -> Self {
        let config = Self::feet_slide().config;
        let cost = cost::Config { correction_prior: 0.0, ..config.cost };
        Self::new("+ Cauchy loss, its scale follows the detector", Config { cost, ..config })
    }

    /// The same with corrections of joints: the default without contacts of the feet and without
    /// catching up.
    pub fn feet_slide() -> Self {
        let config = Config::default();
        let cost = cost::Config { foot_contact: 0.0, ..config.cost };
        let config = Config { cost, catch_up_iterations: 0, ..config };
        Self::new("+ corrections of joints", config)
    }

    /// The program's default settings.
    pub fn default_settings() -> Self {
        Self::new("bundlemocap (default)", Config::default())
    }

    /// The default settings in one pass.
    pub fn live() -> Self {
        Self::new("bundlemocap (live)", Config::default()).with_own_body()
    }
}

impl Method for Windows {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn delay(&self, fps: f64) -> Delay {
        Delay::Frames(self.config.at_period(1e9 / fps).window())
    }

    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        let config = Config { frame_rate_hz: take.fps, ..self.config };
        let body = take.body.clone().filter(|_| !self.own_body);
        let mut tracker = Tracker::new(config, Arc::clone(&take.rig)).with_body(body);
        let mut solver = Solver::new(decoder.clone(), config);
        let (mut poses, mut borders, mut body) = (Vec::new(), Vec::new(), None);
        let (mut followed, mut deviations) = (FollowedSums::default(), Vec::new());
        run_to_end(&mut tracker, &mut solver, take.frames.iter().cloned(), |output| match output {
            Output::Pose(pose) => {
                deviations.push(pose.deviations);
                poses.push((pose.capture, pose.pose));
            }
            Output::Window(window) => {
                borders.push(window.end);
                followed.add(&window);
            }
            Output::Skeleton(skeleton) => body = Some(skeleton),
            _ => {}
        });
        // All poses are scored with the last body.
        let skeleton = tracker.skeleton().cloned().or(body)?;
        let is_found = !poses.is_empty();
        let not_followed = followed.finish();
        let motion = Motion::Poses(skeleton, poses);
        is_found.then_some(Solved { motion, deviations, borders, not_followed })
    }
}
