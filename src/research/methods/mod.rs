//! Our method and the published methods that it is compared with.
//!
//! All get the same [`Take`] and share body, manifold, cameras, data term, optimiser, acquisition
//! and association. They differ in the temporal term:
//!
//! | method | unknowns | temporal term |
//! |---|---|---|
//! | [`MuVs`] | a latent keyframe per frame | none |
//! | [`Dct`] | a keyframe per frame, in segments | low-frequency joint trajectories |
//! | [`Etc`] | a keyframe per frame, all at once | joint velocity |
//! | [`Dmmr`] | a keyframe per frame, in segments | velocity of codes and roots |
//! | [`Slahmr`] | a latent keyframe per frame, all at once | joint velocity, then motion prior |
//! | [`Windows`] | a latent keyframe at each window border | the path between keyframes |

mod dct;
mod dmmr;
mod etc;
mod frames;
mod joints;
mod muvs;
mod path;
mod registry;
mod slahmr;
mod solved;
mod start;
mod terms;
mod windows;

use std::sync::Arc;

pub use dct::{Dct, DctWeights};
pub use dmmr::{Dmmr, DmmrWeights};
pub use etc::{Etc, EtcWeights};
pub use joints::UNKNOWNS;
pub use joints::{COORDINATES, Joints};
pub use muvs::{MuVs, MuVsWeights};
pub use path::{FramePath, State, Term};
pub use registry::{NAMES, all, named};
pub use slahmr::{Slahmr, SlahmrWeights};
pub use solved::{Body, Motion, Solved};
pub use start::{Start, start};
pub use terms::{JointSteps, KeyframeSteps, LowFrequency};
pub use windows::Windows;

use crate::core::camera::Rig;
use crate::core::detections::{Detections, KeypointFormat};
use crate::core::manifold::Decoder;

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

    /// How long a pose waits for later frames.
    fn delay(&self) -> Delay;

    /// Solves a take; `None` if no performer is found.
    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved>;
}
