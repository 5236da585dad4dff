//! Where the detector marks points, learnt while the performer moves.
//!
//! Some of the solved windows tell what marks would lower their cost, their keyframes following
//! ([`Marginal`]); that is summed up, and the marks are those that lower the sum and their own prior most.
//! How far marks usually are off is found with them (empirical Bayes): a detector that agrees with
//! our body keeps them small. After a while the marks stay: what goes on to pull them is our model's
//! own habit, not the detector's, and would let them drift.

use nalgebra::{DMatrix, DVector};

use crate::core::body::{MARKS, Marks};
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
pub struct Learnt {
    information: DMatrix<f64>,
    pull: DVector<f64>,
    windows: usize,
    /// The marks.
    pub marks: Marks,
}

impl Default for Learnt {
    fn default() -> Self {
        Self {
            information: DMatrix::zeros(MARKS, MARKS),
            pull: DVector::zeros(MARKS),
            windows: 0,
            marks: Marks::default(),
        }
    }
}

impl Learnt {
    /// Whether the marks stay from here on.
    pub fn is_complete(&self) -> bool {
        self.windows >= WINDOWS
    }

    /// With what a window tells that was solved with the marks `at`. `prior` is the weight of the
    /// squared marks to begin with. `None` if the sum has no minimum.
    pub fn with(&self, told: &Marginal, at: &Marks, prior: f64) -> Option<Self> {
        let at = DVector::from_column_slice(&at.0);
        let pull = (&told.hessian * at - &told.gradient) * SHARE;
        let information = &self.information + &told.hessian * SHARE;
        let pull = &self.pull + pull;
        let marks = settled(&information, &pull, prior)?;
        Some(Self { information, pull, windows: self.windows + 1, marks })
    }
}

/// The marks that minimise 1/2 m^T information m - pull^T m + 1/2 prior |m|^2, with the prior that
/// they themselves call for.
fn settled(information: &DMatrix<f64>, pull: &DVector<f64>, mut prior: f64) -> Option<Marks> {
    let mut marks = DVector::zeros(MARKS);
    for _ in 0..ROUNDS {
        let factor = (information + DMatrix::identity(MARKS, MARKS) * prior).cholesky()?;
        marks = factor.solve(pull);
        let spread = NOISE * factor.inverse().trace();
        prior = NOISE * MARKS as f64 / (marks.norm_squared() + spread);
    }
    Some(Marks(std::array::from_fn(|i| marks[i])))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A window that wants the marks at `wanted`, as seen from `at`.
    fn window(wanted: &Marks, at: &Marks, weight: f64) -> Marginal {
        let off = std::array::from_fn::<f64, MARKS, _>(|i| weight * (at.0[i] - wanted.0[i]));
        Marginal {
            hessian: DMatrix::identity(MARKS, MARKS) * weight,
            gradient: DVector::from_column_slice(&off),
        }
    }

    fn distance(a: &Marks, b: &Marks) -> f64 {
        a.0.iter().zip(b.0).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    }

    #[test]
    fn marks_go_where_windows_want_them() {
        let wanted = Marks(std::array::from_fn(|i| (i as f64).sin()));
        let mut learnt = Learnt::default();
        let before = distance(&learnt.marks, &wanted);
        for n in 0..WINDOWS {
            assert!(!learnt.is_complete(), "{n}");
            learnt =
                learnt.with(&window(&wanted, &learnt.marks, 100.0), &learnt.marks, 300.0).unwrap();
        }
        assert!(learnt.is_complete());
        let after = distance(&learnt.marks, &wanted);
        assert!(after < 0.1 * before, "{before} {after}");
    }

    #[test]
    fn what_little_is_wanted_is_held_small() {
        let wanted = Marks([0.05; MARKS]);
        let told = window(&wanted, &Marks::default(), 10.0);
        let learnt = Learnt::default().with(&told, &Marks::default(), 300.0).unwrap();
        assert!(learnt.marks.0.iter().all(|m| (0.0..0.01).contains(m)), "{:?}", learnt.marks);
    }
}
