//! Where the detector marks points, learnt while the performer moves.
//!
//! Some of the solved windows tell what marks would lower their cost, their keyframes following
//! ([`Marginal`]); that is summed up, and the marks are those that lower the sum and their own prior most.
//! How far marks usually are off is found with them (empirical Bayes): a detector that agrees with
//! our body keeps them small. After a while the marks stay: what goes on to pull them is our model's
//! own habit, not the detector's, and would let them drift.

use nalgebra::{DMatrix, DVector};

use crate::core::body::{KeypointOffsets, OFFSETS};
use crate::core::cost::Marginal;

/// What a window counts: errors of neighbouring frames are alike, so ten frames tell less than ten.
const SHARE: f64 = 0.8;
/// How many windows are listened to.
const WINDOWS: usize = 25;
/// Variance of what detectors err, square pixels: it sets marks against the cost.
const NOISE: f64 = 50.0;
/// Rounds in which marks and their prior are found.
const ROUNDS: usize = 5;

/// What is known of the marks.
#[derive(Clone, Debug, PartialEq)]
pub struct OffsetEstimator {
    information: DMatrix<f64>,
    pull: DVector<f64>,
    windows: usize,
    /// The marks.
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
    /// Whether the marks stay from here on.
    pub fn is_complete(&self) -> bool {
        self.windows >= WINDOWS
    }

    /// With what a window tells that was solved with the marks `at`. `prior` is the weight of the
    /// squared marks to begin with. `None` if the sum has no minimum.
    pub fn with(&self, marginal: &Marginal, at: &KeypointOffsets, prior: f64) -> Option<Self> {
        let at = DVector::from_column_slice(&at.0);
        let pull = (&marginal.hessian * at - &marginal.gradient) * SHARE;
        let information = &self.information + &marginal.hessian * SHARE;
        let pull = &self.pull + pull;
        let offsets = estimate(&information, &pull, prior)?;
        Some(Self { information, pull, windows: self.windows + 1, offsets })
    }
}

/// The marks that minimise 1/2 m^T information m - pull^T m + 1/2 prior |m|^2, with the prior that
/// they themselves call for.
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

    /// A window that wants the marks at `wanted`, as seen from `at`.
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
    fn marks_go_where_windows_want_them() {
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
    fn what_little_is_wanted_is_held_small() {
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
