//! The cost of a path through keyframes, with its gradient and Gauss-Newton Hessian.
//!
//! All views of a point at one moment share the point's Jacobian: their 2D terms are first
//! summed to a 3x3 matrix in the world, of which a triangular root then scales three rows. So
//! the normal equations cost no more for eight cameras than for two.

use nalgebra::{Matrix3, Vector3};

use super::blocks::{root_of, spread, spread_identity};
use super::config::Config;
use super::observation::{Moment, Observation};
use super::robust::GemanMcClure;
use super::unknowns::{KEYFRAME, Knot, Place, Unknowns};
use crate::body::{
    BODY_JOINTS, BodyPoint, Posture, SHAPE_COEFFICIENTS, Skeleton, Tangents, forward, push_forward,
};
use crate::camera::Rig;
use crate::gemm::{self, Accum};
use crate::manifold::{Decoder, Interpolation, Jacobians, Keyframe, LATENT, Latent};
use crate::so3;
use crate::solve::Problem;

const LOCAL_ROWS: usize = 3 * BODY_JOINTS;

/// What a cost needs besides the unknowns.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// The manifold.
    pub decoder: &'a Decoder,
    /// The cameras.
    pub rig: &'a Rig,
    /// The detector's points that are fitted.
    pub points: &'a [BodyPoint],
    /// Weights.
    pub config: &'a Config,
}

/// Memory that problems use in turn; grows to the largest and stays.
#[derive(Clone, Debug, Default)]
pub struct Workspace {
    codes: Vec<Latent>,
    jacobians: Jacobians,
    /// Right tangents of the local rotations by the code of the moment, 63 x 32.
    by_code: Vec<f64>,
    /// The same by the unknowns of the moment's keyframes, 63 x (32 per free keyframe).
    by_unknowns: Vec<f64>,
    tangents: Option<Tangents>,
    point_rows: Vec<f64>,
    /// Weighted rows of the moment, (3 per point) x (unknowns of the moment).
    rows: Vec<f64>,
    gram: Vec<f64>,
    columns: Vec<usize>,
    local_gradient: Vec<f64>,
}

/// The cost of a path. Also gives the solution back as keyframes and shape.
#[derive(Debug)]
pub struct PathProblem<'a> {
    scene: Scene<'a>,
    moments: &'a [Moment],
    work: &'a mut Workspace,
    unknowns: Unknowns,
    loss: GemanMcClure,
}

/// What is wanted besides the cost.
enum Wanted<'o> {
    Cost,
    Gradient(&'o mut [f64]),
    NormalEquations(&'o mut [f64], &'o mut [f64]),
}

impl<'a> PathProblem<'a> {
    /// A path through `knots`, in order of time. With a single knot the path is constant.
    /// The shape is solved for too if `shape_is_free`, from that of `skeleton`.
    pub fn new(
        scene: Scene<'a>,
        knots: Vec<Knot>,
        skeleton: &Skeleton,
        shape_is_free: bool,
        moments: &'a [Moment],
        work: &'a mut Workspace,
    ) -> Self {
        Self {
            unknowns: Unknowns::new(knots, skeleton, shape_is_free),
            loss: GemanMcClure::new(scene.config.scale_px),
            scene,
            moments,
            work,
        }
    }

    /// Changes the scale of the loss, pixels.
    pub fn set_scale(&mut self, scale_px: f64) {
        self.loss = GemanMcClure::new(scale_px);
    }

    /// The unknowns to start from.
    pub fn start(&self) -> Vec<f64> {
        self.unknowns.start()
    }

    /// The unknowns to start from, with `keyframe` in place of the last knot's, which is free.
    pub fn start_at(&self, keyframe: &Keyframe) -> Vec<f64> {
        self.unknowns.start_at(keyframe)
    }

    /// The keyframes and the body that `x` stands for.
    pub fn solution(mut self, x: &[f64]) -> (Vec<Keyframe>, Skeleton) {
        self.unknowns.take(x);
        (self.unknowns.keyframes, self.unknowns.skeleton)
    }

    fn interpolation(&self) -> Interpolation {
        self.scene.config.interpolation
    }

    fn evaluate(&mut self, x: &[f64], mut wanted: Wanted) -> f64 {
        self.unknowns.take(x);
        self.decode(!matches!(wanted, Wanted::Cost));
        let mut cost = self.prior(x, &mut wanted);
        for m in 0..self.moments.len() {
            let place = self.unknowns.place(self.moments[m].capture);
            let (from, to) =
                (&self.unknowns.keyframes[place.from], &self.unknowns.keyframes[place.to]);
            let rotation = so3::slerp(&from.root_rotation, &to.root_rotation, place.s);
            let position = from.root_position.lerp(&to.root_position, place.s);
            let local = self.work.jacobians.rotations(m);
            let posture = forward(&self.unknowns.skeleton, &rotation, &position, &local);
            if !matches!(wanted, Wanted::Cost) {
                self.push_tangents(m, place, &posture);
            }
            cost += self.add_moment(m, &posture, &wanted);
            self.scatter(&mut wanted);
        }
        cost
    }

    /// Decodes the codes of all moments at once.
    fn decode(&mut self, tangents: bool) {
        self.work.codes.clear();
        for moment in self.moments {
            let Place { from, to, s } = self.unknowns.place(moment.capture);
            let (z0, z1) = (&self.unknowns.keyframes[from].z, &self.unknowns.keyframes[to].z);
            let code = if from == to { *z1 } else { self.interpolation().latent(z0, z1, s) };
            self.work.codes.push(code);
        }
        self.scene.decoder.values(&self.work.codes, &mut self.work.jacobians);
        if tangents {
            self.scene.decoder.tangents(&mut self.work.jacobians);
        }
    }

    /// 1/2 prior |z|^2 of each free keyframe and 1/2 shape prior |shape|^2.
    fn prior(&self, x: &[f64], wanted: &mut Wanted) -> f64 {
        let n = x.len();
        let shape_at = self.unknowns.shape_at();
        let weight = |i: usize| match i {
            i if i >= shape_at => self.scene.config.shape_prior,
            i if i % KEYFRAME < LATENT => self.scene.config.prior,
            _ => 0.0,
        };
        let gradient = match wanted {
            Wanted::Cost => None,
            Wanted::Gradient(gradient) => Some(gradient),
            Wanted::NormalEquations(gradient, hessian) => {
                hessian.fill(0.0);
                (0..n).for_each(|i| hessian[i * n + i] = weight(i));
                Some(gradient)
            }
        };
        if let Some(gradient) = gradient {
            gradient.iter_mut().enumerate().for_each(|(i, g)| *g = weight(i) * x[i]);
        }
        x.iter().enumerate().map(|(i, v)| 0.5 * weight(i) * v * v).sum()
    }

    /// Tangents of the posture at moment `m` by the unknowns of its keyframes, in the order
    /// codes, then rotations and positions, then shape; and which unknowns those are.
    fn push_tangents(&mut self, m: usize, place: Place, posture: &Posture) {
        let ends = [(place.to, place.from, place.s), (place.from, place.to, 1.0 - place.s)];
        let ends = if place.from == place.to { &ends[..1] } else { &ends[..] };
        let free = || ends.iter().filter(|(k, _, _)| self.unknowns.is_free(*k));
        let codes = free().count() * LATENT;
        let roots = free().count() * 6;
        let total =
            codes + roots + if self.unknowns.shape_is_free { SHAPE_COEFFICIENTS } else { 0 };

        let interpolation = self.interpolation();
        let work = &mut *self.work;
        work.by_code.resize(LOCAL_ROWS * LATENT, 0.0);
        work.jacobians.local_tangents(m, &mut work.by_code);
        work.by_unknowns.resize(LOCAL_ROWS * codes, 0.0);
        let mut tangents = work
            .tangents
            .take()
            .filter(|t| t.columns() == total)
            .unwrap_or_else(|| Tangents::zeros(total));
        tangents.clear_root();
        work.columns.clear();
        for (block, &(k, other, s)) in
            ends.iter().filter(|(k, _, _)| self.unknowns.is_free(*k)).enumerate()
        {
            let first = self.unknowns.first_of(k);
            work.columns.extend(first..first + LATENT);
            let turn = so3::left_jacobian(&self.unknowns.turns[k]);
            let column = codes + 6 * block;
            if k == other {
                spread_identity(&work.by_code, block, codes, &mut work.by_unknowns);
                tangents.set_root_turn(column, &turn);
                tangents.set_root_shift(column + 3, 1.0);
            } else {
                let (near, far) = (&self.unknowns.keyframes[k], &self.unknowns.keyframes[other]);
                let by = interpolation.tangent(&far.z, &near.z, s);
                spread(&work.by_code, &by, block, codes, &mut work.by_unknowns);
                let along = so3::slerp_jacobian(&far.root_rotation, &near.root_rotation, s);
                tangents.set_root_turn(column, &(along * turn));
                tangents.set_root_shift(column + 3, s);
            }
        }
        for &(k, _, _) in ends.iter().filter(|(k, _, _)| self.unknowns.is_free(*k)) {
            let first = self.unknowns.first_of(k);
            work.columns.extend(first + LATENT..first + KEYFRAME);
        }
        let shape_at = self.unknowns.shape_at();
        work.columns.extend(shape_at..shape_at + total - codes - roots);
        let shape_column = self.unknowns.shape_is_free.then_some(codes + roots);
        push_forward(
            &self.unknowns.skeleton,
            posture,
            &work.by_unknowns,
            codes,
            shape_column,
            &mut tangents,
        );
        work.tangents = Some(tangents);
    }

    /// Cost of the moment's observations; leaves its rows and gradient in the workspace.
    fn add_moment(&mut self, m: usize, posture: &Posture, wanted: &Wanted) -> f64 {
        let moments = self.moments;
        let n = self.work.columns.len();
        self.work.rows.clear();
        self.work.local_gradient.clear();
        self.work.local_gradient.resize(n, 0.0);
        let mut cost = 0.0;
        for views in moments[m].by_point() {
            let point = &self.scene.points[views[0].point];
            let joint = point.attachment.joint;
            let rotation = &posture.rotations[joint.index()];
            let arm = rotation * point.attachment.offset(self.unknowns.skeleton.shape());
            let position = posture.positions[joint.index()] + arm;
            let weight = point.attachment.weight;
            if matches!(wanted, Wanted::Cost) {
                cost += weight * self.point_cost(views, &position);
                continue;
            }
            let (value, gradient, curvature) = self.point_terms(views, &position);
            cost += weight * value;
            self.point_rows(point, &arm, rotation);
            self.add_rows(&(gradient * weight), &(curvature * weight), wanted);
        }
        cost
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

    /// The point's Jacobian by the moment's unknowns, 3 rows, left in the workspace.
    fn point_rows(&mut self, point: &BodyPoint, arm: &Vector3<f64>, rotation: &Matrix3<f64>) {
        let work = &mut *self.work;
        let n = work.columns.len();
        work.point_rows.resize(3 * n, 0.0);
        let Some(tangents) = &work.tangents else { return };
        tangents.point(point.attachment.joint, arm, &mut work.point_rows);
        if self.unknowns.shape_is_free {
            let first = n - SHAPE_COEFFICIENTS;
            for (k, offset) in point.attachment.offset_by_shape().iter().enumerate() {
                let moved = rotation * offset;
                (0..3).for_each(|row| work.point_rows[row * n + first + k] += moved[row]);
            }
        }
    }

    /// Adds J^T g to the gradient, and L^T J to the rows, where L L^T is the curvature.
    fn add_rows(&mut self, gradient: &Vector3<f64>, curvature: &Matrix3<f64>, wanted: &Wanted) {
        let work = &mut *self.work;
        let n = work.columns.len();
        let (x, rest) = work.point_rows.split_at(n);
        let (y, z) = rest.split_at(n);
        for (c, out) in work.local_gradient.iter_mut().enumerate() {
            *out += gradient.x * x[c] + gradient.y * y[c] + gradient.z * z[c];
        }
        if let Wanted::NormalEquations(..) = wanted {
            let root = root_of(curvature);
            for column in 0..3 {
                let (a, b, c) = (root[(0, column)], root[(1, column)], root[(2, column)]);
                work.rows.extend((0..n).map(|i| a * x[i] + b * y[i] + c * z[i]));
            }
        }
    }

    /// Adds the moment's gradient and Gram matrix to those of all unknowns.
    fn scatter(&mut self, wanted: &mut Wanted) {
        let work = &mut *self.work;
        let n = work.columns.len();
        let gradient = match wanted {
            Wanted::Cost => return,
            Wanted::Gradient(gradient) => gradient,
            Wanted::NormalEquations(gradient, hessian) => {
                work.gram.resize(n * n, 0.0);
                let sizes = [n, work.rows.len() / n, n];
                gemm::product_of_transpose(
                    sizes,
                    &work.rows,
                    &work.rows,
                    Accum::Replace,
                    &mut work.gram,
                );
                let total = gradient.len();
                for (row, &i) in work.gram.chunks_exact(n).zip(&work.columns) {
                    for (value, &j) in row.iter().zip(&work.columns) {
                        hessian[i * total + j] += value;
                    }
                }
                gradient
            }
        };
        for (value, &i) in work.local_gradient.iter().zip(&work.columns) {
            gradient[i] += value;
        }
    }
}

impl Problem for PathProblem<'_> {
    fn dimension(&self) -> usize {
        self.unknowns.count()
    }

    fn cost(&mut self, x: &[f64]) -> f64 {
        self.evaluate(x, Wanted::Cost)
    }

    fn linearise(&mut self, x: &[f64], gradient: &mut [f64], hessian: &mut [f64]) -> f64 {
        self.evaluate(x, Wanted::NormalEquations(gradient, hessian))
    }

    fn gradient(&mut self, x: &[f64], gradient: &mut [f64]) -> f64 {
        self.evaluate(x, Wanted::Gradient(gradient))
    }
}
