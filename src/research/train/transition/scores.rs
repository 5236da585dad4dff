//! Metrics of a transition model, compared with two simple baselines.

use super::samples::Samples;
use crate::core::manifold::LATENT;
use crate::research::transition::{MOVE, STATE, State, Transition, TransitionWork};

/// Metrics at one frame rate: negative log likelihood of the held-out moves, nats per component,
/// and the share of the moves' mean square that the predicted mean explains.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TransitionScores {
    /// Frame rate, Hz.
    pub fps: f64,
    /// Number of held-out transitions.
    pub transitions: usize,
    /// Negative log likelihood of the model.
    pub model: f64,
    /// Negative log likelihood of constant velocity, with deviations fitted to the training clips.
    pub constant_velocity: f64,
    /// Negative log likelihood of no motion, with deviations fitted to the training clips.
    pub stay_put: f64,
    /// Share of the moves' mean square, relative to constant velocity, that the model's mean
    /// explains: code, pelvis position, pelvis rotation.
    pub predicted: [f64; 3],
    /// Share of the model's residuals within one standard deviation; 0.683 if they are Gaussian.
    pub within: f64,
}

impl TransitionScores {
    /// Metrics of a model on `held_out`; the baselines are fitted to `known`.
    pub fn of(model: &Transition, fps: f64, known: &Samples, held_out: &Samples) -> Self {
        let mut scores = Self { fps, transitions: held_out.len(), ..Self::default() };
        scores.constant_velocity = reference(known, held_out, |_, found, i| found[i]);
        // c - b in the units of a move: the move plus the velocity.
        let stay =
            |state: &[f32], found: &[f32], i: usize| f64::from(found[i]) + moving(state, i) * fps;
        scores.stay_put = reference(known, held_out, stay);
        let mut work = TransitionWork::default();
        let (mut left, mut all, mut inside) = ([0.0; MOVE], [0.0; MOVE], 0);
        for (state, found) in held_out.rows() {
            let state: State = std::array::from_fn(|i| f64::from(state[i]));
            let (mean, deviation) = model.predict(&state, &mut work);
            for i in 0..MOVE {
                let off = f64::from(found[i]) - mean[i];
                scores.model += nats(off, deviation[i]);
                left[i] += off * off;
                all[i] += f64::from(found[i]).powi(2);
                inside += usize::from(off.abs() < deviation[i]);
            }
        }
        let count = (MOVE * held_out.len().max(1)) as f64;
        scores.model /= count;
        scores.within = inside as f64 / count;
        let parts = [0..LATENT, LATENT..LATENT + 3, LATENT + 3..MOVE];
        scores.predicted = parts.map(|part| {
            1.0 - left[part.clone()].iter().sum::<f64>() / all[part].iter().sum::<f64>().max(1e-12)
        });
        scores
    }
}

/// The velocity of component `i` of a move, from the state.
fn moving(state: &[f32], i: usize) -> f64 {
    let at = if i < LATENT { LATENT + i } else { STATE - 7 + i - LATENT };
    f64::from(state[at])
}

/// Negative log likelihood of `held_out` under zero-mean Gaussians fitted to the residuals `off` of
/// `known`.
fn reference<N: Into<f64>>(
    known: &Samples,
    held_out: &Samples,
    off: impl Fn(&[f32], &[f32], usize) -> N,
) -> f64 {
    let mut square = [0.0; MOVE];
    for (state, found) in known.rows() {
        (0..MOVE).for_each(|i| square[i] += off(state, found, i).into().powi(2));
    }
    let deviation = square.map(|sum| (sum / known.len().max(1) as f64).sqrt().max(1e-9));
    let rows = held_out.rows();
    let sum: f64 = rows
        .map(|(state, found)| {
            (0..MOVE).map(|i| nats(off(state, found, i).into(), deviation[i])).sum::<f64>()
        })
        .sum();
    sum / (MOVE * held_out.len().max(1)) as f64
}

/// Negative log density of N(0, deviation^2) at `off`, nats.
fn nats(off: f64, deviation: f64) -> f64 {
    0.5 * (off / deviation).powi(2) + deviation.ln() + 0.5 * std::f64::consts::TAU.ln()
}
