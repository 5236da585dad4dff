//! The reprojection cost of a point.

use nalgebra::{Matrix3, Vector3};

use super::observation::Observation;
use super::robust::Loss;
use crate::core::camera::Rig;

/// The cameras and the loss of their errors, pixels.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reprojection<'a> {
    pub(super) rig: &'a Rig,
    pub(super) loss: Loss,
}

impl Reprojection<'_> {
    /// 1/2 sum of w rho over the views of a point at `position` in the world.
    pub(super) fn cost(&self, views: &[Observation], position: &Vector3<f64>) -> f64 {
        let cost = |view: &Observation| {
            let loss = self.loss.wider(view.scale_factor);
            let seen = self.rig.cameras[view.camera].project(position);
            let rho = seen
                .map_or(loss.ceiling(), |pixel| loss.rho((pixel - view.pixel).norm_squared()).0);
            0.5 * view.confidence * rho
        };
        views.iter().map(cost).sum()
    }

    /// The same, with its gradient and Gauss-Newton curvature by the position.
    pub(super) fn terms(
        &self,
        views: &[Observation],
        position: &Vector3<f64>,
    ) -> (f64, Vector3<f64>, Matrix3<f64>) {
        let (mut cost, mut gradient, mut curvature) = (0.0, Vector3::zeros(), Matrix3::zeros());
        for view in views {
            let (camera, loss) =
                (&self.rig.cameras[view.camera], self.loss.wider(view.scale_factor));
            let Some((pixel, jacobian)) = camera.project_with_jacobian(position) else {
                cost += 0.5 * view.confidence * loss.ceiling();
                continue;
            };
            let residual = pixel - view.pixel;
            let (rho, slope) = loss.rho(residual.norm_squared());
            cost += 0.5 * view.confidence * rho;
            let weighted = jacobian.transpose() * (view.confidence * slope);
            gradient += weighted * residual;
            curvature += weighted * jacobian;
        }
        (cost, gradient, curvature)
    }
}
