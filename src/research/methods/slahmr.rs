//! SLAHMR: all frames at once in stages, the last with a motion prior \[Ye 2023\].
//!
//! Stages, starting from the per-frame solutions:
//! 1. roots alone, with the data term;
//! 2. all unknowns, with 1/2 smoothness |P_j(t + 1) - P_j(t)|^2 over joints added;
//! 3. all unknowns, with -ln p of each frame given the two before it added,
//!    1/2 transition |(move - mean) / deviation|^2, from `crate::research::transition::Transition`.
//!    The deviations are predicted from the path at the start of a round and fixed during it.
//!
//! Differences: a Gaussian model of accelerations, trained on the same clips as the manifold,
//! replaces HuMoR. The publication solves for a first state and the latent transitions of HuMoR and
//! rolls out the path from them; here every frame is an unknown and a transition is a term. The
//! publication extends the horizon in chunks; here all frames are solved at once. It uses one
//! moving camera of unknown scale; ours are several and calibrated. It finds the ground and
//! contacts and penalises skating and feet above the ground; we do not, because our model, unlike
//! HuMoR, does not know contacts. All methods here share body, manifold, data term and optimiser.

use serde::{Deserialize, Serialize};

use super::joints::UNKNOWNS;
use super::muvs::{MuVsWeights, PerFrame};
use super::path::{State, Term};
use super::terms::JointSteps;
use super::{Delay, Method, Solved, Take};
use crate::core::body::fitted_points;
use crate::core::cost::{self, Scene};
use crate::core::manifold::{Decoder, Keyframe, LATENT};
use crate::core::optimise::NormalEquations;
use crate::core::so3;
use crate::research::transition::{MOVE, Move, THREE, Transition, TransitionWork, state_of};

/// Weights of [`Slahmr`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SlahmrWeights {
    /// Weight of |z|^2 in each frame, square pixels.
    pub prior: f64,
    /// Scale of the Geman-McClure loss, pixels.
    pub scale_px: f64,
    /// Weight of joint displacements in the second stage, square pixels per square metre.
    pub smoothness: f64,
    /// The same in the third stage.
    pub last_smoothness: f64,
    /// Weight of -ln p of a transition in the third stage, square pixels per nat.
    pub transition: f64,
    /// Maximum iterations of the first stage, of the second, and of each round of the third.
    pub iterations: [usize; 3],
    /// Rounds of the third stage.
    pub rounds: usize,
}

impl Default for SlahmrWeights {
    fn default() -> Self {
        Self {
            prior: 30.0,
            scale_px: 60.0,
            smoothness: 1e5,
            last_smoothness: 0.0,
            transition: 300.0,
            iterations: [30, 60, 20],
            rounds: 3,
        }
    }
}

/// All frames at once in stages, the last with a motion prior.
#[derive(Clone, Debug)]
pub struct Slahmr {
    weights: SlahmrWeights,
    transition: Transition,
}

impl Slahmr {
    /// The method with the given weights and motion prior.
    pub fn new(weights: SlahmrWeights, transition: Transition) -> Self {
        Self { weights, transition }
    }

    /// Runs the three stages, starting from the per-frame solutions.
    fn stages(&self, found: &PerFrame, scene: Scene, fps: f64) -> Vec<Keyframe> {
        let weights = &self.weights;
        let [roots, smooth, last] = weights.iterations;
        let steps = |weight: f64| -> Box<dyn Term> { Box::new(JointSteps { weight }) };
        let seen = &found.observations[..];
        let start = (seen, &found.keyframes[..]);
        // First only the roots.
        let keyframes = found.minimised(scene, start, &[], [false, true], roots);
        let terms = [steps(weights.smoothness)];
        let mut keyframes = found.minimised(scene, (seen, &keyframes), &terms, [true; 2], smooth);
        for _ in 0..weights.rounds {
            let prior =
                Transitions::at(&self.transition, &keyframes, fps.recip(), weights.transition);
            let terms: [Box<dyn Term>; 2] = [Box::new(prior), steps(weights.last_smoothness)];
            keyframes = found.minimised(scene, (seen, &keyframes), &terms, [true; 2], last);
        }
        keyframes
    }
}

impl Method for Slahmr {
    fn name(&self) -> String {
        "SLAHMR-like".to_owned()
    }

    fn delay(&self, _: f64) -> Delay {
        Delay::Recording
    }

    /// Also `None` if the motion prior was trained on the codes of another manifold.
    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        if !self.transition.fits(decoder) {
            return None;
        }
        let SlahmrWeights { prior, scale_px, .. } = self.weights;
        let found = PerFrame::solve(take, decoder, &MuVsWeights::default())?;
        let cost = cost::Config { prior, scale_px, ..found.config.cost };
        let points = fitted_points(take.format);
        let scene = Scene { decoder, rig: &take.rig, points: &points, config: &cost };
        let keyframes = self.stages(&found, scene, take.fps);
        Some(Solved { borders: Vec::new(), ..found.solved(decoder, &keyframes, 1) })
    }
}

/// 1/2 weight |(move - mean) / deviation|^2 over transitions, with fixed deviations.
struct Transitions<'a> {
    model: &'a Transition,
    weight: f64,
    /// Frame period, seconds.
    step: f64,
    /// The standard deviations of each transition.
    deviations: Vec<Move>,
}

impl<'a> Transitions<'a> {
    /// The term with the deviations that the model predicts along `keyframes`.
    fn at(model: &'a Transition, keyframes: &[Keyframe], step: f64, weight: f64) -> Self {
        let mut work = TransitionWork::default();
        let mut deviation =
            |three: &[Keyframe]| model.predict(&state_of(&three[0], &three[1], step), &mut work).1;
        let deviations = keyframes.windows(3).map(&mut deviation).collect();
        Self { model, weight, step, deviations }
    }
}

impl Term for Transitions<'_> {
    fn reach(&self) -> usize {
        2
    }

    fn cost(&self, state: &State) -> f64 {
        let mut work = TransitionWork::default();
        let transitions = state.keyframes.windows(3).zip(&self.deviations);
        let square = |(three, deviation): (&[Keyframe], &Move)| {
            let three = [&three[0], &three[1], &three[2]];
            let residual = self.model.residual(three, self.step, deviation, &mut work);
            residual.iter().map(|r| r * r).sum::<f64>()
        };
        0.5 * self.weight * transitions.map(square).sum::<f64>()
    }

    fn add(&self, state: &State, equations: &mut NormalEquations) {
        let mut work = TransitionWork::default();
        let mut tangent = vec![0.0; MOVE * THREE];
        let mut blocks = vec![vec![0.0; MOVE * UNKNOWNS]; 3];
        let transitions = state.keyframes.windows(3).zip(&self.deviations);
        for (frame, (three, deviation)) in transitions.enumerate() {
            let three = [&three[0], &three[1], &three[2]];
            let (model, step) = (self.model, self.step);
            let residual =
                model.residual_with_tangent(three, step, deviation, &mut work, &mut tangent);
            for (k, block) in blocks.iter_mut().enumerate() {
                let turn = so3::left_jacobian(&state.turns[frame + k]);
                for (row, whole) in
                    block.chunks_exact_mut(UNKNOWNS).zip(tangent.chunks_exact(THREE))
                {
                    row.copy_from_slice(&whole[k * UNKNOWNS..(k + 1) * UNKNOWNS]);
                    let by_turn = nalgebra::Vector3::from_column_slice(&row[LATENT..LATENT + 3]);
                    row[LATENT..LATENT + 3].copy_from_slice(turn.tr_mul(&by_turn).as_slice());
                }
            }
            let by = [0, 1, 2].map(|k| (frame + k, &blocks[k][..]));
            equations.add(self.weight, &residual, &by);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::joints::Joints;
    use super::*;
    use crate::core::manifold::Correction;
    use crate::core::optimise::Layout;
    use nalgebra::Vector3;

    const FRAMES: usize = 4;

    /// A moving path at the unknowns `x`, relative to its initial rotations.
    fn state(x: &[f64]) -> State {
        let turns: Vec<_> = x
            .chunks_exact(UNKNOWNS)
            .map(|x| Vector3::from_column_slice(&x[LATENT..LATENT + 3]))
            .collect();
        let keyframe = |(k, x): (usize, &[f64])| Keyframe {
            z: std::array::from_fn(|i| x[i]),
            root_rotation: so3::exp(&turns[k]) * so3::exp(&Vector3::new(0.1, 0.1 * k as f64, 0.3)),
            root_position: Vector3::from_column_slice(&x[LATENT + 3..]),
            correction: Correction::default(),
        };
        let keyframes = x.chunks_exact(UNKNOWNS).enumerate().map(keyframe).collect();
        State { keyframes, turns, joints: Joints::default() }
    }

    #[test]
    fn the_gradient_of_transitions_agrees_with_central_differences() {
        let model = Transition::embedded().unwrap();
        let x: Vec<f64> = (0..FRAMES * UNKNOWNS).map(|i| 0.3 * (1.7 * i as f64).sin()).collect();
        let term = Transitions::at(&model, &state(&x).keyframes, 0.02, 3.0);
        let mut equations = NormalEquations::zeros(Layout {
            size: UNKNOWNS,
            blocks: FRAMES,
            bandwidth: term.reach(),
        });
        term.add(&state(&x), &mut equations);
        let largest = equations.gradient.iter().fold(0.0_f64, |most, g| most.max(g.abs()));
        for i in 0..x.len() {
            let cost = |by: f64| {
                let mut moved = x.clone();
                moved[i] += by;
                term.cost(&state(&moved))
            };
            let numeric = (cost(1e-5) - cost(-1e-5)) / 2e-5;
            let off = (equations.gradient[i] - numeric).abs();
            assert!(off < 1e-5 * largest, "{i}: {} {numeric}", equations.gradient[i]);
        }
    }
}
