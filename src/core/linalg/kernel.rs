//! Products of dense matrices with the same bits on every processor.
//!
//! An element of a product is the sum of a_ik b_kj with k ascending, begun at zero: one chain of steps,
//! in f32 with one rounding each (a fused multiply-add), in f64 with two. A chain ends after [`DEPTH`]
//! steps; its sum replaces the element, is added to it or subtracted from it, and the next begins.
//! Neither the tiles in which elements are computed nor the registers they are in change a bit of it.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;
use std::ops::Range;

use nalgebra::RealField;

use super::{Accum, Path};

/// Steps of a chain.
pub(super) const DEPTH: usize = 256;
/// Columns of a tile.
const COLUMNS: usize = 2 * LANES;
/// Numbers that are loaded at once.
const LANES: usize = 8;
/// Rows of the largest tile, which takes 12 registers of 8 numbers.
const ROWS: usize = 12;
/// With more tiles in a strip of columns than this, it pays to copy the strip to one place first.
const FEW: usize = 16;

type Sums<T> = [[T; COLUMNS]; ROWS];

/// Numbers that products are made of.
pub trait Real: RealField + Copy {
    /// Those of a register of AVX2.
    #[cfg(target_arch = "x86_64")]
    #[doc(hidden)]
    type Avx2: Lanes<Self>;

    /// Rows of a tile at most.
    #[doc(hidden)]
    const ROWS: usize;

    /// sum + a b.
    #[doc(hidden)]
    fn step(a: Self, b: Self, sum: Self) -> Self;
}

impl Real for f32 {
    #[cfg(target_arch = "x86_64")]
    type Avx2 = std::arch::x86_64::__m256;
    const ROWS: usize = ROWS;

    #[inline(always)]
    fn step(a: f32, b: f32, sum: f32) -> f32 {
        match cfg!(any(target_feature = "fma", target_arch = "aarch64")) {
            true => a.mul_add(b, sum),
            false => mul_add(a, b, sum),
        }
    }
}

impl Real for f64 {
    #[cfg(target_arch = "x86_64")]
    type Avx2 = [f64; LANES];
    const ROWS: usize = 1;

    #[inline(always)]
    fn step(a: f64, b: f64, sum: f64) -> f64 {
        sum + a * b
    }
}

/// Eight numbers, with which the same is done.
#[doc(hidden)]
pub trait Lanes<T>: Copy {
    /// All alike.
    fn splat(value: T) -> Self;
    /// The first of a slice.
    fn load(from: &[T]) -> Self;
    /// self + a b.
    fn step(self, a: Self, b: Self) -> Self;
    /// To the first of a slice.
    fn store(self, to: &mut [T]);
}

impl<T: Real> Lanes<T> for [T; LANES] {
    #[inline(always)]
    fn splat(value: T) -> Self {
        [value; LANES]
    }

    #[inline(always)]
    fn load(from: &[T]) -> Self {
        std::array::from_fn(|i| from[..LANES][i])
    }

    #[inline(always)]
    fn step(self, a: Self, b: Self) -> Self {
        std::array::from_fn(|i| T::step(a[i], b[i], self[i]))
    }

    #[inline(always)]
    fn store(self, to: &mut [T]) {
        to[..LANES].copy_from_slice(&self);
    }
}

/// [`f32::mul_add`] without an instruction for it, so that several are computed at once: in f64 the
/// product is exact and the sum is rounded to odd, which makes the second rounding that of the exact
/// sum \[Boldo 2008\].
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

/// A matrix whose entry (i, j) is at i * `row` + j * `column`; one of them is 1.
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

/// Where a product goes: row-major, its rows `stride` apart.
pub(super) struct Target<'a, T> {
    pub(super) data: &'a mut [T],
    pub(super) stride: usize,
    pub(super) accum: Accum,
    /// Whether only entries (i, j) with j >= i are wanted.
    pub(super) upper: bool,
}

impl<T: Real> Target<'_, T> {
    /// Takes those of a row's sums that are of `columns`; the first is of column `first`.
    #[inline(always)]
    fn take(&mut self, row: usize, columns: Range<usize>, first: usize, sums: &[T; COLUMNS]) {
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

/// out (m x n) takes a (m x k) b (k x n).
pub(super) fn multiply<T: Real>(
    path: Path,
    size: [usize; 3],
    a: View<T>,
    b: View<T>,
    out: Target<T>,
) {
    match path {
        Path::Plain => by_tiles(1, size, a, b, out, tile::<T, [T; LANES], 1>),
        // SAFETY: the processor has AVX2 and FMA.
        #[cfg(target_arch = "x86_64")]
        #[allow(unsafe_code)]
        Path::Avx2 => unsafe { avx2::multiply(size, a, b, out) },
        // SAFETY: the processor has AVX-512 with short registers too.
        #[cfg(target_arch = "x86_64")]
        #[allow(unsafe_code)]
        Path::Avx512 => unsafe { avx512::multiply(size, a, b, out) },
    }
}

#[inline(always)]
fn by_tiles<T: Real>(
    most: usize,
    [m, k, n]: [usize; 3],
    a: View<T>,
    b: View<T>,
    mut out: Target<T>,
    tile: impl Fn([usize; 2], View<T>, View<T>, &mut Sums<T>),
) {
    let (mut packed, mut sums) = (None, [[T::zero(); COLUMNS]; ROWS]);
    let tiles = m.div_ceil(most.min(T::ROWS));
    for begin in (0..k.max(1)).step_by(DEPTH) {
        let depth = DEPTH.min(k - begin);
        for new in (0..n).step_by(COLUMNS) {
            // The last strip is as wide as the others and overlaps the one before.
            let (first, end) = (new.min(n.saturating_sub(COLUMNS)), n.min(new + COLUMNS));
            let mut strip = b.from(begin, first);
            if b.column != 1 || end - first < COLUMNS || tiles > FEW {
                let packed = packed.get_or_insert([[T::zero(); COLUMNS]; DEPTH]);
                strip = pack(strip, end - first, &mut packed[..depth]);
            }
            for number in 0..tiles {
                let rows = number * m / tiles..(number + 1) * m / tiles;
                if !(out.upper && rows.start >= end) {
                    tile([rows.len(), depth], a.from(rows.start, begin), strip, &mut sums);
                    rows.zip(&sums).for_each(|(row, sums)| out.take(row, new..end, first, sums));
                }
            }
        }
        if out.accum == Accum::Replace {
            out.accum = Accum::Add;
        }
    }
}

/// Copies so many columns to one place; the others stay zero.
#[inline(always)]
fn pack<'p, T: Real>(strip: View<T>, width: usize, packed: &'p mut [[T; COLUMNS]]) -> View<'p, T> {
    for (k, out) in packed.iter_mut().enumerate() {
        let row = &strip.data[k * strip.row..];
        match (strip.column, width) {
            (1, COLUMNS) => out.copy_from_slice(&row[..COLUMNS]),
            (column, _) => {
                let row = row.iter().step_by(column).take(width);
                out.iter_mut().zip(row).for_each(|(out, v)| *out = *v);
            }
        }
    }
    View { data: packed.as_flattened(), row: COLUMNS, column: 1 }
}

/// The sums of a tile over the first `depth` columns of a and rows of b.
#[inline(always)]
fn tile<T: Real, L: Lanes<T>, const MOST: usize>(
    [rows, depth]: [usize; 2],
    a: View<T>,
    b: View<T>,
    sums: &mut Sums<T>,
) {
    macro_rules! of {
        ($($count:literal)*) => {
            match rows {
                $($count if MOST.min(T::ROWS) >= $count => chains::<T, L, $count>(depth, a, b, sums),)*
                _ => chains::<T, L, 1>(depth, a, b, sums),
            }
        };
    }
    of!(2 3 4 5 6 7 8 9 10 11 12)
}

/// The sums of R rows, which stay in registers.
#[inline(always)]
fn chains<T: Real, L: Lanes<T>, const R: usize>(
    depth: usize,
    a: View<T>,
    b: View<T>,
    out: &mut Sums<T>,
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

/// The same, of columns of a by their rows and rows of b.
#[inline(always)]
fn chains_of<'b, T: Real, L: Lanes<T>, const R: usize>(
    both: impl Iterator<Item = (impl Fn(usize) -> T, &'b [T])>,
    out: &mut Sums<T>,
) {
    let mut sums = [[L::splat(T::zero()); 2]; R];
    for (a, b) in both {
        let b = &b[..COLUMNS];
        let (left, right) = (L::load(b), L::load(&b[LANES..]));
        for row in 0..R {
            let a = L::splat(a(row));
            sums[row][0] = sums[row][0].step(a, left);
            sums[row][1] = sums[row][1].step(a, right);
        }
    }
    for row in 0..R {
        sums[row][0].store(&mut out[row]);
        sums[row][1].store(&mut out[row][LANES..]);
    }
}

/// By registers of 256 bits, with a fused step in f32.
#[cfg(target_arch = "x86_64")]
macro_rules! wide_path {
    ($name:ident, $features:literal, $rows:literal) => {
        mod $name {
            use super::{Real, Sums, Target, View, by_tiles};

            #[target_feature(enable = $features)]
            pub(super) fn multiply<T: Real>(
                size: [usize; 3],
                a: View<T>,
                b: View<T>,
                out: Target<T>,
            ) {
                by_tiles($rows, size, a, b, out, |size, a, b, sums| tile(size, a, b, sums));
            }

            /// By itself, for the compiler keeps its loops' variables in registers then.
            #[target_feature(enable = $features)]
            #[inline(never)]
            fn tile<T: Real>(size: [usize; 2], a: View<T>, b: View<T>, sums: &mut Sums<T>) {
                super::tile::<T, T::Avx2, $rows>(size, a, b, sums);
            }
        }
    };
}
#[cfg(target_arch = "x86_64")]
wide_path!(avx2, "avx2,fma", 6);
#[cfg(target_arch = "x86_64")]
wide_path!(avx512, "avx2,fma,avx512f,avx512vl", 12);

// SAFETY, for all below: only `multiply` uses these, so the processor has AVX2 and FMA; what is loaded
// and stored lies within slices of the right length.
#[allow(unsafe_code)]
#[cfg(target_arch = "x86_64")]
impl Lanes<f32> for __m256 {
    #[inline(always)]
    fn splat(value: f32) -> Self {
        unsafe { _mm256_set1_ps(value) }
    }

    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        unsafe { _mm256_loadu_ps(from[..LANES].as_ptr()) }
    }

    #[inline(always)]
    fn step(self, a: Self, b: Self) -> Self {
        unsafe { _mm256_fmadd_ps(a, b, self) }
    }

    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        unsafe { _mm256_storeu_ps(to[..LANES].as_mut_ptr(), self) }
    }
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
