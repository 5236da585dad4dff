//! Symmetric block-banded matrices.

use std::ops::Range;

use nalgebra::RealField;

/// The lower half of a symmetric matrix of `blocks` x `blocks` square blocks of `size` rows. Block
/// (i, j) is zero if |i - j| exceeds the bandwidth.
#[derive(Clone, Debug, PartialEq)]
pub struct BlockBanded<T = f64> {
    size: usize,
    blocks: usize,
    bandwidth: usize,
    /// Column-major: entry (i, j) is at i + j * stride, so a column begins where the band of the one
    /// before ends.
    data: Vec<T>,
}

impl<T: RealField + Copy> BlockBanded<T> {
    /// A zero matrix. `bandwidth` is the number of blocks beside the diagonal one.
    pub fn zeros(size: usize, blocks: usize, bandwidth: usize) -> Self {
        let data = vec![T::zero(); size * blocks * (size * (bandwidth + 1) + 1)];
        Self { size, blocks, bandwidth, data }
    }

    /// Rows of a block.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Number of block rows.
    pub fn blocks(&self) -> usize {
        self.blocks
    }

    /// Blocks beside the diagonal one.
    pub fn bandwidth(&self) -> usize {
        self.bandwidth
    }

    /// Rows of the matrix.
    pub fn dimension(&self) -> usize {
        self.size * self.blocks
    }

    /// Sets all entries to zero.
    pub fn clear(&mut self) {
        self.data.fill(T::zero());
    }

    /// Distance of two columns in memory.
    pub(super) fn stride(&self) -> usize {
        self.size * (self.bandwidth + 1)
    }

    /// The memory from the first entry of a block on the diagonal.
    pub(super) fn tail_mut(&mut self, block: usize) -> &mut [T] {
        let first = block * self.size * (self.stride() + 1);
        &mut self.data[first..]
    }

    /// One past the last row of a column's band.
    pub(super) fn end(&self, column: usize) -> usize {
        self.size * (column / self.size + 1 + self.bandwidth).min(self.blocks)
    }

    fn at(&self, rows: &Range<usize>, column: usize) -> Range<usize> {
        debug_assert!(column <= rows.end && rows.end <= self.end(column), "{rows:?} {column}");
        let first = column * self.stride();
        first + rows.start..first + rows.end
    }

    /// Entries of a column, in the rows of the band. Entries above the diagonal are ignored, but
    /// those of a diagonal block may be written.
    pub fn column(&self, rows: Range<usize>, column: usize) -> &[T] {
        &self.data[self.at(&rows, column)]
    }

    /// [`BlockBanded::column`], mutable.
    pub fn column_mut(&mut self, rows: Range<usize>, column: usize) -> &mut [T] {
        let at = self.at(&rows, column);
        &mut self.data[at]
    }

    /// An entry; zero outside the band.
    pub fn entry(&self, i: usize, j: usize) -> T {
        let (i, j) = (i.max(j), i.min(j));
        if i < self.end(j) { self.column(i..i + 1, j)[0] } else { T::zero() }
    }

    /// Entry i of the diagonal.
    pub fn diagonal(&self, i: usize) -> T {
        self.data[i * (self.stride() + 1)]
    }

    /// Adds to entry i of the diagonal.
    pub fn add_to_diagonal(&mut self, i: usize, value: T) {
        let at = i * (self.stride() + 1);
        self.data[at] += value;
    }

    /// Makes row and column i those of the identity, so that unknown i stays fixed.
    pub fn pin(&mut self, i: usize) {
        let first = (i / self.size).saturating_sub(self.bandwidth) * self.size;
        (first..i).for_each(|column| self.column_mut(i..i + 1, column).fill(T::zero()));
        self.column_mut(i..self.end(i), i).fill(T::zero());
        self.add_to_diagonal(i, T::one());
    }
}

impl BlockBanded<f32> {
    /// Copies the entries of a matrix of the same layout, rounded.
    pub fn round_from(&mut self, other: &BlockBanded) {
        self.data.iter_mut().zip(&other.data).for_each(|(mine, other)| *mine = *other as f32);
    }
}
