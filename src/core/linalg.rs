//! Dense products on row-major slices, by `faer` on one thread, and loops in wide registers. They
//! allocate nothing.

use std::mem::MaybeUninit;

use faer::dyn_stack::MemStack;
use faer::linalg::cholesky::llt::factor::{
    LltRegularization, cholesky_in_place, cholesky_in_place_scratch,
};
use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::solvers::Solve;
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::reborrow::{Reborrow, ReborrowMut};
use faer::traits::ComplexField;
use faer::{MatMut, MatRef, Par, Side, Spec};

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

/// Memory of a function that needs some.
#[derive(Clone, Debug)]
pub struct Memory(Vec<MaybeUninit<u8>>);

impl Memory {
    /// For [`eliminate`] with blocks of n columns.
    pub fn of_cholesky(n: usize) -> Self {
        let wanted = cholesky_in_place_scratch::<f32>(n, Par::Seq, Spec::default());
        Self(vec![MaybeUninit::uninit(); wanted.unaligned_bytes_required()])
    }
}

/// One block of a Cholesky factorisation: of a symmetric matrix of n + `below` rows, of which only the
/// lower half is used, column-major with its columns `stride` apart, makes the first n columns those of
/// the factor and takes from the rest what they account for. `None` where no factor is.
pub fn eliminate(
    [n, below]: [usize; 2],
    stride: usize,
    lower: &mut [f32],
    memory: &mut Memory,
) -> Option<()> {
    let rows = n + below;
    let lower = &mut lower[..(rows - 1) * stride + rows];
    let whole = MatMut::from_column_major_slice_with_stride_mut(lower, rows, rows, stride);
    let (mut pivot, _, mut panel, rest) = whole.split_at_mut(n, n);
    let stack = MemStack::new(&mut memory.0);
    let found = cholesky_in_place(
        pivot.rb_mut(),
        LltRegularization::default(),
        Par::Seq,
        stack,
        Spec::default(),
    );
    if found.is_ok() && below > 0 {
        // X L^T = A is L X^T = A^T.
        solve_lower_triangular_in_place(pivot.rb(), panel.rb_mut().transpose_mut(), Par::Seq);
        let (half, whole) = (BlockStructure::TriangularLower, BlockStructure::Rectangular);
        let (panel, across) = (panel.rb(), panel.rb().transpose());
        triangular::matmul(rest, half, Accum::Add, panel, whole, across, whole, -1.0, Par::Seq);
    }
    clean_registers();
    found.ok().map(|_| ())
}

/// The solution of A X = B, with A of n x n, symmetric and positive definite, of which only the lower
/// half is read, and B of n x m; `None` where A is not positive definite.
pub fn solve_symmetric(n: usize, a: &[f64], m: usize, b: &[f64]) -> Option<Vec<f64>> {
    let solved = matrix(a, n, n).llt(Side::Lower).ok().map(|factor| factor.solve(matrix(b, n, m)));
    clean_registers();
    solved.map(|x| (0..n * m).map(|at| x[(at / m, at % m)]).collect())
}

wide! {
    /// out += factor v, as far as v goes.
    pub fn add(factor: f64, v: &[f32], out: &mut [f64]) {
        out.iter_mut().zip(v).for_each(|(out, v)| *out += factor * f64::from(*v));
    }
}

wide! {
    /// The scalar product of v and w, as far as v goes: sums of every eighth product, so that none waits
    /// for the one before.
    pub fn dot(v: &[f32], w: &[f64]) -> f64 {
        let mut sums = [0.0; 8];
        let (v, w) = (v.chunks_exact(8), w[..v.len()].chunks_exact(8));
        let rest = v.remainder().iter().zip(w.remainder());
        let rest: f64 = rest.map(|(v, w)| f64::from(*v) * w).sum();
        for (v, w) in v.zip(w) {
            (0..8).for_each(|k| sums[k] += f64::from(v[k]) * w[k]);
        }
        sums.iter().sum::<f64>() + rest
    }
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
