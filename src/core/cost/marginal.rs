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

impl PathProblem<'_> {
    /// The model about `x` by the last `count` coefficients of a free body, its others held; `None`
    /// where the keyframes are not determined.
    pub fn marginal(&mut self, x: &[f64], count: usize) -> Option<Marginal> {
        let mut equations = NormalEquations::zeros(self.layout());
        self.linearise(x, &mut equations);
        let (total, keyframes) = (x.len(), self.unknowns.body_at());
        let entry = |i: usize, j: usize| equations.hessian.entry(i, j);
        let first = total - count;
        let within: Vec<f64> =
            (0..keyframes).flat_map(|i| (0..keyframes).map(move |j| entry(i, j))).collect();
        // The coefficients' columns, then the gradient.
        let across = DMatrix::from_fn(keyframes, count + 1, |i, j| {
            if j < count { entry(i, first + j) } else { equations.gradient[i] }
        });
        let rows = across.transpose();
        let moved = linalg::solve_symmetric(keyframes, &within, count + 1, rows.as_slice())?;
        let moved = DMatrix::from_row_slice(keyframes, count + 1, &moved);
        let taken = across.columns(0, count).tr_mul(&moved);
        Some(Marginal {
            hessian: DMatrix::from_fn(count, count, |i, j| {
                entry(first + i, first + j) - taken[(i, j)]
            }),
            gradient: DVector::from_fn(count, |i, _| {
                equations.gradient[first + i] - taken[(i, count)]
            }),
        })
    }
}
