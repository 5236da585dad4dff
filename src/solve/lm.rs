//! Levenberg-Marquardt with the nonlinear gain ratio \[Nielsen 1999\].

use nalgebra::{Cholesky, DMatrix, DVector};

use super::{Optimiser, Problem, Summary, Termination};

/// Levenberg-Marquardt: solves (H + mu D) step = -g with D the diagonal of H, and accepts a step
/// when the cost really falls, however the model predicted it.
#[derive(Clone, Debug)]
pub struct LevenbergMarquardt {
    /// First damping, relative to the diagonal.
    pub initial_damping: f64,
    /// Stop when an accepted step lowers the cost by less than this part of it.
    pub change_threshold: f64,
    /// Stop when no entry of the gradient exceeds this.
    pub gradient_threshold: f64,
    hessian: Vec<f64>,
    gradient: DVector<f64>,
    damped: DMatrix<f64>,
    step: DVector<f64>,
    trial: Vec<f64>,
}

/// Damping above which no step is tried any more.
pub(super) const MAX_DAMPING: f64 = 1e12;
/// Keeps the damped diagonal positive where the Hessian's is zero.
pub(super) const MIN_DIAGONAL: f64 = 1e-9;

/// What the damping is multiplied by after a step that lowered the cost by `gain` times what the
/// model predicted.
pub(super) fn next_damping(gain: f64) -> f64 {
    (1.0 - (2.0 * gain - 1.0).powi(3)).clamp(1.0 / 10.0, 2.0)
}

impl Default for LevenbergMarquardt {
    fn default() -> Self {
        Self {
            initial_damping: 1e-3,
            change_threshold: 1e-4,
            gradient_threshold: 1e-6,
            hessian: Vec::new(),
            gradient: DVector::zeros(0),
            damped: DMatrix::zeros(0, 0),
            step: DVector::zeros(0),
            trial: Vec::new(),
        }
    }
}

impl LevenbergMarquardt {
    /// Stops when an accepted step lowers the cost by less than this part of it.
    pub fn new(change_threshold: f64) -> Self {
        Self { change_threshold, ..Self::default() }
    }

    fn reserve(&mut self, n: usize) {
        if self.trial.len() != n {
            self.hessian = vec![0.0; n * n];
            self.gradient = DVector::zeros(n);
            self.damped = DMatrix::zeros(n, n);
            self.step = DVector::zeros(n);
            self.trial = vec![0.0; n];
        }
    }

    /// Solves for the step; the decrease that the model predicts, or `None` where the damped
    /// Hessian is not positive definite.
    fn damped_step(&mut self, damping: f64) -> Option<f64> {
        let n = self.trial.len();
        self.damped.copy_from_slice(&self.hessian);
        for i in 0..n {
            self.damped[(i, i)] += damping * self.hessian[i * n + i].max(MIN_DIAGONAL);
        }
        let matrix = std::mem::replace(&mut self.damped, DMatrix::zeros(0, 0));
        self.step.copy_from(&self.gradient);
        self.step.neg_mut();
        // The factorisation works in place and hands the memory back; on failure it is made anew.
        let Some(factor) = Cholesky::new(matrix) else {
            self.damped = DMatrix::zeros(n, n);
            return None;
        };
        factor.solve_mut(&mut self.step);
        self.damped = factor.unpack_dirty();
        // With H step = -g - mu D step, the decrease is 1/2 step . (mu D step - g).
        let decrease = (0..n).map(|i| {
            let diagonal = self.hessian[i * n + i].max(MIN_DIAGONAL);
            0.5 * self.step[i] * (damping * diagonal * self.step[i] - self.gradient[i])
        });
        Some(decrease.sum())
    }
}

impl Optimiser for LevenbergMarquardt {
    fn minimise(&mut self, problem: &mut dyn Problem, x: &mut [f64], iterations: usize) -> Summary {
        self.reserve(problem.dimension());
        let linearise = |this: &mut Self, problem: &mut dyn Problem, x: &[f64]| {
            problem.linearise(x, this.gradient.as_mut_slice(), &mut this.hessian)
        };
        let mut cost = linearise(self, problem, x);
        let mut summary = Summary::at_start(cost, iterations);
        if !cost.is_finite() {
            return Summary { termination: Termination::NotFinite, ..summary };
        }
        let (mut damping, mut growth) = (self.initial_damping, 2.0);
        while summary.iterations < iterations {
            let steepest = self.gradient.amax();
            if steepest <= self.gradient_threshold {
                summary.termination = Termination::SmallGradient {
                    value: steepest,
                    threshold: self.gradient_threshold,
                };
                break;
            }
            summary.iterations += 1;
            let predicted = self.damped_step(damping);
            self.trial.iter_mut().zip(&*x).zip(&self.step).for_each(|((t, x), s)| *t = x + s);
            let trial_cost = predicted.map_or(f64::INFINITY, |_| {
                summary.evaluations += 1;
                problem.cost(&self.trial)
            });
            if trial_cost < cost {
                let gain = (cost - trial_cost) / predicted.unwrap_or(f64::INFINITY);
                damping *= next_damping(gain);
                growth = 2.0;
                let change = (cost - trial_cost) / cost.max(f64::MIN_POSITIVE);
                cost = trial_cost;
                x.copy_from_slice(&self.trial);
                if change < self.change_threshold {
                    summary.termination = Termination::SmallChange {
                        value: change,
                        threshold: self.change_threshold,
                    };
                    break;
                }
                if summary.iterations < iterations {
                    summary.evaluations += 1;
                    linearise(self, problem, x);
                }
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
