//! What a path tells of the body's coefficients, whatever its keyframes are.

use nalgebra::{DMatrix, DVector};

use super::path::PathProblem;
use crate::solve::{Normal, Problem};

/// The quadratic model of the cost by some coefficients of the body when the keyframes follow them:
/// the Schur complement of the keyframes.
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
        let mut normal = Normal::zeros(self.layout());
        self.linearise(x, &mut normal);
        let (total, keyframes) = (x.len(), self.unknowns.body_at());
        let block = normal.hessian.block(0, 0);
        let entry = |i: usize, j: usize| block[i.max(j) * total + i.min(j)];
        let first = total - count;
        let within = DMatrix::from_fn(keyframes, keyframes, entry);
        let across = DMatrix::from_fn(keyframes, count, |i, j| entry(i, first + j));
        let own = DMatrix::from_fn(count, count, |i, j| entry(first + i, first + j));
        let gradient = DVector::from_column_slice(&normal.gradient);
        let factor = within.cholesky()?;
        // A^T H^-1 A = B^T B with B = L^-1 A.
        let half = factor.l_dirty().solve_lower_triangular(&across)?;
        let moved = factor.solve(&gradient.rows(0, keyframes).into_owned());
        Some(Marginal {
            hessian: own - half.tr_mul(&half),
            gradient: gradient.rows(first, count) - across.tr_mul(&moved),
        })
    }
}
