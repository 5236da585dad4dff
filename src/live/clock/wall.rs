//! The node's clock: starts at the wall clock's time and never goes back.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crate::core::time::{Nanos, Timestamp};

/// How early a sleep should end: it overshoots by the kernel's timer slack, slightly more than
/// 50 us.
pub(crate) const HEAD_START: Duration = Duration::from_micros(100);

/// Nanoseconds since 1970; a later change of the system's clock has no effect.
#[derive(Clone, Copy, Debug)]
pub struct WallClock {
    at_start: Timestamp,
    start: Instant,
}

impl WallClock {
    /// Starts a clock at the system's current time.
    pub fn start() -> Self {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self { at_start: Timestamp::default() + Nanos::from(since_1970), start: Instant::now() }
    }

    /// The current time.
    pub fn now(&self) -> Timestamp {
        self.at_start + Nanos::from(self.start.elapsed())
    }

    /// Waits until that time: sleeps, then spins for the rest.
    pub fn wait_until(&self, then: Timestamp) {
        let sleep = self.until(then).saturating_sub(HEAD_START);
        if !sleep.is_zero() {
            std::thread::sleep(sleep);
        }
        while self.now() < then {
            std::hint::spin_loop();
        }
    }

    /// Time left until then; zero if it has passed.
    pub fn until(&self, then: Timestamp) -> Duration {
        Duration::from_nanos(u64::try_from((then - self.now()).ns()).unwrap_or(0))
    }
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
        assert!(clock.until(second + Nanos::SECOND * 3600) > Duration::from_secs(3000));
    }
}
