//! The normal equations of a problem whose unknowns form equal blocks.

use super::block_banded::BlockBanded;

/// The block structure of the unknowns: equal blocks, of which only near ones share a term.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Unknowns of a block.
    pub size: usize,
    /// Number of blocks.
    pub blocks: usize,
    /// Largest distance of two blocks that share a term.
    pub bandwidth: usize,
}

impl Layout {
    /// One dense block of `size` unknowns.
    pub fn dense(size: usize) -> Self {
        Self { size, blocks: 1, bandwidth: 0 }
    }

    /// Number of unknowns.
    pub fn dimension(&self) -> usize {
        self.size * self.blocks
    }
}

/// Normal equations.
#[derive(Clone, Debug, PartialEq)]
pub struct NormalEquations {
    /// The gradient.
    pub gradient: Vec<f64>,
    /// A Gauss-Newton approximation of the Hessian.
    pub hessian: BlockBanded,
}

impl NormalEquations {
    /// All zero.
    pub fn zeros(layout: Layout) -> Self {
        let hessian = BlockBanded::zeros(layout.size, layout.blocks, layout.bandwidth);
        Self { gradient: vec![0.0; layout.dimension()], hessian }
    }

    /// The layout of the unknowns.
    pub fn layout(&self) -> Layout {
        let Self { hessian, .. } = self;
        let (size, blocks, bandwidth) = (hessian.size(), hessian.blocks(), hessian.bandwidth());
        Layout { size, blocks, bandwidth }
    }

    /// Sets everything to zero.
    pub fn clear(&mut self) {
        self.gradient.fill(0.0);
        self.hessian.clear();
    }

    /// Adds the term 1/2 weight |r|^2 of a residual: `blocks` gives the index of each block it
    /// depends on with its Jacobian, row-major, one row per entry of `residual`. The blocks are in
    /// ascending order and within the bandwidth.
    pub fn add(&mut self, weight: f64, residual: &[f64], by: &[(usize, &[f64])]) {
        let size = self.hessian.size();
        for (i, &(row, left)) in by.iter().enumerate() {
            let gradient = &mut self.gradient[row * size..(row + 1) * size];
            for (jacobian, r) in left.chunks_exact(size).zip(residual) {
                gradient.iter_mut().zip(jacobian).for_each(|(g, j)| *g += weight * r * j);
            }
            for &(column, right) in &by[..=i] {
                for (a, b) in left.chunks_exact(size).zip(right.chunks_exact(size)) {
                    for (j, b) in b.iter().enumerate().filter(|(_, b)| **b != 0.0) {
                        let rows = row * size..(row + 1) * size;
                        let out = self.hessian.column_mut(rows, column * size + j);
                        out.iter_mut().zip(a).for_each(|(out, a)| *out += weight * b * a);
                    }
                }
            }
        }
    }

    /// Keeps unknown i fixed.
    pub fn pin(&mut self, i: usize) {
        self.gradient[i] = 0.0;
        self.hessian.pin(i);
    }
}
