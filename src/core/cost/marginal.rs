//! The cost by the body's coefficients, with the keyframes eliminated.

use nalgebra::{DMatrix, DVector};

use super::path::PathProblem;
use crate::core::linalg;
use crate::core::optimise::{NormalEquations, Problem};

/// The quadratic model of the cost by some coefficients of the body, with the keyframes at their minimum
/// for each value: the Schur complement of the keyframes.
#[derive(Clone, Debug, PartialEq)]
pub struct Marginal {
    /// Coefficients x coefficients, symmetric; square pixels by their units.
    pub hessian: DMatrix<f64>,
    /// By the coefficients, at those that the path has.
    pub gradient: DVector<f64>,
}

impl Marginal {
    /// The model with `by` times the information.
    pub fn scaled(self, by: f64) -> Self {
        Self { hessian: self.hessian * by, gradient: self.gradient * by }
    }
}

impl PathProblem<'_> {
    /// The model about `x` by the last `count` coefficients of a free body, its others held; `None`
    /// where the keyframes are not determined.
    pub fn marginal(&mut self, x: &[f64], count: usize) -> Option<Marginal> {
        let mut equations = NormalEquations::zeros(self.layout());
        self.linearise(x, &mut equations);
        let (total, keyframes) = (x.len(), self.unknowns.body_at());
        // The keyframes, the coefficients, and the gradient as one more row: factorising the first
        // leaves the Schur complement in place of the rest. Column-major, the lower half.
        let place = |i: usize| if i < keyframes { i } else { i - keyframes + total - count };
        let rows = keyframes + count + 1;
        let mut lower = vec![0.0; rows * rows];
        for (j, column) in lower.chunks_exact_mut(rows).take(rows - 1).enumerate() {
            for (i, entry) in column[..rows - 1].iter_mut().enumerate().skip(j) {
                *entry = equations.hessian.entry(place(i), place(j));
            }
            column[rows - 1] = equations.gradient[place(j)];
        }
        linalg::factor_block([keyframes, count + 1], rows, &mut lower)?;
        let left = |i: usize, j: usize| lower[keyframes + i + (keyframes + j) * rows];
        Some(Marginal {
            hessian: DMatrix::from_fn(count, count, |i, j| left(i.max(j), i.min(j))),
            gradient: DVector::from_fn(count, |j, _| left(count, j)),
        })
    }
}
