//! SiLU, the activation between the layers of the decoder.

use crate::core::linalg;

linalg::wide! {
    /// x to x sigma(x) in place, and its derivative sigma + x sigma (1 - sigma) to `slopes`.
    pub fn silu(values: &mut [f32], slopes: &mut [f32]) {
        for (value, slope) in values.iter_mut().zip(slopes) {
            let sigma = 1.0 / (1.0 + exp(-*value));
            let out = *value * sigma;
            *slope = sigma + out * (1.0 - sigma);
            *value = out;
        }
    }
}

/// e^x to about 2e-7 relative, for |x| <= 87 (clamped): 2^n times a polynomial on the rest.
/// Plain arithmetic, so that several are computed at once, and the same on every machine.
#[inline(always)]
fn exp(x: f32) -> f32 {
    /// Adding it leaves an integer in the lowest bits.
    const ROUND: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 87.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (x - n * 0.693_359_4) + n * 2.121_944_4e-4;
    let polynomial = 1.987_569_1e-4;
    let polynomial = polynomial * r + 1.398_199_9e-3;
    let polynomial = polynomial * r + 8.333_452e-3;
    let polynomial = polynomial * r + 4.166_579_6e-2;
    let polynomial = polynomial * r + 1.666_666_5e-1;
    let polynomial = polynomial * r + 0.5;
    let mantissa = polynomial * r * r + r + 1.0;
    let exponent = (shifted.to_bits() << 23).wrapping_add(0x3f80_0000);
    mantissa * f32::from_bits(exponent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_that_of_the_standard_library() {
        for i in -8_700..=8_700 {
            let x = i as f32 * 0.01;
            let expected = f64::from(x).exp();
            assert!((f64::from(exp(x)) / expected - 1.0).abs() < 3e-7, "{x}");
        }
    }
}
