//! The tracker's inputs and outputs.

use std::sync::Arc;

use super::agreement::Unfollowed;
use super::event::Event;
use super::hand_over::HandOver;
use super::job::{Job, Placed, Solution, Verdict};
use super::noise::Residual;
use crate::core::body::{Skeleton, StampedPose};
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::manifold::StampedKeyframe;
use crate::core::optimise::Summary;
use crate::core::time::Timestamp;

/// An input of the tracker.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Input {
    /// A camera's detections.
    Detections(Detections),
    /// A new calibration. With the same cameras it is used from the next window on; with other
    /// cameras the tracker restarts.
    Rig(Arc<Rig>),
    /// The tracker forgets all frames and searches again. It keeps the body.
    Restart,
    /// As `Restart`, after a jump of the capture clock.
    ClockJumped,
    /// As `Restart`, but the body is forgotten too: the performer may be somebody else.
    Forget,
    /// The solution of the solver's job.
    Solved(Solution),
    /// The capture clock has reached this time.
    Tick(Timestamp),
    /// One of several performers: all frames up to this time were given.
    Complete(Timestamp),
    /// A frame with all people who may be this performer, even if the calibration places them elsewhere.
    /// Only for the performer who is used to find moved cameras.
    WatchFrame(Detections),
    /// No more input will come: the open window closes.
    End,
}

/// An output of the tracker.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Output {
    /// A job to solve.
    Solve(Box<Job>),
    /// The body, after each solve of its shape.
    Skeleton(Arc<Skeleton>),
    /// What another tracker needs to go on after this window, before its poses; for one of several performers who are
    /// shared among nodes.
    HandOver(Box<HandOver>),
    /// A pose, in order of capture time.
    Pose(Box<StampedPose>),
    /// A final keyframe.
    Keyframe(Box<StampedKeyframe>),
    /// The result of a window.
    Window(Box<WindowReport>),
    /// An event.
    Event(Event),
    /// Where a camera is that was moved and is left out; each replaces the one before.
    Placed {
        /// Its index.
        camera: usize,
        /// Where it is; `None` if it is back.
        placed: Option<Box<Placed>>,
    },
}

/// The result of a window.
#[derive(Clone, Debug)]
pub struct WindowReport {
    /// Number of the window.
    pub window: u64,
    /// Start of the part of the window that is final, exclusive.
    pub start: Timestamp,
    /// End of that part, inclusive.
    pub end: Timestamp,
    /// The result of the optimiser, if the window was solved.
    pub summary: Option<Summary>,
    /// Euclidean length of the last keyframe's latent code.
    pub latent_norm: f64,
    /// The distance of each observation from the solved body.
    pub residuals: Vec<Residual>,
    /// The points on which the views agree, and where the body is not.
    pub unfollowed: Vec<Unfollowed>,
    /// Whether its poses can be used.
    pub verdict: Verdict,
}
