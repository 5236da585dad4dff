//! Cholesky factors of banded matrices: time and memory are linear in the number of blocks.

use super::banded::Banded;
use crate::gemm;

/// A lower triangular L with L L^T = A, for a positive definite [`Banded`] A.
#[derive(Clone, Debug)]
pub struct Cholesky {
    /// Rows of a block.
    size: usize,
    blocks: usize,
    bandwidth: usize,
    /// Column-major: entry (i, j) is at i + j * stride, so a column begins where the band of the one
    /// before ends.
    data: Vec<f64>,
    memory: gemm::Memory,
}

impl Cholesky {
    /// Memory for factors of matrices that are laid out as `matrix` is.
    pub fn like(matrix: &Banded) -> Self {
        let (size, blocks, bandwidth) = (matrix.size(), matrix.blocks(), matrix.bandwidth());
        let data = vec![0.0; size * blocks * (size * (bandwidth + 1) + 1)];
        Self { size, blocks, bandwidth, data, memory: gemm::Memory::of_cholesky(size) }
    }

    /// How many unknowns there are.
    fn dimension(&self) -> usize {
        self.size * self.blocks
    }

    fn stride(&self) -> usize {
        self.size * (self.bandwidth + 1)
    }

    /// How many rows of L begin within a block's columns and lie below that block.
    fn below(&self, block: usize) -> usize {
        (self.blocks - block - 1).min(self.bandwidth) * self.size
    }

    /// Factorises A + diag(`damping`); gives how many numbers were multiplied with how many, or
    /// `None` where that is not positive definite.
    pub fn factorise(&mut self, matrix: &Banded, damping: impl Fn(usize) -> f64) -> Option<usize> {
        self.take(matrix);
        let (n, stride) = (self.size, self.stride());
        (0..self.dimension()).for_each(|i| self.data[i * (stride + 1)] += damping(i));
        let mut products = 0;
        for block in 0..self.blocks {
            let below = self.below(block);
            let lower = &mut self.data[block * n * (stride + 1)..];
            gemm::eliminate([n, below], stride, lower, &mut self.memory)?;
            products += n * (n + below) * (n + below);
        }
        Some(products)
    }

    /// Takes the lower half of a matrix.
    fn take(&mut self, matrix: &Banded) {
        let (n, stride) = (self.size, self.stride());
        for column in 0..self.blocks {
            for row in column..(column + self.bandwidth + 1).min(self.blocks) {
                let first = column * n * stride + row * n;
                for (i, entries) in matrix.block(row, column).chunks_exact(n).enumerate() {
                    let to = self.data[first + i..].iter_mut().step_by(stride);
                    to.zip(entries).for_each(|(to, entry)| *to = *entry);
                }
            }
        }
    }

    /// Solves A x = b in place, once [`Cholesky::factorise`] has made L.
    pub fn solve(&self, x: &mut [f64]) {
        let (n, stride) = (self.size, self.stride());
        let column = |j: usize| {
            let end = j / n * n + n + self.below(j / n);
            &self.data[j * (stride + 1)..j * stride + end]
        };
        for j in 0..self.dimension() {
            let l = column(j);
            x[j] /= l[0];
            gemm::add(-x[j], &l[1..], &mut x[j + 1..]);
        }
        for j in (0..self.dimension()).rev() {
            let l = column(j);
            x[j] = (x[j] - gemm::dot(&l[1..], &x[j + 1..])) / l[0];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    /// A positive definite matrix with entries from a wave, and the same dense.
    fn sample(size: usize, blocks: usize, bandwidth: usize) -> (Banded, DMatrix<f64>) {
        let mut banded = Banded::zeros(size, blocks, bandwidth);
        let mut dense = DMatrix::zeros(size * blocks, size * blocks);
        for row in 0..blocks {
            for column in row.saturating_sub(bandwidth)..=row {
                for i in 0..size {
                    for j in 0..size {
                        let (a, b) = (row * size + i, column * size + j);
                        let wave = ((a * b + a + b) as f64 * 0.7).sin();
                        let value = if a == b { 9.0 * size as f64 } else { wave };
                        banded.block_mut(row, column)[i * size + j] = value;
                        dense[(a, b)] = value;
                        dense[(b, a)] = value;
                    }
                }
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
            let damping = |i: usize| 0.1 * i as f64;
            for i in 0..dense.nrows() {
                dense[(i, i)] += damping(i);
            }
            let b = DVector::from_fn(size * blocks, |i, _| (i as f64).cos());
            let expected = dense.cholesky().unwrap().solve(&b);
            let mut factor = Cholesky::like(&banded);
            // What an earlier matrix left must not matter.
            for _ in 0..2 {
                factor.factorise(&banded, damping).unwrap();
            }
            let mut x = b.as_slice().to_vec();
            factor.solve(&mut x);
            assert!((DVector::from_vec(x) - expected).amax() < 1e-12);
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
