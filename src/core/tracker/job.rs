//! Jobs for the solver, and their solutions.

use std::sync::Arc;

use super::effort::Effort;
use super::noise::{Noise, Residual};
use super::offset_estimator::OffsetEstimator;
use crate::core::body::{Pose, Skeleton, TrackingState};
use crate::core::camera::Rig;
use crate::core::detections::{Detections, KeypointFormat};
use crate::core::manifold::TimedKeyframe;
use crate::core::optimise::Summary;
use crate::core::time::Timestamp;

/// A job for the solver.
#[derive(Clone, Debug)]
pub struct Job {
    /// Number of the job, from 0; its solution has the same one.
    pub number: u64,
    /// Number of the window, from 0.
    pub window: u64,
    /// Start of the window, exclusive.
    pub start: Timestamp,
    /// End of the window, inclusive.
    pub end: Timestamp,
    /// The solution is final up to this time; the rest of the window is look-ahead.
    pub publish: Timestamp,
    /// Times of its keyframes; `publish` and `end` are among them.
    pub keyframe_times: Vec<Timestamp>,
    /// Times at which final poses are wanted, after `start`.
    pub pose_times: Vec<Timestamp>,
    /// Detections in order of capture time.
    pub frames: Vec<Arc<Detections>>,
    /// The order of the detectors' points.
    pub format: KeypointFormat,
    /// The cameras.
    pub rig: Arc<Rig>,
    /// Nominal frame period, ns, even. Detections of less than half of it apart belong to one frame set.
    pub frame_period: i64,
    /// The work to spend.
    pub effort: Effort,
    /// Errors of the detections in the windows before.
    pub noise: Noise,
    /// What to solve, and from what.
    pub task: Task,
}

impl Job {
    /// Half of the nominal frame period, ns.
    pub(super) fn half_period(&self) -> i64 {
        self.frame_period / 2
    }

    /// The frames to use, counted back from the end.
    pub(super) fn used_frames(&self) -> impl Iterator<Item = &Arc<Detections>> {
        let (stride, period) = (self.effort.stride.max(1) as i64, self.frame_period.max(1));
        self.frames.iter().filter(move |frame| {
            let back = (self.end - frame.capture + period / 2).div_euclid(period);
            back % stride == 0
        })
    }

    /// How many nominal frames those are, at least 1.
    pub(super) fn used_count(&self) -> usize {
        let period = self.frame_period.max(1);
        let frames = (self.end - self.start + period / 2) / period;
        (frames.max(1) as usize).div_ceil(self.effort.stride.max(1))
    }
}

/// The kind of a job, with what is known before.
#[derive(Clone, Debug)]
pub enum Task {
    /// Find the performer, and the body shape if it is not known.
    Acquire {
        /// The body, once known.
        skeleton: Option<Arc<Skeleton>>,
    },
    /// Solve the window's keyframes.
    Track {
        /// The last keyframes that are final, at most two, the last at the window's start.
        past: Vec<TimedKeyframe>,
        /// Keyframes of the window from earlier solves, to start from.
        ahead: Vec<TimedKeyframe>,
        /// The body.
        skeleton: Arc<Skeleton>,
        /// The keypoint offsets so far.
        estimator: Arc<OffsetEstimator>,
        /// Windows in a row, before this one, in which too little was seen.
        coasted: usize,
    },
    /// Fit the open window up to its newest frame set.
    Provisional {
        /// As for `Track`.
        past: Vec<TimedKeyframe>,
        /// As for `Track`.
        ahead: Vec<TimedKeyframe>,
        /// The body.
        skeleton: Arc<Skeleton>,
    },
}

/// The solution of a job.
#[derive(Clone, Debug)]
pub struct Solution {
    /// The job's number.
    pub number: u64,
    /// The result.
    pub outcome: Outcome,
}

/// The result of a job.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// The performer was found.
    Acquired {
        /// The first keyframe.
        first: Box<TimedKeyframe>,
        /// The body.
        skeleton: Arc<Skeleton>,
        /// The pose of the first keyframe.
        pose: Box<Pose>,
    },
    /// Nobody was seen well enough by two cameras.
    NobodyFound,
    /// A window was solved; see the verdict.
    Tracked(Box<Tracked>),
    /// The open window was fitted.
    Provisional(Box<ProvisionalFit>),
}

/// A provisional fit of the open window.
#[derive(Clone, Debug)]
pub struct ProvisionalFit {
    /// The keyframes after its start.
    pub keyframes: Vec<TimedKeyframe>,
    /// The pose of the last one.
    pub pose: Pose,
    /// Whether too little was seen; then the motion was extrapolated.
    pub hidden: bool,
}

/// A solved window.
#[derive(Clone, Debug)]
pub struct Tracked {
    /// The keyframes after its start, with those of the look-ahead.
    pub keyframes: Vec<TimedKeyframe>,
    /// Poses at the job's times.
    pub poses: Vec<Pose>,
    /// The pose at its end.
    pub newest: Pose,
    /// What the optimiser did, if the window was solved.
    pub summary: Option<Summary>,
    /// The distance of each observation up to the job's `publish` from the solved body.
    pub residuals: Vec<Residual>,
    /// Whether the poses can be used.
    pub verdict: Verdict,
    /// The keypoint offsets from here on, if this window updated them.
    pub estimator: Option<Arc<OffsetEstimator>>,
}

/// Whether the poses of a window can be used, and if not, the reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The window was fitted to its detections.
    Tracked,
    /// Too little was seen; the motion was extrapolated.
    Coasted(String),
    /// The fit is bad, or nothing was seen for too long.
    Lost(String),
}

impl Verdict {
    /// The state of the window's poses.
    pub const fn state(&self) -> TrackingState {
        match self {
            Self::Tracked => TrackingState::Tracking,
            Self::Coasted(_) => TrackingState::Coasting,
            Self::Lost(_) => TrackingState::Lost,
        }
    }
}
