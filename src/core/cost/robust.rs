//! The robust loss, and the prior on codes.

use crate::core::manifold::LATENT;

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

/// The prior on codes, a Student t \[Lange 1989\]: rho(q) = (f + 32) ln(1 + q / f), with q the squared
/// length of a code and f its degrees of freedom. Codes of usual length, q = 32, are pulled as by |z|^2,
/// longer ones less, since unusual poses lie further out than N(0, I) has them. Differs: the paper
/// has |z|^2, which f = 0 stands for here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StudentT {
    dof: f64,
}

impl StudentT {
    /// With that many degrees of freedom.
    pub fn new(dof: f64) -> Self {
        Self { dof }
    }

    /// rho and its derivative.
    pub fn rho(&self, square: f64) -> (f64, f64) {
        if self.dof == 0.0 {
            return (square, 1.0);
        }
        let (dof, all) = (self.dof, self.dof + LATENT as f64);
        (all * libm::log1p(square / dof), all / (square + dof))
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

    #[test]
    fn codes_of_usual_length_are_pulled_as_by_their_square() {
        let usual = LATENT as f64;
        for dof in [1.0, 50.0, 1e9] {
            let prior = StudentT::new(dof);
            assert!((prior.rho(usual).1 - 1.0).abs() < 1e-12);
            assert!(prior.rho(0.5 * usual).1 >= 1.0 && prior.rho(2.0 * usual).1 <= 1.0);
            let step = (prior.rho(20.1).0 - prior.rho(19.9).0) / 0.2;
            assert!((step - prior.rho(20.0).1).abs() < 1e-3, "{dof} {step}");
        }
        assert_eq!(StudentT::new(0.0).rho(40.0), (40.0, 1.0));
    }
}
