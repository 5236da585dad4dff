//! The node's clock: the wall clock at the start, and from then on time that never goes back.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crate::core::time::Timestamp;

/// How long before a time a sleep should end: it overshoots by the kernel's timer slack, 50 us and
/// a little.
pub(super) const HEAD_START: Duration = Duration::from_micros(100);

/// Reads nanoseconds since 1970; a step of the system's clock after the start does not move it.
#[derive(Clone, Copy, Debug)]
pub struct WallClock {
    at_start: Timestamp,
    start: Instant,
}

impl WallClock {
    /// A clock that agrees with the system's clock now.
    pub fn start() -> Self {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self { at_start: Timestamp::from_ns(saturating_ns(since_1970)), start: Instant::now() }
    }

    /// The time.
    pub fn now(&self) -> Timestamp {
        self.at_start + saturating_ns(self.start.elapsed())
    }

    /// Waits until then: sleeps, and spins for what a sleep cannot hit.
    pub fn wait_until(&self, then: Timestamp) {
        let sleep = self.until(then).saturating_sub(HEAD_START);
        if !sleep.is_zero() {
            std::thread::sleep(sleep);
        }
        while self.now() < then {
            std::hint::spin_loop();
        }
    }

    /// How long it is until then; zero if it has passed.
    pub fn until(&self, then: Timestamp) -> Duration {
        Duration::from_nanos(u64::try_from(then - self.now()).unwrap_or(0))
    }
}

/// Nanoseconds, at most what a stamp holds.
pub(super) fn saturating_ns(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_never_goes_back_and_past_times_need_no_wait() {
        let clock = WallClock::start();
        let (first, second) = (clock.now(), clock.now());
        assert!(second >= first && first.ns() > 1_500_000_000_000_000_000);
        assert_eq!(clock.until(first), Duration::ZERO);
        assert!(clock.until(second + 3_600_000_000_000) > Duration::from_secs(3000));
    }
}
