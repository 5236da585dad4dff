//! Symmetric matrices of square blocks that vanish away from the diagonal.

/// The lower half of a symmetric matrix of `blocks` x `blocks` square blocks of `size`, in which
/// block (i, j) vanishes where |i - j| exceeds the bandwidth.
#[derive(Clone, Debug, PartialEq)]
pub struct Banded {
    size: usize,
    blocks: usize,
    bandwidth: usize,
    /// Blocks (i, i - bandwidth) to (i, i) of each block row i, each row-major.
    data: Vec<f64>,
}

impl Banded {
    /// All zero. `bandwidth` counts blocks beside the diagonal one.
    pub fn zeros(size: usize, blocks: usize, bandwidth: usize) -> Self {
        let data = vec![0.0; size * size * blocks * (bandwidth + 1)];
        Self { size, blocks, bandwidth, data }
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
}
