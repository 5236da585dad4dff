//! What another tracker needs to go on with a performer.

use std::sync::Arc;

use super::body_estimator::BodyEstimator;
use super::noise::Noise;
use crate::core::body::{JointDeviations, Skeleton};
use crate::core::manifold::TimedKeyframe;
use crate::core::time::{Grid, Timestamp};

/// The state of a tracker between two windows. A tracker that takes it over and gets the frames after `until` gives the
/// same poses, byte for byte.
#[derive(Clone, Debug, PartialEq)]
pub struct HandOver {
    /// The poses up to this time are final.
    pub until: Timestamp,
    /// Number of the next window.
    pub window: u64,
    /// The body, if any window was tracked with it, and what else is known of it.
    pub skeleton: Option<Arc<Skeleton>>,
    /// See `skeleton`.
    pub estimate: Arc<BodyEstimator>,
    /// The motion; `None`: the performer is searched.
    pub motion: Option<Motion>,
}

impl HandOver {
    /// The state of a performer of whom only the body is known, with the keypoint offsets of this detector or the bones
    /// alone, from a time on.
    pub(in crate::core) fn of_body(
        body: Arc<Skeleton>,
        offsets_are_known: bool,
        until: Timestamp,
    ) -> Self {
        let estimate = match offsets_are_known {
            true => BodyEstimator::check(),
            false => BodyEstimator::of_another_take(&body),
        };
        Self { until, window: 0, estimate: Arc::new(estimate), skeleton: Some(body), motion: None }
    }

    /// The body once its estimate is complete, or if it was given.
    pub fn known_body(&self) -> Option<&Arc<Skeleton>> {
        self.skeleton.as_ref().filter(|_| self.estimate.is_known())
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
