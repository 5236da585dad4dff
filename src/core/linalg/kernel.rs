//! Products of dense matrices with the same bits on every processor.
//!
//! An entry of a product is a chain: sum = a_ik b_kj + sum for ascending k, starting at zero. A step
//! has one rounding in f32 (a fused multiply-add) and two in f64. A chain ends after [`DEPTH`] steps;
//! its sum is then written to the output, added or subtracted, and the next chain starts. So the bits
//! of an entry do not depend on the size of the tiles or of the registers.

use std::ops::Range;

use nalgebra::RealField;

use super::{Accum, Path};

/// Number of steps in a chain.
pub(super) const DEPTH: usize = 256;
/// Rows of the largest tile. A tile is two registers wide, so its sums take 12 registers.
const ROWS: usize = 6;
/// A strip of columns with more tiles than this is first copied to contiguous memory.
const FEW: usize = 16;

/// The numbers of a matrix: f32 or f64.
pub trait Real: RealField + Copy {
    /// sum + a b.
    #[doc(hidden)]
    fn step(a: Self, b: Self, sum: Self) -> Self;

    /// [`multiply`] with AVX2. The processor must have AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    #[doc(hidden)]
    #[allow(private_interfaces, unsafe_code)]
    unsafe fn by_avx2(size: [usize; 3], a: View<Self>, b: View<Self>, out: Target<Self>);

    /// [`multiply`] with AVX-512. The processor must have it.
    #[cfg(target_arch = "x86_64")]
    #[doc(hidden)]
    #[allow(private_interfaces, unsafe_code)]
    unsafe fn by_avx512(size: [usize; 3], a: View<Self>, b: View<Self>, out: Target<Self>);
}

impl Real for f32 {
    #[inline(always)]
    fn step(a: f32, b: f32, sum: f32) -> f32 {
        match cfg!(any(target_feature = "fma", target_arch = "aarch64")) {
            true => a.mul_add(b, sum),
            false => mul_add(a, b, sum),
        }
    }

    #[cfg(target_arch = "x86_64")]
    #[allow(private_interfaces, unsafe_code)]
    #[target_feature(enable = "avx2,fma")]
    unsafe fn by_avx2(size: [usize; 3], a: View<f32>, b: View<f32>, out: Target<f32>) {
        by_tiles::<f32, 16>(ROWS, size, a, b, out, |size, a, b, out| {
            wide_256::tile_f32(size, a, b, out)
        });
    }

    #[cfg(target_arch = "x86_64")]
    #[allow(private_interfaces, unsafe_code)]
    #[target_feature(enable = "avx512f")]
    unsafe fn by_avx512(size: [usize; 3], a: View<f32>, b: View<f32>, out: Target<f32>) {
        by_tiles::<f32, 32>(ROWS, size, a, b, out, |size, a, b, out| {
            wide_512::tile_f32(size, a, b, out)
        });
    }
}

impl Real for f64 {
    #[inline(always)]
    fn step(a: f64, b: f64, sum: f64) -> f64 {
        sum + a * b
    }

    #[cfg(target_arch = "x86_64")]
    #[allow(private_interfaces, unsafe_code)]
    #[target_feature(enable = "avx2,fma")]
    unsafe fn by_avx2(size: [usize; 3], a: View<f64>, b: View<f64>, out: Target<f64>) {
        by_tiles::<f64, 8>(ROWS, size, a, b, out, |size, a, b, out| {
            wide_256::tile_f64(size, a, b, out)
        });
    }

    #[cfg(target_arch = "x86_64")]
    #[allow(private_interfaces, unsafe_code)]
    #[target_feature(enable = "avx512f")]
    unsafe fn by_avx512(size: [usize; 3], a: View<f64>, b: View<f64>, out: Target<f64>) {
        by_tiles::<f64, 16>(ROWS, size, a, b, out, |size, a, b, out| {
            wide_512::tile_f64(size, a, b, out)
        });
    }
}

/// A register of several numbers.
trait Lanes<T>: Copy {
    /// Number of entries.
    const COUNT: usize;
    /// The same number in every entry.
    fn splat(value: T) -> Self;
    /// Loads the first entries of a slice.
    fn load(from: &[T]) -> Self;
    /// self + a b.
    fn step(self, a: Self, b: Self) -> Self;
    /// Stores to the first entries of a slice.
    fn store(self, to: &mut [T]);
}

impl<T: Real> Lanes<T> for [T; 8] {
    const COUNT: usize = 8;

    #[inline(always)]
    fn splat(value: T) -> Self {
        [value; 8]
    }

    #[inline(always)]
    fn load(from: &[T]) -> Self {
        std::array::from_fn(|i| from[..8][i])
    }

    #[inline(always)]
    fn step(self, a: Self, b: Self) -> Self {
        std::array::from_fn(|i| T::step(a[i], b[i], self[i]))
    }

    #[inline(always)]
    fn store(self, to: &mut [T]) {
        to[..8].copy_from_slice(&self);
    }
}

/// [`f32::mul_add`] for processors without that instruction; the compiler can vectorise it. The
/// product is exact in f64 and the sum is rounded to odd, so rounding it to f32 gives the same as
/// rounding the exact sum \[Boldo 2008\].
#[inline(always)]
fn mul_add(a: f32, b: f32, c: f32) -> f32 {
    let (product, c) = (f64::from(a) * f64::from(b), f64::from(c));
    let sum = product + c;
    let added = sum - product;
    let lost = (product - (sum - added)) + (c - added);
    let is_even = !sum.to_bits() & 1;
    let is_inexact = u64::from((lost > 0.0) | (lost < 0.0));
    let away = 2 * u64::from((lost > 0.0) == (sum > 0.0));
    f64::from_bits(sum.to_bits().wrapping_add(away.wrapping_sub(1) * (is_even & is_inexact))) as f32
}

/// A matrix whose entry (i, j) is at i * `row` + j * `column`; one of the two is 1.
#[derive(Clone, Copy)]
pub(super) struct View<'a, T> {
    pub(super) data: &'a [T],
    pub(super) row: usize,
    pub(super) column: usize,
}

impl<'a, T> View<'a, T> {
    fn from(self, row: usize, column: usize) -> Self {
        let at = row * self.row + column * self.column;
        Self { data: self.data.get(at..).unwrap_or(&[]), ..self }
    }
}

/// The output of a product: row-major, its rows `stride` apart.
pub(super) struct Target<'a, T> {
    pub(super) data: &'a mut [T],
    pub(super) stride: usize,
    pub(super) accum: Accum,
    /// Whether only the entries (i, j) with j >= i are computed.
    pub(super) upper: bool,
}

impl<T: Real> Target<'_, T> {
    /// The part from an entry on, including its lower half.
    fn from(&mut self, row: usize, column: usize) -> Target<'_, T> {
        let (stride, accum) = (self.stride, self.accum);
        let data = &mut self.data[row * stride + column..];
        Target { data, stride, accum, upper: false }
    }

    /// Writes the sums of `columns` to a row; the first of `sums` belongs to column `first`.
    #[inline(always)]
    fn write(&mut self, row: usize, columns: Range<usize>, first: usize, sums: &[T]) {
        let start = if self.upper { columns.start.max(row) } else { columns.start };
        if start < columns.end {
            let sums = &sums[start - first..columns.end - first];
            let both = self.data[row * self.stride + start..][..sums.len()].iter_mut().zip(sums);
            match self.accum {
                Accum::Replace => both.for_each(|(out, sum)| *out = *sum),
                Accum::Add => both.for_each(|(out, sum)| *out += *sum),
                Accum::Subtract => both.for_each(|(out, sum)| *out -= *sum),
            }
        }
    }
}

/// out (m x n) = a (m x k) b (k x n), or as its `accum` says.
pub(super) fn multiply<T: Real>(
    path: Path,
    size: [usize; 3],
    a: View<T>,
    b: View<T>,
    out: Target<T>,
) {
    match path {
        // One row at a time, because there are few registers.
        Path::Plain => by_tiles::<T, 16>(1, size, a, b, out, tile::<T, [T; 8]>),
        // SAFETY: the processor has AVX2 and FMA.
        #[cfg(target_arch = "x86_64")]
        #[allow(unsafe_code)]
        Path::Avx2 => unsafe { T::by_avx2(size, a, b, out) },
        // SAFETY: the processor has AVX-512.
        #[cfg(target_arch = "x86_64")]
        #[allow(unsafe_code)]
        Path::Avx512 => unsafe { T::by_avx512(size, a, b, out) },
    }
}

/// [`multiply`] in tiles of at most `most` rows and C columns.
#[inline(always)]
fn by_tiles<T: Real, const C: usize>(
    most: usize,
    [m, k, n]: [usize; 3],
    a: View<T>,
    b: View<T>,
    mut out: Target<T>,
    tile: impl Fn([usize; 2], View<T>, View<T>, Target<T>),
) {
    let (mut packed, mut sums) = (None, [[T::zero(); C]; ROWS]);
    let tiles = m.div_ceil(most);
    for begin in (0..k.max(1)).step_by(DEPTH) {
        let depth = DEPTH.min(k - begin);
        for new in (0..n).step_by(C) {
            // The last strip is as wide as the others, so it overlaps the one before.
            let (first, end) = (new.min(n.saturating_sub(C)), n.min(new + C));
            let mut strip = b.from(begin, first);
            if b.column != 1 || end - first < C || tiles > FEW {
                let packed = packed.get_or_insert([[T::zero(); C]; DEPTH]);
                strip = pack(strip, end - first, &mut packed[..depth]);
            }
            for number in 0..tiles {
                let rows = number * m / tiles..(number + 1) * m / tiles;
                if out.upper && rows.start >= end {
                    continue;
                }
                let (size, a) = ([rows.len(), depth], a.from(rows.start, begin));
                let is_whole = end - new == C && !(out.upper && rows.end > new + 1);
                if is_whole {
                    tile(size, a, strip, out.from(rows.start, new));
                } else {
                    let data = sums.as_flattened_mut();
                    let (stride, accum) = (C, Accum::Replace);
                    tile(size, a, strip, Target { data, stride, accum, upper: false });
                    rows.zip(&sums).for_each(|(row, sums)| out.write(row, new..end, first, sums));
                }
            }
        }
        if out.accum == Accum::Replace {
            out.accum = Accum::Add;
        }
    }
}

/// Copies the first `width` columns of a strip to contiguous memory; the others stay zero.
#[inline(always)]
fn pack<'p, T: Real, const C: usize>(
    strip: View<T>,
    width: usize,
    packed: &'p mut [[T; C]],
) -> View<'p, T> {
    for (k, out) in packed.iter_mut().enumerate() {
        let row = &strip.data[k * strip.row..];
        match (strip.column, width) {
            (1, width) if width == C => out.copy_from_slice(&row[..C]),
            (column, _) => {
                let row = row.iter().step_by(column).take(width);
                out.iter_mut().zip(row).for_each(|(out, v)| *out = *v);
            }
        }
    }
    View { data: packed.as_flattened(), row: C, column: 1 }
}

/// Computes a tile over the first `depth` columns of a and rows of b.
#[inline(always)]
fn tile<T: Real, L: Lanes<T>>([rows, depth]: [usize; 2], a: View<T>, b: View<T>, out: Target<T>) {
    match rows {
        2 => chains::<T, L, 2>(depth, a, b, out),
        3 => chains::<T, L, 3>(depth, a, b, out),
        4 => chains::<T, L, 4>(depth, a, b, out),
        5 => chains::<T, L, 5>(depth, a, b, out),
        6 => chains::<T, L, 6>(depth, a, b, out),
        _ => chains::<T, L, 1>(depth, a, b, out),
    }
}

/// Computes a tile of R rows. The sums stay in registers.
#[inline(always)]
fn chains<T: Real, L: Lanes<T>, const R: usize>(
    depth: usize,
    a: View<T>,
    b: View<T>,
    out: Target<T>,
) {
    if a.column == 1 {
        let rows: &[&[T]; R] = &std::array::from_fn(|row| &a.data[row * a.row..][..depth]);
        let both = |k: usize| (move |row: usize| rows[row][k], &b.data[k * b.row..]);
        chains_of::<T, L, R>((0..depth).map(both), out);
    } else {
        let columns = a.data.chunks(a.column).map(|column| {
            let column = &column[..R];
            move |row: usize| column[row]
        });
        chains_of::<T, L, R>(columns.zip(b.data.chunks(b.row)).take(depth), out);
    }
}

/// Computes a tile from the columns of a, read by row, and the rows of b.
#[inline(always)]
// The compiler keeps the sums in registers where they are indexed.
#[allow(clippy::needless_range_loop)]
fn chains_of<'b, T: Real, L: Lanes<T>, const R: usize>(
    both: impl Iterator<Item = (impl Fn(usize) -> T, &'b [T])>,
    out: Target<T>,
) {
    let mut sums = [[L::splat(T::zero()); 2]; R];
    for (a, b) in both {
        let b = &b[..2 * L::COUNT];
        let (left, right) = (L::load(b), L::load(&b[L::COUNT..]));
        for row in 0..R {
            let a = L::splat(a(row));
            sums[row][0] = sums[row][0].step(a, left);
            sums[row][1] = sums[row][1].step(a, right);
        }
    }
    // A step with 1 or -1 adds or subtracts with one rounding.
    let sign = L::splat(if out.accum == Accum::Subtract { -T::one() } else { T::one() });
    for row in 0..R {
        let out_row = &mut out.data[row * out.stride..][..2 * L::COUNT];
        for half in 0..2 {
            let (out_half, sum) = (&mut out_row[half * L::COUNT..], sums[row][half]);
            let is_new = out.accum == Accum::Replace;
            let sum = if is_new { sum } else { L::load(out_half).step(sign, sum) };
            sum.store(out_half);
        }
    }
}

/// Tiles in wide registers, with a fused step in f32.
#[cfg(target_arch = "x86_64")]
macro_rules! lanes {
    (
        $features:literal, $number:ty, $lanes:ty,
        $tile:ident, $splat:ident, $load:ident, $store:ident, $step:expr
    ) => {
        // A function of its own: then the compiler keeps the variables of its loops in registers.
        #[target_feature(enable = $features)]
        #[inline(never)]
        pub(super) fn $tile(
            size: [usize; 2],
            a: View<$number>,
            b: View<$number>,
            out: Target<$number>,
        ) {
            tile::<$number, $lanes>(size, a, b, out);
        }

        // SAFETY: only the function above uses these, so the processor has the features. Loads and
        // stores stay within slices of the right length.
        #[allow(unsafe_code)]
        impl Lanes<$number> for $lanes {
            const COUNT: usize = size_of::<$lanes>() / size_of::<$number>();

            #[inline(always)]
            fn splat(value: $number) -> Self {
                unsafe { $splat(value) }
            }

            #[inline(always)]
            fn load(from: &[$number]) -> Self {
                unsafe { $load(from[..Self::COUNT].as_ptr()) }
            }

            #[inline(always)]
            fn step(self, a: Self, b: Self) -> Self {
                unsafe { $step(a, b, self) }
            }

            #[inline(always)]
            fn store(self, to: &mut [$number]) {
                unsafe { $store(to[..Self::COUNT].as_mut_ptr(), self) }
            }
        }
    };
}

/// Registers of 256 bits.
#[cfg(target_arch = "x86_64")]
#[rustfmt::skip]
mod wide_256 {
    use std::arch::x86_64::*;

    use super::{Lanes, Target, View, tile};

    lanes!(
        "avx2,fma", f32, __m256,
        tile_f32, _mm256_set1_ps, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_fmadd_ps
    );
    lanes!(
        "avx2,fma", f64, __m256d,
        tile_f64, _mm256_set1_pd, _mm256_loadu_pd, _mm256_storeu_pd,
        |a, b, sum| _mm256_add_pd(sum, _mm256_mul_pd(a, b))
    );
}

/// Registers of 512 bits.
#[cfg(target_arch = "x86_64")]
#[rustfmt::skip]
mod wide_512 {
    use std::arch::x86_64::*;

    use super::{Lanes, Target, View, tile};

    lanes!(
        "avx512f", f32, __m512,
        tile_f32, _mm512_set1_ps, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_fmadd_ps
    );
    lanes!(
        "avx512f", f64, __m512d,
        tile_f64, _mm512_set1_pd, _mm512_loadu_pd, _mm512_storeu_pd,
        |a, b, sum| _mm512_add_pd(sum, _mm512_mul_pd(a, b))
    );
}

#[cfg(test)]
mod tests {
    use super::mul_add;

    #[test]
    fn the_multiply_add_without_an_instruction_for_it_is_exact() {
        let mut state = 1_u64;
        let mut draw = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 32) as u32
        };
        for turn in 0..1_000_000 {
            let (a, b) = (f32::from_bits(draw()), f32::from_bits(draw()));
            // Any number, or one that nearly cancels the product.
            let near = (-(a * b)).to_bits().wrapping_add((draw() >> 26) << (draw() % 24));
            let c = f32::from_bits(if turn % 2 == 0 { draw() } else { near });
            let (ours, expected) = (mul_add(a, b, c), a.mul_add(b, c));
            let is_same = ours.to_bits() == expected.to_bits();
            assert!(is_same || ours.is_nan() && expected.is_nan(), "{a:e} {b:e} {c:e}");
        }
    }
}
