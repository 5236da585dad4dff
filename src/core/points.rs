//! Measures and limits of points that several modules share.

use std::ops::Range;

use nalgebra::Vector2;

/// Points of at most this confidence are not used to judge cameras, tracks and errors.
pub const CONFIDENT: f64 = 0.3;

/// Distance from hips to shoulders of a person, metres.
pub const TRUNK_LENGTH: Range<f64> = 0.25..0.85;

/// The longer side of the bounding box of some points, in their unit; 0 without any.
pub fn extent(points: impl Iterator<Item = Vector2<f64>>) -> f64 {
    let mut low = Vector2::repeat(f64::INFINITY);
    let mut high = Vector2::repeat(f64::NEG_INFINITY);
    for point in points {
        (low, high) = (low.inf(&point), high.sup(&point));
    }
    (high - low).max().max(0.0)
}

/// The median; of an even count, the upper of the two in the middle. The order of the values changes.
pub fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}
