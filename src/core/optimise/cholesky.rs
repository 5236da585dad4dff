//! Cholesky factors of banded matrices: time and memory are linear in the number of blocks. In f32: for
//! a step that is tried before it is taken, six digits will do.

use super::block_banded::BlockBanded;
use crate::core::linalg;

/// A lower triangular L with L L^T = A, for a positive definite [`BlockBanded`] A.
#[derive(Clone, Debug)]
pub struct Cholesky {
    lower: BlockBanded<f32>,
}

impl Cholesky {
    /// Memory for factors of matrices that are laid out as `matrix` is.
    pub fn like(matrix: &BlockBanded) -> Self {
        Self { lower: BlockBanded::zeros(matrix.size(), matrix.blocks(), matrix.bandwidth()) }
    }

    /// Factorises A + diag(`damping`); gives a measure of the work, or `None` where that is not
    /// positive definite.
    pub fn factorise(
        &mut self,
        matrix: &BlockBanded,
        damping: impl Fn(usize) -> f64,
    ) -> Option<usize> {
        let Self { lower } = self;
        lower.round_from(matrix);
        (0..lower.dimension()).for_each(|i| lower.add_to_diagonal(i, damping(i) as f32));
        let (n, stride) = (lower.size(), lower.stride());
        let mut products = 0;
        for block in 0..lower.blocks() {
            let rows = lower.end(block * n) - block * n;
            linalg::factor_block([n, rows - n], stride, lower.tail_mut(block))?;
            products += n * rows * rows;
        }
        Some(products)
    }

    /// Solves A x = b in place, once [`Cholesky::factorise`] has made L.
    pub fn solve(&self, x: &mut [f64]) {
        let column = |j: usize| self.lower.column(j..self.lower.end(j), j);
        for j in 0..self.lower.dimension() {
            let l = column(j);
            x[j] /= f64::from(l[0]);
            linalg::axpy(-x[j], &l[1..], &mut x[j + 1..]);
        }
        for j in (0..self.lower.dimension()).rev() {
            let l = column(j);
            x[j] = (x[j] - linalg::dot(&l[1..], &x[j + 1..])) / f64::from(l[0]);
        }
    }

    /// A diagonal block of the inverse of A, row-major: for a Hessian, the covariance of the unknowns of
    /// that block.
    pub fn inverse_block(&self, block: usize) -> Vec<f32> {
        let n = self.lower.size();
        let (first, end) = (block * n, self.lower.dimension());
        // L^-1 of the block's columns of the identity, row-major.
        let mut solved = vec![0.0_f32; (end - first) * n];
        (0..n).for_each(|i| solved[i * n + i] = 1.0);
        for j in first..end {
            let l = self.lower.column(j..self.lower.end(j), j);
            let (done, below) = solved.split_at_mut((j - first + 1) * n);
            let row = &mut done[(j - first) * n..];
            row.iter_mut().for_each(|x| *x /= l[0]);
            for (l, below) in l[1..].iter().zip(below.chunks_exact_mut(n)) {
                below.iter_mut().zip(&*row).for_each(|(x, y)| *x -= l * y);
            }
        }
        let mut inverse = vec![0.0; n * n];
        linalg::gram([end - first, n], &solved, &mut inverse);
        inverse
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    /// A positive definite matrix with entries from a wave, and the same dense.
    fn sample(size: usize, blocks: usize, bandwidth: usize) -> (BlockBanded, DMatrix<f64>) {
        let mut banded = BlockBanded::zeros(size, blocks, bandwidth);
        let mut dense = DMatrix::zeros(size * blocks, size * blocks);
        for column in 0..size * blocks {
            for row in column..banded.end(column) {
                let wave = ((row * column + row + column) as f64 * 0.7).sin();
                let value = if row == column { 9.0 * size as f64 } else { wave };
                banded.column_mut(row..row + 1, column)[0] = value;
                dense[(row, column)] = value;
                dense[(column, row)] = value;
            }
        }
        (banded, dense)
    }

    #[test]
    fn the_banded_factor_solves_as_a_dense_one() {
        for (size, blocks, bandwidth) in [(3, 7, 2), (38, 4, 2), (4, 5, 1), (5, 3, 0), (2, 2, 3)] {
            let (mut banded, mut dense) = sample(size, blocks, bandwidth);
            banded.pin(1);
            for i in 0..dense.nrows() {
                (dense[(1, i)], dense[(i, 1)]) = (0.0, 0.0);
            }
            dense[(1, 1)] = 1.0;
            assert_eq!(
                dense,
                DMatrix::from_fn(dense.nrows(), dense.nrows(), |i, j| banded.entry(i, j))
            );
            let damping = |i: usize| 0.1 * i as f64;
            for i in 0..dense.nrows() {
                dense[(i, i)] += damping(i);
            }
            let b = DVector::from_fn(size * blocks, |i, _| (i as f64).cos());
            let dense = dense.cholesky().unwrap();
            let (expected, inverse) = (dense.solve(&b), dense.inverse());
            let mut factor = Cholesky::like(&banded);
            // What an earlier matrix left must not matter.
            for _ in 0..2 {
                factor.factorise(&banded, damping).unwrap();
            }
            let mut x = b.as_slice().to_vec();
            factor.solve(&mut x);
            assert!((DVector::from_vec(x) - expected).amax() < 1e-7);
            for block in 0..blocks {
                let expected = inverse.view((block * size, block * size), (size, size));
                let found = DMatrix::from_row_slice(size, size, &factor.inverse_block(block));
                let off = (found.cast() - expected).amax() / expected.amax();
                assert!(off < 1e-5, "block {block}: {off:.1e}");
            }
        }
    }

    #[test]
    fn the_work_is_linear_in_the_length() {
        let products = |blocks| {
            let (banded, _) = sample(2, blocks, 2);
            Cholesky::like(&banded).factorise(&banded, |_| 0.0).unwrap()
        };
        let (short, long, longer) = (products(10), products(110), products(210));
        assert_eq!(longer - long, long - short);
    }

    #[test]
    fn a_matrix_that_is_not_positive_definite_has_no_factor() {
        let (mut banded, _) = sample(3, 4, 1);
        let mut factor = Cholesky::like(&banded);
        assert_eq!(factor.factorise(&banded, |i| if i == 7 { -100.0 } else { 0.0 }), None);
        banded.add_to_diagonal(4, f64::NAN);
        assert_eq!(factor.factorise(&banded, |_| 0.0), None);
    }
}
