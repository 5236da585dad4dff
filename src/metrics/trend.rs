//! 95 % confidence intervals of means and trends.

use serde::Serialize;

use super::statistics::Line;

/// A mean, or a slope, with its 95 % confidence interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// The estimate.
    pub value: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl Interval {
    fn about(value: f64, half: f64) -> Self {
        Self { value, low: value - half, high: value + half }
    }
}

/// Mean of independent values: m +- t s / sqrt(n), with the sample's standard deviation s and
/// the 97.5th percentile t of Student's distribution with n - 1 degrees of freedom. On
/// differences it is the paired t interval. `None` for fewer than two values.
pub fn mean_interval(values: &[f64]) -> Option<Interval> {
    let n = values.len();
    if n < 2 {
        return None;
    }
    let mean = values.iter().sum::<f64>() / n as f64;
    let square: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let deviation = (square / (n - 1) as f64).sqrt();
    Some(Interval::about(mean, student_975(n - 1) * deviation / (n as f64).sqrt()))
}

/// Slope of y over x: least squares on the means of `blocks` equal parts of the points, which are
/// in order of x. b +- t s / sqrt(sum (x - mean x)^2), with s^2 the squared residuals over n - 2.
/// Errors of neighbouring frames are correlated; means of parts that are longer than this
/// correlation are nearly independent. `None` for fewer than three parts or if all x are equal.
pub fn slope_interval(points: &[(f64, f64)], blocks: usize) -> Option<Interval> {
    let length = points.len().checked_div(blocks).filter(|&length| length > 0)?;
    let means: Vec<(f64, f64)> = points.chunks_exact(length).take(blocks).map(centre).collect();
    if means.len() < 3 {
        return None;
    }
    let Line { mean_x, mean_y, slope, spread } = Line::fit(means.iter().copied())?;
    let freedom = means.len() - 2;
    let squares = means.iter().map(|&(x, y)| ((y - mean_y) - slope * (x - mean_x)).powi(2));
    let variance = squares.sum::<f64>() / freedom as f64;
    Some(Interval::about(slope, student_975(freedom) * (variance / spread).sqrt()))
}

fn centre(points: &[(f64, f64)]) -> (f64, f64) {
    let n = points.len() as f64;
    let sum = points.iter().fold((0.0, 0.0), |sum, p| (sum.0 + p.0, sum.1 + p.1));
    (sum.0 / n, sum.1 / n)
}

/// 97.5th percentile of Student's distribution; from 11 degrees of freedom on by the expansion in
/// 1 / freedom about the normal distribution, accurate to 0.0002.
fn student_975(freedom: usize) -> f64 {
    const FEW: [f64; 10] =
        [12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281];
    if let Some(value) = freedom.checked_sub(1).and_then(|index| FEW.get(index)) {
        return *value;
    }
    let (z, n) = (1.959_964_f64, freedom as f64);
    let first = (z.powi(3) + z) / 4.0;
    let second = (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / 96.0;
    let third = (3.0 * z.powi(7) + 19.0 * z.powi(5) + 17.0 * z.powi(3) - 15.0 * z) / 384.0;
    z + first / n + second / n.powi(2) + third / n.powi(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-3, "{a} is not {b}");
    }

    #[test]
    fn students_percentiles_are_those_of_the_tables() {
        for (freedom, value) in [(1, 12.7062), (10, 2.2281), (11, 2.2010), (30, 2.0423)] {
            close(student_975(freedom), value);
        }
        close(student_975(1_000_000), 1.96);
    }

    #[test]
    fn a_mean_is_worth_its_scatter() {
        // s = 1, t(2) = 4.3027, n = 3.
        let mean = mean_interval(&[1.0, 2.0, 3.0]).unwrap();
        close(mean.value, 2.0);
        close(mean.high - mean.value, 4.3027 / 3f64.sqrt());
        assert_eq!(mean_interval(&[1.0]), None);
    }

    #[test]
    fn a_slope_by_hand() {
        // y = 0, 1, 1 at x = 0, 1, 2: b = 0.5, residuals -1/6, 1/3, -1/6, s^2 = 1/6, t(1).
        let slope = slope_interval(&[(0.0, 0.0), (1.0, 1.0), (2.0, 1.0)], 3).unwrap();
        close(slope.value, 0.5);
        close(slope.high - slope.value, 12.7062 * (1.0 / 12.0f64).sqrt());
    }

    #[test]
    fn a_wave_is_no_trend_and_a_trend_is_found_below_it() {
        let wave = |i: usize| (i as f64, (i as f64 * 0.1).sin() + ((i * 7919) % 13) as f64 * 0.1);
        let points: Vec<(f64, f64)> = (0..6000).map(wave).collect();
        let none = slope_interval(&points, 20).unwrap();
        assert!(none.low < 0.0 && none.high > 0.0, "{none:?}");
        let tilted: Vec<(f64, f64)> = points.iter().map(|&(x, y)| (x, y + 1e-3 * x)).collect();
        let some = slope_interval(&tilted, 20).unwrap();
        assert!(some.low > 0.0 && some.low < 1e-3 && some.high > 1e-3, "{some:?}");
        assert_eq!(slope_interval(&points[..10], 20), None);
        assert_eq!(slope_interval(&[(1.0, 1.0); 30], 10), None);
    }
}
