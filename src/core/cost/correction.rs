//! Corrections: small rotations of joints beside the manifold.
//!
//! The path on the manifold is known. The unknowns are the corrections c_k of its free keyframes;
//! between keyframes they run along lines. They minimise the cost of the observations plus a prior
//! 1/2 n_k correction_prior |c_k|^2, 1/2 n_k stiffness |acceleration of c at k|^2 and a cost of the
//! velocities of standing feet ([`Feet`]). The prior is stiff, so corrections stay a few degrees, and
//! zero where nothing is seen. The problem is nearly quadratic: one Gauss-Newton step from the
//! corrections of the window before solves it.

use nalgebra::Vector3;

use super::chain_rule::semidefinite_cholesky;
use super::feet::Feet;
use super::observation::FrameObservations;
use super::reprojection::Reprojection;
use super::robust::Loss;
use super::scene::Scene;
use super::stiffness::acceleration_factors;
use super::unknowns::PathKeyframe;
use crate::core::body::{BODY_JOINTS, Pose, Skeleton, Tangents, Wrenches, push_forward};
use crate::core::linalg;
use crate::core::manifold::{CORRECTION, Correction, TimedKeyframe};
use crate::core::optimise::{Cholesky, Layout, NormalEquations};
use crate::core::so3;
use crate::core::time::Timestamp;

/// The cost of the corrections of a path.
#[derive(Debug)]
pub struct CorrectionProblem<'a> {
    scene: Scene<'a>,
    reprojection: Reprojection<'a>,
    /// The fixed keyframes come first.
    path: Vec<PathKeyframe>,
    /// Number of fixed keyframes.
    fixed: usize,
    skeleton: &'a Skeleton,
    /// The points' offsets, see `Attachment::offset`.
    offsets: Vec<Vector3<f64>>,
    observations: &'a [FrameObservations],
    /// The pose on the manifold at each frame, without correction.
    poses: Vec<Pose>,
    feet: Feet,
    work: Work,
}

/// Memory of a frame.
#[derive(Debug)]
struct Work {
    /// Right tangents of the local rotations by the correction, 63 x 48.
    by_correction: Vec<f32>,
    tangents: Tangents,
    /// Weighted rows of the frame, three per point, each of 48.
    rows: Vec<f32>,
    /// Hessian of the frame, 48 x 48.
    gram: Vec<f32>,
}

/// The two keyframes around a frame, by index in the path, with their shares in its correction.
type Shares = [(usize, f64); 2];

impl<'a> CorrectionProblem<'a> {
    /// The problem of a path, fixed keyframes first, with the `poses` on the manifold at the times of
    /// the observations, and at those of the keyframes; without the latter, feet may slide.
    pub fn new(
        scene: Scene<'a>,
        path: Vec<PathKeyframe>,
        skeleton: &'a Skeleton,
        observations: &'a [FrameObservations],
        poses: Vec<Pose>,
        keyframe_poses: Vec<Pose>,
    ) -> Self {
        let loss = Loss::new(scene.config.loss, scene.config.scale_px);
        let mut tangents = Tangents::zeros(CORRECTION);
        tangents.clear_root();
        Self {
            reprojection: Reprojection { rig: scene.rig, loss },
            feet: Feet::new(&path, keyframe_poses, skeleton, scene.config.foot_contact_speed),
            fixed: path.iter().filter(|at| !at.free).count(),
            path,
            skeleton,
            offsets: scene.points.iter().map(|point| point.attachment.offset(skeleton)).collect(),
            scene,
            observations,
            poses,
            work: Work {
                by_correction: vec![0.0; 3 * BODY_JOINTS * CORRECTION],
                tangents,
                rows: Vec::new(),
                gram: vec![0.0; CORRECTION * CORRECTION],
            },
        }
    }

    /// The free keyframes with their corrections; as they were where the cost has no minimum.
    pub fn solve(mut self) -> Vec<TimedKeyframe> {
        let mut equations = NormalEquations::zeros(self.layout());
        let mut factor = Cholesky::like(&equations.hessian);
        let mut x = self.start();
        self.linearise(&x, &mut equations);
        if factor.factorise(&equations.hessian, |_| 0.0).is_some() {
            factor.solve(&mut equations.gradient);
            x.iter_mut().zip(&equations.gradient).for_each(|(x, step)| *x -= step);
        }
        let free = self.path.into_iter().skip(self.fixed).zip(x.chunks_exact(CORRECTION));
        let corrected = free.map(|(PathKeyframe { mut timed, .. }, x)| {
            timed.keyframe.correction.0.copy_from_slice(x);
            TimedKeyframe::new(timed.capture, timed.keyframe.quantised())
        });
        corrected.collect()
    }

    /// The unknowns to start from: the corrections that the free keyframes have.
    pub fn start(&self) -> Vec<f64> {
        self.path[self.fixed..].iter().flat_map(|at| at.timed.keyframe.correction.0).collect()
    }

    /// The structure of the unknowns.
    pub fn layout(&self) -> Layout {
        let blocks = self.path.len() - self.fixed;
        Layout { size: CORRECTION, blocks, bandwidth: blocks.saturating_sub(1).min(2) }
    }

    /// The cost at `x`; overwrites the equations with its gradient and Gauss-Newton Hessian.
    pub fn linearise(&mut self, x: &[f64], equations: &mut NormalEquations) -> f64 {
        equations.clear();
        let mut cost = self.add_regularisers(x, equations);
        let weight = self.scene.config.foot_contact;
        cost +=
            self.feet.add(&self.path, self.skeleton, |k| self.correction(k, x), weight, equations);
        for m in 0..self.observations.len() {
            let shares = self.shares(self.observations[m].capture);
            let [(from, _), (to, s)] = shares;
            let correction = self.correction(from, x).lerp(&self.correction(to, x), s);
            let (value, gradient) = self.frame(m, &correction);
            cost += value;
            let free = shares.iter().filter(|(keyframe, s)| *keyframe >= self.fixed && *s > 0.0);
            for &(keyframe, share) in free.clone() {
                let row = (keyframe - self.fixed) * CORRECTION;
                let out = equations.gradient[row..row + CORRECTION].iter_mut();
                out.zip(&gradient).for_each(|(out, v)| *out += share * v);
                for &(other, other_share) in free.clone().filter(|(other, _)| *other <= keyframe) {
                    let (column, scale) = ((other - self.fixed) * CORRECTION, share * other_share);
                    for (j, values) in self.work.gram.chunks_exact(CORRECTION).enumerate() {
                        let out = equations.hessian.column_mut(row..row + CORRECTION, column + j);
                        out.iter_mut()
                            .zip(values)
                            .for_each(|(out, v)| *out += scale * f64::from(*v));
                    }
                }
            }
        }
        cost
    }

    fn correction(&self, keyframe: usize, x: &[f64]) -> Correction {
        match keyframe.checked_sub(self.fixed) {
            None => self.path[keyframe].timed.keyframe.correction,
            Some(free) => Correction(std::array::from_fn(|i| x[free * CORRECTION + i])),
        }
    }

    fn shares(&self, capture: Timestamp) -> Shares {
        let time = |keyframe: usize| self.path[keyframe].timed.capture;
        let after = self.path.partition_point(|at| at.timed.capture < capture);
        let to = after.clamp(1, self.path.len() - 1);
        let s = capture.fraction(time(to - 1), time(to)).clamp(0.0, 1.0);
        [(to - 1, 1.0 - s), (to, s)]
    }

    /// The cost of frame `m` and its gradient; leaves the Hessian in the work's `gram`.
    fn frame(&mut self, m: usize, correction: &Correction) -> (f64, [f64; CORRECTION]) {
        let mut pose = self.poses[m].clone();
        correction.apply(&mut pose.local);
        let posture = pose.posture(self.skeleton);
        let Work { by_correction, tangents, rows, gram } = &mut self.work;
        for (k, (joint, vector)) in correction.vectors().enumerate() {
            let right = so3::right_jacobian(&vector);
            for (row, column) in (0..9).map(|i| (i / 3, i % 3)) {
                let at = (3 * (joint.index() - 1) + row) * CORRECTION + 3 * k + column;
                by_correction[at] = right[(row, column)] as f32;
            }
        }
        push_forward(self.skeleton, &posture, by_correction, CORRECTION, None, tangents);
        rows.clear();
        let (mut cost, mut wrenches) = (0.0, Wrenches::zeros());
        for views in self.observations[m].by_point() {
            let attachment = &self.scene.points[views[0].point].attachment;
            let weight = attachment.weight;
            let arms = attachment.arms(&posture, &self.offsets[views[0].point]);
            let position = arms.position(&posture);
            let (value, force, curvature) = self.reprojection.terms(views, &position);
            cost += weight * value;
            wrenches.add(&arms, &(force * weight));
            let root = semidefinite_cholesky(&(curvature * weight));
            for direction in root.column_iter().map(|column| column.into_owned()) {
                let first = rows.len();
                rows.resize(first + CORRECTION, 0.0);
                tangents.along(&arms, &direction, &mut rows[first..]);
            }
        }
        wrenches.gather(&posture);
        let mut gradient = [0.0; CORRECTION];
        for ((joint, vector), out) in correction.vectors().zip(gradient.chunks_exact_mut(3)) {
            let local = posture.rotations[joint.index()].tr_mul(wrenches.torque(joint));
            out.copy_from_slice(so3::right_jacobian(&vector).tr_mul(&local).as_slice());
        }
        linalg::gram([rows.len() / CORRECTION, CORRECTION], rows, gram);
        (cost, gradient)
    }

    /// Prior and stiffness; their derivatives are added.
    fn add_regularisers(&self, x: &[f64], equations: &mut NormalEquations) -> f64 {
        let (prior, stiffness) =
            (self.scene.config.correction_prior, self.scene.config.stiffness.correction);
        let mut cost = 0.0;
        for k in self.fixed..self.path.len() {
            let row = (k - self.fixed) * CORRECTION;
            let weight = prior * self.path[k].frames;
            for (i, c) in (row..row + CORRECTION).zip(self.correction(k, x).0) {
                cost += 0.5 * weight * c * c;
                equations.gradient[i] += weight * c;
                equations.hessian.add_to_diagonal(i, weight);
            }
            if k < 2 {
                continue;
            }
            let [t0, t1, t2] = [k - 2, k - 1, k].map(|k| self.path[k].timed.capture);
            let factors = acceleration_factors(t1.seconds_since(t0), t2.seconds_since(t1));
            let corrections = [k - 2, k - 1, k].map(|k| self.correction(k, x));
            let weight = stiffness * self.path[k].frames;
            for i in 0..CORRECTION {
                let acceleration: f64 = (0..3).map(|n| factors[n] * corrections[n].0[i]).sum();
                cost += 0.5 * weight * acceleration * acceleration;
                let free = (0..3).filter_map(|n| Some((n, (k + n).checked_sub(2 + self.fixed)?)));
                for (n, block) in free.clone() {
                    let row = block * CORRECTION + i;
                    equations.gradient[row] += weight * factors[n] * acceleration;
                    for (other, column) in free.clone().filter(|(other, _)| *other <= n) {
                        let column = column * CORRECTION + i;
                        equations.hessian.column_mut(row..row + 1, column)[0] +=
                            weight * factors[n] * factors[other];
                    }
                }
            }
        }
        cost
    }
}
