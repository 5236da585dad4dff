//! What another tracker needs to go on with a performer.

use std::sync::Arc;

use super::body_estimator::BodyEstimator;
use super::noise::Noise;
use super::port::Output;
use super::state_machine::{Phase, Tracker};
use crate::core::body::{JointDeviations, Skeleton};
use crate::core::manifold::TimedKeyframe;
use crate::core::time::{Grid, Timestamp};

/// The state of a tracker between two windows. A tracker that [takes it over](Tracker::take_over) and gets the frames
/// after `until` gives the same poses, byte for byte.
#[derive(Clone, Debug, PartialEq)]
pub struct HandOver {
    /// The poses up to this time are final.
    pub until: Timestamp,
    /// Number of the next window.
    pub window: u64,
    /// The body, if it is known, and what else is known of it.
    pub skeleton: Option<Arc<Skeleton>>,
    /// See `skeleton`.
    pub estimate: Arc<BodyEstimator>,
    /// Whether any window was tracked with this body.
    pub is_proven: bool,
    /// The motion; `None`: the performer is searched.
    pub motion: Option<Motion>,
}

impl HandOver {
    /// The state of a performer of whom only the body is known, from a time on. It is checked in the first windows.
    pub(in crate::core) fn of_body(body: Arc<Skeleton>, until: Timestamp) -> Self {
        Self {
            until,
            window: 0,
            skeleton: Some(body),
            estimate: Arc::new(BodyEstimator::check()),
            is_proven: true,
            motion: None,
        }
    }

    /// The body once its estimate is complete, or if it was given.
    pub fn known_body(&self) -> Option<&Arc<Skeleton>> {
        let is_known = self.estimate.is_check() || self.estimate.is_complete();
        self.skeleton.as_ref().filter(|_| self.is_proven && is_known)
    }
}

/// The motion of a performer at the end of a window.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    /// The last final keyframes, at most two.
    pub past: Vec<TimedKeyframe>,
    /// Keyframes after them that are not final.
    pub ahead: Vec<TimedKeyframe>,
    /// Number of windows in a row that were extrapolated.
    pub coasted: usize,
    /// The grid of nominal frame times, and a time of a pose.
    pub frames: Grid,
    /// See `frames`.
    pub first_pose: Timestamp,
    /// Residual level of the detections.
    pub noise: Noise,
    /// Relative error of the detections when the body was complete.
    pub first_fit: Option<f64>,
    /// Standard deviations of the joint centres at the end of the window.
    pub deviations: Option<JointDeviations>,
}

impl Tracker {
    /// A tracker that puts out a [`HandOver`] before the poses of each window.
    #[must_use]
    pub(in crate::core) fn handing_over(mut self) -> Self {
        self.hands_over = true;
        self
    }

    /// Puts out the state before what was put out since there were `before` outputs.
    pub(super) fn put_out_state(&mut self, before: usize) {
        if self.hands_over {
            self.outputs.insert(before, Output::HandOver(Box::new(self.state_between())));
        }
    }

    /// The state between two windows.
    fn state_between(&self) -> HandOver {
        let motion = match (&self.phase, self.frames) {
            (Phase::Tracking { past, coasted }, Some(frames)) => Some(Motion {
                past: past.clone(),
                ahead: self.ahead.clone(),
                coasted: *coasted,
                frames,
                first_pose: self.first_output.unwrap_or(frames.origin),
                noise: self.noise,
                first_fit: self.first_fit,
                deviations: self.deviations,
            }),
            _ => None,
        };
        HandOver {
            until: self.start.unwrap_or_default(),
            window: self.window,
            skeleton: self.skeleton.clone().filter(|_| self.is_proven),
            estimate: Arc::clone(&self.estimator),
            is_proven: self.is_proven,
            motion,
        }
    }

    /// Goes on where another tracker was. Give it the frames after that; earlier ones are not used.
    pub(in crate::core) fn take_over(&mut self, state: HandOver) {
        self.restart();
        let HandOver { until, window, skeleton, estimate, is_proven, motion } = state;
        let Some(skeleton) = skeleton else { return };
        self.outputs.push_back(Output::Skeleton(Arc::clone(&skeleton)));
        (self.skeleton, self.is_proven, self.window) = (Some(skeleton), is_proven, window);
        let Some(motion) = motion else {
            self.estimator = Arc::new(estimate.after_a_break());
            return;
        };
        self.estimator = estimate;
        self.phase = Phase::Tracking { past: motion.past, coasted: motion.coasted };
        (self.frames, self.first_output) = (Some(motion.frames), Some(motion.first_pose));
        (self.period, self.start) = (Some(motion.frames.period_ns), Some(until));
        (self.ahead, self.noise) = (motion.ahead, motion.noise);
        (self.first_fit, self.deviations) = (motion.first_fit, motion.deviations);
        self.intake.close(until + self.tolerance());
    }
}
