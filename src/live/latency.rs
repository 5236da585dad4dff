//! The declared latency: configured, or measured in the first windows.

use crate::core::time::Nanos;
use crate::core::tracker::Latency;

/// Number of windows that are measured.
const WINDOWS: usize = 5;
/// Factor on the slowest solve time; gives the time reserved for a solve.
const SOLVE_FACTOR: i64 = 2;
/// Least time reserved for a solve.
const LEAST_SOLVE: Nanos = Nanos::from_ms(22);
/// Least time reserved for the network.
const LEAST_NETWORK: Nanos = Nanos::from_ms(2);
/// Time reserved for a solve when the latency is configured.
const GIVEN_SOLVE: Nanos = Nanos::from_ms(10);
/// Time from the end of a solve to its first pose on the bus.
const PUBLISH: Nanos = Nanos::from_ms(4);
/// Measured latencies are rounded up to a multiple of this.
const ROUND: Nanos = Nanos::from_ms(1);

/// Finds the latency to declare.
#[derive(Clone, Debug)]
pub(super) struct Finder {
    given: Option<Nanos>,
    solves: Vec<Nanos>,
    found: Option<Latency>,
}

impl Finder {
    /// For a configured latency in milliseconds; 0 to measure it.
    pub(super) fn new(given_ms: f64) -> Self {
        let given = (given_ms > 0.0).then(|| Nanos::new((given_ms * 1e6) as i64));
        Self { given, solves: Vec::new(), found: None }
    }

    /// The latency, once it is declared.
    pub(super) fn declared(&self) -> Option<Nanos> {
        self.found.map(|latency| latency.declared)
    }

    /// Time reserved for a solve, once the latency is declared.
    pub(super) fn solve_time(&self) -> Option<Nanos> {
        self.found.map(|latency| latency.reserve - PUBLISH)
    }

    /// Adds a window that was solved in `took`; `wait` is the time from its first pose to its end,
    /// `delay` the delay of the network. Returns the latency and its reason, once.
    pub(super) fn solved(
        &mut self,
        took: Nanos,
        wait: Nanos,
        delay: Nanos,
    ) -> Option<(Latency, String)> {
        if self.found.is_some() {
            return None;
        }
        self.solves.push(took);
        let (latency, why) = match self.given {
            Some(declared) => {
                let why = format!("{declared} as configured");
                let least = wait + GIVEN_SOLVE + delay + PUBLISH;
                let why = match declared < least {
                    true => format!("{why}; below {least} poses are coasted"),
                    false => why,
                };
                (Latency { declared, reserve: GIVEN_SOLVE + PUBLISH }, why)
            }
            None if self.solves.len() < WINDOWS => return None,
            None => {
                let slowest = self.solves.iter().max().copied().unwrap_or_default();
                let solve = (slowest * SOLVE_FACTOR).max(LEAST_SOLVE).min(wait);
                let network = delay.max(LEAST_NETWORK);
                let latency = wait + solve + network + PUBLISH;
                let declared = ROUND * ((latency.ns() - 1) / ROUND.ns() + 1);
                let why = format!(
                    "{declared:.0}: window from its first pose {:.1}, solve {:.1}, network {:.1}, \
                     publishing {:.1}",
                    wait.ms(),
                    solve.ms(),
                    network.ms(),
                    PUBLISH.ms()
                );
                (Latency { declared, reserve: solve + PUBLISH }, why)
            }
        };
        self.found = Some(latency);
        Some((latency, why))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Nanos = Nanos::from_ms(1);

    #[test]
    fn a_latency_is_found_once_from_the_slowest_of_the_first_windows() {
        let mut finder = Finder::new(0.0);
        for took in [5, 20, 6, 5] {
            assert!(finder.solved(MS * took, MS * 150, MS * 3).is_none());
        }
        let (latency, why) = finder.solved(MS * 5, MS * 150, MS * 3).unwrap();
        assert_eq!(latency.declared, MS * 197);
        assert!(why.starts_with("197 ms: window from its first pose 150.0, solve 40.0"), "{why}");
        assert!(finder.solved(MS * 90, MS * 150, MS * 3).is_none());
        assert_eq!(finder.declared(), Some(MS * 197));
    }

    #[test]
    fn a_given_latency_holds_and_says_when_it_is_too_short() {
        let (latency, why) = Finder::new(250.0).solved(MS * 5, MS * 150, Nanos::ZERO).unwrap();
        assert_eq!((latency.declared, &*why), (MS * 250, "250.0 ms as configured"));
        let (_, why) = Finder::new(100.0).solved(MS * 5, MS * 150, Nanos::ZERO).unwrap();
        assert!(why.contains("coasted"), "{why}");
    }
}
