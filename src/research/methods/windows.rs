//! BundleMoCap: one latent keyframe per window, by the tracker itself.

use std::sync::Arc;

use super::{Delay, Method, Motion, Solved, Take};
use crate::core::cost;
use crate::core::manifold::Decoder;
use crate::core::tracker::{Config, Output, Solver, Tracker, run_to_end};

/// The tracker with those settings.
#[derive(Clone, Debug)]
pub struct Windows {
    name: String,
    config: Config,
}

impl Windows {
    /// The tracker with settings under a name.
    pub fn new(name: &str, config: Config) -> Self {
        Self { name: name.to_owned(), config }
    }

    /// The tracker's settings.
    pub fn config(&self) -> Config {
        self.config
    }

    /// The settings of the paper; see [`Config::paper`].
    pub fn paper() -> Self {
        Self::new("BundleMoCap (paper)", Config::paper())
    }

    /// The paper's windows and path with Levenberg-Marquardt, the optimiser of all other methods.
    pub fn paper_with_our_optimiser() -> Self {
        let Config { optimiser, change_threshold, .. } = Config::default();
        let paper = Config::paper();
        let cost = cost::Config { prior: 30.0, ..paper.cost };
        let config = Config { optimiser, change_threshold, cost, ..paper };
        Self::new("BundleMoCap (paper, LM)", config)
    }

    /// The program's default settings.
    pub fn default_settings() -> Self {
        Self::new("bundlemocap (default)", Config::default())
    }
}

impl Method for Windows {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn delay(&self) -> Delay {
        Delay::Frames(self.config.window_frames)
    }

    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        let config = Config { frame_rate_hz: take.fps, ..self.config };
        let mut tracker = Tracker::new(config, Arc::clone(&take.rig));
        let mut solver = Solver::new(decoder.clone(), config);
        let (mut poses, mut borders, mut body) = (Vec::new(), Vec::new(), None);
        run_to_end(&mut tracker, &mut solver, take.frames.iter().cloned(), |output| match output {
            Output::Pose(pose) => poses.push((pose.capture, pose.pose)),
            Output::Window(window) => borders.push(window.end),
            Output::Skeleton(skeleton) => body = Some(skeleton),
            _ => {}
        });
        // All poses are scored with the last body.
        let skeleton = tracker.skeleton().cloned().or(body)?;
        Some(Solved { motion: Motion::Poses(skeleton, poses), borders })
    }
}
