//! The methods that ours is compared with, and ours as one of them.
//!
//! All are given the same [`Take`] and share one body, manifold, cameras, data term, optimiser,
//! acquisition and association; they differ in what they hold together over time:
//!
//! | method | unknowns | over time |
//! |---|---|---|
//! | [`MuVs`] | a latent keyframe a frame | nothing |
//! | [`Dct`] | a keyframe a frame, in segments | joint tracks near low frequencies |
//! | [`Etc`] | a keyframe a frame, all at once | small steps of the joints |
//! | [`Dmmr`] | a keyframe a frame, in segments | small steps of codes and roots |
//! | [`Slahmr`] | a latent keyframe a frame, all at once | steps of the joints, then -ln p of each transition |
//! | [`Windows`] | a latent keyframe at each border | the path between keyframes |

mod dct;
mod dmmr;
mod etc;
mod frames;
mod joints;
mod muvs;
mod path;
mod registry;
mod slahmr;
mod start;
mod terms;
mod windows;

use std::sync::Arc;

pub use dct::{Dct, DctWeights};
pub use dmmr::{Dmmr, DmmrWeights};
pub use etc::{Etc, EtcWeights};
pub use joints::{COORDINATES, Joints};
pub use muvs::{MuVs, MuVsWeights};
pub use path::{FramePath, State, Term, UNKNOWNS};
pub use registry::{NAMES, all, named};
pub use slahmr::{Slahmr, SlahmrWeights};
pub use start::{Start, start};
pub use terms::{JointSteps, KeyframeSteps, LowFrequency};
pub use windows::Windows;

use crate::core::body::{Pose, Skeleton};
use crate::core::camera::Rig;
use crate::core::detections::{Detections, KeypointFormat};
use crate::core::manifold::Decoder;
use crate::core::time::Timestamp;

/// What every method is given: the detections of one recording.
#[derive(Clone, Debug)]
pub struct Take {
    /// The cameras.
    pub rig: Arc<Rig>,
    /// The order of the detectors' points.
    pub format: KeypointFormat,
    /// Frames a second.
    pub fps: f64,
    /// Detections in order of capture time.
    pub frames: Vec<Detections>,
}

/// What a method makes of it.
#[derive(Clone, Debug)]
pub struct Solved {
    /// The body.
    pub skeleton: Arc<Skeleton>,
    /// Poses in order of capture time, one for each nominal frame from the first keyframe on.
    pub poses: Vec<(Timestamp, Pose)>,
    /// Capture times at which pieces that were solved one after the other meet.
    pub borders: Vec<Timestamp>,
}

/// How long a pose waits for later frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delay {
    /// At most this many frames.
    Frames(usize),
    /// Until the recording has ended.
    Recording,
}

/// A way to solve a take.
pub trait Method {
    /// Its name in tables.
    fn name(&self) -> String;

    /// How long a pose waits for later frames.
    fn delay(&self) -> Delay;

    /// Solves a take; `None` where no performer is found.
    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved>;
}
