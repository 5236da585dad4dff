//! Dense products on row-major slices, by `faer` on one thread, and loops in wide registers. They
//! allocate nothing.

use faer::linalg::matmul::matmul;
use faer::linalg::solvers::Solve;
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::traits::ComplexField;
use faer::{MatMut, MatRef, Par, Side};

/// Whether a product replaces what is there or is added to it.
pub use faer::Accum;

/// Defines a function that is compiled twice, for any processor and for one with AVX2, and chooses as it
/// runs. Both do the same operations in the same order, so the results do not depend on the processor.
/// What it calls must be inlined into it.
macro_rules! wide {
    (
        $(#[$attribute:meta])*
        $visibility:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?) $(-> $output:ty)?
        $body:block
    ) => {
        $(#[$attribute])*
        $visibility fn $name($($argument: $type),*) $(-> $output)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn avx2($($argument: $type),*) $(-> $output)? $body
                if std::arch::is_x86_feature_detected!("avx2") {
                    // SAFETY: the processor has AVX2.
                    #[allow(unsafe_code, clippy::let_unit_value)]
                    let output = unsafe { avx2($($argument),*) };
                    return output;
                }
            }
            $body
        }
    };
}
pub(crate) use wide;

/// out (m x n) = or += a (m x k) b (k x n).
pub fn product<T: ComplexField>(
    [m, k, n]: [usize; 3],
    a: &[T],
    b: &[T],
    accum: Accum,
    out: &mut [T],
) {
    multiply(matrix(a, m, k), matrix(b, k, n), accum, out);
}

/// out (m x n) = or += a (m x k) b^T, with b of n x k.
pub fn product_with_transpose<T: ComplexField>(
    [m, k, n]: [usize; 3],
    a: &[T],
    b: &[T],
    accum: Accum,
    out: &mut [T],
) {
    multiply(matrix(a, m, k), matrix(b, n, k).transpose(), accum, out);
}

/// out (m x n) = or += a^T b, with a of k x m and b of k x n.
pub fn product_of_transpose<T: ComplexField>(
    [m, k, n]: [usize; 3],
    a: &[T],
    b: &[T],
    accum: Accum,
    out: &mut [T],
) {
    multiply(matrix(a, k, m).transpose(), matrix(b, k, n), accum, out);
}

/// out (m x n) -= a (m x k) b^T, with b of n x k.
pub fn subtract_product_with_transpose(
    [m, k, n]: [usize; 3],
    a: &[f64],
    b: &[f64],
    out: &mut [f64],
) {
    let out = MatMut::from_row_major_slice_mut(&mut out[..m * n], m, n);
    matmul(out, Accum::Add, matrix(a, m, k), matrix(b, n, k).transpose(), -1.0, Par::Seq);
    clean_registers();
}

/// out (n x n) = out L^-T, with L of n x n, lower triangular.
pub fn divide_by_lower_transpose(n: usize, l: &[f64], out: &mut [f64]) {
    // X L^T = A is L X^T = A^T.
    let out = MatMut::from_row_major_slice_mut(&mut out[..n * n], n, n);
    solve_lower_triangular_in_place(matrix(l, n, n), out.transpose_mut(), Par::Seq);
    clean_registers();
}

/// The solution of A X = B, with A of n x n, symmetric and positive definite, of which only the lower
/// half is read, and B of n x m; `None` where A is not positive definite.
pub fn solve_symmetric(n: usize, a: &[f64], m: usize, b: &[f64]) -> Option<Vec<f64>> {
    let solved = matrix(a, n, n).llt(Side::Lower).ok().map(|factor| factor.solve(matrix(b, n, m)));
    clean_registers();
    solved.map(|x| (0..n * m).map(|at| x[(at / m, at % m)]).collect())
}

fn matrix<T>(data: &[T], rows: usize, columns: usize) -> MatRef<'_, T> {
    MatRef::from_row_major_slice(&data[..rows * columns], rows, columns)
}

fn multiply<T: ComplexField>(a: MatRef<T>, b: MatRef<T>, accum: Accum, out: &mut [T]) {
    let (m, n) = (a.nrows(), b.ncols());
    let out = MatMut::from_row_major_slice_mut(&mut out[..m * n], m, n);
    matmul(out, accum, a, b, T::one_impl(), Par::Seq);
    clean_registers();
}

/// The kernels leave the upper halves of the vector registers in use; each instruction of the older
/// kind (SSE) that comes later would then wait for them. That made `exp` ten times as slow, and a whole
/// solve twice.
#[cfg(target_arch = "x86_64")]
#[allow(unsafe_code)]
fn clean_registers() {
    if std::arch::is_x86_feature_detected!("avx") {
        // SAFETY: the processor has AVX. The upper halves hold nothing of ours: by the calling
        // convention no caller keeps a value there across a call.
        unsafe { std::arch::x86_64::_mm256_zeroupper() }
    }
}

#[cfg(not(target_arch = "x86_64"))]
fn clean_registers() {}

#[cfg(test)]
mod tests {
    use super::*;

    const A: [f64; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];

    #[test]
    fn products_match_hand_computed_ones() {
        let mut out = [1.0; 4];
        product([2, 3, 2], &A, &[1.0, 0.0, 0.0, 1.0, 1.0, 1.0], Accum::Add, &mut out);
        assert_eq!(out, [5.0, 6.0, 11.0, 12.0]);
        product_with_transpose([2, 3, 2], &A, &A, Accum::Replace, &mut out);
        assert_eq!(out, [14.0, 32.0, 32.0, 77.0]);
        let mut gram = [0.0; 9];
        product_of_transpose([3, 2, 3], &A, &A, Accum::Replace, &mut gram);
        assert_eq!(gram, [17.0, 22.0, 27.0, 22.0, 29.0, 36.0, 27.0, 36.0, 45.0]);
    }
}
