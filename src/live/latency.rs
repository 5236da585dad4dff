//! The declared latency: configured, or measured in the first windows.

use crate::core::time::Nanos;
use crate::core::tracker::{Config, Latency};

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

    /// Time that a window's solve may take, once the latency is declared: the time reserved for it,
    /// or, if no pose waits for it, half of a frame `period`.
    pub(super) fn solve_time(&self, period: Nanos) -> Option<Nanos> {
        let latency = self.found?;
        Some(latency.look_ahead.map_or(latency.reserve - PUBLISH, |_| period / 2))
    }

    /// Adds a window that was solved in `took`; `wait` is the time from its first pose to its end,
    /// `delay` the delay of the network, `period` that of frames. Returns the latency and its
    /// reason, once.
    pub(super) fn solved(
        &mut self,
        took: Nanos,
        [wait, delay, period]: [Nanos; 3],
        config: &Config,
    ) -> Option<(Latency, String)> {
        if self.found.is_some() {
            return None;
        }
        self.solves.push(took);
        let (latency, why) = match self.given {
            Some(declared) => {
                let waits = [wait, GIVEN_SOLVE + PUBLISH, delay];
                let latency = Latency::new(declared, waits, period, config);
                let least = Latency::LEAST + delay;
                let why = match latency.look_ahead {
                    _ if declared < least => format!(
                        "{declared} as configured is too short: poses are extrapolated; the \
                         smallest possible latency is {least}, {delay} of it network"
                    ),
                    Some(frames) => format!("{declared} as configured: look-ahead {frames} frames"),
                    None => format!("{declared} as configured"),
                };
                (latency, why)
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
                (Latency { declared, reserve: solve + PUBLISH, look_ahead: None }, why)
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

    fn solved(finder: &mut Finder, took: i64, delay: i64) -> Option<(Latency, String)> {
        finder.solved(MS * took, [MS * 150, MS * delay, MS * 16], &Config::default())
    }

    #[test]
    fn a_latency_is_found_once_from_the_slowest_of_the_first_windows() {
        let mut finder = Finder::new(0.0);
        for took in [5, 20, 6, 5] {
            assert!(solved(&mut finder, took, 3).is_none());
        }
        let (latency, why) = solved(&mut finder, 5, 3).unwrap();
        assert_eq!((latency.declared, latency.look_ahead), (MS * 197, None));
        assert!(why.starts_with("197 ms: window from its first pose 150.0, solve 40.0"), "{why}");
        assert!(solved(&mut finder, 90, 3).is_none());
        assert_eq!(finder.declared(), Some(MS * 197));
        assert_eq!(finder.solve_time(MS * 16), Some(MS * 40));
    }

    #[test]
    fn a_given_latency_holds_with_the_look_ahead_that_it_allows() {
        let of = |given: f64, delay: i64| solved(&mut Finder::new(given), 5, delay).unwrap();
        let (latency, why) = of(250.0, 0);
        assert_eq!((latency.declared, &*why), (MS * 250, "250.0 ms as configured"));
        // Eight to solve and publish, two of network.
        for (given, frames) in [(6.0, 0), (25.0, 0), (26.0, 1), (41.0, 1), (100.0, 5), (163.0, 5)] {
            let (latency, why) = of(given, if given > 6.0 { 2 } else { 0 });
            assert_eq!(latency.look_ahead, Some(frames), "{why}");
            assert!(why.ends_with(&format!("look-ahead {frames} frames")), "{why}");
        }
        assert_eq!(of(164.0, 0).0.look_ahead, None);
    }

    #[test]
    fn a_latency_that_is_too_short_is_reported_with_the_smallest_possible_one() {
        let (latency, why) = solved(&mut Finder::new(10.0), 5, 20).unwrap();
        assert_eq!((latency.declared, latency.look_ahead), (MS * 10, Some(0)));
        assert!(why.contains("the smallest possible latency is 26.0 ms"), "{why}");
    }
}
