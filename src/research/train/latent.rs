//! Operations on codes in training: sampling, KL divergence from the prior, slerp.

use crate::core::manifold::LATENT;

/// Outputs of the encoder: means, then log variances.
pub const CODE: usize = 2 * LATENT;

/// Largest magnitude of log variances; they are clamped to it.
const LOG_VARIANCE_LIMIT: f32 = 12.0;

/// Below this angle (radians) between two codes, lerp replaces slerp.
const SMALL_ANGLE: f64 = 1e-3;

/// Below this sine (opposite codes), slerp is not defined; lerp replaces it too.
const SMALL_SINE: f64 = 1e-3;

/// z = mean + exp(log variance / 2) noise.
pub fn sample(code: &[f32], noise: &[f32], z: &mut [f32]) {
    for index in 0..LATENT {
        z[index] = code[index] + deviation(code[LATENT + index]) * noise[index];
    }
}

/// Backpropagates from the sample to the code: adds the derivative to `by_code`.
pub fn sample_backward(code: &[f32], noise: &[f32], by_z: &[f32], by_code: &mut [f32]) {
    for index in 0..LATENT {
        by_code[index] += by_z[index];
        let log_variance = code[LATENT + index];
        if log_variance.abs() < LOG_VARIANCE_LIMIT {
            by_code[LATENT + index] += 0.5 * by_z[index] * deviation(log_variance) * noise[index];
        }
    }
}

fn deviation(log_variance: f32) -> f32 {
    (0.5 * log_variance.clamp(-LOG_VARIANCE_LIMIT, LOG_VARIANCE_LIMIT)).exp()
}

/// KL divergence of a code from N(0, I), nats: 1/2 sum (mean^2 + variance - 1 - log variance).
/// Adds `weight` times its derivative to `by_code`.
pub fn divergence(code: &[f32], weight: f32, by_code: &mut [f32]) -> f32 {
    let mut sum = 0.0;
    for index in 0..LATENT {
        let (mean, log_variance) = (code[index], code[LATENT + index]);
        let variance = deviation(log_variance).powi(2);
        sum += 0.5 * (mean * mean + variance - 1.0 - log_variance);
        by_code[index] += weight * mean;
        by_code[LATENT + index] += weight * 0.5 * (variance - 1.0);
    }
    sum
}

/// Weights of two codes in their slerp, and the derivatives of the weights with respect to the
/// cosine of the angle.
#[derive(Clone, Copy, Debug)]
pub struct Slerp {
    weight_a: f64,
    weight_b: f64,
    by_cosine_a: f64,
    by_cosine_b: f64,
    length_a: f64,
    length_b: f64,
    cosine: f64,
}

impl Slerp {
    /// sin((1 - s) t) / sin t and sin(s t) / sin t, where t is the angle between a and b.
    pub fn new(a: &[f32], b: &[f32], s: f64) -> Self {
        let (length_a, length_b) = (norm(a), norm(b));
        let cosine = (dot(a, b) / (length_a * length_b)).clamp(-1.0, 1.0);
        let angle = angle_between(a, b, length_a, length_b);
        let linear = Self {
            weight_a: 1.0 - s,
            weight_b: s,
            by_cosine_a: 0.0,
            by_cosine_b: 0.0,
            length_a,
            length_b,
            cosine,
        };
        let sine = angle.sin();
        if angle < SMALL_ANGLE || sine < SMALL_SINE {
            return linear;
        }
        let weight = |part: f64| (part * angle).sin() / sine;
        // d weight / d angle, times d angle / d cosine = -1 / sin.
        let slope = |part: f64| {
            let (sin, cos) = (part * angle).sin_cos();
            -(part * cos * sine - sin * angle.cos()) / (sine * sine * sine)
        };
        Self {
            weight_a: weight(1.0 - s),
            weight_b: weight(s),
            by_cosine_a: slope(1.0 - s),
            by_cosine_b: slope(s),
            ..linear
        }
    }

    /// The interpolated code.
    pub fn mix(&self, a: &[f32], b: &[f32], z: &mut [f32]) {
        for (z, (a, b)) in z.iter_mut().zip(a.iter().zip(b)) {
            *z = (self.weight_a * f64::from(*a) + self.weight_b * f64::from(*b)) as f32;
        }
    }

    /// Backpropagates from the interpolated code: adds the derivatives to `by_a` and `by_b`.
    pub fn backward(&self, a: &[f32], b: &[f32], by_z: &[f32], by_a: &mut [f32], by_b: &mut [f32]) {
        let by_cosine = self.by_cosine_a * dot(by_z, a) + self.by_cosine_b * dot(by_z, b);
        let both = self.length_a * self.length_b;
        for index in 0..LATENT {
            let (at_a, at_b) = (f64::from(a[index]), f64::from(b[index]));
            let by = f64::from(by_z[index]);
            let cosine_a = at_b / both - self.cosine * at_a / (self.length_a * self.length_a);
            let cosine_b = at_a / both - self.cosine * at_b / (self.length_b * self.length_b);
            by_a[index] += (self.weight_a * by + by_cosine * cosine_a) as f32;
            by_b[index] += (self.weight_b * by + by_cosine * cosine_b) as f32;
        }
    }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

fn norm(a: &[f32]) -> f64 {
    dot(a, a).sqrt().max(1e-9)
}

/// Angle between unit vectors a', b': 2 atan2(|a' - b'|, |a' + b'|). Accurate for small angles.
fn angle_between(a: &[f32], b: &[f32], length_a: f64, length_b: f64) -> f64 {
    let (mut minus, mut plus) = (0.0, 0.0);
    for (a, b) in a.iter().zip(b) {
        let (a, b) = (f64::from(*a) / length_a, f64::from(*b) / length_b);
        minus += (a - b) * (a - b);
        plus += (a + b) * (a + b);
    }
    2.0 * minus.sqrt().atan2(plus.sqrt())
}

#[cfg(test)]
pub(super) mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::super::mlp::fill_normal;
    use super::*;

    fn normal(count: usize, seed: u64) -> Vec<f32> {
        let mut values = vec![0.0; count];
        fill_normal(&mut values, &mut ChaCha8Rng::seed_from_u64(seed));
        values
    }

    /// Checks `analytic` against central differences of `loss` at `at`.
    pub(in crate::research::train) fn check(
        at: &[f32],
        analytic: &[f32],
        loss: impl Fn(&[f32]) -> f64,
    ) {
        for index in 0..at.len() {
            let shifted = |step: f32| {
                let mut moved = at.to_vec();
                moved[index] += step;
                loss(&moved)
            };
            let numeric = (shifted(1e-2) - shifted(-1e-2)) / 2e-2;
            let error = (f64::from(analytic[index]) - numeric).abs();
            assert!(error < 2e-3 * (1.0 + numeric.abs()), "{index}: {} {numeric}", analytic[index]);
        }
    }

    #[test]
    fn sampling_derivative() {
        let (code, noise, by) = (normal(CODE, 1), normal(LATENT, 2), normal(LATENT, 3));
        let loss = |code: &[f32]| {
            let mut z = [0.0; LATENT];
            sample(code, &noise, &mut z);
            dot(&z, &by)
        };
        let mut analytic = [0.0; CODE];
        sample_backward(&code, &noise, &by, &mut analytic);
        check(&code, &analytic, loss);
    }

    #[test]
    fn divergence_derivative_and_zero() {
        let code = normal(CODE, 4);
        let mut analytic = [0.0; CODE];
        divergence(&code, 1.0, &mut analytic);
        check(&code, &analytic, |code| f64::from(divergence(code, 1.0, &mut [0.0; CODE])));
        assert_eq!(divergence(&[0.0; CODE], 1.0, &mut [0.0; CODE]), 0.0);
    }

    #[test]
    fn slerp_derivative() {
        let (a, by) = (normal(LATENT, 5), normal(LATENT, 7));
        let near: Vec<f32> = a.iter().zip(normal(LATENT, 8)).map(|(a, d)| a + 0.2 * d).collect();
        for (b, s) in [(normal(LATENT, 6), 0.3), (near, 0.5), (a.clone(), 0.7)] {
            let value = |a: &[f32], b: &[f32]| {
                let mut z = [0.0; LATENT];
                Slerp::new(a, b, s).mix(a, b, &mut z);
                dot(&z, &by)
            };
            let (mut by_a, mut by_b) = ([0.0; LATENT], [0.0; LATENT]);
            Slerp::new(&a, &b, s).backward(&a, &b, &by, &mut by_a, &mut by_b);
            check(&a, &by_a, |a| value(a, &b));
            check(&b, &by_b, |b| value(&a, b));
        }
    }

    #[test]
    fn slerp_reaches_both_ends_and_keeps_the_length() {
        let (a, mut b) = (normal(LATENT, 9), normal(LATENT, 10));
        let scale = (norm(&a) / norm(&b)) as f32;
        b.iter_mut().for_each(|v| *v *= scale);
        let mut z = [0.0; LATENT];
        for (s, end) in [(0.0, &a), (1.0, &b)] {
            Slerp::new(&a, &b, s).mix(&a, &b, &mut z);
            assert!(z.iter().zip(end).all(|(z, e)| (z - e).abs() < 1e-5));
        }
        Slerp::new(&a, &b, 0.4).mix(&a, &b, &mut z);
        assert!((norm(&z) - norm(&a)).abs() < 1e-4);
        let opposite: Vec<f32> = a.iter().map(|v| -v).collect();
        Slerp::new(&a, &opposite, 0.5).mix(&a, &opposite, &mut z);
        assert!(z.iter().all(|z| z.is_finite()));
    }
}
