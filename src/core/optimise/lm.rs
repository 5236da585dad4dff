//! Levenberg-Marquardt with the nonlinear gain ratio \[Nielsen 1999\], over banded normal
//! equations: the time of a step is linear in the number of blocks. If the cost changes little from
//! step to step, so does its Hessian: then a step reuses the last factor with the new gradient (a
//! chord step), which takes a fraction of the time and converges to the same minimum.

use super::{Cholesky, NormalEquations, Optimiser, Problem, Summary, Termination};

/// Levenberg-Marquardt: solves (H + mu D) step = -g, D the diagonal of H, and accepts a step if the
/// cost falls, whatever the model predicted.
#[derive(Clone, Debug)]
pub struct LevenbergMarquardt {
    /// First damping, relative to the diagonal.
    pub initial_damping: f64,
    /// Stop if an accepted step lowers the cost by less than this fraction of it.
    pub change_threshold: f64,
    /// Stop if no entry of the gradient exceeds this.
    pub gradient_threshold: f64,
    memory: Option<Memory>,
}

/// Above this damping no step is tried any more.
const MAX_DAMPING: f64 = 1e12;
/// A chord step follows only if the last step lowered the cost by less than this part of it.
const CHORD_CHANGE: f64 = 0.5;
/// It also needs a real gain above this part of the predicted one.
const CHORD_GAIN: f64 = 0.5;
/// Keeps the damped diagonal positive where that of the Hessian is zero.
const MIN_DIAGONAL: f64 = 1e-9;

/// Memory of a solve, reused for the next one of the same layout.
#[derive(Clone, Debug)]
struct Memory {
    equations: NormalEquations,
    /// Factor of the damped Hessian.
    factor: Cholesky,
    /// Whether the factor is of the last problem.
    has_factor: bool,
    /// Damping of the factor.
    damping: f64,
    step: Vec<f64>,
    trial: Vec<f64>,
}

impl Default for LevenbergMarquardt {
    fn default() -> Self {
        let (change_threshold, gradient_threshold) = (1e-4, 1e-6);
        Self { initial_damping: 1e-3, change_threshold, gradient_threshold, memory: None }
    }
}

impl LevenbergMarquardt {
    /// Stops if an accepted step lowers the cost by less than this fraction of it.
    pub fn new(change_threshold: f64) -> Self {
        Self { change_threshold, ..Self::default() }
    }
}

impl Memory {
    fn of(problem: &dyn Problem) -> Self {
        let equations = NormalEquations::zeros(problem.layout());
        let n = equations.gradient.len();
        let factor = Cholesky::like(&equations.hessian);
        let [step, trial] = [0; 2].map(|_| vec![0.0; n]);
        Self { factor, has_factor: false, damping: 0.0, equations, step, trial }
    }

    /// Factorises the damped Hessian; `None` if it is not positive definite.
    fn factorise(&mut self, damping: f64) -> Option<()> {
        let Self { equations, factor, .. } = self;
        self.damping = damping;
        let made = factor.factorise(&equations.hessian, |i| damping * scale(equations, i));
        self.has_factor = made.is_some();
        made.map(|_| ())
    }

    /// Solves for the step; returns the predicted decrease.
    fn solve(&mut self) -> f64 {
        let Self { equations, factor, damping, step, .. } = self;
        step.iter_mut().zip(&equations.gradient).for_each(|(step, g)| *step = -g);
        factor.solve(step);
        // Since H step = -g - mu D step, the decrease is 1/2 step . (mu D step - g).
        let decrease = step.iter().zip(&equations.gradient).enumerate();
        decrease.map(|(i, (s, g))| 0.5 * s * (*damping * scale(equations, i) * s - g)).sum()
    }
}

/// Entry i of D.
fn scale(equations: &NormalEquations, i: usize) -> f64 {
    equations.hessian.diagonal(i).max(MIN_DIAGONAL)
}

impl Optimiser for LevenbergMarquardt {
    fn minimise(&mut self, problem: &mut dyn Problem, x: &mut [f64], iterations: usize) -> Summary {
        let fits = |memory: &Memory| memory.equations.layout() == problem.layout();
        let mut memory = self.memory.take().filter(fits).unwrap_or_else(|| Memory::of(problem));
        memory.has_factor = false;
        let summary = self.descend(problem, x, iterations, &mut memory);
        self.memory = Some(memory);
        summary
    }

    /// From the last factor, whose damping is small after a successful step.
    fn inverse_block(&self, block: usize) -> Option<Vec<f32>> {
        let memory = self.memory.as_ref().filter(|memory| memory.has_factor)?;
        Some(memory.factor.inverse_block(block))
    }
}

impl LevenbergMarquardt {
    fn descend(
        &self,
        problem: &mut dyn Problem,
        x: &mut [f64],
        iterations: usize,
        memory: &mut Memory,
    ) -> Summary {
        let mut cost = problem.linearise(x, &mut memory.equations);
        let mut summary = Summary::at_start(cost, iterations);
        if !cost.is_finite() {
            return Summary { termination: Termination::NotFinite, ..summary };
        }
        let (mut damping, mut growth, mut is_chord) = (self.initial_damping, 2.0, false);
        while summary.iterations < iterations {
            let gradient = &memory.equations.gradient;
            let value = gradient.iter().fold(0.0_f64, |most, g| most.max(g.abs()));
            let threshold = self.gradient_threshold;
            if value <= threshold {
                summary.termination = Termination::SmallGradient { value, threshold };
                break;
            }
            summary.iterations += 1;
            let solvable = is_chord || memory.factorise(damping).is_some();
            let predicted = solvable.then(|| memory.solve());
            let Memory { step, trial, .. } = &mut *memory;
            trial.iter_mut().zip(&*x).zip(&*step).for_each(|((t, x), s)| *t = x + s);
            let trial_cost = predicted.map_or(f64::INFINITY, |_| {
                summary.evaluations += 1;
                problem.cost(trial)
            });
            if trial_cost < cost {
                let gain = (cost - trial_cost) / predicted.unwrap_or(f64::INFINITY);
                if !is_chord {
                    damping *= next_damping(gain);
                    growth = 2.0;
                }
                let value = (cost - trial_cost) / cost.max(f64::MIN_POSITIVE);
                cost = trial_cost;
                x.copy_from_slice(trial);
                let threshold = self.change_threshold;
                if value < threshold {
                    summary.termination = Termination::SmallChange { value, threshold };
                    break;
                }
                if summary.iterations < iterations {
                    summary.evaluations += 1;
                    is_chord = value < CHORD_CHANGE && gain > CHORD_GAIN;
                    match is_chord {
                        true => problem.gradient(x, &mut memory.equations.gradient),
                        false => problem.linearise(x, &mut memory.equations),
                    };
                }
            } else if is_chord {
                summary.evaluations += 1;
                is_chord = false;
                problem.linearise(x, &mut memory.equations);
            } else {
                damping *= growth;
                growth *= 2.0;
                if damping > MAX_DAMPING {
                    summary.termination = Termination::NoDescent { value: damping };
                    break;
                }
            }
        }
        Summary { final_cost: cost, ..summary }
    }
}

/// Factor of the damping after a step that lowered the cost by `gain` times the prediction.
fn next_damping(gain: f64) -> f64 {
    (1.0 - (2.0 * gain - 1.0).powi(3)).clamp(1.0 / 10.0, 2.0)
}
