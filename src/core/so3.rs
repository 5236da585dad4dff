//! Rotations: exponential, logarithm, their Jacobians, spherical interpolation, Euler angles.
//!
//! A rotation is a `Matrix3`. A tangent is a rotation vector in radians. "Right" tangents are
//! expressed in the rotated (body) frame, R exp(d); "left" ones in the outer frame, exp(d) R.
//! Formulas: \[Sola 2018\], eq. 143 to 146.

use libm::{atan2, cos, hypot, sin, sincos};
use nalgebra::{Matrix3, Quaternion, RealField, Rotation3, UnitQuaternion, Vector3};

/// Below this angle (radians) series replace the closed forms.
const SMALL_ANGLE: f64 = 1e-5;

/// The rotation from our world, with y up, to one with z up: (x, y, z) becomes (z, x, y).
pub const Z_UP: Matrix3<f64> = Matrix3::new(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0);

/// Rodrigues' formula: the rotation by |v| radians about v.
pub fn exp(v: &Vector3<f64>) -> Matrix3<f64> {
    let angle = v.norm();
    if angle == 0.0 { Matrix3::identity() } else { turn(&(v / angle), angle) }
}

/// The rotation by `angle` radians about an axis of length 1.
fn turn(axis: &Vector3<f64>, angle: f64) -> Matrix3<f64> {
    let (sin, cos) = sincos(angle);
    Matrix3::from_diagonal_element(cos)
        + axis.cross_matrix() * sin
        + axis * axis.transpose() * (1.0 - cos)
}

/// The rotation vector of R, of length at most pi. At exactly pi one of the two is returned.
pub fn log(r: &Matrix3<f64>) -> Vector3<f64> {
    let q = quaternion(r);
    let (v, half_sine) = (q.imag(), q.imag().norm());
    if half_sine == 0.0 { v } else { v * (2.0 * atan2(half_sine, q.w) / half_sine) }
}

/// The unit quaternion of R, with a real part that is not negative.
pub fn quaternion(r: &Matrix3<f64>) -> UnitQuaternion<f64> {
    let q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*r));
    if q.w < 0.0 { UnitQuaternion::new_unchecked(-q.into_inner()) } else { q }
}

/// The rotation of a quaternion x, y, z, w, which is normalised; `None` if its length is zero
/// or not finite.
pub fn rotation_from_xyzw(xyzw: [f64; 4]) -> Option<Matrix3<f64>> {
    let [x, y, z, w] = xyzw;
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-12)
        .filter(|q| q.coords.iter().all(|c| c.is_finite()))
        .map(|q| q.to_rotation_matrix().into_inner())
}

/// The quaternion of R as x, y, z, w with w >= 0.
pub fn xyzw_from_rotation(r: &Matrix3<f64>) -> [f64; 4] {
    let q = quaternion(r);
    [q.i, q.j, q.k, q.w]
}

/// Of the two quaternions of a rotation the one nearer to `last`.
pub fn continued<T: RealField + Copy>(turn: [T; 4], last: &[T; 4]) -> [T; 4] {
    let dot = turn.iter().zip(last).fold(T::zero(), |sum, (&a, &b)| sum + a * b);
    if dot < T::zero() { turn.map(|number| -number) } else { turn }
}

/// As [`xyzw_from_rotation`], but rounded to 2^-44, so that the rotation of this quaternion has the
/// same quaternion again, bit for bit: a rotation that was sent as a quaternion is the one that
/// came. The first of w, x, y, z that is large is not rounded but follows from the unit length.
pub fn quantised_xyzw(r: &Matrix3<f64>) -> [f64; 4] {
    const STEPS: f64 = (1_u64 << 44) as f64;
    /// One component of a unit quaternion is at least 0.5.
    const LARGE: f64 = 0.4;
    let xyzw = xyzw_from_rotation(r);
    let mut rounded = xyzw.map(|component| (component * STEPS).round() / STEPS);
    if let Some(large) = [3, 0, 1, 2].into_iter().find(|&i| rounded[i].abs() >= LARGE) {
        let others: f64 = (0..4).filter(|&i| i != large).map(|i| rounded[i] * rounded[i]).sum();
        rounded[large] = (1.0 - others).sqrt().copysign(xyzw[large]);
    }
    rounded
}

/// The rotation nearest to R that [`quantised_xyzw`] keeps; R itself if it is no rotation.
pub fn quantised(r: &Matrix3<f64>) -> Matrix3<f64> {
    rotation_from_xyzw(quantised_xyzw(r)).unwrap_or(*r)
}

/// Whether R is a rotation to within `tolerance` in each entry of R^T R, and right-handed.
pub fn is_rotation(r: &Matrix3<f64>, tolerance: f64) -> bool {
    (r.transpose() * r - Matrix3::identity()).amax() <= tolerance && r.determinant() > 0.0
}

/// The left Jacobian: exp(v + d) = exp(Jl(v) d) exp(v) to first order in d. 3x3.
pub fn left_jacobian(v: &Vector3<f64>) -> Matrix3<f64> {
    let angle = v.norm();
    let v_hat = v.cross_matrix();
    if angle < SMALL_ANGLE {
        return Matrix3::identity() + v_hat * 0.5;
    }
    let a2 = angle * angle;
    Matrix3::identity()
        + v_hat * ((1.0 - cos(angle)) / a2)
        + v_hat * v_hat * ((angle - sin(angle)) / (a2 * angle))
}

/// The right Jacobian: exp(v + d) = exp(v) exp(Jr(v) d) to first order in d. 3x3.
pub fn right_jacobian(v: &Vector3<f64>) -> Matrix3<f64> {
    left_jacobian(&-v)
}

/// The inverse of [`right_jacobian`]: log(exp(v) exp(d)) = v + Jr^-1(v) d. 3x3.
/// Singular at |v| = 2 pi, which a logarithm never reaches.
pub fn right_jacobian_inverse(v: &Vector3<f64>) -> Matrix3<f64> {
    let angle = v.norm();
    let v_hat = v.cross_matrix();
    if angle < SMALL_ANGLE {
        return Matrix3::identity() + v_hat * 0.5;
    }
    let half = 0.5 * angle;
    let second = (1.0 - half * cos(half) / sin(half)) / (angle * angle);
    Matrix3::identity() + v_hat * 0.5 + v_hat * v_hat * second
}

/// log(R1 R0^T).
pub fn turn_between(r0: &Matrix3<f64>, r1: &Matrix3<f64>) -> Vector3<f64> {
    log(&(r1 * r0.transpose()))
}

/// The derivatives of that `turn` by the rotation vectors w0 and w1 of R0 = exp(w0) A and
/// R1 = exp(w1) B.
pub fn turn_between_tangents(
    turn: &Vector3<f64>,
    w0: &Vector3<f64>,
    w1: &Vector3<f64>,
) -> (Matrix3<f64>, Matrix3<f64>) {
    let by_first = -right_jacobian_inverse(turn) * left_jacobian(w0);
    (by_first, right_jacobian_inverse(&-turn) * left_jacobian(w1))
}

/// The shortest path from `a` (s = 0) to `b` (s = 1): a exp(s log(a^T b)).
pub fn slerp(a: &Matrix3<f64>, b: &Matrix3<f64>, s: f64) -> Matrix3<f64> {
    a * exp(&(log(&(a.transpose() * b)) * s))
}

/// How [`slerp`] turns when `b` turns: w_t = J w_b, both left (outer-frame) tangents. 3x3.
pub fn slerp_jacobian(a: &Matrix3<f64>, b: &Matrix3<f64>, s: f64) -> Matrix3<f64> {
    let relative = log(&(a.transpose() * b));
    let at = a * exp(&(relative * s));
    at * right_jacobian(&(relative * s)) * right_jacobian_inverse(&relative) * b.transpose() * s
}

/// The angle between two rotations, radians in \[0, pi\].
pub fn angle_between(a: &Matrix3<f64>, b: &Matrix3<f64>) -> f64 {
    log(&(a.transpose() * b)).norm()
}

/// Below this cosine of b, a and c of [`angles`] turn about the same axis.
const GIMBAL: f64 = 1e-6;

/// The rotation by `angle` radians about axis 0, 1 or 2.
pub fn about(axis: usize, angle: f64) -> Matrix3<f64> {
    turn(&Vector3::ith(axis, 1.0), angle)
}

/// The angles a, b, c of R = R_i(a) R_j(b) R_k(c), radians, about three different axes, that lie
/// nearest to `last`: of the two solutions, and with whole turns added. Where b is a quarter turn
/// only the sum or difference of a and c is known: c is kept.
pub fn angles(r: &Matrix3<f64>, axes: [usize; 3], last: [f64; 3]) -> [f64; 3] {
    let [first, second] = both_angles(r, axes, last);
    if apart(&first, &last) <= apart(&second, &last) { first } else { second }
}

/// The two solutions of [`angles`], each nearest to `last` by whole turns. The first one has b within a quarter turn.
pub fn both_angles(r: &Matrix3<f64>, axes: [usize; 3], last: [f64; 3]) -> [[f64; 3]; 2] {
    use std::f64::consts::PI;
    let [i, j, k] = axes;
    let sign = if (i + 1) % 3 == j { 1.0 } else { -1.0 };
    let cosine = hypot(r[(i, i)], r[(i, j)]);
    let b = atan2(sign * r[(i, k)], cosine);
    let first = if cosine < GIMBAL {
        let (p, q) = ((i + 1) % 3, (i + 2) % 3);
        let outer = r * (about(j, b) * about(k, last[2])).transpose();
        [atan2(outer[(q, p)], outer[(p, p)]), b, last[2]]
    } else {
        let a = atan2(-sign * r[(j, k)], r[(k, k)]);
        [a, b, atan2(-sign * r[(i, j)], r[(i, i)])]
    };
    let second = [first[0] + PI, PI - first[1], first[2] + PI];
    [first, second].map(|angles| nearest_turns(angles, last))
}

/// Adds whole turns to each angle so that it lies within half a turn of `last`.
pub fn nearest_turns<const N: usize>(angles: [f64; N], last: [f64; N]) -> [f64; N] {
    use std::f64::consts::TAU;
    std::array::from_fn(|i| angles[i] + TAU * ((last[i] - angles[i]) / TAU).round())
}

/// The sum of the differences of three angles, radians.
pub fn apart(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> [Vector3<f64>; 5] {
        [
            Vector3::new(0.3, -0.7, 1.1),
            Vector3::new(1e-7, 2e-7, -1e-7),
            Vector3::new(0.0, 0.0, 0.0),
            Vector3::new(2.0, 2.0, 1.2),
            Vector3::new(0.0, std::f64::consts::PI - 1e-6, 0.0),
        ]
    }

    #[test]
    fn logarithm_inverts_exponential_up_to_pi() {
        for v in sample() {
            assert!((log(&exp(&v)) - v).norm() < 1e-7, "{v}");
        }
        let half_turn = exp(&Vector3::new(0.0, std::f64::consts::PI, 0.0));
        assert!((exp(&log(&half_turn)) - half_turn).amax() < 1e-9);
    }

    #[test]
    fn slerp_meets_both_ends_and_halves_the_angle() {
        let (a, b) = (exp(&sample()[0]), exp(&sample()[3]));
        assert!((slerp(&a, &b, 0.0) - a).amax() < 1e-12);
        assert!((slerp(&a, &b, 1.0) - b).amax() < 1e-9);
        let middle = slerp(&a, &b, 0.5);
        assert!((angle_between(&a, &middle) - angle_between(&middle, &b)).abs() < 1e-9);
    }

    #[test]
    fn quaternions_round_trip() {
        for v in sample() {
            let r = exp(&v);
            let back = rotation_from_xyzw(xyzw_from_rotation(&r)).unwrap();
            assert!((back - r).amax() < 1e-12);
        }
        assert!(rotation_from_xyzw([0.0; 4]).is_none());
        assert!(rotation_from_xyzw([f64::NAN, 0.0, 0.0, 1.0]).is_none());
    }

    #[test]
    fn a_quantised_rotation_survives_its_quaternion_bit_for_bit() {
        let turn = |n: u32, k: f64| ((f64::from(n) * k).fract() - 0.5) * 7.0;
        let random = (0..20_000).map(|n| {
            Vector3::new(turn(n, 0.754_877_666), turn(n, 0.569_840_29), turn(n, 0.414_213_56))
        });
        let quarters = (0..64).map(|n: u32| {
            let part = |shift: u32| f64::from((n >> shift) & 3) * std::f64::consts::FRAC_PI_2;
            Vector3::new(part(0), part(2), part(4))
        });
        for vector in random.chain(quarters) {
            let rotation = exp(&vector);
            let quantised_rotation = quantised(&rotation);
            assert!((quantised_rotation - rotation).amax() < 1e-12);
            let xyzw = quantised_xyzw(&quantised_rotation);
            assert_eq!(rotation_from_xyzw(xyzw), Some(quantised_rotation), "{vector}");
        }
    }

    #[test]
    fn angles_give_the_rotation_back_and_carry_on_in_every_order() {
        use std::f64::consts::FRAC_PI_2;
        // A knee that bends past a quarter turn, a root that turns for ever, and both at once.
        let paths: [fn(f64) -> [f64; 3]; 3] = [
            |t| [0.02, 2.5 * t.sin().abs(), -0.01],
            |t| [0.1 * t, 0.3, 3.0 * t],
            |t| [t, FRAC_PI_2, 0.4 * t],
        ];
        for order in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
            let compose =
                |[a, b, c]: [f64; 3]| about(order[0], a) * about(order[1], b) * about(order[2], c);
            for path in paths {
                let mut last = path(0.0);
                for frame in 0..2000 {
                    let truth = compose(path(f64::from(frame) * 0.01));
                    let found = angles(&truth, order, last);
                    assert!((compose(found) - truth).amax() < 1e-6, "{order:?}, frame {frame}");
                    assert!(apart(&found, &last) < 0.15, "{order:?}, frame {frame}: {found:?}");
                    last = found;
                }
            }
        }
    }
}
