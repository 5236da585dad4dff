//! Stop requests by signals, and the clock of `play`.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use super::failure::{Exit, Failure};
use crate::cli::tools::player::Clock;
use crate::core::time::Timestamp;
use crate::io::new_file::remove_open;
use crate::live::WallClock;

/// Longest time until a stop request is noticed.
pub(crate) const ATTENTION: Duration = Duration::from_millis(20);
/// A program that has heard nothing for this long says so.
pub(super) const PATIENCE: Duration = Duration::from_secs(5);

/// Whether the command ends by itself at a signal.
static STOPS: AtomicBool = AtomicBool::new(false);

/// At SIGINT and SIGTERM, a command without a [`Stop`] leaves no temporary files.
pub(super) fn clean_up_on_signals() {
    let Ok(mut signals) = Signals::new([SIGINT, SIGTERM]) else { return };
    std::thread::spawn(move || {
        for signal in signals.forever() {
            if !STOPS.load(Ordering::Acquire) {
                remove_open();
                let _ = signal_hook::low_level::emulate_default_handler(signal);
            }
        }
    });
}

/// A request to stop the program; clones share it.
#[derive(Clone, Debug, Default)]
pub(crate) struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Set by SIGINT and SIGTERM; a second signal ends the process at once.
    pub(crate) fn on_signals() -> Result<Self, Failure> {
        STOPS.store(true, Ordering::Release);
        let stop = Self::default();
        for signal in [SIGINT, SIGTERM] {
            let flag = || Arc::clone(&stop.0);
            // The order matters: the first signal finds the flag unset and sets it.
            signal_hook::flag::register_conditional_shutdown(signal, 128 + signal, flag())
                .and_then(|_| signal_hook::flag::register(signal, flag()))
                .map_err(|error| {
                    let message = format!("cannot listen for signals: {error}");
                    Failure::new(Exit::Unexpected, message)
                })?;
        }
        Ok(stop)
    }

    /// Requests a stop.
    #[cfg(test)]
    pub(crate) fn stop(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether a stop is requested.
    pub(crate) fn is_set(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// The clock of the node; its waits end at a stop request.
pub(crate) struct SteadyClock {
    clock: WallClock,
    stop: Stop,
}

impl SteadyClock {
    pub(crate) fn new(stop: Stop) -> Self {
        Self { clock: WallClock::start(), stop }
    }
}

impl Clock for SteadyClock {
    fn now(&self) -> Timestamp {
        self.clock.now()
    }

    fn wait_until(&self, time: Timestamp) -> bool {
        loop {
            let left = self.clock.until(time);
            if self.stop.is_set() {
                return false;
            }
            if left.is_zero() {
                return true;
            }
            std::thread::sleep(left.min(ATTENTION));
        }
    }
}
