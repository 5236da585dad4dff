//! The reprojection terms of frames.
//!
//! All views of a point share the point's Jacobian: their 2D terms are first summed to a gradient
//! and a 3x3 curvature in the world. The gradient acts on the body as a force and is propagated
//! back through joints and decoder; a triangular root of the curvature gives three rows of the
//! Jacobian. So the normal equations cost no more for eight cameras than for two.

use nalgebra::{Matrix3, Vector3};

use super::chain_rule::semidefinite_cholesky;
use super::observation::{FrameObservations, Observation};
use super::observation_batch::{LOCAL_ROWS, ObservationBatch};
use super::reprojection::Reprojection;
use super::scene::Scene;
use super::unknowns::{KEYFRAME, Place, Unknowns};
use crate::core::body::{
    Arms, BodyPoint, Joint, Posture, Tangents, Wrenches, forward, push_forward,
};
use crate::core::linalg;
use crate::core::manifold::{LATENT, Latent};
use crate::core::so3;

/// What to compute for frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Wanted {
    Cost,
    Gradients,
    /// The gradients too.
    Hessians,
}

/// The data of a path that its frames need.
#[derive(Clone, Copy)]
pub(super) struct Path<'p> {
    pub(super) scene: Scene<'p>,
    pub(super) unknowns: &'p Unknowns,
    pub(super) reprojection: Reprojection<'p>,
    /// The points' offsets, see `Attachment::offset`.
    pub(super) offsets: &'p [Vector3<f64>],
}

impl<'p> Path<'p> {
    /// Computes `wanted` for all frames of a batch; the results stay in the batch.
    pub(super) fn compute(
        &self,
        observations: &[FrameObservations],
        wanted: Wanted,
        batch: &mut ObservationBatch,
    ) {
        batch.costs.clear();
        if observations.is_empty() {
            return;
        }
        let n = self.unknowns.coordinates();
        batch.decode(self.scene.decoder, observations.iter().map(|frame| self.code(frame)));
        if wanted == Wanted::Hessians {
            // The Hessian by the body is used as a result, so it must be exact.
            let radius =
                if self.unknowns.body == 0 { self.scene.config.jacobian_reuse_radius } else { 0.0 };
            batch.linearise(self.scene.decoder, radius);
            batch.grams.resize(observations.len() * n * n, 0.0);
        }
        batch.by_rotation.resize(observations.len() * LOCAL_ROWS, 0.0);
        batch.gradients.resize(observations.len() * n, 0.0);
        for (m, frame) in observations.iter().enumerate() {
            let place = self.unknowns.place(frame.capture);
            let posture = self.posture(place, m, batch);
            if wanted == Wanted::Hessians {
                self.push_tangents(place, &posture, m, batch);
            }
            let cost = match wanted {
                Wanted::Cost => self.cost(frame, &posture),
                _ => self.add(frame, &posture, wanted, m, batch),
            };
            batch.costs.push(cost);
            if wanted == Wanted::Hessians {
                batch.counts.frames += 1;
                let (rows, gram) = (&batch.rows, &mut batch.grams[m * n * n..(m + 1) * n * n]);
                linalg::gram([rows.len() / n, n], rows, gram);
            }
        }
        if wanted >= Wanted::Gradients {
            batch.pull_back(self.scene.decoder, n);
        }
    }

    /// Places of the observed points on the body (world, metres), by frame of a batch.
    pub(super) fn points(
        &self,
        observations: &[FrameObservations],
        batch: &mut ObservationBatch,
    ) -> Vec<Vec<Vector3<f64>>> {
        batch.decode(self.scene.decoder, observations.iter().map(|frame| self.code(frame)));
        let of_frame = |(m, frame): (usize, &FrameObservations)| {
            let posture = self.posture(self.unknowns.place(frame.capture), m, batch);
            frame.by_point().map(|views| self.point(views, &posture).2).collect()
        };
        observations.iter().enumerate().map(of_frame).collect()
    }

    /// The code at a frame's time.
    fn code(&self, frame: &FrameObservations) -> Latent {
        let Place { from, to, s } = self.unknowns.place(frame.capture);
        let (z0, z1) = (&self.unknowns.keyframes[from].z, &self.unknowns.keyframes[to].z);
        if from == to { *z1 } else { self.scene.config.interpolation.latent(z0, z1, s) }
    }

    /// The posture in frame `m` of the batch.
    fn posture(&self, Place { from, to, s }: Place, m: usize, batch: &ObservationBatch) -> Posture {
        let (first, last) = (&self.unknowns.keyframes[from], &self.unknowns.keyframes[to]);
        let rotation = match from == to {
            true => last.root_rotation,
            false => so3::slerp(&first.root_rotation, &last.root_rotation, s),
        };
        let position = first.root_position.lerp(&last.root_position, s);
        forward(&self.unknowns.skeleton, &rotation, &position, &batch.rotations(m))
    }

    /// Tangents of the posture in frame `m` by the frame's coordinates.
    fn push_tangents(
        &self,
        place: Place,
        posture: &Posture,
        m: usize,
        batch: &mut ObservationBatch,
    ) {
        let columns = self.unknowns.coordinates();
        let mut tangents = batch
            .tangents
            .take()
            .filter(|t| t.columns() == columns)
            .unwrap_or_else(|| Tangents::zeros(columns));
        tangents.clear_root();
        tangents.set_root_rotation(LATENT, &self.unknowns.root_tangent(place));
        tangents.set_root_position(LATENT + 3, 1.0);
        let shape_column = (self.unknowns.body > 0).then_some(KEYFRAME);
        let skeleton = &self.unknowns.skeleton;
        push_forward(skeleton, posture, batch.by_code(m), LATENT, shape_column, &mut tangents);
        batch.tangents = Some(tangents);
    }

    /// Derivatives of the joint centres by the coordinates of a keyframe.
    pub(super) fn tangents_at<'b>(
        &self,
        keyframe: usize,
        batch: &'b mut ObservationBatch,
    ) -> Option<&'b Tangents> {
        let place = Place { from: keyframe, to: keyframe, s: 1.0 };
        batch.forget();
        batch.decode(self.scene.decoder, std::iter::once(self.unknowns.keyframes[keyframe].z));
        batch.linearise(self.scene.decoder, 0.0);
        let posture = self.posture(place, 0, batch);
        self.push_tangents(place, &posture, 0, batch);
        batch.tangents.as_ref()
    }

    /// The cost of a frame.
    fn cost(&self, frame: &FrameObservations, posture: &Posture) -> f64 {
        let cost = |views: &[Observation]| {
            let (point, _, position) = self.point(views, posture);
            point.attachment.weight * self.reprojection.cost(views, &position)
        };
        frame.by_point().map(cost).sum()
    }

    /// Also writes the gradient of frame `m` to the batch, and its rows if they are wanted.
    fn add(
        &self,
        frame: &FrameObservations,
        posture: &Posture,
        wanted: Wanted,
        m: usize,
        batch: &mut ObservationBatch,
    ) -> f64 {
        let n = self.unknowns.coordinates();
        let mut wrenches = Wrenches::zeros();
        let mut cost = 0.0;
        batch.rows.clear();
        batch.gradients[m * n..(m + 1) * n].fill(0.0);
        for views in frame.by_point() {
            let (point, arms, position) = self.point(views, posture);
            let weight = point.attachment.weight;
            let (value, gradient, curvature) = self.reprojection.terms(views, &position);
            let (gradient, curvature) = (gradient * weight, curvature * weight);
            cost += weight * value;
            wrenches.add(&arms, &gradient);
            let turn = (self.unknowns.body > 0).then(|| point.attachment.turn(posture));
            if wanted == Wanted::Hessians {
                self.add_rows(point, &arms, turn.as_ref(), &curvature, batch);
            }
            if let Some(turn) = &turn {
                let out = &mut batch.gradients[m * n + KEYFRAME..(m + 1) * n];
                add_by_body(&point.attachment.offset_by_body(), turn, &gradient, out);
            }
        }
        wrenches.gather(posture);
        self.add_wrenches(posture, &wrenches, m, batch);
        cost
    }

    /// The observed point, its arms, and its position (world frame, metres).
    fn point(
        &self,
        views: &[Observation],
        posture: &Posture,
    ) -> (&'p BodyPoint, Arms, Vector3<f64>) {
        let point = &self.scene.points[views[0].point];
        let arms = point.attachment.arms(posture, &self.offsets[views[0].point]);
        (point, arms, arms.position(posture))
    }

    /// Adds three rows L^T J: L L^T is the curvature, J the point's Jacobian.
    fn add_rows(
        &self,
        point: &BodyPoint,
        arms: &Arms,
        turn: Option<&Matrix3<f64>>,
        curvature: &Matrix3<f64>,
        batch: &mut ObservationBatch,
    ) {
        let n = self.unknowns.coordinates();
        let Some(tangents) = &batch.tangents else { return };
        let root = semidefinite_cholesky(curvature);
        for direction in root.column_iter().map(|column| column.into_owned()) {
            let first = batch.rows.len();
            batch.rows.resize(first + n, 0.0);
            let row = &mut batch.rows[first..];
            tangents.along(arms, &direction, row);
            if let Some(turn) = turn {
                let by_body = point.attachment.offset_by_body();
                let local = turn.tr_mul(&direction);
                let out = row[KEYFRAME..].iter_mut().zip(&by_body);
                out.for_each(|(out, offset)| *out += local.dot(offset) as f32);
            }
        }
    }

    /// The gradient of frame `m` by its coordinates without the code, and by its local rotations.
    fn add_wrenches(
        &self,
        posture: &Posture,
        wrenches: &Wrenches,
        m: usize,
        batch: &mut ObservationBatch,
    ) {
        let n = self.unknowns.coordinates();
        let skeleton = &self.unknowns.skeleton;
        let gradient = &mut batch.gradients[m * n..(m + 1) * n];
        let root = wrenches.torque(Joint::Pelvis).iter().chain(wrenches.force(Joint::Pelvis));
        gradient[LATENT..].iter_mut().zip(root).for_each(|(out, v)| *out = *v);
        let by_rotation = &mut batch.by_rotation[m * LOCAL_ROWS..(m + 1) * LOCAL_ROWS];
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

/// Adds the derivative, by the body's coefficients, of an offset rotated by `rotation`, along
/// `direction` (world frame).
fn add_by_body(
    by_body: &[Vector3<f64>],
    rotation: &Matrix3<f64>,
    direction: &Vector3<f64>,
    out: &mut [f64],
) {
    let local = rotation.tr_mul(direction);
    out.iter_mut().zip(by_body).for_each(|(out, offset)| *out += local.dot(offset));
}
