//! Optimisers that minimise a [`Problem`] over a vector of numbers. They know nothing of bodies.
//!
//! [`LevenbergMarquardt`] uses normal equations; the problem renews their robust weights at each
//! linearisation (IRLS). [`Lbfgs`] uses gradients alone. Both stop with a [`Termination`] that
//! holds the measured values.

mod block_banded;
mod cholesky;
mod lbfgs;
mod lm;
mod normal_equations;
mod termination;

use serde::{Deserialize, Serialize};

pub use block_banded::BlockBanded;
pub use cholesky::Cholesky;
pub use lbfgs::Lbfgs;
pub use lm::LevenbergMarquardt;
pub use normal_equations::{Layout, NormalEquations};
pub use termination::{Summary, Termination};

/// A cost of some unknowns.
pub trait Problem {
    /// The block structure of the unknowns.
    fn layout(&self) -> Layout;

    /// The cost at `x`.
    fn cost(&mut self, x: &[f64]) -> f64;

    /// The cost at `x`; overwrites `normal` with the gradient and a Gauss-Newton approximation of
    /// the Hessian.
    fn linearise(&mut self, x: &[f64], equations: &mut NormalEquations) -> f64;

    /// The cost at `x`, with its gradient alone.
    fn gradient(&mut self, x: &[f64], gradient: &mut [f64]) -> f64;
}

/// Which optimiser to use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OptimiserKind {
    /// Levenberg-Marquardt with IRLS.
    #[default]
    LevenbergMarquardt,
    /// L-BFGS with a strong Wolfe line search, as in the paper.
    Lbfgs,
}

/// An optimiser. It keeps its memory between calls.
pub trait Optimiser: Send {
    /// Minimises from `x`, in place, in at most `iterations` iterations.
    fn minimise(&mut self, problem: &mut dyn Problem, x: &mut [f64], iterations: usize) -> Summary;

    /// A diagonal block of the inverse of the Hessian near the last minimum, row-major; `None` if the
    /// optimiser has no Hessian.
    fn inverse_block(&self, _block: usize) -> Option<Vec<f32>> {
        None
    }
}

impl OptimiserKind {
    /// An optimiser of a kind that stops if a step lowers the cost by less than `change_threshold`
    /// of it.
    pub fn optimiser(self, change_threshold: f64) -> Box<dyn Optimiser> {
        match self {
            Self::LevenbergMarquardt => Box::new(LevenbergMarquardt::new(change_threshold)),
            Self::Lbfgs => Box::new(Lbfgs { change_threshold, ..Lbfgs::default() }),
        }
    }
}
