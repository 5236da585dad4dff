//! Jobs for the solver, and their solutions.

use std::fmt;
use std::sync::Arc;

use super::agreement::Unfollowed;
use super::body_estimator::BodyEstimator;
use super::effort::Effort;
use super::noise::{Noise, Residual};
use crate::core::body::{JointDeviations, Pose, Skeleton, TrackingState};
use crate::core::calibration::{Correction, Seen};
use crate::core::camera::{Camera, Rig};
use crate::core::detections::{Detections, KeypointFormat};
use crate::core::manifold::TimedKeyframe;
use crate::core::optimise::Summary;
use crate::core::time::{Nanos, Timestamp};

/// A job for the solver.
#[derive(Clone, Debug)]
pub struct Job {
    /// Number of the job, from 0; its solution has the same number.
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
    /// Times of the requested poses; those of a window are after `start`.
    pub pose_times: Vec<Timestamp>,
    /// Detections in order of capture time.
    pub frames: Vec<Arc<Detections>>,
    /// The order of the keypoints.
    pub format: KeypointFormat,
    /// The cameras.
    pub rig: Arc<Rig>,
    /// Nominal frame period, an even number of nanoseconds. Detections less than half of it apart
    /// belong to one frame set.
    pub frame_period: Nanos,
    /// The effort of the solve.
    pub effort: Effort,
    /// Residual level of the windows before.
    pub noise: Noise,
    /// The kind of the job, with its start values.
    pub task: Task,
}

impl Job {
    /// Whether no pose waits for it: [`solve_aside`](super::solve_aside) solves it.
    pub fn is_aside(&self) -> bool {
        matches!(self.task, Task::Mend { .. })
    }

    /// Half of the nominal frame period.
    pub(super) fn half_period(&self) -> Nanos {
        self.frame_period / 2
    }

    /// The frames to use, counted back from the end.
    pub(super) fn used_frames(&self) -> impl Iterator<Item = &Arc<Detections>> {
        self.every(self.effort.stride)
    }

    /// The nominal time between two frames that are used, ns.
    pub(super) fn used_period(&self) -> f64 {
        (self.frame_period * self.effort.stride.max(1) as i64).ns().max(1) as f64
    }

    /// All frames, or the last one of each camera in every `stride` nominal frames. They are counted back from the end.
    pub(super) fn every(&self, stride: usize) -> impl Iterator<Item = &Arc<Detections>> {
        let stride = stride.max(1);
        let length = self.frame_period.ns().max(1) * stride as i64;
        let mut last = vec![None; self.rig.cameras.len()];
        let is_used = |frame: &&Arc<Detections>| {
            let back = (self.end - frame.capture + self.half_period()).ns();
            let (last, slot) = (&mut last[frame.camera], Some(back.div_euclid(length)));
            stride == 1 || std::mem::replace(last, slot) != slot
        };
        let used: Vec<_> = self.frames.iter().rev().filter(is_used).collect();
        used.into_iter().rev()
    }
}

/// The kind of a job, with its known values.
#[derive(Clone, Debug)]
pub enum Task {
    /// Find the performer, and the body shape if it is not known.
    Acquire {
        /// The body, once known.
        skeleton: Option<Arc<Skeleton>>,
    },
    /// Solve the window's keyframes.
    Track {
        /// The last final keyframes, at most two, the last at the window's start.
        past: Vec<TimedKeyframe>,
        /// Keyframes of the window from earlier solves, to start from.
        ahead: Vec<TimedKeyframe>,
        /// The body.
        skeleton: Arc<Skeleton>,
        /// The keypoint offsets so far.
        estimator: Arc<BodyEstimator>,
        /// Number of windows in a row before this one with too few detections.
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
        /// Number of the last known keyframes that are solved again with the new ones.
        again: usize,
    },
    /// Find where a camera is that was moved. It may take some tenths of a second, and no pose waits for it.
    Mend {
        /// Its index.
        camera: usize,
        /// What was seen before and after it was moved.
        seen: [Arc<Seen>; 2],
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
#[non_exhaustive]
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
    /// No person was seen well enough by two cameras.
    NobodyFound,
    /// A window was solved; see the verdict.
    Tracked(Box<Tracked>),
    /// The open window was fitted.
    Provisional(Box<ProvisionalFit>),
    /// Where the moved camera is now, if that could be told.
    Mended(Option<Box<Placed>>),
}

/// A camera that was moved: where it is now, and the way there.
#[derive(Clone, Debug, PartialEq)]
pub struct Placed {
    /// The camera in its new pose.
    pub camera: Camera,
    /// How it was moved.
    pub by: Correction,
}

impl fmt::Display for Placed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Correction { rotation: [turn, of_turn], position: [shift, of_shift], .. } = self.by;
        let [turn, of_turn] = [turn, of_turn].map(f64::to_degrees);
        let [shift, of_shift] = [shift, of_shift].map(|metres| metres * 100.0);
        write!(f, "turned by {turn:.1} ± {of_turn:.1} degrees, ")?;
        write!(f, "moved by {shift:.1} ± {of_shift:.1} cm")
    }
}

/// A pose and its capture time.
pub type PoseAt = (Timestamp, Pose);

/// A provisional fit of the open window.
#[derive(Clone, Debug)]
pub struct ProvisionalFit {
    /// The keyframes after its start.
    pub keyframes: Vec<TimedKeyframe>,
    /// Poses at the job's times, which are not all after its start.
    pub poses: Vec<PoseAt>,
    /// Whether too little was seen; the motion is then extrapolated.
    pub hidden: bool,
}

/// A solved window.
#[derive(Clone, Debug)]
pub struct Tracked {
    /// The keyframes after its start, with those of the look-ahead.
    pub keyframes: Vec<TimedKeyframe>,
    /// Keyframes between them, at the times of poses. They are put out, but the next window does not have them.
    pub between: Vec<TimedKeyframe>,
    /// Poses at the job's times.
    pub poses: Vec<Pose>,
    /// The standard deviations of the joint centres at the job's `publish`.
    pub deviations: Option<JointDeviations>,
    /// The pose at its end.
    pub newest: Pose,
    /// The result of the optimiser, if the window was solved.
    pub summary: Option<Summary>,
    /// The distance of each observation up to the job's `publish` from the solved body.
    pub residuals: Vec<Residual>,
    /// The points in the same part on which the views agree, and where the body is not.
    pub unfollowed: Vec<Unfollowed>,
    /// Whether the poses can be used.
    pub verdict: Verdict,
    /// The keypoint offsets from here on, if this window updated them.
    pub estimator: Option<Arc<BodyEstimator>>,
}

/// Whether the poses of a window can be used, and if not, the reason.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Verdict {
    /// The window was fitted to its detections.
    Tracked,
    /// Too little was seen; the motion was extrapolated.
    Coasted(String),
    /// The fit is bad, or too little was seen for too long.
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
