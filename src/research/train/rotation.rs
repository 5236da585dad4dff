//! Rotations in 6D: Gram-Schmidt and its derivative \[Zhou 2019, sec. 4.2\].

use nalgebra::{Matrix3, Vector3};

/// Smallest length to divide by.
const SHORTEST: f32 = 1e-8;

/// Values of [`from_six`] that its derivative needs.
#[derive(Clone, Copy, Debug)]
pub struct SixTape {
    b: Vector3<f32>,
    length_a: f32,
    length_u: f32,
    /// Columns c1, c2, c3.
    pub rotation: Matrix3<f32>,
}

/// Rotation from the six values (a, b): c1 = a / |a|, u = b - (c1 . b) c1, c2 = u / |u|,
/// c3 = c1 x c2.
pub fn from_six(six: &[f32]) -> SixTape {
    let (a, b) = (Vector3::from_column_slice(&six[..3]), Vector3::from_column_slice(&six[3..6]));
    let length_a = a.norm().max(SHORTEST);
    let c1 = a / length_a;
    let u = b - c1 * c1.dot(&b);
    let length_u = u.norm().max(SHORTEST);
    let c2 = u / length_u;
    let rotation = Matrix3::from_columns(&[c1, c2, c1.cross(&c2)]);
    SixTape { b, length_a, length_u, rotation }
}

/// Backpropagates from the rotation's entries to (a, b): adds the derivative to `out`.
pub fn from_six_backward(tape: &SixTape, by_rotation: &Matrix3<f32>, out: &mut [f32]) {
    let columns = |m: &Matrix3<f32>| [0, 1, 2].map(|c| m.column(c).into_owned());
    let [c1, c2, _] = columns(&tape.rotation);
    let [g1, g2, g3] = columns(by_rotation);
    let (g1, g2) = (g1 + c2.cross(&g3), g2 + g3.cross(&c1));
    let gu = (g2 - c2 * c2.dot(&g2)) / tape.length_u;
    let gb = gu - c1 * c1.dot(&gu);
    let g1 = g1 - gu * c1.dot(&tape.b) - tape.b * c1.dot(&gu);
    let ga = (g1 - c1 * c1.dot(&g1)) / tape.length_a;
    for (out, value) in out.iter_mut().zip(ga.iter().chain(gb.iter())) {
        *out += value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivative_agrees_with_central_differences() {
        let six = [0.9, 0.2, -0.4, 0.3, 1.2, 0.1];
        let by = Matrix3::new(0.3, -0.8, 0.4, 1.1, 0.2, -0.5, 0.7, 0.9, -0.6);
        let loss = |six: &[f32]| f64::from(from_six(six).rotation.dot(&by));
        let mut analytic = [0.0; 6];
        from_six_backward(&from_six(&six), &by, &mut analytic);
        for index in 0..6 {
            let shifted = |step: f32| {
                let mut moved = six;
                moved[index] += step;
                loss(&moved)
            };
            let numeric = (shifted(1e-2) - shifted(-1e-2)) / 2e-2;
            assert!((f64::from(analytic[index]) - numeric).abs() < 2e-3, "{index} {numeric}");
        }
    }

    #[test]
    fn the_columns_form_a_rotation_and_zero_input_stays_finite() {
        let rotation = from_six(&[2.0, 0.0, 1.0, 0.5, 3.0, 0.0]).rotation;
        assert!((rotation.transpose() * rotation - Matrix3::identity()).amax() < 1e-6);
        assert!((rotation.determinant() - 1.0).abs() < 1e-6);
        assert!(from_six(&[0.0; 6]).rotation.iter().all(|v| v.is_finite()));
    }
}
