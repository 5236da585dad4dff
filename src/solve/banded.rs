//! Symmetric matrices of square blocks that vanish away from the diagonal, and their Cholesky
//! factors: time and memory are linear in the number of blocks.

use crate::gemm;

/// The lower half of a symmetric matrix of `blocks` x `blocks` square blocks of `size`, in which
/// block (i, j) vanishes where |i - j| exceeds the bandwidth.
#[derive(Clone, Debug, PartialEq)]
pub struct Banded {
    size: usize,
    blocks: usize,
    bandwidth: usize,
    /// Blocks (i, i - bandwidth) to (i, i) of each block row i, each row-major.
    data: Vec<f64>,
    /// Memory of the factorisation: one column of a block.
    column: Vec<f64>,
}

impl Banded {
    /// All zero. `bandwidth` counts blocks beside the diagonal one.
    pub fn zeros(size: usize, blocks: usize, bandwidth: usize) -> Self {
        let data = vec![0.0; size * size * blocks * (bandwidth + 1)];
        Self { size, blocks, bandwidth, data, column: Vec::new() }
    }

    /// Rows of a block.
    pub fn size(&self) -> usize {
        self.size
    }

    /// How many block rows there are.
    pub fn blocks(&self) -> usize {
        self.blocks
    }

    /// Blocks beside the diagonal one.
    pub fn bandwidth(&self) -> usize {
        self.bandwidth
    }

    /// Sets all entries to zero.
    pub fn clear(&mut self) {
        self.data.fill(0.0);
    }

    /// Takes the entries of another matrix of the same layout.
    pub fn copy_from(&mut self, other: &Self) {
        self.data.copy_from_slice(&other.data);
    }

    fn at(&self, row: usize, column: usize) -> usize {
        debug_assert!(column <= row && row - column <= self.bandwidth);
        (row * (self.bandwidth + 1) + column + self.bandwidth - row) * self.size * self.size
    }

    /// Block (row, column), row-major, with column <= row <= column + bandwidth.
    pub fn block(&self, row: usize, column: usize) -> &[f64] {
        let at = self.at(row, column);
        &self.data[at..at + self.size * self.size]
    }

    /// As [`Banded::block`], to change it.
    pub fn block_mut(&mut self, row: usize, column: usize) -> &mut [f64] {
        let at = self.at(row, column);
        &mut self.data[at..at + self.size * self.size]
    }

    /// Entry i of the diagonal.
    pub fn diagonal(&self, i: usize) -> f64 {
        let (block, within) = (i / self.size, i % self.size);
        self.block(block, block)[within * (self.size + 1)]
    }

    /// Adds to entry i of the diagonal.
    pub fn add_to_diagonal(&mut self, i: usize, value: f64) {
        let (block, within, size) = (i / self.size, i % self.size, self.size);
        self.block_mut(block, block)[within * (size + 1)] += value;
    }

    /// Makes row and column i those of the identity, so that unknown i keeps its place.
    pub fn pin(&mut self, i: usize) {
        let (block, within, size) = (i / self.size, i % self.size, self.size);
        for column in block.saturating_sub(self.bandwidth)..=block {
            self.block_mut(block, column)[within * size..(within + 1) * size].fill(0.0);
        }
        for row in block..(block + self.bandwidth + 1).min(self.blocks) {
            let entries = self.block_mut(row, block);
            entries.iter_mut().skip(within).step_by(size).for_each(|entry| *entry = 0.0);
        }
        self.add_to_diagonal(i, 1.0);
    }

    /// Replaces the matrix by its lower Cholesky factor; gives how many products of two blocks
    /// that took, or `None` where it is not positive definite.
    pub fn factorise(&mut self) -> Option<usize> {
        let mut products = 0;
        for row in 0..self.blocks {
            let first = row.saturating_sub(self.bandwidth);
            for column in first..=row {
                for k in first.max(column.saturating_sub(self.bandwidth))..column {
                    self.subtract_product(row, column, k);
                    products += 1;
                }
                if column < row {
                    self.solve_right(row, column);
                    products += 1;
                }
            }
            self.factorise_block(row)?;
        }
        Some(products)
    }

    /// A(row, column) -= L(row, k) L(column, k)^T.
    fn subtract_product(&mut self, row: usize, column: usize, k: usize) {
        let (n, target) = (self.size, self.at(row, column));
        let (left, right) = (self.at(row, k), self.at(column, k));
        // All operands of a row come before its target in memory.
        let (known, rest) = self.data.split_at_mut(target);
        gemm::subtract_product_with_transpose([n, n, n], &known[left..], &known[right..], rest);
    }

    /// L(row, column) = A(row, column) L(column, column)^-T.
    fn solve_right(&mut self, row: usize, column: usize) {
        let (n, target, pivot) = (self.size, self.at(row, column), self.at(column, column));
        let (known, rest) = self.data.split_at_mut(target);
        gemm::divide_by_lower_transpose(n, &known[pivot..], rest);
    }

    /// The Cholesky factor of a diagonal block.
    fn factorise_block(&mut self, row: usize) -> Option<()> {
        let (n, at) = (self.size, self.at(row, row));
        self.column.resize(n, 0.0);
        cholesky(&mut self.data[at..at + n * n], &mut self.column)
    }

    /// Solves L L^T x = b in place, once [`Banded::factorise`] has made this L.
    pub fn solve_factorised(&self, x: &mut [f64]) {
        let n = self.size;
        for row in 0..self.blocks {
            let (done, here) = x.split_at_mut(row * n);
            for column in row.saturating_sub(self.bandwidth)..row {
                let part = &done[column * n..(column + 1) * n];
                for (l, out) in self.block(row, column).chunks_exact(n).zip(&mut *here) {
                    *out -= dot(l, part);
                }
            }
            for (i, l) in self.block(row, row).chunks_exact(n).enumerate() {
                here[i] = (here[i] - dot(&l[..i], &here[..i])) / l[i];
            }
        }
        for row in (0..self.blocks).rev() {
            let (others, here) = x.split_at_mut(row * n);
            let l = self.block(row, row);
            for i in (0..n).rev() {
                here[i] /= l[i * n + i];
                let value = here[i];
                here[..i].iter_mut().zip(&l[i * n..]).for_each(|(x, l)| *x -= l * value);
            }
            for column in row.saturating_sub(self.bandwidth)..row {
                let out = &mut others[column * n..(column + 1) * n];
                for (l, value) in self.block(row, column).chunks_exact(n).zip(&*here) {
                    out.iter_mut().zip(l).for_each(|(x, l)| *x -= l * value);
                }
            }
        }
    }
}

gemm::wide! {
    /// The lower Cholesky factor in place, column after column; `column` is memory, as long as a row.
    fn cholesky(block: &mut [f64], column: &mut [f64]) -> Option<()> {
        let n = column.len();
        for k in 0..n {
            let pivot = block[k * n + k];
            if pivot.is_nan() || pivot <= 0.0 {
                return None;
            }
            let root = pivot.sqrt();
            block[k * n + k] = root;
            block[k * n + k + 1..(k + 1) * n].fill(0.0);
            for (i, entries) in block.chunks_exact_mut(n).enumerate().skip(k + 1) {
                let factor = entries[k] / root;
                (entries[k], column[i]) = (factor, factor);
                let products = column[k + 1..=i].iter().map(|other| factor * other);
                entries[k + 1..=i].iter_mut().zip(products).for_each(|(a, b)| *a -= b);
            }
        }
        Some(())
    }
}

/// Four sums at once, so that no product waits for the one before.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 4];
    let (a, b) = (a.chunks_exact(4), b[..a.len()].chunks_exact(4));
    let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a.zip(b) {
        (0..4).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum::<f64>() + rest
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
        for (size, blocks, bandwidth) in [(3, 7, 2), (4, 5, 1), (5, 3, 0), (2, 2, 3)] {
            let (mut banded, mut dense) = sample(size, blocks, bandwidth);
            banded.pin(1);
            for i in 0..dense.nrows() {
                (dense[(1, i)], dense[(i, 1)]) = (0.0, 0.0);
            }
            dense[(1, 1)] = 1.0;
            let b = DVector::from_fn(size * blocks, |i, _| (i as f64).cos());
            let expected = dense.cholesky().unwrap().solve(&b);
            let mut x = b.as_slice().to_vec();
            banded.factorise().unwrap();
            banded.solve_factorised(&mut x);
            assert!((DVector::from_vec(x) - expected).amax() < 1e-12);
        }
    }

    #[test]
    fn the_work_is_linear_in_the_length() {
        let products = |blocks| sample(2, blocks, 2).0.factorise().unwrap();
        let (short, long, longer) = (products(10), products(110), products(210));
        assert_eq!(longer - long, long - short);
    }

    #[test]
    fn an_indefinite_matrix_has_no_factor() {
        let (mut banded, _) = sample(3, 4, 1);
        banded.add_to_diagonal(7, -100.0);
        assert_eq!(banded.factorise(), None);
    }
}
