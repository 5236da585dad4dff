//! Small matrix blocks of the normal equations.

use nalgebra::Matrix3;

use crate::manifold::{LATENT, LatentTangent};

/// Copies a 63 x 32 block to block column `block` of a matrix with `columns` columns.
pub(super) fn spread_identity(by_code: &[f64], block: usize, columns: usize, out: &mut [f64]) {
    for (row, out) in by_code.chunks_exact(LATENT).zip(out.chunks_exact_mut(columns)) {
        out[block * LATENT..(block + 1) * LATENT].copy_from_slice(row);
    }
}

/// by_code (scale I + across along^T), to block column `block`.
pub(super) fn spread(
    by_code: &[f64],
    by: &LatentTangent,
    block: usize,
    columns: usize,
    out: &mut [f64],
) {
    for (row, out) in by_code.chunks_exact(LATENT).zip(out.chunks_exact_mut(columns)) {
        let across: f64 = row.iter().zip(&by.across).map(|(a, b)| a * b).sum();
        let out = &mut out[block * LATENT..(block + 1) * LATENT];
        for ((out, value), along) in out.iter_mut().zip(row).zip(&by.along) {
            *out = by.scale * value + across * along;
        }
    }
}

/// A lower triangular L with L L^T = A, for A positive semidefinite: a pivot that vanishes, as
/// along the ray of a point that one camera sees, gives a zero column.
pub(super) fn root_of(a: &Matrix3<f64>) -> Matrix3<f64> {
    let floor = 1e-12 * a.trace();
    let mut rest = *a;
    let mut root = Matrix3::zeros();
    for column in 0..3 {
        let pivot = rest[(column, column)];
        if pivot > floor {
            let mut l = rest.column(column) / pivot.sqrt();
            l.rows_mut(0, column).fill(0.0);
            rest -= l * l.transpose();
            root.set_column(column, &l);
        }
    }
    root
}
