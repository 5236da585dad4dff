//! The wall clock, and the wish to stop.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use signal_hook::consts::{SIGINT, SIGTERM};

use super::failure::{Exit, Failure};
use crate::core::time::Timestamp;
use crate::live::tools::player::Clock;

/// A wish to stop is seen within this time.
pub(crate) const ATTENTION: Duration = Duration::from_millis(20);

/// Whether the user wants an end; clones are the same wish.
#[derive(Clone, Debug, Default)]
pub(crate) struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Set by SIGINT and SIGTERM; a second signal ends the process at once.
    pub(crate) fn on_signals() -> Result<Self, Failure> {
        let stop = Self::default();
        for signal in [SIGINT, SIGTERM] {
            let flag = || Arc::clone(&stop.0);
            signal_hook::flag::register_conditional_shutdown(signal, 128 + signal, flag())
                .and_then(|_| signal_hook::flag::register(signal, flag()))
                .map_err(|error| {
                    let message = format!("cannot listen for signals: {error}");
                    Failure::new(Exit::Unexpected, message)
                })?;
        }
        Ok(stop)
    }

    /// Wishes for an end.
    #[cfg(test)]
    pub(crate) fn stop(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether an end is wished for.
    pub(crate) fn is_set(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// The wall clock when this was made, and steady from there on.
pub(crate) struct SteadyClock {
    wall: Timestamp,
    steady: Instant,
    stop: Stop,
}

impl SteadyClock {
    pub(crate) fn new(stop: Stop) -> Self {
        Self { wall: wall_clock(), steady: Instant::now(), stop }
    }
}

impl Clock for SteadyClock {
    fn now(&self) -> Timestamp {
        let elapsed = self.steady.elapsed().as_nanos();
        self.wall + i64::try_from(elapsed).unwrap_or(i64::MAX)
    }

    fn wait_until(&self, time: Timestamp) -> bool {
        loop {
            let left = time - self.now();
            if self.stop.is_set() {
                return false;
            }
            match u64::try_from(left) {
                Ok(left) if left > 0 => {
                    std::thread::sleep(Duration::from_nanos(left).min(ATTENTION));
                }
                _ => return true,
            }
        }
    }
}

/// The wall clock, nanoseconds since 1970.
pub(crate) fn wall_clock() -> Timestamp {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Timestamp::from_ns(i64::try_from(since.as_nanos()).unwrap_or(i64::MAX))
}
