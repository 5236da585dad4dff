//! The known values of a window before its solve.

use crate::core::body::Skeleton;
use crate::core::cost::PathKeyframe;
use crate::core::manifold::{Interpolation, Keyframe, TimedKeyframe};
use crate::core::time::Timestamp;
use crate::core::tracker::job::Job;

/// The known keyframes and the known body of a window before its solve.
#[derive(Clone, Copy)]
pub(super) struct Known<'a> {
    /// The last final keyframes; the very last is at the window's start.
    pub(super) past: &'a [TimedKeyframe],
    /// Keyframes of the window from earlier solves.
    pub(super) ahead: &'a [TimedKeyframe],
    pub(super) skeleton: &'a Skeleton,
}

impl Known<'_> {
    /// The time of the last keyframe.
    pub(super) fn end(&self, job: &Job) -> Timestamp {
        let last = self.ahead.last().or(self.past.last());
        last.map_or(job.start, |last| last.capture)
    }

    /// The final keyframes, as fixed keyframes of a path.
    pub(super) fn fixed(&self) -> impl Iterator<Item = PathKeyframe> {
        self.past.iter().cloned().map(PathKeyframe::fixed)
    }

    /// The last two keyframes, if there are two.
    pub(super) fn last_two(&self) -> Option<[&TimedKeyframe; 2]> {
        let mut latest = self.past.iter().chain(self.ahead).rev();
        let (last, before) = (latest.next()?, latest.next()?);
        Some([before, last])
    }

    /// The keyframe at a time: interpolated; before the first one the first, after the last one the
    /// last.
    pub(super) fn at(&self, time: Timestamp, interpolation: Interpolation) -> Option<Keyframe> {
        let mut path = self.past.iter().chain(self.ahead);
        let mut earlier = path.next()?;
        for later in path {
            if time == later.capture {
                return Some(later.keyframe.clone());
            }
            if time < later.capture {
                let s = time.fraction(earlier.capture, later.capture);
                let s = s.max(0.0);
                return Some(interpolation.keyframe(&earlier.keyframe, &later.keyframe, s));
            }
            earlier = later;
        }
        Some(earlier.keyframe.clone())
    }

    /// The keyframe at a time between two keyframes, on the cubic through these two and their other neighbours. `None` at a
    /// keyframe, where a neighbour is missing, and where one is at less than half the distance in time of the two.
    ///
    /// Source: Barry and Goldman 1988, a Catmull-Rom spline by interpolation of interpolated values.
    pub(super) fn between(
        &self,
        time: Timestamp,
        interpolation: Interpolation,
    ) -> Option<Keyframe> {
        let path: Vec<&TimedKeyframe> = self.past.iter().chain(self.ahead).collect();
        let next = path.partition_point(|at| at.capture < time);
        let [p0, p1, p2, p3] = *path.get(next.checked_sub(2)?..next + 2)? else { return None };
        let [before, own, after] =
            [(p0, p1), (p1, p2), (p2, p3)].map(|(from, to)| to.capture - from.capture);
        if time >= p2.capture || own > before * 2 || own > after * 2 {
            return None;
        }
        let mix = |a: &Keyframe, from: &TimedKeyframe, b: &Keyframe, to: &TimedKeyframe| {
            interpolation.keyframe(a, b, time.fraction(from.capture, to.capture))
        };
        let [a, b, c] = [(p0, p1), (p1, p2), (p2, p3)]
            .map(|(from, to)| mix(&from.keyframe, from, &to.keyframe, to));
        let [a, b] = [mix(&a, p0, &b, p2), mix(&b, p1, &c, p3)];
        Some(mix(&a, p1, &b, p2))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::core::manifold::Correction;

    #[test]
    fn a_smooth_path_follows_an_accelerated_motion() {
        let at = |ms: i64| {
            let capture = Timestamp::from_ns(ms * 1_000_000);
            let t = ms as f64 * 1e-3;
            let root_position = Vector3::new(t, 1.0 - 5.0 * t * t, 0.0);
            let (z, root_rotation) = ([0.0; 32], Matrix3::identity());
            let correction = Correction::default();
            TimedKeyframe::new(capture, Keyframe { z, root_rotation, root_position, correction })
        };
        let (past, ahead) = ([at(0), at(20)], [at(40), at(60)]);
        let skeleton = Skeleton::default();
        let known = Known { past: &past, ahead: &ahead, skeleton: &skeleton };
        let error = |ms: i64| {
            let TimedKeyframe { capture, keyframe } = at(ms);
            let found = known.between(capture, Interpolation::Lerp)?;
            Some((found.root_position - keyframe.root_position).norm())
        };
        assert!([25, 30, 37].into_iter().all(|ms| error(ms).unwrap() < 1e-12));
        // At the keyframes, and beside the first and the last one, there is none.
        assert!([0, 10, 20, 40, 50, 60].into_iter().all(|ms| error(ms).is_none()));
    }
}
