//! Transition model: a Gaussian of a keyframe, given the two keyframes before it.
//!
//! For three keyframes a, b, c at steps of h seconds, with codes z, rotations R and positions p:
//!
//! - The state describes a and b, independent of the person's position and heading: z_b, its rate
//!   (z_b - z_a) / h, up in the pelvis R_b^T e_y, its velocity R_b^T (p_b - p_a) / h, its angular
//!   velocity w_ab / h with w_ab = log(R_a^T R_b), and ln(60 h).
//! - The move is the deviation of c from constant velocity, an acceleration:
//!   (z_c - 2 z_b + z_a) / h^2, R_b^T (p_c - 2 p_b + p_a) / h^2 and (w_bc - w_ab) / h^2.
//! - p(move | state) = N(mean, diag(deviation^2)). A network with SiLU between its layers gives 38
//!   means m and 38 numbers v: mean = scale m, deviation = scale exp(v'/2), v' = 5 tanh(v / 5). So
//!   each deviation is 0.08 to 12 times that of the corpus (scale).
//!
//! The height over the floor is not in the state: the corpus's clips do not share a floor, and
//! height changes with leg length.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};
use safetensors::tensor::SafeTensors;

use crate::core::linalg::{self, Accum};
use crate::core::manifold::weights::{Layer, checked_metadata, layers, numbers};
use crate::core::manifold::{Decoder, Keyframe, LATENT, WeightsError};
use crate::core::so3;

/// Size of a state.
pub const STATE: usize = 2 * LATENT + 10;
/// Size of a move: code, position, rotation.
pub const MOVE: usize = LATENT + 6;
/// Unknowns of three keyframes: for each its code, a left tangent of its rotation, its position.
pub const THREE: usize = 3 * KEYFRAME;

/// The state of two keyframes; see the module.
pub type State = [f64; STATE];
/// The move to the third keyframe; see the module.
pub type Move = [f64; MOVE];

const KEYFRAME: usize = LATENT + 6;
/// The format's name in the metadata.
const FORMAT: &str = "bundlemocap-transition";
/// The rate at which ln(60 h) is zero.
const RATE: f64 = 60.0;
/// Largest absolute log variance, relative to that of the corpus.
const WIDEST: f64 = 5.0;

/// Where the parts of a state begin.
const RATES: usize = LATENT;
const UP: usize = 2 * LATENT;
const VELOCITY: usize = UP + 3;
const SPIN: usize = VELOCITY + 3;

/// The model. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Transition {
    layers: Arc<[Layer]>,
    /// Each layer's weight transposed, [in, out], f64.
    wide: Arc<[Vec<f64>]>,
    scale: Move,
    manifold: String,
}

/// Memory for one transition.
#[derive(Clone, Debug, Default)]
pub struct TransitionWork {
    values: Vec<Vec<f64>>,
    slopes: Vec<Vec<f32>>,
    back: Vec<f32>,
    next_back: Vec<f32>,
}

impl Transition {
    /// Reads a weights file: `transition.N.weight` \[out, in\], `transition.N.bias`, `scale` (38).
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, WeightsError> {
        let metadata = checked_metadata(bytes, FORMAT)?;
        let tensors = SafeTensors::deserialize(bytes)?;
        let layers = layers(&tensors, "transition", STATE, 2 * MOVE)?;
        let numbers = numbers(&tensors, "scale", &[MOVE])?;
        Ok(Self {
            wide: layers.iter().map(Layer::transposed).collect(),
            layers: layers.into(),
            scale: std::array::from_fn(|i| f64::from(numbers[i])),
            manifold: metadata.get("manifold").cloned().unwrap_or_default(),
        })
    }

    /// The embedded model; see `src/core/manifold/MODEL_CARD.md`.
    pub fn embedded() -> Result<Self, WeightsError> {
        Self::from_bytes(include_bytes!("transition.safetensors"))
    }

    /// Whether it was trained on codes of a decoder.
    pub fn fits(&self, decoder: &Decoder) -> bool {
        self.manifold == format!("{:016x}", decoder.fingerprint())
    }

    /// Mean and deviation of the move after a state.
    pub fn predict(&self, state: &State, work: &mut TransitionWork) -> (Move, Move) {
        work.values.resize_with(self.layers.len(), Vec::new);
        work.slopes.resize_with(self.layers.len(), Vec::new);
        for (n, layer) in self.layers.iter().enumerate() {
            let (before, here) = work.values.split_at_mut(n);
            let input = before.last().map_or(&state[..], |values| &values[..]);
            let output = &mut here[0];
            output.clear();
            output.extend(layer.bias.iter().map(|&b| f64::from(b)));
            let sizes = [1, layer.inputs, layer.outputs];
            linalg::product(sizes, input, &self.wide[n], Accum::Add, output);
            if n + 1 < self.layers.len() {
                work.slopes[n].resize(layer.outputs, 0.0);
                silu(output, &mut work.slopes[n]);
            }
        }
        let out = work.values.last().map_or(&[][..], |values| &values[..]);
        let deviation = |v: f64| libm::exp(0.5 * WIDEST * libm::tanh(v / WIDEST));
        (
            std::array::from_fn(|i| self.scale[i] * out[i]),
            std::array::from_fn(|i| self.scale[i] * deviation(out[MOVE + i])),
        )
    }

    /// The derivative of the last predicted mean by the state: 38 x 74, row-major.
    fn mean_tangent<'w>(&self, work: &'w mut TransitionWork) -> &'w [f32] {
        let last = self.layers.len() - 1;
        for (n, layer) in self.layers.iter().enumerate().rev() {
            if n == last {
                work.back.clear();
                for (row, &scale) in layer.weight.chunks_exact(layer.inputs).zip(&self.scale) {
                    work.back.extend(row.iter().map(|w| w * scale as f32));
                }
                continue;
            }
            for row in work.back.chunks_exact_mut(layer.outputs) {
                row.iter_mut().zip(&work.slopes[n]).for_each(|(v, slope)| *v *= slope);
            }
            work.next_back.resize(MOVE * layer.inputs, 0.0);
            let sizes = [MOVE, layer.outputs, layer.inputs];
            let out = &mut work.next_back;
            linalg::product(sizes, &work.back, &layer.weight, Accum::Replace, out);
            std::mem::swap(&mut work.back, &mut work.next_back);
        }
        &work.back
    }

    /// -ln p of c after a and b, nats, without the constant 19 ln(2 pi).
    pub fn neg_log_likelihood(
        &self,
        three: [&Keyframe; 3],
        step: f64,
        work: &mut TransitionWork,
    ) -> f64 {
        let (mean, deviation) = self.predict(&state_of(three[0], three[1], step), work);
        let found = move_of(three, step);
        let of = |i: usize| {
            0.5 * ((found[i] - mean[i]) / deviation[i]).powi(2) + libm::log(deviation[i])
        };
        (0..MOVE).map(of).sum()
    }

    /// The move minus its mean, divided by the deviations.
    pub fn residual(
        &self,
        three: [&Keyframe; 3],
        step: f64,
        deviation: &Move,
        work: &mut TransitionWork,
    ) -> Move {
        let (mean, _) = self.predict(&state_of(three[0], three[1], step), work);
        let found = move_of(three, step);
        std::array::from_fn(|i| (found[i] - mean[i]) / deviation[i])
    }

    /// [`Transition::residual`] with its derivative by the three keyframes at fixed deviations: 38
    /// x 114, row-major.
    pub fn residual_with_tangent(
        &self,
        three: [&Keyframe; 3],
        step: f64,
        deviation: &Move,
        work: &mut TransitionWork,
        tangent: &mut [f64],
    ) -> Move {
        let residual = self.residual(three, step, deviation, work);
        let mean = self.mean_tangent(work);
        move_tangent(three, step, tangent);
        subtract_mean_tangent(three, step, mean, tangent);
        for (row, deviation) in tangent.chunks_exact_mut(THREE).zip(deviation) {
            row.iter_mut().for_each(|v| *v /= deviation);
        }
        residual
    }
}

/// The state of a and b, `step` seconds apart.
pub fn state_of(a: &Keyframe, b: &Keyframe, step: f64) -> State {
    let mut state = [0.0; STATE];
    for i in 0..LATENT {
        state[i] = b.z[i];
        state[RATES + i] = (b.z[i] - a.z[i]) / step;
    }
    let inverse = b.root_rotation.transpose();
    let up = inverse * Vector3::y();
    let velocity = inverse * (b.root_position - a.root_position) / step;
    let spin = so3::log(&(a.root_rotation.transpose() * b.root_rotation)) / step;
    for i in 0..3 {
        state[UP + i] = up[i];
        state[VELOCITY + i] = velocity[i];
        state[SPIN + i] = spin[i];
    }
    state[STATE - 1] = libm::log(RATE * step);
    state
}

/// The move to c after a and b, each `step` seconds after the one before.
pub fn move_of([a, b, c]: [&Keyframe; 3], step: f64) -> Move {
    let per = step.powi(-2);
    let bend = c.root_position - b.root_position * 2.0 + a.root_position;
    let position = b.root_rotation.transpose() * bend;
    let turn = so3::log(&(b.root_rotation.transpose() * c.root_rotation))
        - so3::log(&(a.root_rotation.transpose() * b.root_rotation));
    std::array::from_fn(|i| match i {
        0..LATENT => (c.z[i] - 2.0 * b.z[i] + a.z[i]) * per,
        _ if i < LATENT + 3 => position[i - LATENT] * per,
        _ => turn[i - LATENT - 3] * per,
    })
}

/// Derivatives of the pelvis's velocities by two rotations: v = R_b^T u and w = log(R_a^T R_b).
struct Turns {
    /// v by R_b's left tangent: R_b^T \[u\]x.
    moved: Matrix3<f64>,
    /// w by R_b's left tangent, and the negative of w by R_a's: Jr(w)^-1 R_b^T.
    turned: Matrix3<f64>,
}

impl Turns {
    fn of(a: &Matrix3<f64>, b: &Matrix3<f64>, u: &Vector3<f64>) -> Self {
        let inverse = b.transpose();
        let turn = so3::log(&(a.transpose() * b));
        Self {
            moved: inverse * u.cross_matrix(),
            turned: so3::right_jacobian_inverse(&turn) * inverse,
        }
    }
}

/// Writes the derivative of [`move_of`], 38 x 114.
fn move_tangent([a, b, c]: [&Keyframe; 3], step: f64, out: &mut [f64]) {
    let per = step.powi(-2);
    out.fill(0.0);
    for i in 0..LATENT {
        for (frame, factor) in [per, -2.0 * per, per].into_iter().enumerate() {
            out[i * THREE + frame * KEYFRAME + i] = factor;
        }
    }
    let bend = c.root_position - b.root_position * 2.0 + a.root_position;
    let first = Turns::of(&a.root_rotation, &b.root_rotation, &bend);
    let second = Turns::of(&b.root_rotation, &c.root_rotation, &bend);
    let inverse = b.root_rotation.transpose();
    let mut put = |row: usize, frame: usize, part: usize, block: Matrix3<f64>| {
        for i in 0..3 {
            for j in 0..3 {
                out[(LATENT + row + i) * THREE + frame * KEYFRAME + LATENT + part + j] =
                    block[(i, j)] * per;
            }
        }
    };
    put(0, 0, 3, inverse);
    put(0, 1, 0, first.moved);
    put(0, 1, 3, inverse * -2.0);
    put(0, 2, 3, inverse);
    put(3, 0, 0, first.turned);
    put(3, 1, 0, -second.turned - first.turned);
    put(3, 2, 0, second.turned);
}

/// Subtracts `mean` (38 x 74, the derivative by the state) times the state's derivative by a and b.
fn subtract_mean_tangent([a, b, _]: [&Keyframe; 3], step: f64, mean: &[f32], tangent: &mut [f64]) {
    let per = step.recip();
    let inverse = b.root_rotation.transpose();
    let moved = b.root_position - a.root_position;
    let turns = Turns::of(&a.root_rotation, &b.root_rotation, &(moved * per));
    let up = inverse * Vector3::y().cross_matrix();
    let (shift, turned) = (inverse * per, turns.turned * per);
    for (row, mean) in tangent.chunks_exact_mut(THREE).zip(mean.chunks_exact(STATE)) {
        for i in 0..LATENT {
            let rate = f64::from(mean[RATES + i]) * per;
            row[i] += rate;
            row[KEYFRAME + i] -= f64::from(mean[i]) + rate;
        }
        let three = |at: usize| Vector3::from_fn(|i, _| f64::from(mean[at + i]));
        let (by_up, by_velocity, by_spin) = (three(UP), three(VELOCITY), three(SPIN));
        let by_turn = turned.tr_mul(&by_spin);
        let by_shift = shift.tr_mul(&by_velocity);
        let by_b = up.tr_mul(&by_up) + turns.moved.tr_mul(&by_velocity) + by_turn;
        for i in 0..3 {
            row[LATENT + i] += by_turn[i];
            row[LATENT + 3 + i] += by_shift[i];
            row[KEYFRAME + LATENT + i] -= by_b[i];
            row[KEYFRAME + LATENT + 3 + i] -= by_shift[i];
        }
    }
}

/// x to x sigma(x) in place, and its derivative to `slopes`.
fn silu(values: &mut [f64], slopes: &mut [f32]) {
    for (value, slope) in values.iter_mut().zip(slopes) {
        let sigma = 1.0 / (1.0 + (-*value).exp());
        let out = *value * sigma;
        *slope = (sigma + out * (1.0 - sigma)) as f32;
        *value = out;
    }
}
