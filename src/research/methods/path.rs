//! One keyframe per frame, all solved at once: a data term per frame and terms between frames.
//!
//! The unknowns of a frame: z (32), a rotation vector w (3) with R = exp(w) R_initial, and the
//! position (3).

use nalgebra::Vector3;

use super::joints::{Joints, UNKNOWNS};
use crate::core::body::Skeleton;
use crate::core::cost::{FrameObservations, FreeBody, PathKeyframe, PathProblem, Scene, Workspace};
use crate::core::manifold::{Correction, Keyframe, LATENT, TimedKeyframe};
use crate::core::optimise::{Layout, NormalEquations, Problem};
use crate::core::so3;
use crate::core::time::Timestamp;

/// A path at given values of its unknowns.
#[derive(Clone, Debug)]
pub struct State {
    /// The keyframe of each frame.
    pub keyframes: Vec<Keyframe>,
    /// The rotation vector w of each frame.
    pub turns: Vec<Vector3<f64>>,
    /// Each frame's joint positions, with Jacobians if normal equations are computed; empty if no
    /// term uses them.
    pub joints: Joints,
}

/// A term of the cost over the frames of a path.
pub trait Term {
    /// The largest distance, in frames, of two frames that share a block of the approximate
    /// Hessian.
    fn reach(&self) -> usize;

    /// Whether it uses [`State::joints`].
    fn uses_joints(&self) -> bool {
        false
    }

    /// The cost at `state`.
    fn cost(&self, state: &State) -> f64;

    /// Adds gradient and Gauss-Newton Hessian at `state`.
    fn add(&self, state: &State, equations: &mut NormalEquations);
}

/// The cost of a path with one keyframe per frame and any number of [`Term`]s.
pub struct FramePath<'a> {
    scene: Scene<'a>,
    skeleton: &'a Skeleton,
    observations: &'a [Vec<FrameObservations>],
    /// Each frame's values at the start.
    initial: &'a [Keyframe],
    terms: &'a [Box<dyn Term + 'a>],
    /// Whether codes and roots are solved for, in that order.
    pub free: [bool; 2],
    work: Workspace,
}

impl<'a> FramePath<'a> {
    /// The problem with every unknown free.
    pub fn new(
        scene: Scene<'a>,
        skeleton: &'a Skeleton,
        observations: &'a [Vec<FrameObservations>],
        initial: &'a [Keyframe],
        terms: &'a [Box<dyn Term + 'a>],
    ) -> Self {
        let work = Workspace::default();
        Self { scene, skeleton, observations, initial, terms, free: [true; 2], work }
    }

    /// The initial unknowns, 38 per frame.
    pub fn start(&self) -> Vec<f64> {
        let unknowns = |keyframe: &Keyframe| {
            let mut x = keyframe.z.to_vec();
            x.extend([0.0; 3]);
            x.extend(keyframe.root_position.iter());
            x
        };
        self.initial.iter().flat_map(unknowns).collect()
    }

    /// The keyframes at the unknowns `x`.
    pub fn keyframes(&self, x: &[f64]) -> Vec<Keyframe> {
        self.state(x, None).keyframes
    }

    /// The state at `x`. `joints`: `None` for no joints, else whether to compute their Jacobians.
    fn state(&self, x: &[f64], joints: Option<bool>) -> State {
        let turn = |x: &[f64]| Vector3::from_column_slice(&x[LATENT..LATENT + 3]);
        let turns: Vec<_> = x.chunks_exact(UNKNOWNS).map(turn).collect();
        let keyframe = |((x, initial), turn): ((&[f64], &Keyframe), &Vector3<f64>)| Keyframe {
            z: std::array::from_fn(|i| x[i]),
            root_rotation: so3::exp(turn) * initial.root_rotation,
            root_position: Vector3::from_column_slice(&x[LATENT + 3..]),
            correction: Correction::default(),
        };
        let frames = x.chunks_exact(UNKNOWNS).zip(self.initial).zip(&turns);
        let keyframes: Vec<_> = frames.map(keyframe).collect();
        let joints = match joints.filter(|_| self.terms.iter().any(|term| term.uses_joints())) {
            Some(jacobians) => {
                let decoder = self.scene.decoder;
                Joints::new(decoder, self.skeleton, &keyframes, &turns, jacobians)
            }
            None => Joints::default(),
        };
        State { keyframes, turns, joints }
    }

    /// Data term and prior of a frame at its unknowns `x`; also fills `derivatives` if given.
    fn frame(&mut self, frame: usize, x: &[f64], derivatives: Option<&mut NormalEquations>) -> f64 {
        let keyframe = self.initial[frame].clone();
        let capture = Timestamp::default();
        let path = vec![PathKeyframe::free(TimedKeyframe::new(capture, keyframe), 1.0)];
        let observations = &self.observations[frame];
        let mut problem = PathProblem::new(
            self.scene,
            path,
            self.skeleton,
            FreeBody::Fixed,
            observations,
            &mut self.work,
        );
        match derivatives {
            None => problem.cost(x),
            Some(equations) => problem.linearise(x, equations),
        }
    }
}

impl Problem for FramePath<'_> {
    fn layout(&self) -> Layout {
        let bandwidth = self.terms.iter().map(|term| term.reach()).max().unwrap_or(0);
        Layout { size: UNKNOWNS, blocks: self.initial.len(), bandwidth }
    }

    fn cost(&mut self, x: &[f64]) -> f64 {
        let state = self.state(x, Some(false));
        let terms: f64 = self.terms.iter().map(|term| term.cost(&state)).sum();
        let frames = x.chunks_exact(UNKNOWNS).enumerate();
        terms + frames.map(|(frame, x)| self.frame(frame, x, None)).sum::<f64>()
    }

    fn linearise(&mut self, x: &[f64], equations: &mut NormalEquations) -> f64 {
        equations.clear();
        let state = self.state(x, Some(true));
        let mut cost = 0.0;
        let mut alone = NormalEquations::zeros(Layout::dense(UNKNOWNS));
        for (frame, x) in x.chunks_exact(UNKNOWNS).enumerate() {
            cost += self.frame(frame, x, Some(&mut alone));
            let mine = frame * UNKNOWNS..(frame + 1) * UNKNOWNS;
            equations.gradient[mine.clone()].copy_from_slice(&alone.gradient);
            for (j, column) in mine.clone().enumerate() {
                let entries = alone.hessian.column(0..UNKNOWNS, j);
                equations.hessian.column_mut(mine.clone(), column).copy_from_slice(entries);
            }
        }
        for term in self.terms {
            cost += term.cost(&state);
            term.add(&state, equations);
        }
        for i in 0..x.len() {
            if !self.free[usize::from(i % UNKNOWNS >= LATENT)] {
                equations.pin(i);
            }
        }
        cost
    }

    fn gradient(&mut self, x: &[f64], gradient: &mut [f64]) -> f64 {
        let mut equations = NormalEquations::zeros(self.layout());
        let cost = self.linearise(x, &mut equations);
        gradient.copy_from_slice(&equations.gradient);
        cost
    }
}
