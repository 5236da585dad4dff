//! Percentiles of a stream of values in bounded memory.

use super::statistics::percentiles;

/// Number of values that are stored exactly; beyond it, a histogram is used.
const EXACT: usize = 1 << 17;
/// Low bits of a single-precision number that do not select the bin: 1024 bins per octave.
const SHIFT: u32 = 13;
/// The values of the first and the last bin: 2^-10 and 2^20.
const RANGE: [f32; 2] = [9.765_625e-4, 1_048_576.0];

/// The distribution of values that are 0 or above, for instance errors in pixels.
///
/// Percentiles are exact for up to 131,072 values. Beyond that, values are counted in bins that are
/// 0.1 % wide: a percentile is the middle of its bin, at most 0.05 % off, and values below 2^-10 or
/// above 2^20 count in the first or last bin. Memory: at most 1 MB.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Distribution {
    exact: Vec<f64>,
    /// Counts by bin; empty while values are stored exactly.
    bins: Vec<u64>,
    count: u64,
}

impl Distribution {
    /// Adds a value; NaN is ignored.
    pub fn add(&mut self, value: f64) {
        if value.is_nan() {
            return;
        }
        self.count += 1;
        if self.bins.is_empty() {
            self.exact.push(value);
            if self.exact.len() > EXACT {
                self.bins = vec![0; bin_of(f64::from(RANGE[1])) + 1];
                for value in std::mem::take(&mut self.exact) {
                    self.bins[bin_of(value)] += 1;
                }
            }
        } else {
            self.bins[bin_of(value)] += 1;
        }
    }

    /// Number of added values.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The median; `None` without values.
    pub fn median(&self) -> Option<f64> {
        self.percentiles([50.0]).map(|[median]| median)
    }

    /// Several percentiles, p in \[0, 100\]; `None` without values. See [`percentiles`].
    pub fn percentiles<const N: usize>(&self, p: [f64; N]) -> Option<[f64; N]> {
        if self.bins.is_empty() {
            return percentiles(&self.exact, p);
        }
        Some(p.map(|p| self.percentile_of_bins(p)))
    }

    fn percentile_of_bins(&self, p: f64) -> f64 {
        let rank = (p.clamp(0.0, 100.0) / 100.0 * (self.count - 1) as f64).round() as u64;
        let mut before = 0;
        let bin = self.bins.iter().position(|count| {
            before += count;
            before > rank
        });
        middle_of(bin.unwrap_or(self.bins.len() - 1))
    }
}

/// The bits of positive numbers have the same order as the numbers.
fn bin_of(value: f64) -> usize {
    let bits = (value as f32).clamp(RANGE[0], RANGE[1]).to_bits();
    ((bits - RANGE[0].to_bits()) >> SHIFT) as usize
}

fn middle_of(bin: usize) -> f64 {
    let low = RANGE[0].to_bits() + ((bin as u32) << SHIFT);
    f64::from(f32::from_bits(low + (1 << (SHIFT - 1))))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values from 0 to 10, unordered.
    fn values(count: usize) -> impl Iterator<Item = f64> {
        (0..count).map(move |i| 10.0 * ((i * 7919) % count) as f64 / count as f64)
    }

    #[test]
    fn few_values_are_exact() {
        let mut few = Distribution::default();
        assert_eq!(few.median(), None);
        [4.0, 1.0, f64::NAN, 3.0, 2.0].into_iter().for_each(|value| few.add(value));
        assert_eq!((few.median(), few.count()), (Some(2.5), 4));
        assert_eq!(few.percentiles([25.0, 90.0]), Some([1.75, 3.7]));
    }

    #[test]
    fn percentiles_of_many_values_are_off_by_a_twentieth_of_a_percent() {
        let mut many = Distribution::default();
        values(1_000_003).for_each(|value| many.add(value));
        assert!(many.exact.is_empty() && many.bins.len() < 40_000);
        for p in [1.0, 25.0, 50.0, 75.0, 99.0] {
            let found = many.percentiles([p]).unwrap()[0];
            assert!((found / (p / 10.0) - 1.0).abs() < 6e-4, "{p}: {found}");
        }
        many.add(f64::INFINITY);
        many.add(0.0);
        assert_eq!(many.count(), 1_000_005);
    }
}
