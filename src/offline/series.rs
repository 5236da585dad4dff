//! Plot values over time, in memory that does not grow with the recording's length.

/// Most bins of a series.
pub(crate) const LIMIT: usize = 4096;

/// A value that can be merged with the following ones into one bin.
pub(crate) trait Bin {
    /// Merges the next value.
    fn merge(&mut self, next: Self);
}

/// Values over time: all of them up to a limit, [`LIMIT`] by default, then bins of 2, 4, 8 ... values.
#[derive(Clone, Debug)]
pub(crate) struct Series<T> {
    bins: Vec<T>,
    limit: usize,
    /// Number of values in a full bin.
    size: usize,
    /// Number of values in the last bin.
    last: usize,
}

impl<T> Default for Series<T> {
    fn default() -> Self {
        Self::up_to(LIMIT)
    }
}

impl<T> Series<T> {
    /// With at most `limit` bins; a limit below 2 counts as 2.
    pub(crate) fn up_to(limit: usize) -> Self {
        Self { bins: Vec::new(), limit: limit.max(2), size: 1, last: 1 }
    }
}

impl<T: Bin> Series<T> {
    /// Adds the next value.
    pub(crate) fn push(&mut self, value: T) {
        if self.last < self.size
            && let Some(bin) = self.bins.last_mut()
        {
            bin.merge(value);
            self.last += 1;
            return;
        }
        if self.bins.len() == self.limit {
            self.halve();
        }
        self.bins.push(value);
        self.last = 1;
    }

    /// The bins in order of time.
    pub(crate) fn bins(&self) -> &[T] {
        &self.bins
    }

    fn halve(&mut self) {
        let mut bins = std::mem::take(&mut self.bins).into_iter();
        while let Some(mut bin) = bins.next() {
            if let Some(next) = bins.next() {
                bin.merge(next);
            }
            self.bins.push(bin);
        }
        self.size *= 2;
    }
}

/// The mean of values, with the time of the first.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mean<A, const N: usize> {
    pub(crate) at: A,
    sums: [f64; N],
    count: f64,
}

impl<A, const N: usize> Mean<A, N> {
    pub(crate) fn new(at: A, values: [f64; N]) -> Self {
        Self { at, sums: values, count: 1.0 }
    }

    pub(crate) fn values(&self) -> [f64; N] {
        self.sums.map(|sum| sum / self.count)
    }
}

impl<A, const N: usize> Bin for Mean<A, N> {
    fn merge(&mut self, next: Self) {
        for (sum, value) in self.sums.iter_mut().zip(next.sums) {
            *sum += value;
        }
        self.count += next.count;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_kept_and_then_become_means() {
        let mut series = Series::default();
        for i in 0..LIMIT {
            series.push(Mean::new(i, [i as f64]));
        }
        assert_eq!(series.bins().len(), LIMIT);
        assert_eq!(series.bins()[7].values(), [7.0]);
        for i in LIMIT..10 * LIMIT {
            series.push(Mean::new(i, [i as f64]));
        }
        assert_eq!((series.bins().len(), series.size), (10 * LIMIT / 16, 16));
        assert_eq!((series.bins()[1].at, series.bins()[1].values()), (16, [23.5]));
        let count: f64 = series.bins().iter().map(|bin| bin.count).sum();
        assert_eq!(count as usize, 10 * LIMIT);
    }

    #[test]
    fn a_series_has_at_least_two_bins_and_does_not_grow() {
        let mut series = Series::up_to(1);
        (0..100).for_each(|i| series.push(Mean::new(i, [0.0])));
        assert!(series.bins().len() <= 2, "{}", series.bins().len());
    }
}
