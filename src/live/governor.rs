//! Chooses the effort of the solver.
//!
//! Effort goes down when a solve takes longer than the available time, poses are coasted, or the
//! queue overflows. It goes up again after many windows with time to spare. The latency stays as
//! declared.

use crate::core::tracker::Effort;

/// Windows without trouble before effort is raised by one level.
const CALM: u32 = 60;
/// Effort is raised if solves take less than this part of the available time.
const SPARE: f64 = 0.5;
/// Windows after a change that are not judged, since they may still carry the backlog.
const SETTLE: u32 = 3;

/// The current level of effort and the counters that change it.
#[derive(Clone, Debug, Default)]
pub(super) struct Governor {
    level: u32,
    calm: u32,
    settling: u32,
    /// How often the level rose, that is, effort was reduced.
    pub(super) degradation_steps: u64,
}

impl Governor {
    pub(super) fn level(&self) -> u32 {
        self.level
    }

    /// Judges a window that was solved in `took` of the `available` nanoseconds; `trouble` names
    /// what else went wrong since the last one. Returns the reason if the level changes.
    pub(super) fn solved(
        &mut self,
        took: i64,
        available: i64,
        trouble: Option<&str>,
    ) -> Option<String> {
        if self.settling > 0 {
            self.settling -= 1;
            return None;
        }
        let [took_ms, available_ms] = [took, available].map(|ns| ns as f64 * 1e-6);
        if took > available || trouble.is_some() {
            self.calm = 0;
            if self.level + 1 >= Effort::LEVELS {
                return None;
            }
            (self.level, self.settling) = (self.level + 1, SETTLE);
            self.degradation_steps += 1;
            let trouble = trouble.unwrap_or("the solve is too slow");
            return Some(format!("{trouble}; a window took {took_ms:.1} of {available_ms:.1} ms"));
        }
        let is_calm = took as f64 <= SPARE * available as f64;
        self.calm = if is_calm { self.calm + 1 } else { 0 };
        if self.level == 0 || self.calm < CALM {
            return None;
        }
        (self.level, self.calm) = (self.level - 1, 0);
        Some(format!("{CALM} windows took at most half of {available_ms:.1} ms"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn effort_falls_at_once_and_rises_slowly() {
        let mut governor = Governor::default();
        assert!(governor.solved(5, 10, None).is_none());
        assert!(governor.solved(11, 10, None).is_some());
        assert_eq!(governor.level(), 1);
        for _ in 0..SETTLE {
            assert!(governor.solved(11, 10, None).is_none());
        }
        assert!(governor.solved(1, 10, Some("the queue ran over")).is_some());
        assert_eq!((governor.level(), governor.degradation_steps), (2, 2));
        let calm = (0..1000).filter(|_| governor.solved(1, 10, None).is_some()).count();
        assert_eq!((governor.level(), calm), (0, 2));
        for _ in 0..100 {
            governor.solved(100, 10, None);
        }
        assert_eq!(governor.level(), Effort::LEVELS - 1);
    }
}
