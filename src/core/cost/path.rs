//! The cost of a path through keyframes, with its gradient and Gauss-Newton Hessian.
//!
//! Each frame is linearised in its own coordinates: code, rotation and position at its time, and
//! the body. The chain rule maps the result to the unknowns of the two keyframes around it, with
//! the derivative of the interpolation. If the body is free, all keyframes share it, and the normal
//! equations are one dense block; otherwise they are banded, with a block for each free keyframe.

use nalgebra::Vector3;

use super::chain_rule::{KeyframeTangent, block, keyframe_tangents};
use super::config::Config;
use super::frame_cost::{self, Path};
use super::observation::{FrameObservations, Observation};
use super::reprojection::Reprojection;
use super::robust::{Loss, StudentT};
use super::scene::Scene;
use super::unknowns::{FreeBody, KEYFRAME, PathKeyframe, Unknowns};
use super::workspace::{Workspace, in_batches};
use crate::core::body::{SHAPE_COEFFICIENTS, Skeleton};
use crate::core::manifold::{Keyframe, LATENT};
use crate::core::optimise::{Layout, NormalEquations, Problem};
use crate::core::time::Timestamp;

/// The cost of a path, for an optimiser; [`PathProblem::solution`] turns its result into keyframes and
/// body.
#[derive(Debug)]
pub struct PathProblem<'a> {
    pub(super) scene: Scene<'a>,
    observations: &'a [FrameObservations],
    /// Used in place of `observations` if they are there.
    replaced: Option<Vec<FrameObservations>>,
    pub(super) work: &'a mut Workspace,
    pub(super) unknowns: Unknowns,
    pub(super) loss: Loss,
}

/// What to compute besides the cost.
enum Wanted<'o> {
    Cost,
    Gradient(&'o mut [f64]),
    NormalEquations(&'o mut NormalEquations),
}

impl Wanted<'_> {
    fn for_frames(&self) -> frame_cost::Wanted {
        match self {
            Self::Cost => frame_cost::Wanted::Cost,
            Self::Gradient(_) => frame_cost::Wanted::Gradients,
            Self::NormalEquations(_) => frame_cost::Wanted::Hessians,
        }
    }

    fn gradient(&mut self) -> Option<&mut [f64]> {
        match self {
            Self::Cost => None,
            Self::Gradient(gradient) => Some(gradient),
            Self::NormalEquations(equations) => Some(&mut equations.gradient),
        }
    }

    fn equations(&mut self) -> Option<&mut NormalEquations> {
        match self {
            Self::NormalEquations(equations) => Some(equations),
            _ => None,
        }
    }
}

impl<'a> PathProblem<'a> {
    /// The problem of a path through the keyframes `path`, in order of time. With a single keyframe
    /// the path is constant. The `free` coefficients of the body are unknowns too, and start from
    /// those of `skeleton`.
    pub fn new(
        scene: Scene<'a>,
        path: Vec<PathKeyframe>,
        skeleton: &Skeleton,
        free: FreeBody,
        observations: &'a [FrameObservations],
        work: &'a mut Workspace,
    ) -> Self {
        work.forget();
        Self {
            unknowns: Unknowns::new(path, skeleton, free),
            loss: Loss::new(scene.config.loss, scene.config.scale_px),
            scene,
            observations,
            replaced: None,
            work,
        }
    }

    /// Uses other observations of the same points and times, or its own again (`None`).
    pub fn replace_observations(&mut self, other: Option<Vec<FrameObservations>>) {
        self.replaced = other;
    }

    /// Changes the scale of the loss, pixels.
    pub fn set_scale(&mut self, scale_px: f64) {
        self.loss = Loss::new(self.scene.config.loss, scale_px);
    }

    /// The cost of the observations up to a time, and of those after it, at the last evaluation, as
    /// fractions of the largest possible cost (a body far from all of them).
    pub fn misfits(&self, time: Timestamp) -> [f64; 2] {
        let (mut costs, mut most) = ([0.0; 2], [0.0; 2]);
        let weight = |seen: &Observation| {
            0.5 * seen.confidence * self.scene.points[seen.point].attachment.weight
        };
        for (frame, cost) in self.observations.iter().zip(self.work.costs()) {
            let part = usize::from(frame.capture > time);
            costs[part] += cost;
            most[part] += frame.observations().iter().map(weight).sum::<f64>();
        }
        let ceiling = self.loss.ceiling();
        [0, 1].map(|part| costs[part] / (ceiling * most[part]).max(f64::MIN_POSITIVE))
    }

    /// Places of the observed points on the body at `x` (world, metres): by frame, in the order of
    /// [`FrameObservations::by_point`]. The body must be that of the last evaluation.
    pub fn points(&mut self, x: &[f64]) -> Vec<Vec<Vector3<f64>>> {
        self.unknowns.take(x);
        let Self { scene, unknowns, loss, observations, work, .. } = self;
        let reprojection = Reprojection { rig: scene.rig, loss: *loss };
        let Workspace { batches, offsets, .. } = &mut **work;
        let path = Path { scene: *scene, unknowns, reprojection, offsets };
        let batches = batches.iter_mut().zip(in_batches(observations));
        batches.flat_map(|(batch, frames)| path.points(frames, batch)).collect()
    }

    /// The unknowns to start from.
    pub fn start(&self) -> Vec<f64> {
        self.unknowns.start()
    }

    /// The unknowns to start from: `value` gives each free keyframe, from its index in the path.
    pub fn start_at(&self, value: impl Fn(usize, &PathKeyframe) -> Keyframe) -> Vec<f64> {
        self.unknowns.start_at(value)
    }

    /// The keyframes and the body at the unknowns `x`.
    pub fn solution(mut self, x: &[f64]) -> (Vec<Keyframe>, Skeleton) {
        self.unknowns.take(x);
        (self.unknowns.keyframes, self.unknowns.skeleton)
    }

    fn evaluate(&mut self, x: &[f64], mut wanted: Wanted) -> f64 {
        self.unknowns.take(x);
        let cost = self.prior(x, &mut wanted);
        let Self { scene, unknowns, loss, observations, replaced, work } = self;
        let observations = replaced.as_deref().unwrap_or(observations);
        let reprojection = Reprojection { rig: scene.rig, loss: *loss };
        let (scene, unknowns, for_frames) = (*scene, &*unknowns, wanted.for_frames());
        let offsets = scene.points.iter().map(|point| point.attachment.offset(&unknowns.skeleton));
        work.offsets.clear();
        work.offsets.extend(offsets);
        work.compute(observations, |observations, offsets, batch| {
            Path { scene, unknowns, reprojection, offsets }.compute(
                observations,
                for_frames,
                batch,
            );
        });
        if let Some(gradient) = wanted.gradient() {
            self.scatter_gradients(gradient);
        }
        if let Some(equations) = wanted.equations() {
            self.scatter_hessians(equations);
        }
        cost + self.work.costs().sum::<f64>()
    }

    /// 1/2 n prior rho(|z|^2) of each free keyframe of n frames, 1/2 shape prior |shape|^2,
    /// 1/2 offset prior |offsets|^2, and the path's stiffness. Overwrites the `wanted` outputs.
    fn prior(&self, x: &[f64], wanted: &mut Wanted) -> f64 {
        let Config { prior, prior_dof, shape_prior, offset_prior, stiffness, .. } =
            *self.scene.config;
        let mut cost = 0.0;
        if let Some(gradient) = wanted.gradient() {
            gradient.fill(0.0);
        }
        if let Some(equations) = wanted.equations() {
            equations.hessian.clear();
        }
        let student = StudentT::new(prior_dof);
        let codes = self.unknowns.free_frames().enumerate().map(|(keyframe, frames)| {
            let first = keyframe * KEYFRAME;
            let (rho, slope) = student.rho(square(&x[first..first + LATENT]));
            (first, LATENT, prior * frames * slope, prior * frames * rho)
        });
        let body_at = self.unknowns.body_at();
        let shape = self.unknowns.body.min(SHAPE_COEFFICIENTS);
        let (offsets_at, offsets) = (body_at + shape, self.unknowns.body - shape);
        let body = [(body_at, shape, shape_prior), (offsets_at, offsets, offset_prior)];
        let body = body.map(|(first, count, weight)| {
            (first, count, weight, weight * square(&x[first..first + count]))
        });
        for (first, count, weight, twice_cost) in codes.chain(body) {
            cost += 0.5 * twice_cost;
            for i in first..first + count {
                if let Some(gradient) = wanted.gradient() {
                    gradient[i] = weight * x[i];
                }
                if let Some(equations) = wanted.equations() {
                    equations.hessian.add_to_diagonal(i, weight);
                }
            }
        }
        cost + match wanted {
            Wanted::Cost => stiffness.cost(&self.unknowns),
            Wanted::Gradient(gradient) => stiffness.add_gradient(&self.unknowns, gradient),
            Wanted::NormalEquations(equations) => stiffness.add(&self.unknowns, equations),
        }
    }

    /// Adds the frames' gradients to those of the unknowns.
    fn scatter_gradients(&self, gradient: &mut [f64]) {
        let (n, body_at) = (self.unknowns.coordinates(), self.unknowns.body_at());
        let interpolation = self.scene.config.interpolation;
        let mut pulled = [0.0; KEYFRAME];
        for (batch, observations) in self.work.batches.iter().zip(in_batches(self.observations)) {
            for (mine, frame) in batch.gradients.chunks_exact(n).zip(observations) {
                let place = self.unknowns.place(frame.capture);
                for tangent in
                    keyframe_tangents(&self.unknowns, interpolation, place).iter().flatten()
                {
                    tangent.pull_back(mine, &mut pulled);
                    add(&mut gradient[tangent.keyframe * KEYFRAME..], &pulled);
                }
                add(&mut gradient[body_at..], &mine[KEYFRAME..]);
            }
        }
    }

    /// Adds the frames' Hessians to that of the unknowns.
    fn scatter_hessians(&mut self, equations: &mut NormalEquations) {
        let n = self.unknowns.coordinates();
        let (unknowns, interpolation) = (&self.unknowns, self.scene.config.interpolation);
        let Workspace { batches, half, .. } = &mut *self.work;
        for (batch, observations) in batches.iter().zip(in_batches(self.observations)) {
            for (gram, frame) in batch.grams.chunks_exact(n * n).zip(observations) {
                let place = unknowns.place(frame.capture);
                if unknowns.is_direct(place) {
                    if unknowns.is_free(place.to) {
                        let mine = block(unknowns.number(place.to));
                        for (column, row) in mine.clone().zip(gram.chunks_exact(n)) {
                            add(equations.hessian.column_mut(mine.clone(), column), row);
                        }
                    }
                    continue;
                }
                let tangents = keyframe_tangents(unknowns, interpolation, place);
                for (first, tangent) in tangents.iter().flatten().enumerate() {
                    for other in tangents.iter().flatten().skip(first) {
                        tangent.add_block(other, gram, n, half, &mut equations.hessian);
                    }
                }
                add_body_rows(unknowns, &tangents, gram, equations);
            }
        }
    }
}

/// Adds the body's rows of a frame's Hessian.
fn add_body_rows(
    unknowns: &Unknowns,
    tangents: &[Option<KeyframeTangent>],
    gram: &[f32],
    equations: &mut NormalEquations,
) {
    let (n, body_at) = (unknowns.coordinates(), unknowns.body_at());
    let mut pulled = [0.0; KEYFRAME];
    for (row, entries) in (body_at..).zip(gram.chunks_exact(n).skip(KEYFRAME)) {
        let mut add = |column: usize, value: f64| {
            equations.hessian.column_mut(row..row + 1, column)[0] += value;
        };
        for tangent in tangents.iter().flatten() {
            tangent.pull_back(entries, &mut pulled);
            block(tangent.keyframe).zip(pulled).for_each(|(column, value)| add(column, value));
        }
        let body = (body_at..=row).zip(&entries[KEYFRAME..]);
        body.for_each(|(column, &value)| add(column, value.into()));
    }
}

/// The sum of squares.
fn square(v: &[f64]) -> f64 {
    v.iter().map(|v| v * v).sum()
}

/// out += v, over the length of v.
fn add<T: Copy + Into<f64>>(out: &mut [f64], v: &[T]) {
    out.iter_mut().zip(v).for_each(|(out, &v)| *out += v.into());
}

impl Problem for PathProblem<'_> {
    fn layout(&self) -> Layout {
        let blocks = self.unknowns.number(self.unknowns.keyframes.len());
        let bandwidth = if self.scene.config.stiffness.is_none() { 1 } else { 2 };
        match self.unknowns.body {
            0 => Layout {
                size: KEYFRAME,
                blocks,
                bandwidth: bandwidth.min(blocks.saturating_sub(1)),
            },
            _ => Layout::dense(self.unknowns.count()),
        }
    }

    fn cost(&mut self, x: &[f64]) -> f64 {
        self.evaluate(x, Wanted::Cost)
    }

    fn linearise(&mut self, x: &[f64], equations: &mut NormalEquations) -> f64 {
        self.evaluate(x, Wanted::NormalEquations(equations))
    }

    fn gradient(&mut self, x: &[f64], gradient: &mut [f64]) -> f64 {
        self.evaluate(x, Wanted::Gradient(gradient))
    }
}
