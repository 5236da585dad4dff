//! Chooses the effort of the solver.
//!
//! Effort goes down when a solve takes longer than the available time, poses are coasted, or the
//! tracker falls behind. It goes up again after many windows with time to spare. The latency stays as
//! declared.

use crate::core::time::Nanos;
use crate::core::tracker::Effort;

/// Windows without trouble before effort is raised by one level.
const CALM: u32 = 60;
/// Effort is raised if a solve would fit this often into the available time.
const SPARE: i64 = 2;
/// Windows after a change that are not judged, since they may still carry the backlog.
const SETTLE: u32 = 3;

/// The current level of effort and the counters that change it.
#[derive(Clone, Debug, Default)]
pub(super) struct Governor {
    level: u32,
    calm: u32,
    settling: u32,
    /// Number of performers whose windows are judged.
    pub(super) performers: u32,
    /// How often the level rose, that is, effort was reduced.
    pub(super) degradation_steps: u64,
}

impl Governor {
    pub(super) fn level(&self) -> u32 {
        self.level
    }

    /// The tracker fell behind, so that no window is judged: fewer frames from now on. Returns
    /// whether the level changes.
    pub(super) fn fell_behind(&mut self) -> bool {
        if self.settling > 0 && self.performers > 1 {
            // Several performers fall behind together.
            return false;
        }
        let level = (self.level + 1).clamp(Effort::FEWER_FRAMES, Effort::LEVELS - 1);
        self.degradation_steps += u64::from(level - self.level);
        (self.calm, self.settling) = (0, self.windows(SETTLE));
        std::mem::replace(&mut self.level, level) != level
    }

    /// Judges a window that was solved in `took` of the `available` time; `trouble` names
    /// what else went wrong since the last one. Returns the reason if the level changes.
    pub(super) fn solved(
        &mut self,
        took: Nanos,
        available: Nanos,
        trouble: Option<&str>,
    ) -> Option<String> {
        if self.settling > 0 {
            self.settling -= 1;
            return None;
        }
        if took > available || trouble.is_some() {
            self.calm = 0;
            if self.level + 1 >= Effort::LEVELS {
                return None;
            }
            (self.level, self.settling) = (self.level + 1, self.windows(SETTLE));
            self.degradation_steps += 1;
            let trouble = trouble.unwrap_or("the solve is too slow");
            return Some(format!("{trouble}; a window took {took} of {available}"));
        }
        let is_calm = took * SPARE <= available;
        self.calm = if is_calm { self.calm + 1 } else { 0 };
        let calm = self.windows(CALM);
        if self.level == 0 || self.calm < calm {
            return None;
        }
        (self.level, self.calm) = (self.level - 1, 0);
        Some(format!("{calm} windows took at most half of {available}"))
    }

    /// So many windows of each performer.
    fn windows(&self, each: u32) -> u32 {
        each * self.performers.max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tracker_that_fell_behind_uses_fewer_frames_at_once() {
        let mut governor = Governor::default();
        assert!(governor.fell_behind());
        assert_eq!(
            Effort::at(governor.level(), &crate::core::tracker::Config::default()).stride,
            2
        );
        assert!(governor.fell_behind() && governor.fell_behind() && !governor.fell_behind());
        assert_eq!((governor.level(), governor.degradation_steps), (5, 5));
    }

    #[test]
    fn effort_falls_at_once_and_rises_slowly() {
        let mut governor = Governor::default();
        let solved = |governor: &mut Governor, took, trouble| {
            governor.solved(Nanos::new(took), Nanos::new(10), trouble)
        };
        assert!(solved(&mut governor, 5, None).is_none());
        assert!(solved(&mut governor, 11, None).is_some());
        assert_eq!(governor.level(), 1);
        for _ in 0..SETTLE {
            assert!(solved(&mut governor, 11, None).is_none());
        }
        assert!(solved(&mut governor, 1, Some("the queue ran over")).is_some());
        assert_eq!((governor.level(), governor.degradation_steps), (2, 2));
        let calm = (0..1000).filter(|_| solved(&mut governor, 1, None).is_some()).count();
        assert_eq!((governor.level(), calm), (0, 2));
        for _ in 0..100 {
            solved(&mut governor, 100, None);
        }
        assert_eq!(governor.level(), Effort::LEVELS - 1);
    }
}
