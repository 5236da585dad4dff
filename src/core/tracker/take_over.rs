//! A tracker puts out its state after each window, and goes on where another one was.

use std::sync::Arc;

use super::hand_over::{HandOver, Motion};
use super::port::Output;
use super::state_machine::{Phase, Tracker};

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
            motion,
        }
    }

    /// Goes on where another tracker was. Give it the frames after that; earlier ones are not used.
    pub(in crate::core) fn take_over(&mut self, state: HandOver) {
        self.restart();
        let HandOver { until, window, skeleton, estimate, motion } = state;
        let Some(skeleton) = skeleton else { return };
        self.outputs.push_back(Output::Skeleton(Arc::clone(&skeleton)));
        (self.skeleton, self.is_proven) = (Some(skeleton), true);
        self.window = self.window.max(window);
        self.intake.refuse(until);
        self.estimator = estimate;
        let Some(motion) = motion else { return };
        self.phase = Phase::Tracking { past: motion.past, coasted: motion.coasted };
        (self.frames, self.first_output) = (Some(motion.frames), Some(motion.first_pose));
        (self.period, self.start) = (Some(motion.frames.period_ns), Some(until));
        (self.ahead, self.noise) = (motion.ahead, motion.noise);
        (self.first_fit, self.deviations) = (motion.first_fit, motion.deviations);
        self.intake.close(until + self.tolerance());
    }
}
