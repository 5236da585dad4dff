//! Estimates the keypoint offsets while the performer moves.
//!
//! Some of the solved windows give a quadratic model of their cost by the offsets, with the
//! keyframes eliminated ([`Marginal`]). The offsets minimise the sum of these models and a prior.
//! The prior's weight is estimated with them (empirical Bayes), so the offsets stay small for a
//! detector that agrees with our body. After [`WINDOWS`] windows the offsets are fixed: later
//! updates would follow errors of our model and drift.

use nalgebra::{DMatrix, DVector};

use crate::core::body::{KeypointOffsets, OFFSETS};
use crate::core::cost::Marginal;

/// Weight of a window; below 1, because the errors of neighbouring frames are correlated.
const SHARE: f64 = 0.8;
/// Number of windows that are used.
const WINDOWS: usize = 25;
/// Variance of the detectors' errors, square pixels.
const NOISE: f64 = 50.0;
/// Rounds that estimate the offsets and the prior in turn.
const ROUNDS: usize = 5;

/// The estimate of the keypoint offsets.
#[derive(Clone, Debug, PartialEq)]
pub struct OffsetEstimator {
    information: DMatrix<f64>,
    pull: DVector<f64>,
    windows: usize,
    /// The offsets.
    pub offsets: KeypointOffsets,
}

impl Default for OffsetEstimator {
    fn default() -> Self {
        Self {
            information: DMatrix::zeros(OFFSETS, OFFSETS),
            pull: DVector::zeros(OFFSETS),
            windows: 0,
            offsets: KeypointOffsets::default(),
        }
    }
}

impl OffsetEstimator {
    /// Whether the offsets are fixed from here on.
    pub fn is_complete(&self) -> bool {
        self.windows >= WINDOWS
    }

    /// The estimate after one more window, solved with the offsets `at`. `prior` is the first
    /// weight of the squared offsets. `None` if the sum has no minimum.
    pub fn with(&self, marginal: &Marginal, at: &KeypointOffsets, prior: f64) -> Option<Self> {
        let at = DVector::from_column_slice(&at.0);
        let pull = (&marginal.hessian * at - &marginal.gradient) * SHARE;
        let information = &self.information + &marginal.hessian * SHARE;
        let pull = &self.pull + pull;
        let offsets = estimate(&information, &pull, prior)?;
        Some(Self { information, pull, windows: self.windows + 1, offsets })
    }
}

/// The offsets m that minimise 1/2 m^T information m - pull^T m + 1/2 prior |m|^2, with an estimate
/// of the prior.
fn estimate(
    information: &DMatrix<f64>,
    pull: &DVector<f64>,
    mut prior: f64,
) -> Option<KeypointOffsets> {
    let mut offsets = DVector::zeros(OFFSETS);
    for _ in 0..ROUNDS {
        let factor = (information + DMatrix::identity(OFFSETS, OFFSETS) * prior).cholesky()?;
        offsets = factor.solve(pull);
        let spread = NOISE * factor.inverse().trace();
        prior = NOISE * OFFSETS as f64 / (offsets.norm_squared() + spread);
    }
    Some(KeypointOffsets(std::array::from_fn(|i| offsets[i])))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A window's model with its minimum at `wanted`, expanded at `at`.
    fn window(wanted: &KeypointOffsets, at: &KeypointOffsets, weight: f64) -> Marginal {
        let off = std::array::from_fn::<f64, OFFSETS, _>(|i| weight * (at.0[i] - wanted.0[i]));
        Marginal {
            hessian: DMatrix::identity(OFFSETS, OFFSETS) * weight,
            gradient: DVector::from_column_slice(&off),
        }
    }

    fn distance(a: &KeypointOffsets, b: &KeypointOffsets) -> f64 {
        a.0.iter().zip(b.0).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    }

    #[test]
    fn offsets_converge_to_the_minimum_of_the_windows() {
        let wanted = KeypointOffsets(std::array::from_fn(|i| (i as f64).sin()));
        let mut estimator = OffsetEstimator::default();
        let before = distance(&estimator.offsets, &wanted);
        for n in 0..WINDOWS {
            assert!(!estimator.is_complete(), "{n}");
            estimator = estimator
                .with(&window(&wanted, &estimator.offsets, 100.0), &estimator.offsets, 300.0)
                .unwrap();
        }
        assert!(estimator.is_complete());
        let after = distance(&estimator.offsets, &wanted);
        assert!(after < 0.1 * before, "{before} {after}");
    }

    #[test]
    fn the_prior_shrinks_small_offsets() {
        let wanted = KeypointOffsets([0.05; OFFSETS]);
        let marginal = window(&wanted, &KeypointOffsets::default(), 10.0);
        let estimator =
            OffsetEstimator::default().with(&marginal, &KeypointOffsets::default(), 300.0).unwrap();
        assert!(
            estimator.offsets.0.iter().all(|m| (0.0..0.01).contains(m)),
            "{:?}",
            estimator.offsets
        );
    }
}
