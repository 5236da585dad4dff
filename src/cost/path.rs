//! The cost of a path through keyframes, with its gradient and Gauss-Newton Hessian.
//!
//! All views of a point at one moment share the point's Jacobian: their 2D terms are first
//! summed to a 3x3 matrix in the world, of which a triangular root then scales three rows. So
//! the normal equations cost no more for eight cameras than for two.
//!
//! Each moment is linearised in coordinates of its own (code, rotation and position where it is on
//! the path, and the shape); the result is carried to the unknowns of the two knots about it by the
//! derivative of the interpolation. A free shape concerns all knots: then the normal equations are
//! one dense block; else they are banded, a block for each free knot.

use nalgebra::{Matrix3, Vector3};

use super::blocks::{Blocks, End, root_of};
use super::config::Config;
use super::observation::{Moment, Observation};
use super::robust::GemanMcClure;
use super::unknowns::{KEYFRAME, Knot, Place, Unknowns};
use crate::body::{
    BODY_JOINTS, BodyPoint, Posture, SHAPE_COEFFICIENTS, Skeleton, Tangents, forward, push_forward,
};
use crate::camera::Rig;
use crate::gemm::{self, Accum};
use crate::manifold::{Decoder, Interpolation, Jacobians, Keyframe, LATENT, Latent, LatentTangent};
use crate::so3;
use crate::solve::{Layout, Normal, Problem};

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
    tangents: Option<Tangents>,
    point_rows: Vec<f64>,
    /// Weighted rows of the moment, (3 per point) x (coordinates of the moment).
    rows: Vec<f64>,
    /// Hessian and gradient by the coordinates of the moment.
    gram: Vec<f64>,
    gradient: Vec<f64>,
    /// Half of a change of coordinates.
    half: Vec<f64>,
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
    NormalEquations(&'o mut Normal),
}

impl Wanted<'_> {
    fn gradient(&mut self) -> Option<&mut [f64]> {
        match self {
            Self::Cost => None,
            Self::Gradient(gradient) => Some(gradient),
            Self::NormalEquations(normal) => Some(&mut normal.gradient),
        }
    }

    fn normal(&mut self) -> Option<&mut Normal> {
        match self {
            Self::NormalEquations(normal) => Some(normal),
            _ => None,
        }
    }
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

    /// The unknowns to start from, with other values of the free knots, by their number in the path.
    pub fn start_at(&self, value: impl Fn(usize, &Knot) -> Keyframe) -> Vec<f64> {
        self.unknowns.start_at(value)
    }

    /// The keyframes and the body that `x` stands for.
    pub fn solution(mut self, x: &[f64]) -> (Vec<Keyframe>, Skeleton) {
        self.unknowns.take(x);
        (self.unknowns.keyframes, self.unknowns.skeleton)
    }

    fn interpolation(&self) -> Interpolation {
        self.scene.config.interpolation
    }

    fn blocks(&self) -> Blocks {
        match self.unknowns.shape_is_free {
            true => Blocks::Dense(self.unknowns.count()),
            false => Blocks::Banded,
        }
    }

    /// Coordinates of a moment.
    fn coordinates(&self) -> usize {
        KEYFRAME + if self.unknowns.shape_is_free { SHAPE_COEFFICIENTS } else { 0 }
    }

    fn evaluate(&mut self, x: &[f64], mut wanted: Wanted) -> f64 {
        self.unknowns.take(x);
        let derivatives = !matches!(wanted, Wanted::Cost);
        self.decode(derivatives);
        let mut cost = self.prior(x, &mut wanted);
        for m in 0..self.moments.len() {
            let place = self.unknowns.place(self.moments[m].capture);
            let (from, to) =
                (&self.unknowns.keyframes[place.from], &self.unknowns.keyframes[place.to]);
            let rotation = so3::slerp(&from.root_rotation, &to.root_rotation, place.s);
            let position = from.root_position.lerp(&to.root_position, place.s);
            let local = self.work.jacobians.rotations(m);
            let posture = forward(&self.unknowns.skeleton, &rotation, &position, &local);
            if derivatives {
                self.push_tangents(m, &posture);
            }
            cost += self.add_moment(m, &posture, &wanted);
            if derivatives {
                self.scatter(place, &mut wanted);
            }
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
        let work = &mut *self.work;
        self.scene.decoder.values(&work.codes, &mut work.jacobians);
        if tangents {
            self.scene.decoder.tangents(&mut work.jacobians);
        }
    }

    /// 1/2 prior |z|^2 of each free knot, counted for each frame that it stands for, 1/2 shape prior
    /// |shape|^2, and the path's stiffness. Overwrites what is wanted.
    fn prior(&self, x: &[f64], wanted: &mut Wanted) -> f64 {
        let Config { prior, shape_prior, stiffness, .. } = *self.scene.config;
        let mut cost = 0.0;
        if let Some(gradient) = wanted.gradient() {
            gradient.fill(0.0);
        }
        if let Some(normal) = wanted.normal() {
            normal.hessian.clear();
        }
        let codes = self.unknowns.free_frames().enumerate();
        let codes = codes.map(|(knot, frames)| (knot * KEYFRAME, LATENT, prior * frames));
        let shape_at = self.unknowns.shape_at();
        for (first, count, weight) in codes.chain([(shape_at, x.len() - shape_at, shape_prior)]) {
            for i in first..first + count {
                cost += 0.5 * weight * x[i] * x[i];
                if let Some(gradient) = wanted.gradient() {
                    gradient[i] = weight * x[i];
                }
                if let Some(normal) = wanted.normal() {
                    normal.hessian.add_to_diagonal(i, weight);
                }
            }
        }
        cost + match wanted {
            Wanted::Cost => stiffness.cost(&self.unknowns),
            Wanted::Gradient(gradient) => stiffness.add_gradient(&self.unknowns, gradient),
            Wanted::NormalEquations(normal) => stiffness.add(&self.unknowns, self.blocks(), normal),
        }
    }

    /// Tangents of the posture at moment `m` by the moment's coordinates.
    fn push_tangents(&mut self, m: usize, posture: &Posture) {
        let columns = self.coordinates();
        let work = &mut *self.work;
        work.by_code.resize(LOCAL_ROWS * LATENT, 0.0);
        work.jacobians.local_tangents(m, &mut work.by_code);
        let mut tangents = work
            .tangents
            .take()
            .filter(|t| t.columns() == columns)
            .unwrap_or_else(|| Tangents::zeros(columns));
        tangents.clear_root();
        tangents.set_root_turn(LATENT, &Matrix3::identity());
        tangents.set_root_shift(LATENT + 3, 1.0);
        let shape_column = self.unknowns.shape_is_free.then_some(KEYFRAME);
        let skeleton = &self.unknowns.skeleton;
        push_forward(skeleton, posture, &work.by_code, LATENT, shape_column, &mut tangents);
        work.tangents = Some(tangents);
    }

    /// Cost of the moment's observations; leaves its rows and gradient in the workspace.
    fn add_moment(&mut self, m: usize, posture: &Posture, wanted: &Wanted) -> f64 {
        let moments = self.moments;
        self.work.rows.clear();
        self.work.gradient.clear();
        self.work.gradient.resize(self.coordinates(), 0.0);
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

    /// The point's Jacobian by the moment's coordinates, 3 rows, left in the workspace.
    fn point_rows(&mut self, point: &BodyPoint, arm: &Vector3<f64>, rotation: &Matrix3<f64>) {
        let n = self.coordinates();
        let work = &mut *self.work;
        work.point_rows.resize(3 * n, 0.0);
        let Some(tangents) = &work.tangents else { return };
        tangents.point(point.attachment.joint, arm, &mut work.point_rows);
        if self.unknowns.shape_is_free {
            for (k, offset) in point.attachment.offset_by_shape().iter().enumerate() {
                let moved = rotation * offset;
                (0..3).for_each(|row| work.point_rows[row * n + KEYFRAME + k] += moved[row]);
            }
        }
    }

    /// Adds J^T g to the gradient, and L^T J to the rows, where L L^T is the curvature.
    fn add_rows(&mut self, gradient: &Vector3<f64>, curvature: &Matrix3<f64>, wanted: &Wanted) {
        let n = self.coordinates();
        let work = &mut *self.work;
        let (x, rest) = work.point_rows.split_at(n);
        let (y, z) = rest.split_at(n);
        for (c, out) in work.gradient.iter_mut().enumerate() {
            *out += gradient.x * x[c] + gradient.y * y[c] + gradient.z * z[c];
        }
        if let Wanted::NormalEquations(..) = wanted {
            let root = root_of(curvature);
            for column in 0..3 {
                let (a, b, c) = (root[(0, column)], root[(1, column)], root[(2, column)]);
                let first = work.rows.len();
                work.rows.resize(first + n, 0.0);
                let points = x.iter().zip(y).zip(z);
                for (out, ((x, y), z)) in work.rows[first..].iter_mut().zip(points) {
                    *out = a * x + b * y + c * z;
                }
            }
        }
    }

    /// How the moment's coordinates change with the free knots about it, the later one first.
    fn ends(&self, Place { from, to, s }: Place) -> [Option<End>; 2] {
        let free = |knot: usize, make: &dyn Fn() -> (LatentTangent, Matrix3<f64>, f64)| {
            self.unknowns.is_free(knot).then(|| {
                let (code, turn, shift) = make();
                let turn = turn * so3::left_jacobian(&self.unknowns.turns[knot]);
                End { knot: self.unknowns.number(knot), code, turn, shift }
            })
        };
        if from == to {
            let same = || (LatentTangent::straight(1.0), Matrix3::identity(), 1.0);
            return [free(to, &same), None];
        }
        let end = |knot: usize, other: usize, s: f64| {
            let (near, far) = (&self.unknowns.keyframes[knot], &self.unknowns.keyframes[other]);
            free(knot, &|| {
                let along = so3::slerp_jacobian(&far.root_rotation, &near.root_rotation, s);
                (self.interpolation().tangent(&far.z, &near.z, s), along, s)
            })
        };
        [end(to, from, s), end(from, to, 1.0 - s)]
    }

    /// Adds the moment's gradient and Gram matrix to those of all unknowns.
    fn scatter(&mut self, place: Place, wanted: &mut Wanted) {
        let (ends, blocks) = (self.ends(place), self.blocks());
        let (n, shape_at) = (self.coordinates(), self.unknowns.shape_at());
        let work = &mut *self.work;
        let mut pulled = [0.0; KEYFRAME];
        let Some(gradient) = wanted.gradient() else { return };
        for end in ends.iter().flatten() {
            end.pull(&work.gradient, &mut pulled);
            let mine = &mut gradient[end.knot * KEYFRAME..(end.knot + 1) * KEYFRAME];
            mine.iter_mut().zip(&pulled).for_each(|(g, v)| *g += v);
        }
        let by_shape = &work.gradient[KEYFRAME..];
        gradient[shape_at..].iter_mut().zip(by_shape).for_each(|(g, v)| *g += v);

        let Some(normal) = wanted.normal() else { return };
        work.gram.resize(n * n, 0.0);
        let sizes = [n, work.rows.len() / n, n];
        gemm::product_of_transpose(sizes, &work.rows, &work.rows, Accum::Replace, &mut work.gram);
        for (e, end) in ends.iter().flatten().enumerate() {
            for other in ends.iter().flatten().skip(e) {
                end.add_block(other, &work.gram, n, &mut work.half, blocks, normal);
            }
        }
        let total = normal.gradient.len();
        for (k, row) in work.gram.chunks_exact(n).skip(KEYFRAME).enumerate() {
            let out = &mut normal.hessian.block_mut(0, 0)[(shape_at + k) * total..][..total];
            for end in ends.iter().flatten() {
                end.pull(row, &mut pulled);
                let mine = &mut out[end.knot * KEYFRAME..(end.knot + 1) * KEYFRAME];
                mine.iter_mut().zip(&pulled).for_each(|(h, v)| *h += v);
            }
            out[shape_at..].iter_mut().zip(&row[KEYFRAME..]).for_each(|(h, v)| *h += v);
        }
    }
}

impl Problem for PathProblem<'_> {
    fn layout(&self) -> Layout {
        let blocks = self.unknowns.number(self.unknowns.keyframes.len());
        let reach = if self.scene.config.stiffness.is_none() { 1 } else { 2 };
        match self.blocks() {
            Blocks::Dense(size) => Layout::dense(size),
            Blocks::Banded => {
                Layout { size: KEYFRAME, blocks, bandwidth: reach.min(blocks.saturating_sub(1)) }
            }
        }
    }

    fn cost(&mut self, x: &[f64]) -> f64 {
        self.evaluate(x, Wanted::Cost)
    }

    fn linearise(&mut self, x: &[f64], normal: &mut Normal) -> f64 {
        self.evaluate(x, Wanted::NormalEquations(normal))
    }

    fn gradient(&mut self, x: &[f64], gradient: &mut [f64]) -> f64 {
        self.evaluate(x, Wanted::Gradient(gradient))
    }
}
