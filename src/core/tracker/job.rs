//! Jobs for the solver, and their answers.

use std::sync::Arc;

use super::effort::Effort;
use super::noise::Noise;
use super::offset_estimator::OffsetEstimator;
use crate::core::body::{Pose, Skeleton};
use crate::core::camera::Rig;
use crate::core::detections::{Detections, KeypointFormat};
use crate::core::manifold::Keyframe;
use crate::core::optimise::Summary;
use crate::core::time::Timestamp;

/// What is to be solved.
#[derive(Clone, Debug)]
pub struct Job {
    /// Number of the job, from 0; its solution carries it too.
    pub number: u64,
    /// Number of the window, from 0.
    pub window: u64,
    /// The window: after `start`, up to `end`.
    pub start: Timestamp,
    /// Its end.
    pub end: Timestamp,
    /// Up to this time the solution is final; the rest of the window is looked ahead.
    pub publish: Timestamp,
    /// Times of its keyframes; `publish` and `end` are among them.
    pub knots: Vec<Timestamp>,
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
    /// How much to do.
    pub effort: Effort,
    /// How far detections lay from the body that was solved.
    pub noise: Noise,
    /// What is known already.
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

/// A keyframe with its time.
pub type TimedKeyframe = (Timestamp, Keyframe);

/// What kind of job it is, with what it stands on.
#[derive(Clone, Debug)]
pub enum Task {
    /// Find the performer; and the shape, if it is not known.
    Acquire {
        /// The body, once known.
        skeleton: Option<Arc<Skeleton>>,
    },
    /// Solve the window's keyframes.
    Track {
        /// The last keyframes that are final, at most two, the last at the window's start.
        past: Vec<TimedKeyframe>,
        /// Keyframes of the window that were found before, to start from.
        ahead: Vec<TimedKeyframe>,
        /// The body.
        skeleton: Arc<Skeleton>,
        /// What is known of the body's marks.
        estimator: Arc<OffsetEstimator>,
        /// Windows in a row, before this one, in which too little was seen.
        coasted: usize,
    },
    /// Fit the open window as far as it goes, up to its newest frame set.
    Provisional {
        /// As for `Tracker`.
        past: Vec<TimedKeyframe>,
        /// As for `Tracker`.
        ahead: Vec<TimedKeyframe>,
        /// The body.
        skeleton: Arc<Skeleton>,
    },
}

/// The answer to a job.
#[derive(Clone, Debug)]
pub struct Solution {
    /// The job's number.
    pub number: u64,
    /// What came of it.
    pub outcome: Outcome,
}

/// What came of a job.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// The performer was found.
    Acquired {
        /// The time of the keyframe.
        at: Timestamp,
        /// The first keyframe.
        keyframe: Box<Keyframe>,
        /// The body.
        skeleton: Arc<Skeleton>,
        /// Its pose.
        pose: Box<Pose>,
    },
    /// Nobody was seen well enough by two cameras.
    NobodyFound,
    /// A window was solved, well or badly.
    Tracked(Box<Tracked>),
    /// The open window was fitted.
    Provisional(Box<ProvisionalFit>),
}

/// A fit of the open window.
#[derive(Clone, Debug)]
pub struct ProvisionalFit {
    /// The keyframes after its start.
    pub keyframes: Vec<TimedKeyframe>,
    /// The pose of the last one.
    pub pose: Pose,
    /// Whether too little was seen; then the motion was carried on.
    pub hidden: bool,
}

/// A solved window.
#[derive(Clone, Debug)]
pub struct Tracked {
    /// The keyframes after its start, those that are looked ahead too.
    pub keyframes: Vec<TimedKeyframe>,
    /// Poses at the job's times.
    pub poses: Vec<Pose>,
    /// The pose at its end.
    pub newest: Pose,
    /// What the optimiser did, if the window was solved.
    pub summary: Option<Summary>,
    /// Where each observation up to the time of publishing ended up.
    pub residuals: Vec<Residual>,
    /// What the window is worth.
    pub verdict: Verdict,
    /// What is known of the body's marks from here on, if the window was asked.
    pub estimator: Option<Arc<OffsetEstimator>>,
}

/// What a window is worth.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Fitted to its detections.
    Tracked,
    /// Too little was seen, for this reason; the motion was carried on.
    Coasted(String),
    /// Fitted badly, or nothing was seen for too long, for this reason.
    Lost(String),
}

/// The distance of a detected point from the solved body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residual {
    /// Capture time of the detection.
    pub capture: Timestamp,
    /// Index of the camera.
    pub camera: usize,
    /// Index of the point in the format.
    pub point: usize,
    /// Distance in the image, pixels; infinite for a point behind the camera.
    pub error_px: f64,
    /// The same as a part of the performer's height in that image.
    pub error_relative: f64,
    /// The detector's confidence.
    pub confidence: f64,
}
