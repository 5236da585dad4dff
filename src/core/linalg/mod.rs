//! Products and Cholesky factors of dense matrices in slices, without allocation.
//!
//! Results have the same bits on every processor; `kernel` explains how.

mod kernel;

pub use kernel::Real;
use kernel::{Target, View, multiply};

/// How a product changes the output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Accum {
    /// out = a b.
    Replace,
    /// out += a b.
    Add,
    /// out -= a b.
    Subtract,
}

/// The instructions that are used. All give the same bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Path {
    /// The instructions that every processor of the architecture has.
    Plain,
    /// Also AVX2 and fused multiply-adds.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// Also AVX-512.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Path {
    /// The fastest path of this processor.
    pub(crate) fn here() -> Self {
        #[cfg(all(test, feature = "research"))]
        if let Some(path) = tests::FORCED.get() {
            return path;
        }
        #[cfg(target_arch = "x86_64")]
        if std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma") {
            let has_512 = std::is_x86_feature_detected!("avx512f");
            return if has_512 { Self::Avx512 } else { Self::Avx2 };
        }
        Self::Plain
    }
}

/// Compiles a function twice, with and without AVX2, and chooses at run time. Both versions do the
/// same operations in the same order, so the result does not depend on the processor. Functions that
/// it calls must be inlined.
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
                if $crate::core::linalg::Path::here() != $crate::core::linalg::Path::Plain {
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

/// out (m x n) = a (m x k) b (k x n), or as `accum` says. All matrices are row-major.
pub fn product<T: Real>([m, k, n]: [usize; 3], a: &[T], b: &[T], accum: Accum, out: &mut [T]) {
    let (a, b) = (View { data: a, row: k, column: 1 }, View { data: b, row: n, column: 1 });
    let out = Target { data: out, stride: n, accum, upper: false };
    multiply(Path::here(), [m, k, n], a, b, out);
}

/// out (m x n) = a (m x k) b^T, or as `accum` says; b is n x k.
pub fn product_with_transpose<T: Real>(
    [m, k, n]: [usize; 3],
    a: &[T],
    b: &[T],
    accum: Accum,
    out: &mut [T],
) {
    let (a, b) = (View { data: a, row: k, column: 1 }, View { data: b, row: 1, column: k });
    let out = Target { data: out, stride: n, accum, upper: false };
    multiply(Path::here(), [m, k, n], a, b, out);
}

/// out (m x n) = a^T b, or as `accum` says; a is k x m, b is k x n.
pub fn product_of_transpose<T: Real>(
    [m, k, n]: [usize; 3],
    a: &[T],
    b: &[T],
    accum: Accum,
    out: &mut [T],
) {
    let (a, b) = (View { data: a, row: 1, column: m }, View { data: b, row: n, column: 1 });
    let out = Target { data: out, stride: n, accum, upper: false };
    multiply(Path::here(), [m, k, n], a, b, out);
}

/// out (n x n) = a^T a; a is k x n.
pub fn gram<T: Real>([k, n]: [usize; 2], a: &[T], out: &mut [T]) {
    let of = View { data: a, row: 1, column: n };
    let by = View { data: a, row: n, column: 1 };
    let target = Target { data: &mut *out, stride: n, accum: Accum::Replace, upper: true };
    multiply(Path::here(), [n, k, n], of, by, target);
    for i in 1..n {
        let (above, row) = out.split_at_mut(i * n);
        row[..i].iter_mut().zip(above[i..].iter().step_by(n)).for_each(|(out, v)| *out = *v);
    }
}

/// Number of columns that are factorised together.
const PANEL: usize = 6;

/// Factorises the first n columns of a symmetric matrix of n + `below` rows (Cholesky) and replaces
/// the rest by its Schur complement. `None` if the matrix is not positive definite.
///
/// `lower` is column-major, its columns `stride` apart; only the lower half is used. Panels of
/// `PANEL` columns are updated by a product with all earlier columns, then factorised column by
/// column.
pub fn factor_block<T: Real>([n, below]: [usize; 2], stride: usize, lower: &mut [T]) -> Option<()> {
    let rows = n + below;
    for first in (0..n).step_by(PANEL) {
        let columns = PANEL.min(n - first);
        subtract_earlier(first, columns, rows, stride, lower);
        factor_panel(columns, rows - first, stride, &mut lower[first * (stride + 1)..])?;
    }
    subtract_earlier(n, below, rows, stride, lower);
    Some(())
}

/// Subtracts the product of all earlier columns from a panel.
fn subtract_earlier<T: Real>(
    first: usize,
    columns: usize,
    rows: usize,
    stride: usize,
    lower: &mut [T],
) {
    if first == 0 || columns == 0 {
        return;
    }
    let (earlier, rest) = lower.split_at_mut(first * stride);
    // Column-major is the transpose of row-major: the lower half is the upper one.
    let (earlier, data) = (&earlier[first..], &mut rest[first..]);
    let a = View { data: earlier, row: 1, column: stride };
    let b = View { data: earlier, row: stride, column: 1 };
    let out = Target { data, stride, accum: Accum::Subtract, upper: true };
    multiply(Path::here(), [columns, first, rows - first], a, b, out);
}

/// Factorises a panel after the earlier columns were subtracted.
fn factor_panel<T: Real>(
    columns: usize,
    rows: usize,
    stride: usize,
    lower: &mut [T],
) -> Option<()> {
    for j in 0..columns {
        let (done, later) = lower.split_at_mut(((j + 1) * stride).min(lower.len()));
        let column = &mut done[j * stride..][j..rows];
        let pivot = Some(column[0]).filter(|pivot| *pivot > T::zero() && pivot.is_finite())?;
        let scale = pivot.sqrt().recip();
        column.iter_mut().for_each(|l| *l *= scale);
        for (next, out) in (j + 1..columns).zip(later.chunks_mut(stride)) {
            let column = &column[next - j..];
            let factor = column[0];
            out[next..rows].iter_mut().zip(column).for_each(|(out, l)| *out -= factor * *l);
        }
    }
    Some(())
}

wide! {
    /// out += factor v, for the entries of v.
    pub fn axpy(factor: f64, v: &[f32], out: &mut [f64]) {
        out.iter_mut().zip(v).for_each(|(out, v)| *out += factor * f64::from(*v));
    }
}

wide! {
    /// The scalar product of v and the first entries of w. Eight partial sums run side by side.
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

#[cfg(all(test, feature = "research"))]
mod tests {
    use std::cell::Cell;
    use std::sync::Arc;

    use super::*;
    use crate::core::detections::KeypointFormat;
    use crate::core::manifold::Decoder;
    use crate::research::experiments::{Case, View, procedural};
    use crate::research::methods::{Method, Motion, Solved, Windows};
    use crate::research::synth::{Noise, SequenceChoice, rig_named};

    thread_local! {
        /// The path that a test chose for this thread.
        pub(super) static FORCED: Cell<Option<Path>> = const { Cell::new(None) };
    }

    /// The result of `make` on each path of this processor.
    fn on_each_path<T>(make: impl Fn() -> T) -> Vec<T> {
        let mut paths = vec![Path::Plain, Path::here()];
        #[cfg(target_arch = "x86_64")]
        if Path::here() == Path::Avx512 {
            paths.push(Path::Avx2);
        }
        paths.dedup();
        if paths.len() == 1 {
            println!("not compared: this processor has one path");
        }
        let on = |path: Path| {
            FORCED.set(Some(path));
            let made = make();
            FORCED.set(None);
            made
        };
        paths.into_iter().map(on).collect()
    }

    fn wave(count: usize, step: f32) -> Vec<f32> {
        (0..count).map(|i| (i as f32 * step).sin() * 3.0 + 0.1).collect()
    }

    /// a (m x k) b (k x n) by the definition in `kernel`; `a` and `b` read the entries.
    fn by_definition(
        [m, k, n]: [usize; 3],
        a: impl Fn(usize, usize) -> f32,
        b: impl Fn(usize, usize) -> f32,
        start: &[f32],
    ) -> Vec<f32> {
        let entry = |at: usize| {
            let (i, j) = (at / n, at % n);
            (0..k).step_by(kernel::DEPTH).fold(start[at], |entry, first| {
                let steps = first..k.min(first + kernel::DEPTH);
                entry + steps.fold(0.0_f32, |sum, k| a(i, k).mul_add(b(k, j), sum))
            })
        };
        (0..m * n).map(entry).collect()
    }

    /// Sizes of the decoder and of Gram matrices, and odd sizes.
    const SIZES: [[usize; 3]; 10] = [
        [8, 32, 256],
        [10, 256, 126],
        [126, 256, 64],
        [5, 126, 256],
        [38, 69, 38],
        [17, 3, 16],
        [1, 300, 1],
        [13, 1, 15],
        [7, 129, 33],
        [3, 0, 5],
    ];

    type Product = fn([usize; 3], &[f32], &[f32], Accum, &mut [f32]);

    #[test]
    fn products_are_chains_of_fused_steps_on_every_path() {
        for [m, k, n] in SIZES {
            let (a, b, start) = (wave(m * k, 0.7), wave(k * n, 0.3), wave(m * n, 0.9));
            let by = |product: Product| {
                on_each_path(|| {
                    let mut out = start.clone();
                    product([m, k, n], &a, &b, Accum::Add, &mut out);
                    out
                })
            };
            let straight =
                by_definition([m, k, n], |i, l| a[i * k + l], |l, j| b[l * n + j], &start);
            by(product).iter().for_each(|out| assert_eq!(out, &straight, "{m} {k} {n}"));
            let across = by_definition([m, k, n], |i, l| a[i * k + l], |l, j| b[j * k + l], &start);
            by(product_with_transpose).iter().for_each(|out| assert_eq!(out, &across));
            let of = by_definition([m, k, n], |i, l| a[l * m + i], |l, j| b[l * n + j], &start);
            by(product_of_transpose).iter().for_each(|out| assert_eq!(out, &of, "{m} {k} {n}"));
        }
    }

    #[test]
    fn products_in_f64_and_factors_have_the_same_bits_on_every_path() {
        for [n, below] in [[38, 76], [38, 38], [38, 0], [130, 31], [5, 3], [1, 0], [7, 1]] {
            let rows = n + below;
            let wide: Vec<f64> = wave(rows * rows, 0.7).into_iter().map(f64::from).collect();
            let made = on_each_path(|| {
                let mut gram = vec![0.0; rows * rows];
                super::gram([rows, rows], &wide, &mut gram);
                (0..rows).for_each(|i| gram[i * (rows + 1)] += 20.0 * rows as f64);
                let mut short: Vec<f32> = gram.iter().map(|v| *v as f32).collect();
                factor_block([n, below], rows, &mut short).unwrap();
                factor_block([n, below], rows, &mut gram).unwrap();
                (gram, short)
            });
            assert!(made.iter().all(|other| *other == made[0]), "{n} {below}");
        }
    }

    #[test]
    fn a_block_of_a_factor_leaves_the_schur_complement() {
        let mut matrix = [4.0, 2.0, -6.0, 0.0, 5.0, 1.0, 0.0, 0.0, 30.0];
        factor_block([1, 2], 3, &mut matrix).unwrap();
        assert_eq!(matrix, [2.0, 1.0, -3.0, 0.0, 4.0, 4.0, 0.0, 0.0, 21.0]);
        assert_eq!(factor_block([2, 0], 3, &mut [1.0, 2.0, 0.0, 0.0, 4.0]), None);
    }

    #[test]
    fn a_whole_solve_has_the_same_bits_on_every_path() {
        let view = View {
            name: String::new(),
            rig: Arc::new(rig_named("ring4", None).unwrap()),
            format: KeypointFormat::Body25,
            noise: Noise::default(),
            choice: SequenceChoice { fps: 60.0, ..SequenceChoice::default() },
            seed: 4,
        };
        let take = Case::new(&procedural(1, 2.0)[0], &view).unwrap().make().take;
        let decoder = Decoder::embedded().unwrap();
        let solved = on_each_path(|| Windows::default_settings().solve(&take, &decoder).unwrap());
        let poses = |solved: &Solved| match &solved.motion {
            Motion::Poses(_, poses) => poses.clone(),
            Motion::Points(_) => Vec::new(),
        };
        assert!(poses(&solved[0]).len() > 100);
        assert!(solved.iter().all(|other| poses(other) == poses(&solved[0])));
    }

    const A: [f64; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];

    #[test]
    fn products_match_hand_computed_ones() {
        let mut out = [1.0; 4];
        product([2, 3, 2], &A, &[1.0, 0.0, 0.0, 1.0, 1.0, 1.0], Accum::Add, &mut out);
        assert_eq!(out, [5.0, 6.0, 11.0, 12.0]);
        product_with_transpose([2, 3, 2], &A, &A, Accum::Replace, &mut out);
        assert_eq!(out, [14.0, 32.0, 32.0, 77.0]);
        let mut gram = [0.0; 9];
        super::gram([2, 3], &A, &mut gram);
        assert_eq!(gram, [17.0, 22.0, 27.0, 22.0, 29.0, 36.0, 27.0, 36.0, 45.0]);
    }
}
