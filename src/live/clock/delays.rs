//! Delays of the cameras' frames: which are usual, lasting or too long, and what is drift.

use super::base::{AHEAD, Base, LONGEST_DELAY};
use super::camera::{CameraClock, LeftOut};
use super::{Clock, RECENT, median};
use crate::core::time::{Nanos, Timestamp};

/// A camera whose frames come this much later than the median camera's is not waited for.
const MOST_BEHIND: Nanos = Nanos::from_ms(250);

/// A latency is declared for the drift of this time, and for this much of it.
const FORESEEN: Nanos = Nanos::from_ms(600_000);
const MOST_FORESEEN: Nanos = Nanos::from_ms(100);

impl Clock {
    /// Whether delays are to be reviewed: a quarter of a second has begun.
    pub(crate) fn takes_review(&mut self) -> bool {
        std::mem::take(&mut self.is_to_review)
    }

    /// Leaves out cameras whose frames come far later than the others', and takes them back.
    pub(crate) fn leave_out_late(&mut self) {
        let Some(usual) = median(self.levels()) else { return };
        let mut used = self.levels().count();
        for camera in &mut self.cameras {
            let level = camera.level().filter(|_| !camera.is_silent);
            let Some(behind) = level.map(|level| level - usual) else { continue };
            match camera.left_out {
                None if behind > MOST_BEHIND && camera.is_settled() && used > 2 => {
                    camera.left_out = Some(LeftOut::Late(behind));
                    used -= 1;
                }
                // Late is better than alone.
                Some(LeftOut::Late(_))
                    if used < 2
                        || camera.lasting().is_some_and(|at| at - usual < MOST_BEHIND * 4 / 5) =>
                {
                    camera.left_out = None;
                    used += 1;
                }
                _ => {}
            }
        }
    }

    /// A lasting delay of more than two seconds is a clock that has stepped while nothing came:
    /// it becomes part of the base. Returns by how much.
    pub(crate) fn absorb_delay(&mut self) -> Option<Nanos> {
        let least = self.levels().min()?;
        let is_settled = self.cameras.iter().any(CameraClock::is_settled);
        let excess = least - self.base();
        if !is_settled || excess < LONGEST_DELAY {
            return None;
        }
        self.base = Some(Base::of(least));
        Some(excess)
    }

    /// Delay of the frames of the last seconds, apart from outliers: what windows should wait for.
    pub(crate) fn delay(&self) -> Nanos {
        self.slowest(CameraClock::usual_most)
    }

    /// A delay that has been reached again and again, and the longest one beside it.
    pub(crate) fn lasting_delay(&self) -> [Nanos; 2] {
        [self.slowest(CameraClock::lasting), self.slowest(CameraClock::most)]
    }

    /// Shortest delay from capture to arrival for the slowest camera.
    pub(crate) fn usual_delay(&self) -> Nanos {
        self.slowest(CameraClock::level)
    }

    fn slowest(&self, offset: impl Fn(&CameraClock) -> Option<Nanos>) -> Nanos {
        let used = self.cameras.iter().filter(|camera| camera.is_used());
        let slowest = used.filter_map(offset).max();
        slowest.map_or(Nanos::ZERO, |slowest| (slowest - self.base()).max(Nanos::ZERO))
    }

    /// By how much the delay of the slowest camera will seem to grow in the next ten minutes: its own
    /// clock falls behind.
    pub(crate) fn growth(&self) -> Nanos {
        let used = self.cameras.iter().filter(|camera| camera.is_used());
        // Motion may correct the drift of a camera whose times it corrects.
        let used = used.filter(|camera| !camera.is_corrected);
        let drifts = used.filter_map(CameraClock::drift);
        let most = drifts.fold(0.0, f64::max) * FORESEEN.seconds();
        Nanos::rounded(most).min(MOST_FORESEEN)
    }

    /// By how much corrections make frames come before their capture time. Then the other cameras are late instead.
    pub(crate) fn too_early(&self) -> Option<Nanos> {
        let used = self.cameras.iter().filter(|camera| camera.is_used());
        let by =
            |camera: &CameraClock| Some((self.base() - camera.level()?).min(camera.correction()));
        used.filter_map(by).max().filter(|by| *by > AHEAD)
    }

    /// Deviation of each camera's offset from the median of all, seconds: of the smallest ones of ten
    /// seconds, without changes of the delay. With or without its correction, whichever is less.
    pub(crate) fn deviations(&self) -> Vec<(usize, f64)> {
        let used = self.cameras.iter().enumerate().filter(|(_, camera)| camera.is_used());
        let of = |(index, camera): (usize, &CameraClock)| {
            let offset = camera.compared()?;
            Some((index, [offset, offset - camera.correction()]))
        };
        let offsets: Vec<(usize, [Nanos; 2])> = used.filter_map(of).collect();
        let middle = |which: usize| median(offsets.iter().map(|(_, offsets)| offsets[which]));
        let Some(medians) = middle(0).zip(middle(1)) else { return Vec::new() };
        let off = |(index, [raw, corrected]): &(usize, [Nanos; 2])| {
            let off = [*raw - medians.0, *corrected - medians.1];
            let least = off.into_iter().min_by_key(|off| off.abs()).unwrap_or_default();
            (*index, least.seconds())
        };
        offsets.iter().map(off).collect()
    }

    /// Follows the drift of the clock, and notes which cameras are silent; called once a second.
    pub(crate) fn follow(&mut self, now: Timestamp) {
        let Some(base) = &mut self.base else { return };
        let is_heard = |camera: &CameraClock| camera.last.is_some_and(|(_, at)| now - at < RECENT);
        if self.cameras.iter().any(is_heard) {
            self.cameras.iter_mut().for_each(|camera| camera.is_silent = !is_heard(camera));
        }
        let used = self.cameras.iter().filter(|camera| camera.is_used());
        let drifts: Option<Vec<f64>> = used.map(CameraClock::drift).collect();
        let Some(mut drifts) = drifts.filter(|drifts| !drifts.is_empty()) else { return };
        // The smallest common drift: one camera's is its own affair.
        drifts.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
        let is_common = drifts.iter().all(|drift| drift.signum() == drifts[0].signum());
        if is_common {
            base.follow(drifts[0]);
        }
    }
}
