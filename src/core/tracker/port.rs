//! What goes into the machine and comes out of it.

use std::sync::Arc;

use super::effort::Effort;
use super::event::Event;
use super::job::{Job, Residual, Solution, Verdict};
use super::playout::Latency;
use crate::core::body::{Skeleton, StampedPose, TrackingState};
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::manifold::Keyframe;
use crate::core::optimise::Summary;
use crate::core::time::{Grid, Timestamp};

/// What the machine is told.
#[derive(Clone, Debug)]
pub enum Input {
    /// A camera's detections.
    Detections(Detections),
    /// A new calibration: of the same cameras, it is used from the next window on; of others, the
    /// machine starts anew with it.
    Rig(Arc<Rig>),
    /// The capture clock jumped: forget all frames, search anew; the body stays known.
    Restart,
    /// How much to do from the next job on.
    Effort(Effort),
    /// The latency to keep, of a live machine.
    Latency(Latency),
    /// How long after its capture a frame usually comes, ns; of a live machine.
    Delay(i64),
    /// The answer to the job that is out.
    Solved(Solution),
    /// The capture clock has reached this time.
    Tick(Timestamp),
    /// Nothing more will come: windows that are open close.
    End,
}

/// What the machine wants done or known.
#[derive(Clone, Debug)]
pub enum Output {
    /// A job to solve.
    Solve(Box<Job>),
    /// The body, whenever its shape has been found.
    Skeleton(Arc<Skeleton>),
    /// A pose, in order of capture time.
    Pose(Box<StampedPose>),
    /// A final keyframe.
    Keyframe(Box<KeyframeAt>),
    /// How a window went.
    Window(Box<WindowReport>),
    /// Something to count.
    Event(Event),
}

/// A keyframe with its time.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyframeAt {
    /// Its capture time.
    pub capture: Timestamp,
    /// The keyframe that the path comes from; its own time where a path begins.
    pub start: Timestamp,
    /// The window that gave it.
    pub window: u64,
    /// Its value.
    pub keyframe: Keyframe,
    /// The times of poses.
    pub grid: Grid,
    /// What the poses since `start` are worth.
    pub state: TrackingState,
    /// Version of the rig that it was solved with.
    pub rig_version: u64,
}

/// How a window went.
#[derive(Clone, Debug)]
pub struct WindowReport {
    /// Number of the window.
    pub window: u64,
    /// After this time ...
    pub start: Timestamp,
    /// ... up to this one, what it gave is final.
    pub end: Timestamp,
    /// What the optimiser did, if the window was solved.
    pub summary: Option<Summary>,
    /// Euclidean length of the last keyframe's latent code.
    pub latent_norm: f64,
    /// Where each observation ended up.
    pub residuals: Vec<Residual>,
    /// What it is worth.
    pub verdict: Verdict,
}

/// What is known of the performer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Performer {
    /// Nobody is seen.
    Searching,
    /// Somebody is seen; frames are gathered or looked through.
    Acquiring,
    /// Followed.
    Tracking,
    /// Carried on without enough detections.
    Coasting,
    /// Known, but not seen.
    Lost,
}

impl Performer {
    /// A lower-case name, as used on the wire.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Searching => "searching",
            Self::Acquiring => "acquiring",
            Self::Tracking => "tracking",
            Self::Coasting => "coasting",
            Self::Lost => "lost",
        }
    }
}
