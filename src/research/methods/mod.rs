//! Our method and the published methods that it is compared with.
//!
//! All get the same [`Take`] and share cameras, acquisition and association; all but triangulation
//! share body, manifold and data term, and all but the paper's rows the optimiser. Weights are fixed,
//! but for the default's, which follow the detector. The methods differ in the temporal term:
//!
//! | method | unknowns | temporal term |
//! |---|---|---|
//! | [`MuVs`] | a latent keyframe per frame | none |
//! | [`Dct`] | a keyframe per frame, in segments | low-frequency joint trajectories |
//! | [`Etc`] | a keyframe per frame, all at once | joint velocity |
//! | [`Dmmr`] | a keyframe per frame, in segments | velocity of codes and roots |
//! | [`Slahmr`] | a latent keyframe per frame, all at once | joint velocity, then motion prior |
//! | [`Triangulation`] | limb keypoints, no body | a filter of each track |
//! | [`Windows`] | a latent keyframe at each window border | the path between keyframes |

mod dct;
mod dmmr;
mod etc;
mod filter;
mod frames;
mod joints;
mod live;
mod muvs;
mod path;
mod registry;
mod slahmr;
mod solved;
mod start;
mod terms;
mod triangulation;
mod windows;

use std::sync::Arc;

pub use dct::{Dct, DctWeights};
pub use dmmr::{Dmmr, DmmrWeights};
pub use etc::{Etc, EtcWeights};
pub use filter::Filter;
pub use joints::UNKNOWNS;
pub use joints::{COORDINATES, Joints};
pub use live::LiveTracker;
pub use muvs::{MuVs, MuVsWeights};
pub use path::{FramePath, State, Term};
pub use registry::{LADDER, NAMES, named};
pub use slahmr::{Slahmr, SlahmrWeights};
pub use solved::{Body, Motion, Solved};
pub use start::{Start, start};
pub use terms::{JointSteps, KeyframeSteps, LowFrequency};
pub use triangulation::Triangulation;
pub use windows::Windows;

use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::detections::{Detections, KeypointFormat};
use crate::core::manifold::Decoder;
use crate::core::tracker::{Config, Solver, Tracker, run_to_end};
use crate::offline::first_pass_settings;

/// The input of every method: the detections of one recording.
#[derive(Clone, Debug)]
pub struct Take {
    /// The cameras.
    pub rig: Arc<Rig>,
    /// The keypoint format of the detectors.
    pub format: KeypointFormat,
    /// Frame rate, Hz.
    pub fps: f64,
    /// Detections in order of capture time.
    pub frames: Vec<Detections>,
    /// The body that methods use instead of one that they find themselves.
    pub body: Option<Arc<Skeleton>>,
}

impl Take {
    /// A take without a body.
    pub fn new(rig: Arc<Rig>, format: KeypointFormat, fps: f64, frames: Vec<Detections>) -> Self {
        Self { rig, format, fps, frames, body: None }
    }

    /// The take with the body that `solve` finds in its first pass, with the default settings; without
    /// one if nobody is found.
    pub fn with_body(mut self, decoder: &Decoder) -> Self {
        let config = Config { frame_rate_hz: self.fps, ..Config::default() };
        let frames = self.frames.iter().filter(|frame| frame.camera == 0).count();
        let (config, effort) = first_pass_settings(config, frames, 1e9 / self.fps);
        let mut tracker = Tracker::new(config, Arc::clone(&self.rig));
        tracker.set_effort(effort);
        let mut solver = Solver::new(decoder.clone(), config);
        run_to_end(&mut tracker, &mut solver, self.frames.iter().cloned(), |_| {});
        self.body = tracker.skeleton().cloned();
        self
    }
}

/// How long a pose waits for later frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delay {
    /// At most this many frames.
    Frames(usize),
    /// Until the end of the recording.
    Recording,
}

/// A method that solves a take.
pub trait Method {
    /// The name in tables.
    fn name(&self) -> String;

    /// How long a pose waits for later frames, of cameras of that frame rate, Hz.
    fn delay(&self, fps: f64) -> Delay;

    /// Solves a take; `None` if no performer is found.
    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved>;
}
