//! A published motion that stays smooth while each fit revises the past.
//!
//! Each fit of the open window solves its last frames again, so its path differs a little from the
//! poses that were published from the fits before. The offset d of the published motion from the
//! newest fit is not dropped but decays as a critically damped spring does: from its values d0 and
//! d1 at the last two published times, h seconds apart, it becomes after another t seconds
//!
//! d = ((1 + t/h) d1 - t/h e^(-h/c) d0) e^(-t/c), with the time constant c.
//!
//! So the published motion keeps its velocity, and has the acceleration of the newest fit. d is the
//! translation of the root and the rotation vector of each joint.

use nalgebra::Matrix3;

use super::job::PoseAt;
use crate::core::body::Pose;
use crate::core::so3;
use crate::core::time::Timestamp;

/// The last two poses of a published motion.
#[derive(Clone, Debug, Default)]
pub(super) struct Published {
    last_two: [Option<PoseAt>; 2],
}

impl Published {
    /// Adds a pose, unless it is not later than the last one.
    pub(super) fn add(&mut self, capture: Timestamp, pose: &Pose) {
        if self.last().is_none_or(|(last, _)| capture > *last) {
            self.last_two.swap(0, 1);
            self.last_two[1] = Some((capture, pose.clone()));
        }
    }

    /// The last pose begins a path: do not continue from the pose before it.
    pub(super) fn begin_path(&mut self) {
        self.last_two[0] = None;
    }

    /// The last pose and its time.
    pub(super) fn last(&self) -> Option<&PoseAt> {
        self.last_two[1].as_ref()
    }

    /// The pose before the last one and its time.
    pub(super) fn before(&self) -> Option<&PoseAt> {
        self.last_two[0].as_ref()
    }

    /// The times of the poses.
    pub(super) fn times(&self) -> impl Iterator<Item = Timestamp> {
        self.last_two.iter().flatten().map(|(capture, _)| *capture)
    }

    /// The pose of a fit at `capture` with the decayed offset of this motion from the fit; `None` if
    /// the fit has no pose at that time. `constant` is the time constant, seconds.
    pub(super) fn continued(
        &self,
        capture: Timestamp,
        fit: &[PoseAt],
        constant: f64,
    ) -> Option<Pose> {
        let of_fit = |time| fit.iter().find(|(at, _)| *at == time).map(|(_, pose)| pose);
        let pose = of_fit(capture)?;
        let (Some((at0, shown0)), Some((at1, shown1))) = (self.before(), self.last()) else {
            return Some(pose.clone());
        };
        let (Some(fit0), Some(fit1)) = (of_fit(*at0), of_fit(*at1)) else {
            return Some(pose.clone());
        };
        let (step, ahead) = (at1.seconds_since(*at0), capture.seconds_since(*at1));
        let decay = |seconds: f64| libm::exp(-seconds / constant);
        let share1 = (1.0 + ahead / step) * decay(ahead);
        let share0 = -ahead / step * decay(step + ahead);
        let turned = |joint: fn(&Pose, usize) -> &Matrix3<f64>, j: usize| {
            let offset = |fit, shown| so3::turn_between(joint(fit, j), joint(shown, j));
            so3::exp(&(offset(fit1, shown1) * share1 + offset(fit0, shown0) * share0))
                * joint(pose, j)
        };
        let moved = |fit: &Pose, shown: &Pose| shown.root_position - fit.root_position;
        Some(Pose {
            root_rotation: turned(|pose, _| &pose.root_rotation, 0),
            root_position: pose.root_position
                + moved(fit1, shown1) * share1
                + moved(fit0, shown0) * share0,
            local: std::array::from_fn(|j| turned(|pose, j| &pose.local[j], j)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: i64 = 20_000_000;

    fn at(frame: i64, x: f64) -> PoseAt {
        let mut pose = Pose::rest();
        pose.root_position.x = x;
        pose.local[3] = so3::exp(&nalgebra::Vector3::new(0.0, x, 0.0));
        (Timestamp::from_ns(STEP * frame), pose)
    }

    /// Publishes the poses `of` a fit at frames 0 to 9; the first two of them are given.
    fn shown(first: [f64; 2], of: fn(i64) -> f64) -> Vec<f64> {
        let mut published = Published::default();
        let fit: Vec<PoseAt> = (0..10).map(|frame| at(frame, of(frame))).collect();
        let mut shown = first.to_vec();
        for (frame, x) in (0..).zip(first) {
            let (time, pose) = at(frame, x);
            published.add(time, &pose);
        }
        for (time, _) in &fit[2..] {
            let pose = published.continued(*time, &fit, 0.03).unwrap();
            let turn = so3::log(&pose.local[3]).y;
            assert!((turn - pose.root_position.x).abs() < 1e-9, "{turn}");
            shown.push(pose.root_position.x);
            published.add(*time, &pose);
        }
        shown
    }

    #[test]
    fn a_motion_comes_back_to_the_fit_without_a_jump() {
        let still = shown([0.1, 0.1], |_| 0.0);
        let steps: Vec<f64> = still.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(steps[1..].iter().all(|step| (-0.04..0.0).contains(step)), "{still:?}");
        assert!(still[9].abs() < 0.01, "{still:?}");
    }

    #[test]
    fn a_motion_on_the_fit_stays_on_it() {
        let of = |frame: i64| 0.01 * frame as f64;
        let moving = shown([0.0, 0.01], of);
        assert!((0..).zip(moving).all(|(frame, x)| (x - of(frame)).abs() < 1e-12));
    }

    #[test]
    fn a_path_that_begins_is_the_fit() {
        let mut published = Published::default();
        let fit = [at(0, 0.0), at(1, 0.0), at(2, 0.0)];
        for (time, pose) in [at(0, 1.0), at(1, 1.0)] {
            published.add(time, &pose);
        }
        published.begin_path();
        assert_eq!(published.continued(fit[2].0, &fit, 0.03).as_ref(), Some(&fit[2].1));
        assert_eq!(published.continued(at(3, 0.0).0, &fit, 0.03), None);
    }
}
