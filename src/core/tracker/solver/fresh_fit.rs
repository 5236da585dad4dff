//! Leaves wrong minima: a fresh fit replaces a solved window that does not fit its detections.

use std::sync::Arc;

use super::Solver;
use super::keyframes::between;
use super::known::Known;
use crate::core::body::{BodyPoint, Skeleton};
use crate::core::cost::{FrameObservations, Loss};
use crate::core::points::median;
use crate::core::tracker::job::{Job, Outcome};
use crate::core::tracker::verdict::residuals;

/// A point this many scales of the loss from a view is far from it.
const FAR: f64 = 4.0;
/// A fresh fit replaces the solution below this part of its cost.
const BETTER: f64 = 0.8;

impl Solver {
    /// A fresh fit of the performer, where the solved window is a wrong minimum: some point lies far
    /// from several views all the time, and the fresh fit costs less. `None` otherwise.
    pub(super) fn fresh_fit(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        solved: Known,
        skeleton: &Arc<Skeleton>,
        observations: &[FrameObservations],
    ) -> Option<Outcome> {
        let every = self.config.fresh_fit_windows as u64;
        // With many cameras it takes as long as several windows: not when there is no time.
        let is_due = every > 0 && job.window.is_multiple_of(every);
        if !is_due
            || !job.effort.has_time(&self.config)
            || self.misfit(job, points, solved, observations).1 == 0
        {
            return None;
        }
        let found = self.acquire(job, points, Some(skeleton));
        let Outcome::Acquired { first, .. } = &found else { return None };
        let at = first.capture;
        let there = between(observations, [at - job.half_period(), at + job.half_period()]);
        let fresh = Known { past: std::slice::from_ref(first), ahead: &[], ..solved };
        let [known, fresh] = [solved, fresh].map(|path| self.misfit(job, points, path, there).0);
        (fresh < BETTER * known).then_some(found)
    }

    /// The reprojection cost of a window, and its number of points that lie far from two views or
    /// more in the median.
    fn misfit(
        &self,
        job: &Job,
        points: &[BodyPoint],
        solved: Known,
        observations: &[FrameObservations],
    ) -> (f64, usize) {
        let cost = self.cost(job);
        let loss = Loss::new(cost.loss, cost.scale_px);
        let poses = self.poses_at(solved, observations.iter().map(|frame| frame.capture));
        let all = residuals(observations.iter().zip(&poses), points, &job.rig, solved.skeleton);
        let total = all.iter().map(|r| r.confidence * loss.rho(r.error_px * r.error_px).0).sum();
        let is_far = |point: usize, camera: usize| {
            let mut errors: Vec<f64> = all
                .iter()
                .filter(|r| r.point == point && r.camera == camera)
                .map(|r| r.error_px)
                .collect();
            median(&mut errors).is_some_and(|error| error > FAR * cost.scale_px)
        };
        let far = |point: &&BodyPoint| {
            (0..job.rig.cameras.len()).filter(|&camera| is_far(point.index, camera)).count() >= 2
        };
        (total, points.iter().filter(far).count())
    }
}
