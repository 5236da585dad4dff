//! The terms of moments: what the cameras saw of the body's points.
//!
//! All views of a point share the point's Jacobian: their 2D terms are first summed to a gradient
//! and a 3x3 curvature in the world. The gradient acts on the body as a force, which goes back
//! through joints and decoder; a triangular root of the curvature gives three rows of the Jacobian.
//! So the normal equations cost no more for eight cameras than for two.

use nalgebra::{Matrix3, Vector3};

use super::ends::root_of;
use super::lane::{LOCAL_ROWS, Lane};
use super::observation::{Moment, Observation};
use super::path::Scene;
use super::robust::GemanMcClure;
use super::unknowns::{KEYFRAME, Place, Unknowns};
use crate::body::{BodyPoint, Joint, Posture, Tangents, Wrenches, forward, push_forward};
use crate::gemm;
use crate::manifold::{LATENT, Latent};
use crate::so3;

/// What is wanted of moments.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Wanted {
    Cost,
    Gradients,
    /// The gradients too.
    Hessians,
}

/// A path, as its moments need it.
#[derive(Clone, Copy)]
pub(super) struct Path<'p> {
    pub(super) scene: Scene<'p>,
    pub(super) unknowns: &'p Unknowns,
    pub(super) loss: GemanMcClure,
    /// The points' offsets in their joints' frames.
    pub(super) offsets: &'p [Vector3<f64>],
}

impl<'p> Path<'p> {
    /// Computes what is wanted of all moments of a lane, and leaves it there.
    pub(super) fn compute(&self, moments: &[Moment], wanted: Wanted, lane: &mut Lane) {
        lane.costs.clear();
        if moments.is_empty() {
            return;
        }
        let n = self.unknowns.coordinates();
        lane.decode(self.scene.decoder, moments.iter().map(|moment| self.code(moment)));
        if wanted == Wanted::Hessians {
            // The Hessian by the body is used for itself, not only to steer.
            let reach =
                if self.unknowns.body == 0 { self.scene.config.jacobian_reach } else { 0.0 };
            lane.linearise(self.scene.decoder, reach);
            lane.grams.resize(moments.len() * n * n, 0.0);
        }
        lane.by_rotation.resize(moments.len() * LOCAL_ROWS, 0.0);
        lane.gradients.resize(moments.len() * n, 0.0);
        for (m, moment) in moments.iter().enumerate() {
            let place = self.unknowns.place(moment.capture);
            let posture = self.posture(place, m, lane);
            if wanted == Wanted::Hessians {
                self.push_tangents(place, &posture, m, lane);
            }
            let cost = match wanted {
                Wanted::Cost => self.cost(moment, &posture),
                _ => self.add(moment, &posture, wanted, m, lane),
            };
            lane.costs.push(cost);
            if wanted == Wanted::Hessians {
                lane.counts.moments += 1;
                let (rows, gram) = (&lane.rows, &mut lane.grams[m * n * n..(m + 1) * n * n]);
                gemm::gram([rows.len() / n, n], rows, gram);
            }
        }
        if wanted >= Wanted::Gradients {
            lane.pull_back(self.scene.decoder, n);
        }
    }

    /// The code at a moment.
    fn code(&self, moment: &Moment) -> Latent {
        let Place { from, to, s } = self.unknowns.place(moment.capture);
        let (z0, z1) = (&self.unknowns.keyframes[from].z, &self.unknowns.keyframes[to].z);
        if from == to { *z1 } else { self.scene.config.interpolation.latent(z0, z1, s) }
    }

    /// Where the body is at moment `m` of the lane.
    fn posture(&self, Place { from, to, s }: Place, m: usize, lane: &Lane) -> Posture {
        let (first, last) = (&self.unknowns.keyframes[from], &self.unknowns.keyframes[to]);
        let rotation = match from == to {
            true => last.root_rotation,
            false => so3::slerp(&first.root_rotation, &last.root_rotation, s),
        };
        let position = first.root_position.lerp(&last.root_position, s);
        forward(&self.unknowns.skeleton, &rotation, &position, &lane.rotations(m))
    }

    /// Tangents of the posture at moment `m` by the moment's coordinates.
    fn push_tangents(&self, place: Place, posture: &Posture, m: usize, lane: &mut Lane) {
        let columns = self.unknowns.coordinates();
        let mut tangents = lane
            .tangents
            .take()
            .filter(|t| t.columns() == columns)
            .unwrap_or_else(|| Tangents::zeros(columns));
        tangents.clear_root();
        tangents.set_root_turn(LATENT, &self.unknowns.knot_turn(place));
        tangents.set_root_shift(LATENT + 3, 1.0);
        let shape_column = (self.unknowns.body > 0).then_some(KEYFRAME);
        let skeleton = &self.unknowns.skeleton;
        push_forward(skeleton, posture, lane.by_code(m), LATENT, shape_column, &mut tangents);
        lane.tangents = Some(tangents);
    }

    /// Cost of what was seen at a moment.
    fn cost(&self, moment: &Moment, posture: &Posture) -> f64 {
        let cost = |views: &[Observation]| {
            let (point, arm) = self.point(views, posture);
            let position = posture.positions[point.attachment.joint.index()] + arm;
            point.attachment.weight * self.point_cost(views, &position)
        };
        moment.by_point().map(cost).sum()
    }

    /// The same; leaves the gradient of moment `m` in the lane, and its rows if they are wanted.
    fn add(
        &self,
        moment: &Moment,
        posture: &Posture,
        wanted: Wanted,
        m: usize,
        lane: &mut Lane,
    ) -> f64 {
        let n = self.unknowns.coordinates();
        let mut wrenches = Wrenches::zeros();
        let mut cost = 0.0;
        lane.rows.clear();
        lane.gradients[m * n..(m + 1) * n].fill(0.0);
        for views in moment.by_point() {
            let (point, arm) = self.point(views, posture);
            let (joint, weight) = (point.attachment.joint, point.attachment.weight);
            let position = posture.positions[joint.index()] + arm;
            let (value, gradient, curvature) = self.point_terms(views, &position);
            let (gradient, curvature) = (gradient * weight, curvature * weight);
            cost += weight * value;
            wrenches.add(joint, &arm, &gradient);
            let rotation = &posture.rotations[joint.index()];
            if wanted == Wanted::Hessians {
                self.add_rows(point, &arm, rotation, &curvature, lane);
            }
            if self.unknowns.body > 0 {
                let out = &mut lane.gradients[m * n + KEYFRAME..(m + 1) * n];
                add_by_body(&point.attachment.offset_by_body(), rotation, &gradient, out);
            }
        }
        wrenches.gather(posture);
        self.add_wrenches(posture, &wrenches, m, lane);
        cost
    }

    /// The point that was seen, and where it is from its joint's centre (world frame).
    fn point(&self, views: &[Observation], posture: &Posture) -> (&'p BodyPoint, Vector3<f64>) {
        let point = &self.scene.points[views[0].point];
        let rotation = &posture.rotations[point.attachment.joint.index()];
        (point, rotation * self.offsets[views[0].point])
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
        &self,
        point: &BodyPoint,
        arm: &Vector3<f64>,
        rotation: &Matrix3<f64>,
        curvature: &Matrix3<f64>,
        lane: &mut Lane,
    ) {
        let n = self.unknowns.coordinates();
        let Some(tangents) = &lane.tangents else { return };
        let root = root_of(curvature);
        for direction in root.column_iter().map(|column| column.into_owned()) {
            let first = lane.rows.len();
            lane.rows.resize(first + n, 0.0);
            let row = &mut lane.rows[first..];
            tangents.along(point.attachment.joint, arm, &direction, row);
            if self.unknowns.body > 0 {
                let by_body = point.attachment.offset_by_body();
                let local = rotation.tr_mul(&direction);
                let out = row[KEYFRAME..].iter_mut().zip(&by_body);
                out.for_each(|(out, offset)| *out += local.dot(offset) as f32);
            }
        }
    }

    /// The gradient by the coordinates of moment `m` but the code, and by its local rotations.
    fn add_wrenches(&self, posture: &Posture, wrenches: &Wrenches, m: usize, lane: &mut Lane) {
        let n = self.unknowns.coordinates();
        let skeleton = &self.unknowns.skeleton;
        let gradient = &mut lane.gradients[m * n..(m + 1) * n];
        let root = wrenches.torque(Joint::Pelvis).iter().chain(wrenches.force(Joint::Pelvis));
        gradient[LATENT..].iter_mut().zip(root).for_each(|(out, v)| *out = *v);
        let by_rotation = &mut lane.by_rotation[m * LOCAL_ROWS..(m + 1) * LOCAL_ROWS];
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
