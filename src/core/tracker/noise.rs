//! The residual level of the detections, which scales the prior and the stiffness.
//!
//! The cost is in square pixels. If the errors of a detector have twice the variance, its detections
//! carry half the information, so the weights of prior and stiffness are proportional to the variance.
//! They are also proportional to the mean confidence: a detector's scale of confidences has no meaning.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::{FRAC_PI_2, LN_2};

use nalgebra::Vector2;

use crate::core::points::median;
use crate::core::time::Timestamp;

/// Number of windows that the running mean covers, about.
const WINDOWS: f64 = 20.0;
/// The estimate is settled after this many windows.
const SETTLED: f64 = 8.0;
/// Mean confidence for which the weights were tuned.
const USUAL_CONFIDENCE: f64 = 0.6;
/// Limits of the weights' factor: small errors leave the errors of our model, and with large errors
/// poses must still follow the detections.
const FACTORS: (f64, f64) = (0.08, 2.0);
/// With fewer points, the shift of a camera may be chance.
const LEAST_POINTS: usize = 6;
/// A camera whose shift exceeds this many median errors is wrong. The solve hardly uses it.
const WRONG_CAMERA: f64 = 3.0;

/// How far a detected point is from the solved body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residual {
    /// Capture time of the detection.
    pub capture: Timestamp,
    /// Index of the camera.
    pub camera: usize,
    /// Index of the point in the format.
    pub point: usize,
    /// From the detection to the body's point in the image, pixels; infinite for a point behind the camera.
    pub way_px: Vector2<f64>,
    /// Its length as a part of the performer's height in that image.
    pub error_relative: f64,
    /// The detector's confidence.
    pub confidence: f64,
}

impl Residual {
    /// The distance in the image, pixels.
    pub fn error_px(&self) -> f64 {
        self.way_px.norm()
    }
}

/// A running estimate of the detections' errors: the median distance from the solved body, pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Noise {
    /// Mean of the windows' squared median errors, square pixels.
    square: f64,
    /// Mean of the windows' median errors as parts of the performer's height.
    relative: f64,
    /// Mean confidence of the detections.
    confidence: f64,
    /// Number of windows in it, at most [`WINDOWS`].
    windows: f64,
    /// Mean of the windows' [`shift_variance`], square pixels; not negative.
    shift: f64,
}

impl Noise {
    /// As numbers: mean of the squared errors, square pixels; mean relative error; mean confidence; number of windows;
    /// variance of the cameras' shifts along an axis, square pixels.
    pub fn numbers(&self) -> [f64; 5] {
        [self.square, self.relative, self.confidence, self.windows, self.shift]
    }

    /// The estimate of such numbers.
    pub fn of_numbers([square, relative, confidence, windows, shift]: [f64; 5]) -> Self {
        Self { square, relative, confidence, windows, shift }
    }

    /// The estimate after the residuals of one more solved window.
    pub(super) fn with(self, residuals: &[Residual]) -> Self {
        if residuals.is_empty() {
            return self;
        }
        let typical = |error: fn(&Residual) -> f64| {
            median(&mut residuals.iter().map(error).collect::<Vec<_>>()).unwrap_or(0.0)
        };
        let (error, relative) = (typical(Residual::error_px), typical(|r| r.error_relative));
        let windows = (self.windows + 1.0).min(WINDOWS);
        let square = self.square + (error * error - self.square) / windows;
        let relative = self.relative + (relative - self.relative) / windows;
        let confidence =
            residuals.iter().map(|r| r.confidence).sum::<f64>() / residuals.len() as f64;
        let confidence = self.confidence + (confidence - self.confidence) / windows;
        let shift = shift_variance(residuals, error).unwrap_or(self.shift);
        let shift = (self.shift + (shift - self.shift) / windows).max(0.0);
        Self { square, relative, confidence, windows, shift }
    }

    /// Whether it covers so many windows that it hardly depends on the first ones.
    pub(super) fn is_settled(&self) -> bool {
        self.windows >= SETTLED
    }

    /// The median error of the detections, pixels; `None` before the first window.
    pub(super) fn error_px(&self) -> Option<f64> {
        (self.windows > 0.0).then(|| libm::sqrt(self.square))
    }

    /// The median error of the detections as a part of the performer's height; 0 before the first
    /// window.
    pub(super) fn relative(&self) -> f64 {
        self.relative
    }

    /// The variance along an axis of a detection of confidence 1, square pixels, for normally distributed
    /// errors with the measured median; before the first window the median is `usual_px`.
    pub(super) fn variance_px(&self, usual_px: f64) -> f64 {
        let (square, confidence) = match self.windows > 0.0 {
            true => (self.square, self.confidence),
            false => (usual_px * usual_px, USUAL_CONFIDENCE),
        };
        along_an_axis(square) * confidence
    }

    /// The variance along an axis of the cameras' shifts, square pixels. A shift moves all points of a camera together: its
    /// calibration or its times are wrong. 0 if the residuals show no shifts.
    pub(super) fn shift_variance_px(&self) -> f64 {
        self.shift
    }

    /// The factor of weights that were tuned for median errors of `usual_px` and
    /// [`USUAL_CONFIDENCE`]; 1 before the first
    /// window or if `usual_px` is 0.
    pub(super) fn factor(&self, usual_px: f64) -> f64 {
        if self.windows == 0.0 || usual_px == 0.0 {
            return 1.0;
        }
        let variance = self.square / (usual_px * usual_px);
        (variance * self.confidence / USUAL_CONFIDENCE).clamp(FACTORS.0, FACTORS.1)
    }
}

/// The variance along an axis of normally distributed errors, from their squared median length.
fn along_an_axis(squared_median: f64) -> f64 {
    // The median of a Rayleigh distribution is sqrt(2 ln 2) of its scale.
    squared_median / (2.0 * LN_2)
}

/// [`Noise::shift_variance_px`] of one window with this median error. It may be below 0. `None` if fewer than two cameras
/// show enough points.
fn shift_variance(residuals: &[Residual], error_px: f64) -> Option<f64> {
    let mut cameras = BTreeMap::<usize, Vec<&Residual>>::new();
    for residual in residuals.iter().filter(|residual| residual.error_px().is_finite()) {
        cameras.entry(residual.camera).or_default().push(residual);
    }
    let (mut squares, mut chance, mut count) = (0.0, 0.0, 0_u32);
    for seen in cameras.values() {
        let typical = |of: &dyn Fn(&Residual) -> f64| {
            median(&mut seen.iter().map(|residual| of(residual)).collect::<Vec<_>>()).unwrap_or(0.0)
        };
        let common = Vector2::new(typical(&|r| r.way_px.x), typical(&|r| r.way_px.y));
        let own = typical(&|r| (r.way_px - common).norm());
        let points: BTreeSet<usize> = seen.iter().map(|residual| residual.point).collect();
        if points.len() < LEAST_POINTS || common.norm() > WRONG_CAMERA * error_px {
            continue;
        }
        squares += common.norm_squared();
        // The expected square of medians of independent errors, along an axis. The errors of a point hardly change
        // within a window, so each point counts once.
        chance += FRAC_PI_2 * along_an_axis(own * own) / points.len() as f64;
        count += 1;
    }
    // The place of the body follows the shifts along three axes: so many of the shifts' coordinates are lost.
    (count > 1).then(|| squares / f64::from(2 * count - 3) - chance / f64::from(count))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::time::Timestamp;

    fn window(error_px: f64) -> Vec<Residual> {
        let residual = |k: usize| Residual {
            capture: Timestamp::of_frame(1, 50.0),
            camera: 0,
            point: k,
            way_px: Vector2::new(if k == 0 { 500.0 } else { error_px }, 0.0),
            error_relative: 0.01,
            confidence: USUAL_CONFIDENCE,
        };
        (0..9).map(residual).collect()
    }

    #[test]
    fn weights_scale_with_the_variance_of_the_errors() {
        let unknown = Noise::default();
        assert_eq!((unknown.factor(10.0), unknown.with(&[])), (1.0, unknown));
        let known = |error: f64| (0..30).fold(unknown, |noise, _| noise.with(&window(error)));
        assert!((known(10.0).factor(10.0) - 1.0).abs() < 1e-12);
        assert!((known(12.0).factor(10.0) - 1.44).abs() < 1e-12);
        assert_eq!([known(0.1), known(90.0)].map(|n| n.factor(10.0)), [FACTORS.0, FACTORS.1]);
        assert_eq!(known(12.0).factor(0.0), 1.0);
    }

    #[test]
    fn weights_scale_with_the_confidence() {
        let halved = |r: Residual| Residual { confidence: 0.5 * r.confidence, ..r };
        let [usual, low] = [window(10.0), window(10.0).into_iter().map(halved).collect()]
            .map(|residuals| Noise::default().with(&residuals).factor(10.0));
        assert!((low / usual - 0.5).abs() < 1e-12, "{low} {usual}");
    }

    /// Residuals of cameras whose points are off by these, pixels, and by independent errors.
    fn shifted(shifts: &[[f64; 2]]) -> Vec<Residual> {
        let points = (0..shifts.len()).flat_map(|camera| (0..15).map(move |point| (camera, point)));
        let residual = |(camera, point): (usize, usize)| {
            let angle = 2.4 * point as f64;
            let own = Vector2::new(angle.cos(), angle.sin()) * 2.0;
            let way_px = own + Vector2::from(shifts[camera]);
            Residual { camera, point, way_px, ..window(1.0)[1] }
        };
        points.map(residual).collect()
    }

    #[test]
    fn what_all_points_of_a_camera_have_in_common_is_a_shift() {
        let variance = |shifts: &[[f64; 2]]| {
            let residuals = shifted(shifts);
            Noise::default().with(&residuals).shift_variance_px()
        };
        assert_eq!(variance(&[[0.0, 0.0]; 4]), 0.0);
        let four = [[10.0, 0.0], [-10.0, 0.0], [0.0, 10.0], [0.0, -10.0]];
        // 400 square pixels over five: eight coordinates, less the three of the body's place.
        assert!((variance(&four) - 80.0).abs() < 5.0, "{}", variance(&four));
        // A camera that is far off is wrong, and hardly counts in the solve.
        let one_wrong = [four[0], four[1], four[2], four[3], [300.0, 0.0]];
        assert!((variance(&one_wrong) - 400.0 / 5.0).abs() < 5.0, "{}", variance(&one_wrong));
        assert_eq!(variance(&four[..1]), 0.0);
    }

    #[test]
    fn old_windows_lose_their_weight() {
        let before = (0..50).fold(Noise::default(), |noise, _| noise.with(&window(12.0)));
        let after = (0..100).fold(before, |noise, _| noise.with(&window(8.0)));
        assert!((after.factor(10.0) - 0.64).abs() < 0.02, "{after:?}");
    }
}
