//! Leaves wrong minima: a fresh fit replaces a solved window that does not fit its detections.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::Solver;
use super::keyframes::between;
use super::known::Known;
use crate::core::body::{BodyPoint, Skeleton};
use crate::core::cost::{FrameObservations, Loss};
use crate::core::points::median;
use crate::core::tracker::job::{Job, Outcome};
use crate::core::tracker::noise::Residual;
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
            || !self.is_far(job, points, solved, observations)
        {
            return None;
        }
        let found = self.acquire(job, points, Some(skeleton));
        let Outcome::Acquired { first, .. } = &found else { return None };
        let at = first.capture;
        let there = between(observations, [at - job.half_period(), at + job.half_period()]);
        let fresh = Known { past: std::slice::from_ref(first), ahead: &[], ..solved };
        let [known, fresh] = [solved, fresh].map(|path| self.misfit(job, points, path, there));
        (fresh < BETTER * known).then_some(found)
    }

    /// The reprojection cost of a window.
    fn misfit(
        &self,
        job: &Job,
        points: &[BodyPoint],
        solved: Known,
        observations: &[FrameObservations],
    ) -> f64 {
        let cost = self.cost(job);
        let loss = Loss::new(cost.loss, cost.scale_px);
        let all = self.residuals_of(job, points, solved, observations);
        all.iter().map(|r| r.confidence * loss.rho(r.way_px.norm_squared()).0).sum()
    }

    /// Whether some point lies far from two views or more in the median.
    fn is_far(
        &self,
        job: &Job,
        points: &[BodyPoint],
        solved: Known,
        observations: &[FrameObservations],
    ) -> bool {
        let limit = FAR * self.cost(job).scale_px;
        // In the order of points: two views of one point are neighbours.
        let mut errors: BTreeMap<(usize, usize), Vec<f64>> = BTreeMap::new();
        for r in self.residuals_of(job, points, solved, observations) {
            errors.entry((r.point, r.camera)).or_default().push(r.error_px());
        }
        let far = errors
            .iter_mut()
            .filter_map(|(&(point, _), errors)| (median(errors)? > limit).then_some(point));
        let far_points: Vec<usize> = far.collect();
        far_points.windows(2).any(|pair| pair[0] == pair[1])
    }

    /// The residuals of the observations on a solved path.
    fn residuals_of(
        &self,
        job: &Job,
        points: &[BodyPoint],
        solved: Known,
        observations: &[FrameObservations],
    ) -> Vec<Residual> {
        let poses = self.poses_at(solved, observations.iter().map(|frame| frame.capture));
        residuals(observations.iter().zip(&poses), points, &job.rig, solved.skeleton)
    }
}
