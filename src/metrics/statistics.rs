//! Order statistics, means and straight lines.

/// The p-th percentile, p in \[0, 100\], with linear interpolation between neighbours
/// (\[Hyndman 1996\], definition 7). NaN values are ignored. `None` without values.
pub fn percentile(values: &[f64], p: f64) -> Option<f64> {
    percentiles(values, [p]).map(|[value]| value)
}

/// The median. NaN values are ignored. `None` without values.
pub fn median(values: &[f64]) -> Option<f64> {
    percentile(values, 50.0)
}

/// Several percentiles at once, see [`percentile`].
pub fn percentiles<const N: usize>(values: &[f64], p: [f64; N]) -> Option<[f64; N]> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|v| !v.is_nan()).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    Some(p.map(|p| {
        let at = (p.clamp(0.0, 100.0) / 100.0) * last as f64;
        let (low, high) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
        low + (high - low) * at.fract()
    }))
}

/// The mean; `None` without values.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// A straight line in x and y: y = `mean_y` + `slope` (x - `mean_x`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// Mean of x.
    pub mean_x: f64,
    /// Mean of y.
    pub mean_y: f64,
    /// Change of y per unit of x.
    pub slope: f64,
    /// Sum of (x - mean x)^2.
    pub spread: f64,
}

impl Line {
    /// Fits the line by least squares in y. `None` if all x are equal or there are no points.
    pub fn fit(points: impl Iterator<Item = (f64, f64)> + Clone) -> Option<Self> {
        let count = points.clone().count() as f64;
        let sum = points.clone().fold((0.0, 0.0), |sum, p| (sum.0 + p.0, sum.1 + p.1));
        let (mean_x, mean_y) = (sum.0 / count, sum.1 / count);
        let (product, spread) = points.fold((0.0, 0.0), |sum, (x, y)| {
            let (x, y) = (x - mean_x, y - mean_y);
            (sum.0 + x * y, sum.1 + x * x)
        });
        (spread > 0.0).then(|| Self { mean_x, mean_y, slope: product / spread, spread })
    }

    /// y at `x`.
    pub fn at(&self, x: f64) -> f64 {
        self.mean_y + self.slope * (x - self.mean_x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_goes_through_points_that_lie_on_one() {
        let line = Line::fit([(1.0, 5.0), (2.0, 7.0), (4.0, 11.0)].into_iter()).unwrap();
        assert!((line.slope - 2.0).abs() < 1e-12 && (line.at(0.0) - 3.0).abs() < 1e-12);
        assert_eq!(Line::fit([(1.0, 5.0), (1.0, 7.0)].into_iter()), None);
        assert_eq!(Line::fit([].into_iter()), None);
    }

    #[test]
    fn percentiles_interpolate_between_neighbours() {
        let values = [4.0, 1.0, f64::NAN, 3.0, 2.0];
        assert_eq!(median(&values), Some(2.5));
        assert_eq!(percentile(&values, 0.0), Some(1.0));
        assert_eq!(percentile(&values, 100.0), Some(4.0));
        assert_eq!(percentiles(&values, [25.0, 90.0]), Some([1.75, 3.7]));
        assert_eq!(median(&[f64::NAN]), None);
        assert_eq!((mean(&[1.0, 2.0]), mean(&[])), (Some(1.5), None));
    }
}
