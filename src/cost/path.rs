//! The cost of a path through keyframes, with its gradient and Gauss-Newton Hessian.
//!
//! Each moment is linearised in coordinates of its own (code, rotation and position where it is on
//! the path, and the body); the result is carried to the unknowns of the two knots about it by the
//! derivative of the interpolation. A free body concerns all knots: then the normal equations are
//! one dense block; else they are banded, a block for each free knot.

use nalgebra::Matrix3;

use super::blocks::{Blocks, End};
use super::config::Config;
use super::observation::Moment;
use super::robust::GemanMcClure;
use super::unknowns::{FreeBody, KEYFRAME, Knot, Place, Unknowns};
use super::workspace::{LOCAL_ROWS, Workspace};
use crate::body::{BodyPoint, Posture, SHAPE_COEFFICIENTS, Skeleton, forward};
use crate::camera::Rig;
use crate::gemm::{self, Accum};
use crate::manifold::{Decoder, Interpolation, Keyframe, LATENT, LatentTangent};
use crate::so3;
use crate::solve::{Layout, Normal, Problem};

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

/// The cost of a path. Also gives the solution back as keyframes and body.
#[derive(Debug)]
pub struct PathProblem<'a> {
    pub(super) scene: Scene<'a>,
    pub(super) moments: &'a [Moment],
    pub(super) work: &'a mut Workspace,
    pub(super) unknowns: Unknowns,
    pub(super) loss: GemanMcClure,
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
    /// What is free of the body is solved for too, from that of `skeleton`.
    pub fn new(
        scene: Scene<'a>,
        knots: Vec<Knot>,
        skeleton: &Skeleton,
        free: FreeBody,
        moments: &'a [Moment],
        work: &'a mut Workspace,
    ) -> Self {
        work.forget();
        Self {
            unknowns: Unknowns::new(knots, skeleton, free),
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
        match self.unknowns.body {
            0 => Blocks::Banded,
            _ => Blocks::Dense(self.unknowns.count()),
        }
    }

    /// Coordinates of a moment.
    pub(super) fn coordinates(&self) -> usize {
        KEYFRAME + self.unknowns.body
    }

    fn evaluate(&mut self, x: &[f64], mut wanted: Wanted) -> f64 {
        self.unknowns.take(x);
        self.decode();
        if wanted.normal().is_some() {
            // The Hessian by the body is used for itself, not only to steer.
            let reach =
                if self.unknowns.body == 0 { self.scene.config.jacobian_reach } else { 0.0 };
            self.work.linearise(self.scene.decoder, reach);
        }
        let mut cost = self.prior(x, &mut wanted);
        let (moments, body) = (self.moments.len(), &self.unknowns.skeleton);
        let offsets = self.scene.points.iter().map(|point| point.attachment.offset(body));
        self.work.offsets.clear();
        self.work.offsets.extend(offsets);
        self.work.by_rotation.resize(moments * LOCAL_ROWS, 0.0);
        self.work.gradients.resize(moments * self.coordinates(), 0.0);
        for m in 0..moments {
            let place = self.unknowns.place(self.moments[m].capture);
            let posture = self.posture(m, place);
            cost += match &mut wanted {
                Wanted::Cost => self.moment_cost(m, &posture),
                Wanted::Gradient(_) => self.add_moment(m, &posture, false),
                Wanted::NormalEquations(normal) => {
                    self.push_tangents(m, &posture, &self.knot_turn(place));
                    let cost = self.add_moment(m, &posture, true);
                    self.scatter_hessian(place, normal);
                    cost
                }
            };
        }
        if let Some(gradient) = wanted.gradient() {
            self.scatter_gradients(gradient);
        }
        cost
    }

    /// Where the body is at moment `m`.
    fn posture(&self, m: usize, Place { from, to, s }: Place) -> Posture {
        let (first, last) = (&self.unknowns.keyframes[from], &self.unknowns.keyframes[to]);
        let rotation = match from == to {
            true => last.root_rotation,
            false => so3::slerp(&first.root_rotation, &last.root_rotation, s),
        };
        let position = first.root_position.lerp(&last.root_position, s);
        forward(&self.unknowns.skeleton, &rotation, &position, &self.work.jacobians.rotations(m))
    }

    /// Decodes the codes of all moments at once, unless they are those decoded last.
    fn decode(&mut self) {
        let (unknowns, interpolation) = (&self.unknowns, self.interpolation());
        let codes = self.moments.iter().map(|moment| {
            let Place { from, to, s } = unknowns.place(moment.capture);
            let (z0, z1) = (&unknowns.keyframes[from].z, &unknowns.keyframes[to].z);
            if from == to { *z1 } else { interpolation.latent(z0, z1, s) }
        });
        self.work.decode(self.scene.decoder, codes);
    }

    /// 1/2 prior |z|^2 of each free knot, counted for each frame that it stands for, 1/2 shape prior
    /// |shape|^2, 1/2 mark prior |marks|^2, and the path's stiffness. Overwrites what is wanted.
    fn prior(&self, x: &[f64], wanted: &mut Wanted) -> f64 {
        let Config { prior, shape_prior, mark_prior, stiffness, .. } = *self.scene.config;
        let mut cost = 0.0;
        if let Some(gradient) = wanted.gradient() {
            gradient.fill(0.0);
        }
        if let Some(normal) = wanted.normal() {
            normal.hessian.clear();
        }
        let codes = self.unknowns.free_frames().enumerate();
        let codes = codes.map(|(knot, frames)| (knot * KEYFRAME, LATENT, prior * frames));
        let body_at = self.unknowns.body_at();
        let shape = self.unknowns.body.min(SHAPE_COEFFICIENTS);
        let (marks_at, marks) = (body_at + shape, self.unknowns.body - shape);
        let body = [(body_at, shape, shape_prior), (marks_at, marks, mark_prior)];
        for (first, count, weight) in codes.chain(body) {
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

    /// Carries the moments' gradients to all unknowns.
    fn scatter_gradients(&mut self, gradient: &mut [f64]) {
        let (n, body_at) = (self.coordinates(), self.unknowns.body_at());
        self.work.pull_back(self.scene.decoder);
        for (m, moment) in self.moments.iter().enumerate() {
            let mine = &mut self.work.gradients[m * n..(m + 1) * n];
            mine[..LATENT].copy_from_slice(&self.work.code_gradients[m * LATENT..][..LATENT]);
            let mine = &self.work.gradients[m * n..(m + 1) * n];
            let mut pulled = [0.0; KEYFRAME];
            for end in self.ends(self.unknowns.place(moment.capture)).iter().flatten() {
                end.pull(mine, &mut pulled);
                add(&mut gradient[end.knot * KEYFRAME..], &pulled);
            }
            add(&mut gradient[body_at..], &mine[KEYFRAME..]);
        }
    }

    /// Whether the moment's Hessian is a part of that of a single knot, once its rotation is
    /// parametrised as the knot's is.
    fn is_direct(&self, place: Place) -> bool {
        place.from == place.to && self.unknowns.body == 0
    }

    /// How the pelvis turns with the coordinates of the moment's rotation.
    fn knot_turn(&self, place: Place) -> Matrix3<f64> {
        match self.is_direct(place) {
            true => so3::left_jacobian(&self.unknowns.turns[place.to]),
            false => Matrix3::identity(),
        }
    }

    /// Adds the Gram matrix of the moment's rows to the Hessian of all unknowns.
    fn scatter_hessian(&mut self, place: Place, normal: &mut Normal) {
        self.work.counts.moments += 1;
        let (n, body_at) = (self.coordinates(), self.unknowns.body_at());
        let sizes = [n, self.work.rows.len() / n, n];
        if self.is_direct(place) {
            if self.unknowns.is_free(place.to) {
                let knot = self.unknowns.number(place.to);
                let (rows, block) = (&self.work.rows, normal.hessian.block_mut(knot, knot));
                gemm::product_of_transpose(sizes, rows, rows, Accum::Add, block);
            }
            return;
        }
        let (ends, blocks) = (self.ends(place), self.blocks());
        let work = &mut *self.work;
        work.gram.resize(n * n, 0.0);
        gemm::product_of_transpose(sizes, &work.rows, &work.rows, Accum::Replace, &mut work.gram);
        for (e, end) in ends.iter().flatten().enumerate() {
            for other in ends.iter().flatten().skip(e) {
                end.add_block(other, &work.gram, n, &mut work.half, blocks, normal);
            }
        }
        let total = normal.gradient.len();
        let mut pulled = [0.0; KEYFRAME];
        for (k, row) in work.gram.chunks_exact(n).skip(KEYFRAME).enumerate() {
            let out = &mut normal.hessian.block_mut(0, 0)[(body_at + k) * total..][..total];
            for end in ends.iter().flatten() {
                end.pull(row, &mut pulled);
                add(&mut out[end.knot * KEYFRAME..], &pulled);
            }
            add(&mut out[body_at..], &row[KEYFRAME..]);
        }
    }
}

/// out += v, as far as v goes.
fn add(out: &mut [f64], v: &[f64]) {
    out.iter_mut().zip(v).for_each(|(out, v)| *out += v);
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
