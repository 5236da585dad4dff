//! Whether errors are as large as their standard deviations say.

use serde::Serialize;

/// Shares of errors within one and within two standard deviations, percent. Of normally distributed
/// errors with the right deviations they are 68 and 95.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Coverage {
    /// Number of compared coordinates.
    pub coordinates: usize,
    /// Share within one standard deviation.
    pub within_1_percent: f64,
    /// Share within two.
    pub within_2_percent: f64,
}

/// Counts errors for a [`Coverage`].
#[derive(Clone, Copy, Debug, Default)]
pub struct CoverageSums {
    all: usize,
    within: [usize; 2],
}

impl CoverageSums {
    /// Adds the errors of a point along each axis, and their standard deviation, in the same unit.
    pub fn add<'e>(&mut self, errors: impl IntoIterator<Item = &'e f64>, deviation: f64) {
        for error in errors {
            self.all += 1;
            for (count, limit) in self.within.iter_mut().zip([1.0, 2.0]) {
                *count += usize::from(error.abs() <= limit * deviation);
            }
        }
    }

    /// The shares; `None` without errors.
    pub fn finish(self) -> Option<Coverage> {
        let percent = |count: usize| 100.0 * count as f64 / self.all as f64;
        let [within_1_percent, within_2_percent] = self.within.map(percent);
        (self.all > 0).then_some(Coverage {
            coordinates: self.all,
            within_1_percent,
            within_2_percent,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_counted_within_one_and_two_deviations() {
        let mut sums = CoverageSums::default();
        assert_eq!(sums.finish(), None);
        sums.add(&[0.5, -1.0, 1.5, -3.0], 1.0);
        sums.add(&[0.01], 0.02);
        let coverage = sums.finish().unwrap();
        assert_eq!((coverage.coordinates, coverage.within_1_percent), (5, 60.0));
        assert_eq!(coverage.within_2_percent, 80.0);
    }
}
