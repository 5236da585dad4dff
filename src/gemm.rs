//! Dense products on row-major slices, by `matrixmultiply` through nalgebra's views.

use nalgebra::{DMatrixView, DMatrixViewMut, RealField};

/// out (m x n) = a (m x k) b (k x n) + `keep` out.
pub fn product<T: RealField + Copy>(
    [m, k, n]: [usize; 3],
    a: &[T],
    b: &[T],
    keep: T,
    out: &mut [T],
) {
    // A row-major matrix is its transpose in nalgebra's column-major order: out^T = b^T a^T.
    let a = DMatrixView::from_slice(&a[..m * k], k, m);
    let b = DMatrixView::from_slice(&b[..k * n], n, k);
    DMatrixViewMut::from_slice(&mut out[..m * n], n, m).gemm(T::one(), &b, &a, keep);
}

/// out (n x n) += a^T a, with a of `rows` x n.
pub fn add_gram<T: RealField + Copy>(rows: usize, n: usize, a: &[T], out: &mut [T]) {
    let transposed = DMatrixView::from_slice(&a[..rows * n], n, rows);
    let upright = DMatrixView::from_slice_with_strides(&a[..rows * n], rows, n, n, 1);
    DMatrixViewMut::from_slice(&mut out[..n * n], n, n).gemm(
        T::one(),
        &transposed,
        &upright,
        T::one(),
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_match_hand_computed_ones() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let mut out = [1.0; 4];
        product([2, 3, 2], &a, &[1.0, 0.0, 0.0, 1.0, 1.0, 1.0], 1.0, &mut out);
        assert_eq!(out, [5.0, 6.0, 11.0, 12.0]);
        let mut gram = [0.0; 9];
        add_gram(2, 3, &a, &mut gram);
        assert_eq!(gram, [17.0, 22.0, 27.0, 22.0, 29.0, 36.0, 27.0, 36.0, 45.0]);
    }
}
