//! Random numbers by key: a number depends on its key, and not on the order of the draws.

use std::f64::consts::PI;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Length of a time cell, seconds; an event lies within one cell.
const CELL: f64 = 2.0;

/// Smooth step from 0 to 1 with zero first and second derivatives at both ends: 6 x^5 - 15 x^4 + 10
/// x^3.
pub fn smoothstep(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (x * (6.0 * x - 15.0) + 10.0)
}

/// A source of random numbers; the same key always gives the same number.
#[derive(Clone, Copy, Debug)]
pub struct Draws {
    /// The seed.
    pub seed: u64,
    /// Separates the sources of one seed.
    pub stream: u64,
}

impl Draws {
    fn rng(&self, topic: u64, item: u64) -> ChaCha8Rng {
        let mut key = [0; 32];
        for (bytes, word) in key.chunks_exact_mut(8).zip([self.seed, self.stream, topic, item]) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        ChaCha8Rng::from_seed(key)
    }

    /// Uniform in \[0, 1).
    pub fn uniform(&self, topic: u64, item: u64) -> f64 {
        self.rng(topic, item).random()
    }

    /// Two standard normals, by the Box-Muller transform.
    pub fn normals(&self, topic: u64, item: u64) -> [f64; 2] {
        let mut rng = self.rng(topic, item);
        let (u, v): (f64, f64) = (rng.random(), rng.random());
        let radius = (-2.0 * (1.0 - u).ln()).sqrt();
        [radius * (2.0 * PI * v).cos(), radius * (2.0 * PI * v).sin()]
    }

    /// Two standard normals that change smoothly with time: normals every `knot_s` seconds, blended
    /// with constant variance 1.
    pub fn smooth_normals(&self, topic: u64, seconds: f64, knot_s: f64) -> [f64; 2] {
        let at = seconds / knot_s;
        let knot = at.floor();
        let (a, b) = (
            self.normals(topic, knot as i64 as u64),
            self.normals(topic, (knot as i64 + 1) as u64),
        );
        let w = smoothstep(at - knot);
        let norm = (w * w + (1.0 - w) * (1.0 - w)).sqrt();
        [0, 1].map(|i| (a[i] * (1.0 - w) + b[i] * w) / norm)
    }

    /// Random events that start `rate` times a second and last up to `longest_s` seconds: the
    /// event's own number in \[0, 1) if one is active at this time, else `None`.
    pub fn occurrence(&self, topic: u64, seconds: f64, rate: f64, longest_s: f64) -> Option<f64> {
        let cell = (seconds / CELL).floor();
        let mut rng = self.rng(topic, cell as i64 as u64);
        if rng.random::<f64>() >= rate * CELL {
            return None;
        }
        let length = longest_s.min(CELL) * (0.3 + 0.7 * rng.random::<f64>());
        let start = cell * CELL + rng.random::<f64>() * (CELL - length);
        (start..start + length).contains(&seconds).then(|| rng.random())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DRAWS: Draws = Draws { seed: 3, stream: 1 };

    #[test]
    fn smooth_normals_have_unit_variance_and_change_slowly() {
        let (mut square, mut step, n) = (0.0, 0.0f64, 20_000);
        for i in 0..n {
            let t = i as f64 * 0.003;
            let a = DRAWS.smooth_normals(1, t, 0.1)[0];
            square += a * a;
            step = step.max((DRAWS.smooth_normals(1, t + 1e-4, 0.1)[0] - a).abs());
        }
        assert!((square / n as f64 - 1.0).abs() < 0.15, "{}", square / n as f64);
        assert!(step < 0.02, "{step}");
    }

    #[test]
    fn occurrences_have_the_expected_share_of_time() {
        let n = 20_000;
        let on = (0..n)
            .filter(|&i| DRAWS.occurrence(2, i as f64 * 0.05, 0.2, 0.5).is_some())
            .count() as f64;
        let expected = 0.2 * 0.5 * 0.65;
        assert!((on / n as f64 / expected - 1.0).abs() < 0.2, "{}", on / n as f64);
    }

    #[test]
    fn keys_and_seeds_differ() {
        let other = Draws { seed: 4, ..DRAWS };
        assert_eq!(DRAWS.normals(1, 5), DRAWS.normals(1, 5));
        assert_ne!(DRAWS.normals(1, 5), DRAWS.normals(1, 6));
        assert_ne!(DRAWS.normals(1, 5), DRAWS.normals(2, 5));
        assert_ne!(DRAWS.uniform(1, 5), other.uniform(1, 5));
    }
}
