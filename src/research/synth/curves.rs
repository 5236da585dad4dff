//! Smooth curves of time that motions and noise are made of. All are twice differentiable.

pub use crate::core::random::smoothstep;

/// 0 outside (0, 1), 1 in the middle: 64 x^3 (1 - x)^3.
pub fn bump(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    let y = 4.0 * x * (1.0 - x);
    y * y * y
}

/// 0 outside \[from, to\], 1 inside, with ramps of `ramp` seconds.
pub fn plateau(t: f64, from: f64, to: f64, ramp: f64) -> f64 {
    smoothstep((t - from) / ramp) * smoothstep((to - t) / ramp)
}

/// Between the two, like `min` but smooth, within 0.7 `softness` below it:
/// -k log(exp(-a/k) + exp(-b/k)).
pub fn soft_min(a: f64, b: f64, softness: f64) -> f64 {
    let (low, high) = (a.min(b), a.max(b));
    low - softness * (-(high - low) / softness).exp().ln_1p()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_meet_their_ends_flat() {
        let h = 1e-4;
        for curve in [smoothstep, bump] {
            for end in [0.0, 1.0] {
                let second = (curve(end + h) - 2.0 * curve(end) + curve(end - h)) / (h * h);
                assert!(second.abs() < 0.05, "{second}");
            }
        }
        assert_eq!((smoothstep(0.5), bump(0.5)), (0.5, 1.0));
        assert_eq!(plateau(1.0, 0.0, 2.0, 0.5), 1.0);
    }

    #[test]
    fn soft_minimum_stays_just_below_the_minimum() {
        assert!((soft_min(1.0, 2.0, 0.01) - 1.0).abs() < 1e-12);
        assert!((soft_min(1.0, 1.0, 0.01) - (1.0 - 0.01 * 2f64.ln())).abs() < 1e-12);
    }
}
