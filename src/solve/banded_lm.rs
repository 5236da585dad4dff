//! Levenberg-Marquardt over banded normal equations: the algorithm of [`super::lm`], with a
//! factorisation whose time is linear in the number of blocks.

use super::banded::Banded;
use super::lm::{MAX_DAMPING, MIN_DIAGONAL, next_damping};
use super::{LevenbergMarquardt, Summary, Termination};

/// A cost whose unknowns come in equal blocks, of which only near ones share a term.
pub trait BandedProblem {
    /// Zero normal equations of the right size.
    fn normal(&self) -> Normal;

    /// The cost at `x`.
    fn cost(&mut self, x: &[f64]) -> f64;

    /// The cost at `x`; its gradient and a Gauss-Newton approximation of its Hessian go to
    /// `normal`, which is overwritten.
    fn linearise(&mut self, x: &[f64], normal: &mut Normal) -> f64;
}

/// Normal equations.
#[derive(Clone, Debug, PartialEq)]
pub struct Normal {
    /// The gradient.
    pub gradient: Vec<f64>,
    /// The approximate Hessian.
    pub hessian: Banded,
}

impl Normal {
    /// All zero, for `blocks` blocks of `size` unknowns.
    pub fn zeros(size: usize, blocks: usize, bandwidth: usize) -> Self {
        let hessian = Banded::zeros(size, blocks, bandwidth);
        Self { gradient: vec![0.0; size * blocks], hessian }
    }

    /// Sets everything to zero.
    pub fn clear(&mut self) {
        self.gradient.fill(0.0);
        self.hessian.clear();
    }

    /// Adds the term 1/2 weight |r|^2 of a residual that depends on some blocks: gives each block's
    /// number with its Jacobian, row-major, as many rows as `residual` has. Blocks are in
    /// ascending order and lie within the bandwidth.
    pub fn add(&mut self, weight: f64, residual: &[f64], by: &[(usize, &[f64])]) {
        let size = self.hessian.size();
        for (i, &(row, left)) in by.iter().enumerate() {
            let gradient = &mut self.gradient[row * size..(row + 1) * size];
            for (jacobian, r) in left.chunks_exact(size).zip(residual) {
                gradient.iter_mut().zip(jacobian).for_each(|(g, j)| *g += weight * r * j);
            }
            for &(column, right) in &by[..=i] {
                let block = self.hessian.block_mut(row, column);
                for (a, b) in left.chunks_exact(size).zip(right.chunks_exact(size)) {
                    for (a, out) in a.iter().zip(block.chunks_exact_mut(size)) {
                        let a = weight * a;
                        if a != 0.0 {
                            out.iter_mut().zip(b).for_each(|(out, b)| *out += a * b);
                        }
                    }
                }
            }
        }
    }

    /// Keeps unknown i where it is.
    pub fn pin(&mut self, i: usize) {
        self.gradient[i] = 0.0;
        self.hessian.pin(i);
    }
}

impl LevenbergMarquardt {
    /// Minimises a banded problem from `x`, in place, in at most `iterations` iterations.
    pub fn minimise_banded(
        &self,
        problem: &mut dyn BandedProblem,
        x: &mut [f64],
        iterations: usize,
    ) -> Summary {
        let mut normal = problem.normal();
        let mut factor = normal.hessian.clone();
        let mut cost = problem.linearise(x, &mut normal);
        let mut summary = Summary::at_start(cost, iterations);
        if !cost.is_finite() {
            return Summary { termination: Termination::NotFinite, ..summary };
        }
        let (mut damping, mut growth) = (self.initial_damping, 2.0);
        while summary.iterations < iterations {
            let steepest = normal.gradient.iter().fold(0.0_f64, |most, g| most.max(g.abs()));
            let threshold = self.gradient_threshold;
            if steepest <= threshold {
                summary.termination = Termination::SmallGradient { value: steepest, threshold };
                break;
            }
            summary.iterations += 1;
            factor.clone_from(&normal.hessian);
            let step = damped_step(&mut factor, &normal, damping);
            let trial = step.as_ref().map(|(step, _)| {
                let trial: Vec<f64> = x.iter().zip(step).map(|(x, s)| x + s).collect();
                summary.evaluations += 1;
                (problem.cost(&trial), trial)
            });
            match (trial, step) {
                (Some((lower, trial)), Some((_, predicted))) if lower < cost => {
                    damping *= next_damping((cost - lower) / predicted);
                    growth = 2.0;
                    let value = (cost - lower) / cost.max(f64::MIN_POSITIVE);
                    cost = lower;
                    x.copy_from_slice(&trial);
                    let threshold = self.change_threshold;
                    if value < threshold {
                        summary.termination = Termination::SmallChange { value, threshold };
                        break;
                    }
                    if summary.iterations < iterations {
                        summary.evaluations += 1;
                        problem.linearise(x, &mut normal);
                    }
                }
                _ => {
                    damping *= growth;
                    growth *= 2.0;
                    if damping > MAX_DAMPING {
                        summary.termination = Termination::NoDescent { value: damping };
                        break;
                    }
                }
            }
        }
        Summary { final_cost: cost, ..summary }
    }
}

/// The step, and the decrease of the cost that the model predicts.
fn damped_step(factor: &mut Banded, normal: &Normal, damping: f64) -> Option<(Vec<f64>, f64)> {
    let damped = |i: usize| damping * normal.hessian.diagonal(i).max(MIN_DIAGONAL);
    (0..normal.gradient.len()).for_each(|i| factor.add_to_diagonal(i, damped(i)));
    factor.factorise()?;
    let mut step: Vec<f64> = normal.gradient.iter().map(|g| -g).collect();
    factor.solve_factorised(&mut step);
    let decrease = step.iter().zip(&normal.gradient).enumerate();
    let decrease = decrease.map(|(i, (s, g))| 0.5 * s * (damped(i) * s - g)).sum();
    Some((step, decrease))
}
