//! Estimates the body while the performer moves: the shape and the keypoint offsets together.
//!
//! Some of the solved windows give a quadratic model of their cost by the body's coefficients, with
//! the keyframes eliminated ([`Marginal`]). The body minimises the sum of these models and a prior.
//! A longer thigh and a knee keypoint below the knee look alike; the prior decides what the
//! detections cannot tell apart. The prior of the shape is the variation of adults. The prior of the
//! offsets is estimated with them (empirical Bayes), so the offsets stay small for a detector that
//! agrees with our body. After [`WINDOWS`] windows the body is fixed: later updates would follow
//! errors of our model and drift.

use nalgebra::{DMatrix, DVector};

use crate::core::body::{
    BODY_COEFFICIENTS, KeypointOffsets, OFFSETS, SHAPE_COEFFICIENTS, Skeleton,
};
use crate::core::cost::Marginal;

/// Weight of a window; below 1, because the errors of neighbouring frames are correlated.
const SHARE: f64 = 0.8;
/// Number of windows that are used.
pub const WINDOWS: usize = 25;
/// A new body is used after each of this many windows.
const EARLY_WINDOWS: usize = 8;
/// After them, a new body is used every this many windows.
const INTERVAL: usize = 4;
/// Variance of the detectors' errors at the reference level, square pixels.
const NOISE: f64 = 50.0;
/// Precision of the shape's prior. Adults have 1; it is higher because the errors of different
/// windows are correlated.
const SHAPE_PRECISION: f64 = 6.0;
/// Rounds that estimate the body and the prior of the offsets in turn.
const ROUNDS: usize = 5;

/// The estimate of the body.
#[derive(Clone, Debug, PartialEq)]
pub struct BodyEstimator {
    information: DMatrix<f64>,
    pull: DVector<f64>,
    windows: usize,
    /// Shape and keypoint offsets, see [`Skeleton::coefficients`].
    coefficients: Vec<f64>,
}

impl Default for BodyEstimator {
    fn default() -> Self {
        Self {
            information: DMatrix::zeros(BODY_COEFFICIENTS, BODY_COEFFICIENTS),
            pull: DVector::zeros(BODY_COEFFICIENTS),
            windows: 0,
            coefficients: Vec::new(),
        }
    }
}

impl BodyEstimator {
    /// For a body that is known and is not estimated.
    pub(super) fn of_known_body() -> Self {
        Self { windows: WINDOWS, ..Self::default() }
    }

    /// Whether the body is fixed from here on.
    pub fn is_complete(&self) -> bool {
        self.windows >= WINDOWS
    }

    /// The new body, if it is time for one.
    pub(super) fn new_body(&self, body: &Skeleton) -> Option<Skeleton> {
        let is_early = self.windows <= EARLY_WINDOWS;
        let is_due = is_early || self.windows.is_multiple_of(INTERVAL) || self.is_complete();
        is_due.then(|| body.with_coefficients(&self.coefficients))
    }

    /// The estimate after one more window, which was solved with the body `at`. `noise` is the
    /// variance of the detections' errors relative to the reference level; `offset_prior` is the
    /// first weight of the squared offsets. `None` if the sum has no minimum.
    pub fn with(
        &self,
        marginal: &Marginal,
        at: &Skeleton,
        noise: f64,
        offset_prior: f64,
    ) -> Option<Self> {
        let at = DVector::from_iterator(BODY_COEFFICIENTS, at.coefficients());
        let pull = &self.pull + (&marginal.hessian * at - &marginal.gradient) * SHARE;
        let information = &self.information + &marginal.hessian * SHARE;
        let body = estimate(&information, &pull, NOISE * noise, offset_prior)?;
        let coefficients = body.iter().copied().collect();
        Some(Self { information, pull, windows: self.windows + 1, coefficients })
    }
}

/// The body b = (shape, offsets m) that minimises
/// 1/2 b^T information b - pull^T b + 1/2 noise SHAPE_PRECISION |shape|^2
/// + 1/2 offset_prior sum of precision m^2, with an estimate of offset_prior.
fn estimate(
    information: &DMatrix<f64>,
    pull: &DVector<f64>,
    noise: f64,
    mut offset_prior: f64,
) -> Option<DVector<f64>> {
    let precisions = KeypointOffsets::prior_precisions();
    let mut body = DVector::zeros(BODY_COEFFICIENTS);
    for _ in 0..ROUNDS {
        let mut posterior = information.clone();
        for i in 0..SHAPE_COEFFICIENTS {
            posterior[(i, i)] += noise * SHAPE_PRECISION;
        }
        for (i, precision) in precisions.into_iter().enumerate() {
            posterior[(SHAPE_COEFFICIENTS + i, SHAPE_COEFFICIENTS + i)] += offset_prior * precision;
        }
        let factor = posterior.cholesky()?;
        body = factor.solve(pull);
        let variances = factor.inverse().diagonal();
        let spread = noise * variances.rows(SHAPE_COEFFICIENTS, OFFSETS).sum();
        let offsets = body.rows(SHAPE_COEFFICIENTS, OFFSETS);
        offset_prior = noise * OFFSETS as f64 / (offsets.norm_squared() + spread);
    }
    Some(body)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A body with all coefficients of that function of their index.
    fn body(of: impl Fn(usize) -> f64) -> Skeleton {
        let values: Vec<f64> = (0..BODY_COEFFICIENTS).map(of).collect();
        Skeleton::default().with_coefficients(&values)
    }

    /// A window's model with its minimum at `wanted`, expanded at `at`.
    fn window(wanted: &Skeleton, at: &Skeleton, weight: f64) -> Marginal {
        let off = at.coefficients().zip(wanted.coefficients()).map(|(at, to)| weight * (at - to));
        Marginal {
            hessian: DMatrix::identity(BODY_COEFFICIENTS, BODY_COEFFICIENTS) * weight,
            gradient: DVector::from_iterator(BODY_COEFFICIENTS, off),
        }
    }

    fn distance(a: &Skeleton, b: &Skeleton) -> f64 {
        a.coefficients().zip(b.coefficients()).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    }

    #[test]
    fn the_body_converges_to_the_minimum_of_the_windows() {
        let wanted = body(|i| (i as f64).sin());
        let (mut estimator, mut found) = (BodyEstimator::default(), Skeleton::default());
        let (before, mut changes) = (distance(&found, &wanted), Vec::new());
        for n in 1..=WINDOWS {
            assert!(!estimator.is_complete(), "{n}");
            let marginal = window(&wanted, &found, 100.0);
            estimator = estimator.with(&marginal, &found, 1.0, 300.0).unwrap();
            if let Some(body) = estimator.new_body(&found) {
                changes.push(n);
                found = body;
            }
        }
        assert!(estimator.is_complete());
        assert_eq!(changes, [1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, WINDOWS]);
        let after = distance(&found, &wanted);
        assert!(after < 0.2 * before, "{before} {after}");
    }

    #[test]
    fn the_priors_shrink_what_the_detections_hardly_tell() {
        let template = Skeleton::default();
        let marginal = window(&body(|_| 0.05), &template, 10.0);
        let estimator = BodyEstimator::default().with(&marginal, &template, 1.0, 300.0).unwrap();
        let found = estimator.new_body(&template).unwrap();
        assert!(found.coefficients().all(|c| (0.0..0.01).contains(&c)), "{found:?}");
    }

    /// The sum of a shape coefficient and an offset is told, not their difference.
    #[test]
    fn the_priors_decide_what_the_detections_cannot_tell_apart() {
        let template = Skeleton::default();
        let (shape, offset) = (2, SHAPE_COEFFICIENTS + 5);
        let mut hessian = DMatrix::zeros(BODY_COEFFICIENTS, BODY_COEFFICIENTS);
        for (i, j) in [(shape, shape), (shape, offset), (offset, shape), (offset, offset)] {
            hessian[(i, j)] = 1e5;
        }
        let mut gradient = DVector::zeros(BODY_COEFFICIENTS);
        (gradient[shape], gradient[offset]) = (-1e5, -1e5);
        let told = Marginal { hessian, gradient };
        let estimator = BodyEstimator::default().with(&told, &template, 1.0, 300.0).unwrap();
        let found: Vec<f64> = estimator.new_body(&template).unwrap().coefficients().collect();
        assert!((found[shape] + found[offset] - 1.0).abs() < 0.01, "{found:?}");
        assert!(found[shape] > 0.0 && found[offset] > 0.0, "{found:?}");
        let others = (0..BODY_COEFFICIENTS).filter(|i| *i != shape && *i != offset);
        assert!(others.into_iter().all(|i| found[i].abs() < 1e-9), "{found:?}");
    }
}
