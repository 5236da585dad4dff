//! Cost terms between frames.

use super::joints::COORDINATES;
use super::joints::UNKNOWNS;
use super::path::{State, Term};
use crate::core::manifold::LATENT;
use crate::core::optimise::NormalEquations;
use crate::core::so3::{turn_between, turn_between_tangents};

/// 1/2 weight |P_j(t + 1) - P_j(t)|^2 over joints and frames.
#[derive(Clone, Copy, Debug)]
pub struct JointSteps {
    /// Weight, square pixels per square metre.
    pub weight: f64,
}

impl JointSteps {
    fn residual(state: &State, frame: usize) -> Vec<f64> {
        let (a, b) = (state.joints.positions(frame), state.joints.positions(frame + 1));
        b.iter().zip(a).map(|(b, a)| b - a).collect()
    }
}

impl Term for JointSteps {
    fn reach(&self) -> usize {
        1
    }

    fn uses_joints(&self) -> bool {
        true
    }

    fn cost(&self, state: &State) -> f64 {
        let steps = 1..state.keyframes.len();
        let square = |t: usize| squared(&Self::residual(state, t - 1));
        0.5 * self.weight * steps.map(square).sum::<f64>()
    }

    fn add(&self, state: &State, equations: &mut NormalEquations) {
        for frame in 1..state.keyframes.len() {
            let residual = Self::residual(state, frame - 1);
            let before: Vec<f64> = state.joints.jacobian(frame - 1).iter().map(|j| -j).collect();
            let by = [(frame - 1, &before[..]), (frame, state.joints.jacobian(frame))];
            equations.add(self.weight, &residual, &by);
        }
    }
}

/// 1/2 latent |z(t + 1) - z(t)|^2 + 1/2 rotation |log(R(t + 1) R(t)^T)|^2 +
/// 1/2 position |p(t + 1) - p(t)|^2.
#[derive(Clone, Copy, Debug)]
pub struct KeyframeSteps {
    /// Weight of codes, square pixels.
    pub latent: f64,
    /// Weight of rotations, square pixels per square radian.
    pub rotation: f64,
    /// Weight of positions, square pixels per square metre.
    pub position: f64,
}

impl KeyframeSteps {
    /// The square root of the weight of each unknown.
    fn roots(&self) -> [f64; UNKNOWNS] {
        std::array::from_fn(|i| match i {
            i if i < LATENT => self.latent.sqrt(),
            i if i < LATENT + 3 => self.rotation.sqrt(),
            _ => self.position.sqrt(),
        })
    }

    /// The weighted residual between a frame and the next, with its Jacobians with respect to both.
    fn step(&self, state: &State, frame: usize) -> (Vec<f64>, [Vec<f64>; 2]) {
        let (a, b) = (&state.keyframes[frame], &state.keyframes[frame + 1]);
        let (w0, w1) = (&state.turns[frame], &state.turns[frame + 1]);
        let turn = turn_between(&a.root_rotation, &b.root_rotation);
        let (by_first, by_second) = turn_between_tangents(&turn, w0, w1);
        let mut step: Vec<f64> = b.z.iter().zip(&a.z).map(|(b, a)| b - a).collect();
        step.extend(turn.iter());
        step.extend((b.root_position - a.root_position).iter());
        let roots = self.roots();
        let jacobian = |sign: f64, turn: &nalgebra::Matrix3<f64>| {
            let mut rows = vec![0.0; UNKNOWNS * UNKNOWNS];
            (0..UNKNOWNS).for_each(|i| rows[i * UNKNOWNS + i] = sign * roots[i]);
            for i in 0..3 {
                for j in 0..3 {
                    let at = (LATENT + i) * UNKNOWNS + LATENT + j;
                    rows[at] = roots[LATENT] * turn[(i, j)];
                }
            }
            rows
        };
        let jacobians = [jacobian(-1.0, &by_first), jacobian(1.0, &by_second)];
        step.iter_mut().zip(&roots).for_each(|(step, root)| *step *= root);
        (step, jacobians)
    }
}

impl Term for KeyframeSteps {
    fn reach(&self) -> usize {
        1
    }

    fn cost(&self, state: &State) -> f64 {
        (1..state.keyframes.len()).map(|t| 0.5 * squared(&self.step(state, t - 1).0)).sum()
    }

    fn add(&self, state: &State, equations: &mut NormalEquations) {
        for frame in 1..state.keyframes.len() {
            let (step, [before, after]) = self.step(state, frame - 1);
            equations.add(1.0, &step, &[(frame - 1, &before[..]), (frame, &after[..])]);
        }
    }
}

/// 1/2 weight |P - B c|^2 over the joint trajectories P of all frames, with the optimal
/// coefficients c = B^T P.
///
/// B holds the first DCT basis vectors. The gradient is exact: weight J^T (P - B c). The
/// approximate Hessian omits the part -J^T B B^T J that couples all frames, which makes it larger.
/// So each step moves every frame on its own towards the projection of the trajectories.
#[derive(Clone, Debug)]
pub struct LowFrequency {
    weight: f64,
    /// Frames x components, orthonormal columns.
    basis: Vec<Vec<f64>>,
}

impl LowFrequency {
    /// The term over `frames` frames with min(`components`, `frames`) basis vectors.
    pub fn new(weight: f64, frames: usize, components: usize) -> Self {
        let cosine = |k: usize, t: usize| {
            let scale = if k == 0 { 1.0 } else { 2.0 } / frames as f64;
            let phase = std::f64::consts::PI * k as f64 * (t as f64 + 0.5) / frames as f64;
            scale.sqrt() * libm::cos(phase)
        };
        let row = |t: usize| (0..components.min(frames)).map(|k| cosine(k, t)).collect();
        Self { weight, basis: (0..frames).map(row).collect() }
    }

    /// P - B c of each frame.
    fn residuals(&self, state: &State) -> Vec<Vec<f64>> {
        let components = self.basis.first().map_or(0, Vec::len);
        let mut coefficients = vec![vec![0.0; COORDINATES]; components];
        for (t, row) in self.basis.iter().enumerate() {
            for (b, c) in row.iter().zip(&mut coefficients) {
                c.iter_mut().zip(state.joints.positions(t)).for_each(|(c, p)| *c += b * p);
            }
        }
        let residual = |(t, row): (usize, &Vec<f64>)| {
            let mut rest = state.joints.positions(t).to_vec();
            for (b, c) in row.iter().zip(&coefficients) {
                rest.iter_mut().zip(c).for_each(|(r, c)| *r -= b * c);
            }
            rest
        };
        self.basis.iter().enumerate().map(residual).collect()
    }
}

impl Term for LowFrequency {
    fn reach(&self) -> usize {
        0
    }

    fn uses_joints(&self) -> bool {
        true
    }

    fn cost(&self, state: &State) -> f64 {
        0.5 * self.weight * self.residuals(state).iter().map(|r| squared(r)).sum::<f64>()
    }

    fn add(&self, state: &State, equations: &mut NormalEquations) {
        for (frame, residual) in self.residuals(state).iter().enumerate() {
            equations.add(self.weight, residual, &[(frame, state.joints.jacobian(frame))]);
        }
    }
}

fn squared(residual: &[f64]) -> f64 {
    residual.iter().map(|r| r * r).sum()
}
