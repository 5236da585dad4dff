//! Order statistics.

/// The p-th percentile, p in \[0, 100\], between neighbours by linear interpolation
/// (\[Hyndman 1996\], definition 7). `None` without values; NaN values are left out.
pub fn percentile(values: &[f64], p: f64) -> Option<f64> {
    percentiles(values, [p]).map(|[value]| value)
}

/// The middle value. `None` without values; NaN values are left out.
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

#[cfg(test)]
mod tests {
    use super::*;

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
