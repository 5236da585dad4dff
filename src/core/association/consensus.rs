//! Where most views see a performer.

use nalgebra::{Matrix2x3, Matrix3, Vector2, Vector3};

use super::parts::Points;
use super::{Sight, View};
use crate::core::detections::Keypoint as K;

/// The points that are compared: on the trunk and the thighs, which detectors find well.
const POINTS: [K; 8] =
    [K::LEar, K::REar, K::LShoulder, K::RShoulder, K::LHip, K::RHip, K::LKnee, K::RKnee];
/// A view shows the performer if this many of them are seen.
const LEAST_POINTS: usize = 3;
/// Scales of the loss, one after the other, as fractions of the size in the image.
const SCALES: [f64; 6] = [0.20, 0.20, 0.10, 0.10, 0.05, 0.05];
/// How far a prediction is wrong, metres, and the number of points that it counts for.
const PREDICTION_M: f64 = 0.15;
const PREDICTION_POINTS: f64 = 2.0;
/// An error that counts as this one if it is larger.
const FAR: f64 = 0.3;

/// A point in a view: its error as a fraction of the size in the image, and the derivative of its
/// projection, in that unit a metre.
struct Seen {
    error: Vector2<f64>,
    by_shift: Matrix2x3<f64>,
}

/// What the views say of a performer's place.
pub(super) struct Consensus {
    /// To be added to the performer's points, metres.
    pub(super) shift: Vector3<f64>,
    /// The median of the views' mean errors after that, as a fraction of the size in the image.
    pub(super) error: f64,
}

/// The shift of the predicted points that most views agree on: iteratively reweighted least squares
/// with the Geman-McClure loss, whose scale shrinks. Points behind a camera do not count. `None` with
/// fewer than three views: two cannot outvote one another.
pub(super) fn consensus(points: &Points, views: &[(&View, &Sight, f64)]) -> Option<Consensus> {
    let of_view = |(view, sight, size): &(&View, &Sight, f64)| {
        let seen = POINTS.iter().filter_map(|&keypoint| {
            let (point, pixel) = (points[keypoint as usize]?, sight.pixels[keypoint as usize]?);
            let (projected, by_point) = view.camera.project_with_jacobian(&point)?;
            Some(Seen { error: (pixel - projected) / *size, by_shift: by_point / *size })
        });
        let seen: Vec<Seen> = seen.collect();
        (seen.len() >= LEAST_POINTS).then_some(seen)
    };
    let views: Vec<Vec<Seen>> = views.iter().filter_map(of_view).collect();
    if views.len() < 3 {
        return None;
    }
    let mut shift = Vector3::zeros();
    for scale in SCALES {
        let stay = PREDICTION_POINTS * (scale / PREDICTION_M) * (scale / PREDICTION_M);
        let mut normal = Matrix3::from_diagonal_element(stay);
        let mut right = Vector3::zeros();
        for seen in views.iter().flatten() {
            let left = (seen.error - seen.by_shift * shift).norm_squared() / (scale * scale);
            let weight = 1.0 / ((1.0 + left) * (1.0 + left));
            normal += seen.by_shift.tr_mul(&seen.by_shift) * weight;
            right += seen.by_shift.tr_mul(&seen.error) * weight;
        }
        shift = normal.cholesky()?.solve(&right);
    }
    let error = |view: &Vec<Seen>| {
        let left = |seen: &Seen| (seen.error - seen.by_shift * shift).norm().min(FAR);
        view.iter().map(left).sum::<f64>() / view.len() as f64
    };
    let mut errors: Vec<f64> = views.iter().map(error).collect();
    errors.sort_by(f64::total_cmp);
    Some(Consensus { shift, error: errors[errors.len() / 2] })
}
