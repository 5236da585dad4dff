//! The robust loss.

/// Geman-McClure: rho(q) = s^2 q / (q + s^2), with q a squared residual.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GemanMcClure {
    square_scale: f64,
}

impl GemanMcClure {
    /// With scale s, in the residual's unit.
    pub fn new(scale: f64) -> Self {
        Self { square_scale: scale * scale }
    }

    /// rho and its derivative, which is the IRLS weight (s^2 / (q + s^2))^2.
    pub fn rho(&self, square: f64) -> (f64, f64) {
        let ratio = self.square_scale / (square + self.square_scale);
        (ratio * square, ratio * ratio)
    }

    /// The value that rho tends to for large residuals.
    pub fn ceiling(&self) -> f64 {
        self.square_scale
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_errors_count_squared_and_large_ones_are_capped() {
        let loss = GemanMcClure::new(30.0);
        assert!((loss.rho(1.0).0 - 1.0).abs() < 2e-3);
        assert_eq!(loss.rho(900.0), (450.0, 0.25));
        assert!(loss.rho(1e9).0 < loss.ceiling());
    }
}
