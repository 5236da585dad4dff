//! The terms of one moment: what the cameras saw of the body's points.
//!
//! All views of a point share the point's Jacobian: their 2D terms are first summed to a gradient
//! and a 3x3 curvature in the world. The gradient acts on the body as a force, which goes back
//! through joints and decoder; a triangular root of the curvature gives three rows of the Jacobian.
//! So the normal equations cost no more for eight cameras than for two.

use nalgebra::{Matrix3, Vector3};

use super::blocks::root_of;
use super::observation::Observation;
use super::path::PathProblem;
use super::unknowns::KEYFRAME;
use super::workspace::LOCAL_ROWS;
use crate::body::{BodyPoint, Joint, Posture, Tangents, Wrenches, push_forward};
use crate::manifold::LATENT;

impl<'a> PathProblem<'a> {
    /// Tangents of the posture at moment `m` by the moment's coordinates; `turn` is how the pelvis
    /// turns with those of its rotation.
    pub(super) fn push_tangents(&mut self, m: usize, posture: &Posture, turn: &Matrix3<f64>) {
        let columns = self.coordinates();
        let work = &mut *self.work;
        let mut tangents = work
            .tangents
            .take()
            .filter(|t| t.columns() == columns)
            .unwrap_or_else(|| Tangents::zeros(columns));
        tangents.clear_root();
        tangents.set_root_turn(LATENT, turn);
        tangents.set_root_shift(LATENT + 3, 1.0);
        let shape_column = (self.unknowns.body > 0).then_some(KEYFRAME);
        let skeleton = &self.unknowns.skeleton;
        let by_code = &work.by_code[m * LOCAL_ROWS * LATENT..(m + 1) * LOCAL_ROWS * LATENT];
        push_forward(skeleton, posture, by_code, LATENT, shape_column, &mut tangents);
        work.tangents = Some(tangents);
    }

    /// Cost of the observations at moment `m`.
    pub(super) fn moment_cost(&self, m: usize, posture: &Posture) -> f64 {
        let cost = |views: &[Observation]| {
            let (point, arm) = self.point(views, posture);
            let position = posture.positions[point.attachment.joint.index()] + arm;
            point.attachment.weight * self.point_cost(views, &position)
        };
        self.moments[m].by_point().map(cost).sum()
    }

    /// The same; leaves the moment's gradient in the workspace and, if wanted, its rows.
    pub(super) fn add_moment(&mut self, m: usize, posture: &Posture, rows: bool) -> f64 {
        let (n, moments) = (self.coordinates(), self.moments);
        let mut wrenches = Wrenches::zeros();
        let mut cost = 0.0;
        self.work.rows.clear();
        self.work.gradients[m * n..(m + 1) * n].fill(0.0);
        for views in moments[m].by_point() {
            let (point, arm) = self.point(views, posture);
            let (joint, weight) = (point.attachment.joint, point.attachment.weight);
            let position = posture.positions[joint.index()] + arm;
            let (value, gradient, curvature) = self.point_terms(views, &position);
            let (gradient, curvature) = (gradient * weight, curvature * weight);
            cost += weight * value;
            wrenches.add(joint, &arm, &gradient);
            let rotation = &posture.rotations[joint.index()];
            if rows {
                self.add_rows(point, &arm, rotation, &curvature);
            }
            if self.unknowns.body > 0 {
                let out = &mut self.work.gradients[m * n + KEYFRAME..(m + 1) * n];
                add_by_body(&point.attachment.offset_by_body(), rotation, &gradient, out);
            }
        }
        wrenches.gather(posture);
        self.add_wrenches(m, posture, &wrenches);
        cost
    }

    /// The point that was seen, and where it is from its joint's centre (world frame).
    fn point(&self, views: &[Observation], posture: &Posture) -> (&'a BodyPoint, Vector3<f64>) {
        let point = &self.scene.points[views[0].point];
        let rotation = &posture.rotations[point.attachment.joint.index()];
        (point, rotation * self.work.offsets[views[0].point])
    }

    fn point_cost(&self, views: &[Observation], position: &Vector3<f64>) -> f64 {
        let cost = |view: &Observation| {
            let seen = self.scene.rig.cameras[view.camera].project(position);
            let rho = seen.map_or(self.loss.ceiling(), |pixel| {
                self.loss.rho((pixel - view.pixel).norm_squared()).0
            });
            0.5 * view.confidence * rho
        };
        views.iter().map(cost).sum()
    }

    /// Cost of a point's views, its gradient and Gauss-Newton curvature by the point's position.
    fn point_terms(
        &self,
        views: &[Observation],
        position: &Vector3<f64>,
    ) -> (f64, Vector3<f64>, Matrix3<f64>) {
        let (mut cost, mut gradient, mut curvature) = (0.0, Vector3::zeros(), Matrix3::zeros());
        for view in views {
            let camera = &self.scene.rig.cameras[view.camera];
            let Some((pixel, jacobian)) = camera.project_with_jacobian(position) else {
                cost += 0.5 * view.confidence * self.loss.ceiling();
                continue;
            };
            let residual = pixel - view.pixel;
            let (rho, slope) = self.loss.rho(residual.norm_squared());
            cost += 0.5 * view.confidence * rho;
            let weighted = jacobian.transpose() * (view.confidence * slope);
            gradient += weighted * residual;
            curvature += weighted * jacobian;
        }
        (cost, gradient, curvature)
    }

    /// Adds three rows: L^T J, where L L^T is the curvature and J the point's Jacobian.
    fn add_rows(
        &mut self,
        point: &BodyPoint,
        arm: &Vector3<f64>,
        rotation: &Matrix3<f64>,
        curvature: &Matrix3<f64>,
    ) {
        let n = self.coordinates();
        let work = &mut *self.work;
        let Some(tangents) = &work.tangents else { return };
        let root = root_of(curvature);
        for direction in root.column_iter().map(|column| column.into_owned()) {
            let first = work.rows.len();
            work.rows.resize(first + n, 0.0);
            let row = &mut work.rows[first..];
            tangents.along(point.attachment.joint, arm, &direction, row);
            if self.unknowns.body > 0 {
                let by_body = point.attachment.offset_by_body();
                add_by_body(&by_body, rotation, &direction, &mut row[KEYFRAME..]);
            }
        }
    }

    /// The gradient by the moment's coordinates but the code, and by its local rotations.
    fn add_wrenches(&mut self, m: usize, posture: &Posture, wrenches: &Wrenches) {
        let n = self.coordinates();
        let skeleton = &self.unknowns.skeleton;
        let work = &mut *self.work;
        let gradient = &mut work.gradients[m * n..(m + 1) * n];
        let root = wrenches.torque(Joint::Pelvis).iter().chain(wrenches.force(Joint::Pelvis));
        gradient[LATENT..].iter_mut().zip(root).for_each(|(out, v)| *out = *v);
        let by_rotation = &mut work.by_rotation[m * LOCAL_ROWS..(m + 1) * LOCAL_ROWS];
        for (joint, out) in Joint::ALL[1..].iter().zip(by_rotation.chunks_exact_mut(3)) {
            let turned = posture.rotations[joint.index()].tr_mul(wrenches.torque(*joint));
            out.copy_from_slice(turned.as_slice());
            let Some(parent) = joint.parent() else { continue };
            let (rotation, force) = (&posture.rotations[parent.index()], wrenches.force(*joint));
            if self.unknowns.body > 0 {
                let by_shape = skeleton.offset_by_shape(*joint);
                add_by_body(by_shape, rotation, force, &mut gradient[KEYFRAME..]);
            }
        }
    }
}

/// Adds the derivative along `direction` (world frame) of an offset that `rotation` turns, by the
/// body's coefficients.
fn add_by_body(
    by_body: &[Vector3<f64>],
    rotation: &Matrix3<f64>,
    direction: &Vector3<f64>,
    out: &mut [f64],
) {
    let local = rotation.tr_mul(direction);
    out.iter_mut().zip(by_body).for_each(|(out, offset)| *out += local.dot(offset));
}
