//! The robust loss, and the prior on codes.

use serde::{Deserialize, Serialize};

use crate::core::manifold::LATENT;

/// The kind of a robust loss rho(q) of a squared residual q, with a scale s.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LossKind {
    /// rho(q) = s^2 ln(1 + q / s^2): large errors never lose all their force, so a limb finds back.
    #[default]
    Cauchy,
    /// rho(q) = s^2 q / (q + s^2), the paper's.
    #[serde(rename = "geman_mcclure")]
    GemanMcClure,
}

/// A robust loss with its scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Loss {
    kind: LossKind,
    square_scale: f64,
}

/// An error of this many scales stands for a body far from the detections.
const FAR: f64 = 7.0;

impl Loss {
    /// With scale s, in the residual's unit.
    pub fn new(kind: LossKind, scale: f64) -> Self {
        Self { kind, square_scale: scale * scale }
    }

    /// The same loss with `factor` times the scale.
    pub fn wider(&self, factor: f64) -> Self {
        Self { square_scale: self.square_scale * factor * factor, ..*self }
    }

    /// rho and its derivative, which is the IRLS weight: s^2 / (q + s^2), for Geman-McClure its square.
    pub fn rho(&self, square: f64) -> (f64, f64) {
        let ratio = self.square_scale / (square + self.square_scale);
        match self.kind {
            LossKind::Cauchy => (-self.square_scale * libm::log(ratio), ratio),
            LossKind::GemanMcClure => (ratio * square, ratio * ratio),
        }
    }

    /// The loss of a point behind the camera: of an error of seven scales.
    pub fn ceiling(&self) -> f64 {
        self.rho(FAR * FAR * self.square_scale).0
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
    fn small_errors_count_squared_and_large_ones_less() {
        for kind in [LossKind::Cauchy, LossKind::GemanMcClure] {
            let loss = Loss::new(kind, 30.0);
            assert!((loss.rho(1.0).0 - 1.0).abs() < 2e-3, "{kind:?}");
            for error in [3.0_f64, 30.0, 300.0] {
                let q = error * error;
                let step = (loss.rho(1.0001 * q).0 - loss.rho(0.9999 * q).0) / (2e-4 * q);
                assert!((step / loss.rho(q).1 - 1.0).abs() < 1e-6, "{kind:?} {error}");
            }
        }
        assert_eq!(Loss::new(LossKind::GemanMcClure, 30.0).rho(900.0), (450.0, 0.25));
        assert_eq!(Loss::new(LossKind::Cauchy, 30.0).rho(900.0).1, 0.5);
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
