//! Lens distortion in normalised coordinates.

use std::f64::consts::TAU;

use nalgebra::{Matrix2, Vector2};

use super::CameraError;

/// Beyond this normalised radius (84 degrees off axis) a model is not examined for folds.
const SCAN_RADIUS: f64 = 10.0;
/// Steps of the scan for the first fold.
const SCAN_STEPS: usize = 2000;
/// Directions looked at in each step (tangential distortion is not the same in all).
const SCAN_DIRECTIONS: usize = 16;
/// Undistortion stops below this step, normalised units (1e-9 pixels at most).
const TOLERANCE: f64 = 1e-13;
/// Undistortion fails above this error, normalised units.
const ACCEPTED: f64 = 1e-9;

/// How a lens bends normalised coordinates, with OpenCV's formulas and order of coefficients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lens {
    /// Brown-Conrady: k1 k2 p1 p2 k3 k4 k5 k6. With r^2 = x^2 + y^2 and
    /// g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6):
    /// x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2), y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y.
    BrownConrady([f64; 8]),
    /// Equidistant fisheye: k1 k2 k3 k4. With a = atan r,
    /// (x', y') = (x, y) / r * a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8).
    /// Only points in front of the camera's plane are seen.
    Fisheye([f64; 4]),
}

impl Lens {
    /// No distortion.
    pub const IDEAL: Self = Self::BrownConrady([0.0; 8]);

    /// From 4, 5 or 8 coefficients k1 k2 p1 p2 (k3 (k4 k5 k6)). More are taken if they are 0.
    ///
    /// # Errors
    /// Another number of coefficients.
    pub fn brown_conrady(coefficients: &[f64]) -> Result<Self, CameraError> {
        let (used, rest) = coefficients.split_at(coefficients.len().min(8));
        if !matches!(used.len(), 4 | 5 | 8) || rest.iter().any(|&c| c != 0.0) {
            return Err(CameraError::CoefficientCount {
                model: "Brown-Conrady",
                expected: "4, 5 or 8",
                found: coefficients.len(),
            });
        }
        let mut all = [0.0; 8];
        all[..used.len()].copy_from_slice(used);
        Ok(Self::BrownConrady(all))
    }

    /// From 4 coefficients k1 k2 k3 k4. More are taken if they are 0.
    ///
    /// # Errors
    /// Another number of coefficients.
    pub fn fisheye(coefficients: &[f64]) -> Result<Self, CameraError> {
        match coefficients {
            [k1, k2, k3, k4, rest @ ..] if rest.iter().all(|&c| c == 0.0) => {
                Ok(Self::Fisheye([*k1, *k2, *k3, *k4]))
            }
            _ => Err(CameraError::CoefficientCount {
                model: "fisheye",
                expected: "4",
                found: coefficients.len(),
            }),
        }
    }

    /// The coefficients in the model's order.
    pub fn coefficients(&self) -> &[f64] {
        match self {
            Self::BrownConrady(k) => k,
            Self::Fisheye(k) => k,
        }
    }

    /// Whether the lens leaves every point where it is.
    pub fn is_ideal(&self) -> bool {
        *self == Self::IDEAL
    }

    /// The normalised radius up to which the model is one-to-one: its radial part grows with the
    /// radius, and the determinant of its Jacobian is positive in every direction looked at.
    /// Infinite if it does not fold within 84 degrees of the axis.
    pub fn limit(&self) -> f64 {
        let step = SCAN_RADIUS / SCAN_STEPS as f64;
        let fold = (1..=SCAN_STEPS).find(|&i| !self.grows_at(i as f64 * step));
        let Some(i) = fold else { return f64::INFINITY };
        let (mut good, mut bad) = ((i - 1) as f64 * step, i as f64 * step);
        for _ in 0..50 {
            let middle = 0.5 * (good + bad);
            if self.grows_at(middle) { good = middle } else { bad = middle }
        }
        good
    }

    /// Whether the radial part is positive and increasing, and nothing is mirrored, at radius `r`.
    fn grows_at(&self, r: f64) -> bool {
        match self {
            Self::BrownConrady(k) => {
                let (g, by_r2) = brown_radial(k, r * r);
                let below = 1.0 + r * r * (k[5] + r * r * (k[6] + r * r * k[7]));
                let upright = |i: usize| {
                    let (sin, cos) = libm::sincos(i as f64 * TAU / SCAN_DIRECTIONS as f64);
                    self.distort_with_jacobian(&Vector2::new(r * cos, r * sin)).1.determinant()
                        > 0.0
                };
                below > 0.0
                    && g > 0.0
                    && g + 2.0 * r * r * by_r2 > 0.0
                    && (0..SCAN_DIRECTIONS).all(upright)
            }
            Self::Fisheye(k) => fisheye_angle(k, libm::atan(r)).1 > 0.0,
        }
    }

    /// Distorts normalised coordinates.
    #[inline]
    pub fn distort(&self, n: &Vector2<f64>) -> Vector2<f64> {
        let r2 = n.norm_squared();
        match self {
            Self::BrownConrady(k) => {
                let (x, y) = (n.x, n.y);
                let g = brown_gain(k, r2);
                Vector2::new(
                    x * g + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
                    y * g + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y,
                )
            }
            Self::Fisheye(k) => n * fisheye_gain(k, r2.sqrt()).0,
        }
    }

    /// Distorts normalised coordinates; also the derivative by them, 2x2.
    #[inline]
    pub fn distort_with_jacobian(&self, n: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let (x, y, r2) = (n.x, n.y, n.norm_squared());
        match self {
            Self::BrownConrady(k) => {
                let (g, by_r2) = brown_radial(k, r2);
                let (p1, p2) = (k[2], k[3]);
                let distorted = Vector2::new(
                    x * g + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    y * g + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                );
                let cross = 2.0 * (x * y * by_r2 + p1 * x + p2 * y);
                let jacobian = Matrix2::new(
                    g + 2.0 * x * x * by_r2 + 2.0 * p1 * y + 6.0 * p2 * x,
                    cross,
                    cross,
                    g + 2.0 * y * y * by_r2 + 6.0 * p1 * y + 2.0 * p2 * x,
                );
                (distorted, jacobian)
            }
            Self::Fisheye(k) => {
                let (gain, by_r_over_r) = fisheye_gain(k, r2.sqrt());
                let jacobian = Matrix2::identity() * gain + n * n.transpose() * by_r_over_r;
                (n * gain, jacobian)
            }
        }
    }

    /// The point within `limit` (see [`Lens::limit`]) that is distorted to `d`.
    /// `None` if there is none or the iteration does not converge to 1e-9.
    pub fn undistort(&self, d: &Vector2<f64>, limit: f64) -> Option<Vector2<f64>> {
        if !(d.x.is_finite() && d.y.is_finite()) {
            return None;
        }
        match self {
            Self::BrownConrady(_) => self.undistort_brown(d, limit),
            Self::Fisheye(k) => undistort_fisheye(k, d, limit),
        }
    }

    /// Newton's method; steps that leave the limit or do not bring the error down are halved.
    fn undistort_brown(&self, d: &Vector2<f64>, limit: f64) -> Option<Vector2<f64>> {
        let radius = d.norm();
        let mut n = if radius > 0.9 * limit { d * (0.9 * limit / radius) } else { *d };
        let (mut at, mut jacobian) = self.distort_with_jacobian(&n);
        for _ in 0..50 {
            let error = d - at;
            let mut step = jacobian.try_inverse()? * error;
            if step.norm() < TOLERANCE {
                break;
            }
            let mut halvings = 0;
            loop {
                let next = n + step;
                let (next_at, next_jacobian) = self.distort_with_jacobian(&next);
                let inside = next.norm() <= limit && next_jacobian.determinant() > 0.0;
                if inside && (d - next_at).norm() < error.norm() {
                    (n, at, jacobian) = (next, next_at, next_jacobian);
                    break;
                }
                halvings += 1;
                if halvings > 30 {
                    return ((d - at).norm() < ACCEPTED).then_some(n);
                }
                step *= 0.5;
            }
        }
        ((d - at).norm() < ACCEPTED).then_some(n)
    }
}

/// The radial gain g.
#[inline]
fn brown_gain(k: &[f64; 8], r2: f64) -> f64 {
    let above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
    let below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]));
    above / below
}

/// The radial gain g and its derivative by r^2.
#[inline]
fn brown_radial(k: &[f64; 8], r2: f64) -> (f64, f64) {
    let above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]));
    let above_by = k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4]);
    let below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]));
    let below_by = k[5] + r2 * (2.0 * k[6] + r2 * 3.0 * k[7]);
    let gain = above / below;
    (gain, (above_by - gain * below_by) / below)
}

/// The distorted angle of an angle off the axis, and its derivative.
#[inline]
fn fisheye_angle(k: &[f64; 4], angle: f64) -> (f64, f64) {
    let a2 = angle * angle;
    let gain = 1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3])));
    let by_angle =
        1.0 + a2 * (3.0 * k[0] + a2 * (5.0 * k[1] + a2 * (7.0 * k[2] + a2 * 9.0 * k[3])));
    (angle * gain, by_angle)
}

/// The gain distorted angle / r, and its derivative by r over r.
#[inline]
fn fisheye_gain(k: &[f64; 4], r: f64) -> (f64, f64) {
    if r < 1e-4 {
        // atan r (1 + k1 atan^2 r) / r = 1 + (k1 - 1/3) r^2 + ...
        return (1.0 + (k[0] - 1.0 / 3.0) * r * r, 2.0 * (k[0] - 1.0 / 3.0));
    }
    let (distorted, by_angle) = fisheye_angle(k, libm::atan(r));
    let gain = distorted / r;
    (gain, (by_angle / (1.0 + r * r) - gain) / (r * r))
}

/// Newton on the angle, kept in a bracket that is bisected when a step leaves it.
fn undistort_fisheye(k: &[f64; 4], d: &Vector2<f64>, limit: f64) -> Option<Vector2<f64>> {
    let target = d.norm();
    let (mut low, mut high) = (0.0, libm::atan(limit));
    if target >= fisheye_angle(k, high).0 {
        return None;
    }
    let mut angle = target.min(high);
    for _ in 0..100 {
        let (at, by_angle) = fisheye_angle(k, angle);
        if at > target {
            high = angle
        } else {
            low = angle
        }
        let newton = angle + (target - at) / by_angle;
        let next = if newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
        let step = (next - angle).abs();
        angle = next;
        if step < TOLERANCE {
            break;
        }
    }
    if (fisheye_angle(k, angle).0 - target).abs() > ACCEPTED {
        return None;
    }
    // At the axis tan(a) / a is 1.
    let gain = if target < 1e-12 { 1.0 } else { libm::tan(angle) / target };
    Some(d * gain)
}
