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
            if time <= later.capture {
                let s = time.fraction(earlier.capture, later.capture);
                let s = s.max(0.0);
                return Some(interpolation.keyframe(&earlier.keyframe, &later.keyframe, s));
            }
            earlier = later;
        }
        Some(earlier.keyframe.clone())
    }
}
