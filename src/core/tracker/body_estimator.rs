//! Estimates the body while the performer moves: the shape and the keypoint offsets together.
//!
//! Some of the solved windows give a quadratic model of their cost by the body's coefficients, with
//! the keyframes eliminated ([`Marginal`]). The body minimises the sum of these models and a prior.
//! A longer thigh and a knee keypoint below the knee look alike; the prior decides what the
//! detections cannot tell apart. The prior of the shape is the variation of adults. The prior of the
//! offsets is estimated with them (empirical Bayes), so the offsets stay small for a detector that
//! agrees with our body. After [`WINDOWS`] windows the body is fixed: later updates would follow
//! errors of our model and drift.
//!
//! A body that was given is treated by where it comes from:
//! - The same take: it is checked. If some windows agree on another body, the estimate begins anew.
//! - Another take: its bones are kept, and its offsets are the prior means of the new ones. A detector's
//!   errors depend on the pose, so its mean offsets differ from take to take. If another body fits
//!   clearly better, the estimate begins anew.

use nalgebra::{DMatrix, DVector};

use crate::core::body::{
    BODY_COEFFICIENTS, Joint, OffsetPrior, SHAPE_COEFFICIENTS, SYMMETRIC_OFFSETS, Skeleton,
};
use crate::core::cost::Marginal;
use crate::core::detections::KeypointFormat;

/// Numbers in the upper triangle of the information.
const TRIANGLE: usize = BODY_COEFFICIENTS * (BODY_COEFFICIENTS + 1) / 2;
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
/// Precision of the bones of a body of another take: they are fixed.
const FIXED: f64 = 1e8;
/// Number of windows that check a body of the same take.
const CHECKS: usize = 8;
/// A body of the same take is wrong if another one fits the windows better by this much a window: the
/// squared distance by their information, in variances of the detections. Measured: up to 70 for the
/// body of the same take or the true one, 130 to 1,300 for other performers; 86 for a synthetic
/// performer with limbs 1.4 cm shorter.
const WRONG: f64 = 80.0;
/// A body of another take is wrong if its limbs differ by this part from those of a free estimate. In a
/// short take this shows before the deviance does. Measured: 1 % for the same performer.
pub const OTHER_SIZE: f64 = 0.08;
/// A body of another take is wrong too if its [`Estimate::deviance`] exceeds that of a free estimate by
/// this much a window. The limit grows with the windows, because the errors of our model add up.
/// Measured on two real takes of one performer, with bodies of both takes by two, four and nine cameras:
/// -62 at most after 2 windows, -43 after 8, 42 after 25. With bodies of other performers by other
/// detectors, after 25: walking 198 to 381; sitting or balancing, which shows less, -49 to 189.
const MORE_DEVIANCE: f64 = 2.0;
/// Rounds that estimate the body and the prior of the offsets in turn.
const ROUNDS: usize = 5;

/// The body that was given before the first window.
#[derive(Clone, Debug, Default, PartialEq)]
enum Given {
    /// None, or one that was wrong.
    #[default]
    Nothing,
    /// One of the same take.
    SameTake,
    /// The coefficients of one of another take.
    OtherTake(Vec<f64>),
}

/// The estimate of the body.
#[derive(Clone, Debug, PartialEq)]
pub struct BodyEstimator {
    information: DMatrix<f64>,
    pull: DVector<f64>,
    windows: usize,
    /// Variance of the detections' errors in the last window, square pixels. Only [`shared_body`] needs it and
    /// the prior: they are not among the numbers.
    noise: f64,
    /// The prior of the offsets in that window, and its weight.
    prior: (OffsetPrior, f64),
    given: Given,
    /// Shape and keypoint offsets, see [`Skeleton::coefficients`].
    coefficients: Vec<f64>,
}

/// A [`BodyEstimator`] as numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EstimateNumbers {
    /// Number of windows in it.
    pub windows: usize,
    /// Whether a body of the same take is checked.
    pub is_check: bool,
    /// The coefficients of a body that was given from another take; none if there was none.
    pub other_take: Vec<f64>,
    /// Shape and keypoint offsets; none before the first window.
    pub coefficients: Vec<f64>,
    /// The upper triangle of the information, row by row; none if the estimate is complete.
    pub information: Vec<f64>,
    /// Information times estimate, without priors.
    pub pull: Vec<f64>,
}

impl Default for BodyEstimator {
    fn default() -> Self {
        Self {
            information: DMatrix::zeros(BODY_COEFFICIENTS, BODY_COEFFICIENTS),
            pull: DVector::zeros(BODY_COEFFICIENTS),
            windows: 0,
            noise: NOISE,
            prior: (OffsetPrior::of(KeypointFormat::Body25), 1.0),
            given: Given::Nothing,
            coefficients: Vec::new(),
        }
    }
}

impl BodyEstimator {
    /// Checks a body of the same take.
    pub(super) fn check() -> Self {
        Self { given: Given::SameTake, ..Self::default() }
    }

    /// Keeps the bones of a body of another take, unless others fit clearly better, and estimates its
    /// offsets.
    pub(super) fn of_another_take(body: &Skeleton) -> Self {
        Self { given: Given::OtherTake(body.coefficients().collect()), ..Self::default() }
    }

    /// Neither estimates nor checks.
    pub(super) fn complete() -> Self {
        Self { windows: WINDOWS, ..Self::default() }
    }

    /// Whether the body may still change a lot.
    pub(super) fn is_early(&self) -> bool {
        !self.is_given() && self.windows <= EARLY_WINDOWS
    }

    /// The estimate as numbers, for other nodes.
    pub fn numbers(&self) -> EstimateNumbers {
        let rows = (0..BODY_COEFFICIENTS).flat_map(|i| (i..BODY_COEFFICIENTS).map(move |j| (i, j)));
        let is_used = self.windows > 0 && !self.is_complete();
        EstimateNumbers {
            windows: self.windows,
            is_check: self.is_check(),
            other_take: match &self.given {
                Given::OtherTake(body) => body.clone(),
                Given::Nothing | Given::SameTake => Vec::new(),
            },
            coefficients: self.coefficients.clone(),
            information: rows.filter(|_| is_used).map(|at| self.information[at]).collect(),
            pull: self.pull.iter().filter(|_| is_used).copied().collect(),
        }
    }

    /// The estimate of such numbers; `None` if there are not as many as there must be.
    pub fn of_numbers(numbers: &EstimateNumbers) -> Option<Self> {
        let EstimateNumbers { windows, is_check, other_take, coefficients, information, pull } =
            numbers;
        let given = match (is_check, other_take.len()) {
            (true, 0) => Given::SameTake,
            (false, 0) => Given::Nothing,
            (false, BODY_COEFFICIENTS) => Given::OtherTake(other_take.clone()),
            _ => return None,
        };
        let (windows, coefficients) = (*windows, coefficients.clone());
        let mut estimate = Self { windows, given, coefficients, ..Self::default() };
        let is_used = windows > 0 && !estimate.is_complete();
        let is_sound = [0, BODY_COEFFICIENTS].contains(&estimate.coefficients.len());
        let lengths = match is_used {
            true => (TRIANGLE, BODY_COEFFICIENTS),
            false => (0, 0),
        };
        if !is_sound || (information.len(), pull.len()) != lengths {
            return None;
        }
        let mut rest = information.iter();
        for i in (0..BODY_COEFFICIENTS).filter(|_| is_used) {
            for (j, value) in (i..BODY_COEFFICIENTS).zip(&mut rest) {
                (estimate.information[(i, j)], estimate.information[(j, i)]) = (*value, *value);
            }
            estimate.pull[i] = pull[i];
        }
        Some(estimate)
    }

    /// The estimator when a performer is found again: a complete body is checked, else the estimate
    /// begins anew.
    pub(super) fn after_a_break(&self) -> Self {
        match self.is_complete() {
            true => Self::check(),
            false => Self { given: self.given.clone(), ..Self::default() },
        }
    }

    /// Whether the body is fixed from here on.
    pub fn is_complete(&self) -> bool {
        self.windows >= if self.is_check() { CHECKS } else { WINDOWS }
    }

    fn is_check(&self) -> bool {
        self.given == Given::SameTake
    }

    /// Whether the bones are those of a body that was given.
    pub fn is_given(&self) -> bool {
        self.given != Given::Nothing
    }

    /// Whether the bones are known: they were given, or the estimate is complete.
    pub fn is_known(&self) -> bool {
        self.is_given() || self.is_complete()
    }

    /// Whether the keypoint offsets are those of this detector: they were estimated here, or are checked.
    pub fn knows_offsets(&self) -> bool {
        self.is_complete() || !matches!(self.given, Given::OtherTake(_))
    }

    /// Number of windows in it.
    pub fn windows(&self) -> usize {
        self.windows
    }

    /// The new body, if it is time for one.
    pub(super) fn new_body(&self, body: &Skeleton) -> Option<Skeleton> {
        let is_due = self.is_early() || self.windows.is_multiple_of(INTERVAL) || self.is_complete();
        (is_due && !self.is_check()).then(|| body.with_coefficients(&self.coefficients))
    }

    /// The estimate after one more window, which was solved with the body `at`. `noise` is the
    /// variance of the detections' errors relative to the reference level, times the confidence;
    /// `weight` is the first weight of the prior of the offsets. `None` if the sum has no minimum.
    pub fn with(
        &self,
        marginal: &Marginal,
        at: &Skeleton,
        noise: f64,
        (prior, weight): (&OffsetPrior, f64),
    ) -> Option<Self> {
        let at = DVector::from_iterator(BODY_COEFFICIENTS, at.coefficients());
        let pull = &self.pull + (&marginal.hessian * &at - &marginal.gradient) * SHARE;
        let information = &self.information + &marginal.hessian * SHARE;
        let (windows, noise) = (self.windows + 1, NOISE * noise);
        let sums = Sums { information: &information, pull: &pull, noise };
        let mut body = sums.estimate(prior, weight, None)?;
        let mut given = self.given.clone();
        // One window is not enough to call a body wrong.
        match &self.given {
            Given::OtherTake(bones) => {
                let kept = sums.estimate(prior, weight, Some(bones))?;
                let size = limbs(body.coefficients.as_slice()) / limbs(bones);
                let is_wrong = (size - 1.0).abs() > OTHER_SIZE
                    || kept.deviance - body.deviance > MORE_DEVIANCE * windows as f64;
                match windows > 1 && is_wrong {
                    true => given = Given::Nothing,
                    false => body = kept,
                }
            }
            Given::SameTake => {
                let change = &body.coefficients - &at;
                let distance = change.dot(&(&information * &change)) / sums.noise;
                if windows > 1 && distance > WRONG * windows as f64 {
                    given = Given::Nothing;
                }
            }
            Given::Nothing => {}
        }
        let mut coefficients: Vec<f64> = body.coefficients.iter().copied().collect();
        if let Given::OtherTake(bones) = &given {
            coefficients[..SHAPE_COEFFICIENTS].copy_from_slice(&bones[..SHAPE_COEFFICIENTS]);
        }
        let prior = (prior.clone(), body.weight);
        Some(Self { information, pull, windows, noise, prior, given, coefficients })
    }

    fn sums(&self) -> Sums<'_> {
        Sums { information: &self.information, pull: &self.pull, noise: self.noise }
    }
}

/// The body of a person that fits several takes together. The bones are the same in all of them. Each take
/// has its own offsets, and the body has their means. The estimates were made in this process, and each has
/// windows. `None` without a take, or if the sum has no minimum.
pub fn shared_body(takes: &[&BodyEstimator]) -> Option<Skeleton> {
    const SIZE: usize = SHAPE_COEFFICIENTS;
    let mut information = DMatrix::identity(SIZE, SIZE) * SHAPE_PRECISION;
    let mut pull = DVector::zeros(SIZE);
    for take in takes {
        let (prior, weight) = &take.prior;
        let alone = take.sums().estimate(prior, *weight, None)?;
        let told = take.sums().bones(prior, alone.weight)?;
        (information, pull) = (information + told.0, pull + told.1);
    }
    let bones = information.cholesky()?.solve(&pull);
    let mut mean = DVector::zeros(BODY_COEFFICIENTS);
    for take in takes {
        let (prior, weight) = &take.prior;
        let means = bones.iter().copied().chain(prior.means).collect();
        let kept = take.sums().estimate(prior, *weight, Some(&means))?;
        mean += kept.coefficients / takes.len() as f64;
    }
    mean.rows_mut(0, SIZE).copy_from(&bones);
    (!takes.is_empty()).then(|| Skeleton::default().with_coefficients(mean.as_slice()))
}

/// Length of the limbs of a body with these coefficients, metres.
fn limbs(coefficients: &[f64]) -> f64 {
    let body = Skeleton::default().with_coefficients(coefficients);
    let ends = [Joint::LKnee, Joint::LAnkle, Joint::LElbow, Joint::LWrist];
    ends.iter().map(|joint| body.offset(*joint).norm()).sum()
}

/// What the windows tell of the body.
struct Sums<'a> {
    information: &'a DMatrix<f64>,
    pull: &'a DVector<f64>,
    noise: f64,
}

/// A body, and how badly its prior fits the windows.
struct Estimate {
    coefficients: DVector<f64>,
    /// -2 ln of the marginal likelihood of the windows under the prior, up to a constant.
    deviance: f64,
    /// The weight of the prior of the offsets.
    weight: f64,
}

impl Sums<'_> {
    /// What they tell of the bones if the offsets follow these, under a prior of that weight: information
    /// and pull, in variances of the detections.
    fn bones(&self, prior: &OffsetPrior, weight: f64) -> Option<(DMatrix<f64>, DVector<f64>)> {
        let (bones, offsets) = (SHAPE_COEFFICIENTS, BODY_COEFFICIENTS - SHAPE_COEFFICIENTS);
        let precisions = DVector::from_iterator(offsets, prior.precisions) * weight;
        let means = DVector::from_iterator(offsets, prior.means);
        let block = |i, j, rows, columns| self.information.view((i, j), (rows, columns));
        let of_offsets =
            block(bones, bones, offsets, offsets) + DMatrix::from_diagonal(&precisions);
        let pull = self.pull.rows(bones, offsets) + precisions.component_mul(&means);
        let across = block(bones, 0, offsets, bones);
        let factor = of_offsets.cholesky()?;
        let information =
            block(0, 0, bones, bones) - across.transpose() * factor.solve(&across.into_owned());
        let pull = self.pull.rows(0, bones) - across.transpose() * factor.solve(&pull);
        Some((information / self.noise, pull / self.noise))
    }

    /// The body b = (shape, offsets) that minimises
    /// 1/2 b^T information b - pull^T b + 1/2 sum of precision (b - mean)^2, with an estimate of the
    /// weight of all precisions of offsets. The means are the coefficients of the body of `other_take`,
    /// if there is one, and its bones are fixed.
    fn estimate(
        &self,
        prior: &OffsetPrior,
        weight: f64,
        other_take: Option<&Vec<f64>>,
    ) -> Option<Estimate> {
        let of_bones = if other_take.is_some() { FIXED } else { SHAPE_PRECISION };
        let bones = [self.noise * of_bones; SHAPE_COEFFICIENTS];
        let means = match other_take {
            Some(body) => DVector::from_column_slice(body),
            None => {
                let means = [0.0; SHAPE_COEFFICIENTS].into_iter().chain(prior.means);
                DVector::from_iterator(BODY_COEFFICIENTS, means)
            }
        };
        // Some coordinates are seen by no keypoint: their prior alone determines them.
        let mut weight = weight.max(1.0);
        let mut found = None;
        for _ in 0..ROUNDS {
            let offsets = prior.precisions.map(|precision| weight * precision);
            let precisions = bones.into_iter().chain(offsets);
            let precisions = DVector::from_iterator(BODY_COEFFICIENTS, precisions);
            let posterior = self.information + DMatrix::from_diagonal(&precisions);
            let pull = self.pull + precisions.component_mul(&means);
            let factor = posterior.cholesky()?;
            let body = factor.solve(&pull);
            let by_mean = means.component_mul(&means).dot(&precisions) - pull.dot(&body);
            let ln_of_root: f64 = factor.l_dirty().diagonal().iter().map(|l| libm::log(*l)).sum();
            let determinants = 2.0 * ln_of_root - precisions.map(libm::log).sum();
            let variances = factor.inverse().diagonal();
            let both_sides =
                |v: &DVector<f64>| v.rows(SHAPE_COEFFICIENTS, SYMMETRIC_OFFSETS).into_owned();
            let square = both_sides(&(&body - &means)).norm_squared();
            weight = self.noise * SYMMETRIC_OFFSETS as f64
                / (square + self.noise * both_sides(&variances).sum());
            let deviance = by_mean / self.noise + determinants;
            found = Some(Estimate { coefficients: body, deviance, weight });
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Attachment, SYMMETRIC_SHAPE};
    use crate::core::detections::Keypoint;

    /// A body with all coefficients that change both sides alike of that function of their index.
    fn body(of: impl Fn(usize) -> f64) -> Skeleton {
        let offsets = SHAPE_COEFFICIENTS..SHAPE_COEFFICIENTS + SYMMETRIC_OFFSETS;
        let is_symmetric = |i: &usize| *i < SYMMETRIC_SHAPE || offsets.contains(i);
        let value = |i: usize| if is_symmetric(&i) { of(i) } else { 0.0 };
        let values: Vec<f64> = (0..BODY_COEFFICIENTS).map(value).collect();
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

    fn prior() -> OffsetPrior {
        OffsetPrior::of(KeypointFormat::Body25)
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
            estimator = estimator.with(&marginal, &found, 1.0, (&prior(), 300.0)).unwrap();
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
        let estimator =
            BodyEstimator::default().with(&marginal, &template, 1.0, (&prior(), 300.0)).unwrap();
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
        let estimator =
            BodyEstimator::default().with(&told, &template, 1.0, (&prior(), 300.0)).unwrap();
        let found: Vec<f64> = estimator.new_body(&template).unwrap().coefficients().collect();
        assert!((found[shape] + found[offset] - 1.0).abs() < 0.01, "{found:?}");
        assert!(found[shape] > 0.0 && found[offset] > 0.0, "{found:?}");
        let others = (0..BODY_COEFFICIENTS).filter(|i| *i != shape && *i != offset);
        assert!(others.into_iter().all(|i| found[i].abs() < 1e-9), "{found:?}");
    }

    /// The estimates after each window; the windows agree on `wanted`.
    fn estimates(first: BodyEstimator, at: &Skeleton, wanted: &Skeleton) -> Vec<BodyEstimator> {
        let of_window = |estimator: &mut BodyEstimator, _| {
            let window = window(wanted, at, 1000.0);
            *estimator = estimator.with(&window, at, 1.0, (&prior(), 300.0)).unwrap();
            Some(estimator.clone())
        };
        (1..=WINDOWS).scan(first, of_window).collect()
    }

    #[test]
    fn a_body_of_the_same_take_is_replaced_if_windows_agree_on_another() {
        let known = body(|i| (i as f64).sin());
        let right = estimates(BodyEstimator::check(), &known, &known);
        assert!(right[..CHECKS].iter().all(|one| one.new_body(&known).is_none()));
        assert!(right[CHECKS - 1].is_complete() && !right[CHECKS - 2].is_complete());
        let other = body(|i| 4.0 * (i as f64).cos());
        let wrong = estimates(BodyEstimator::check(), &known, &other);
        assert_eq!(wrong[0].new_body(&known), None, "one window is not enough");
        let found = wrong[1].new_body(&known).unwrap();
        assert!(!wrong[1].is_given());
        assert!(distance(&found, &other) < 0.3 * distance(&known, &other));
    }

    #[test]
    fn of_a_body_of_another_take_the_bones_are_kept_unless_the_windows_agree_on_others() {
        let known = body(|i| (i as f64).sin());
        let first = || BodyEstimator::of_another_take(&known);
        // A detector that sees another place of the nose.
        let nose = |i: usize| if i == SHAPE_COEFFICIENTS { 1.0 } else { 0.0 };
        let other_detector = body(|i| (i as f64).sin() + nose(i));
        let found = estimates(first(), &known, &other_detector);
        assert!(found.iter().all(|one| one.is_given() && one.is_known()));
        assert!(found[WINDOWS - 1].is_complete() && !found[WINDOWS - 2].is_complete());
        let found = found[WINDOWS - 1].new_body(&known).unwrap();
        assert_eq!(found.shape(), known.shape());
        assert!(distance(&found, &other_detector) < 0.3 * distance(&known, &other_detector));

        let other = body(|i| 4.0 * (i as f64).cos());
        let wrong = estimates(first(), &known, &other);
        assert!(wrong[0].is_given(), "one window is not enough");
        assert!(!wrong[1].is_given());
        let found = wrong[1].new_body(&known).unwrap();
        assert!(distance(&found, &other) < 0.3 * distance(&known, &other));

        // Of nearly the same size: the deviance shows it.
        let unlike = body(|i| (i as f64).sin() + if i < 4 { 0.9 } else { 0.0 });
        let wrong = estimates(first(), &known, &unlike);
        let last = wrong.iter().position(|one| !one.is_given()).unwrap();
        assert!((1..WINDOWS - 1).contains(&last), "{last}");
        let sizes = [&unlike, &known].map(|body| limbs(&body.coefficients().collect::<Vec<_>>()));
        assert!((sizes[0] / sizes[1] - 1.0).abs() < OTHER_SIZE, "{sizes:?}");
    }

    #[test]
    fn takes_of_a_person_share_the_bones() {
        let bones = |i: usize| (i as f64).sin();
        let offset = |i: usize| if i < SHAPE_COEFFICIENTS { 0.0 } else { 1.0 };
        let template = Skeleton::default();
        let take = |wanted: &Skeleton| {
            estimates(BodyEstimator::default(), &template, wanted).swap_remove(WINDOWS - 1)
        };
        // The bones of both takes seem a little wrong, and differ, as their detectors differ.
        let one = take(&body(|i| bones(i) + 0.1 + offset(i)));
        let two = take(&body(|i| bones(i) - 0.1 - offset(i)));
        let shared = shared_body(&[&one, &two]).unwrap();
        assert!(distance(&shared, &body(bones)) < 0.1, "{shared:?}");
        assert_eq!(shared_body(&[]), None);
    }

    /// As in the estimate of one take: with offsets that follow the bones.
    #[test]
    fn the_bones_of_one_take_are_those_of_its_estimate() {
        let template = Skeleton::default();
        let (shape, offset) = (2, SHAPE_COEFFICIENTS + 5);
        let mut told = window(&body(|i| (i as f64).sin()), &template, 1e3);
        for (i, j) in [(shape, shape), (shape, offset), (offset, shape), (offset, offset)] {
            told.hessian[(i, j)] += 1e5;
        }
        (told.gradient[shape], told.gradient[offset]) = (-1e5, -1e5);
        let estimate = BodyEstimator::default().with(&told, &template, 1.0, (&prior(), 300.0));
        let estimate = estimate.unwrap();
        let shared = shared_body(&[&estimate]).unwrap();
        let apart = shared.shape().0.iter().zip(&estimate.coefficients);
        assert!(apart.into_iter().all(|(a, b)| (a - b).abs() < 1e-3), "{shared:?} {estimate:?}");
        assert!(shared.shape().0[shape].abs() > 0.1, "{shared:?}");
    }

    #[test]
    fn halpe_knees_are_expected_below_the_joint() {
        let nothing = Marginal {
            hessian: DMatrix::zeros(BODY_COEFFICIENTS, BODY_COEFFICIENTS),
            gradient: DVector::zeros(BODY_COEFFICIENTS),
        };
        let knee = |format| {
            let prior = OffsetPrior::of(format);
            let found =
                BodyEstimator::default().with(&nothing, &Skeleton::default(), 1.0, (&prior, 300.0));
            let found = found.unwrap().new_body(&Skeleton::default()).unwrap();
            Attachment::of(Keypoint::RKnee).offset(&found)
                - Attachment::of(Keypoint::RKnee).offset(&Skeleton::default())
        };
        assert!((knee(KeypointFormat::Halpe26).y + 0.019).abs() < 1e-9);
        assert_eq!(knee(KeypointFormat::Body25).norm(), 0.0);
    }
}
