//! The declared latency: configured, or measured in the first windows.

use crate::core::tracker::Latency;

/// Number of windows that are measured.
const WINDOWS: usize = 5;
/// Factor on the slowest solve time; gives the time reserved for a solve.
const SOLVE_FACTOR: f64 = 2.0;
/// Least time reserved for a solve, ns.
const LEAST_SOLVE: i64 = 22_000_000;
/// Least time reserved for the network, ns.
const LEAST_NETWORK: i64 = 2_000_000;
/// Time reserved for a solve when the latency is configured, ns.
const GIVEN_SOLVE: i64 = 10_000_000;
/// Time from the end of a solve to its first pose on the bus, ns.
const PUBLISH: i64 = 4_000_000;
/// Measured latencies are rounded up to a multiple of this, ns.
const ROUND: i64 = 1_000_000;

/// Finds the latency to declare.
#[derive(Clone, Debug)]
pub(super) struct Finder {
    given_ns: Option<i64>,
    solves: Vec<i64>,
    found: Option<Latency>,
}

impl Finder {
    /// For a configured latency in milliseconds; 0 to measure it.
    pub(super) fn new(given_ms: f64) -> Self {
        let given_ns = (given_ms > 0.0).then_some((given_ms * 1e6) as i64);
        Self { given_ns, solves: Vec::new(), found: None }
    }

    /// The latency, once it is declared, ns.
    pub(super) fn declared_ns(&self) -> Option<i64> {
        self.found.map(|latency| latency.declared_ns)
    }

    /// Time reserved for a solve, once the latency is declared, ns.
    pub(super) fn solve_ns(&self) -> Option<i64> {
        self.found.map(|latency| latency.reserve_ns - PUBLISH)
    }

    /// Adds a window that was solved in `took`; `wait` is the time from its first pose to its end,
    /// `delay` the delay of the network, all in ns. Returns the latency and its reason, once.
    pub(super) fn solved(&mut self, took: i64, wait: i64, delay: i64) -> Option<(Latency, String)> {
        if self.found.is_some() {
            return None;
        }
        self.solves.push(took);
        let ms = |ns: i64| ns as f64 * 1e-6;
        let (latency, why) = match self.given_ns {
            Some(declared_ns) => {
                let why = format!("{:.1} ms as configured", ms(declared_ns));
                let least = wait + GIVEN_SOLVE + delay + PUBLISH;
                let why = match declared_ns < least {
                    true => format!("{why}; below {:.1} ms poses are coasted", ms(least)),
                    false => why,
                };
                (Latency { declared_ns, reserve_ns: GIVEN_SOLVE + PUBLISH }, why)
            }
            None if self.solves.len() < WINDOWS => return None,
            None => {
                let slowest = self.solves.iter().max().copied().unwrap_or(0);
                let solve = ((slowest as f64 * SOLVE_FACTOR) as i64).max(LEAST_SOLVE).min(wait);
                let network = delay.max(LEAST_NETWORK);
                let latency = wait + solve + network + PUBLISH;
                let declared_ns = (latency + ROUND - 1) / ROUND * ROUND;
                let why = format!(
                    "{:.0} ms: window from its first pose {:.1}, solve {:.1}, network {:.1}, \
                     publishing {:.1}",
                    ms(declared_ns),
                    ms(wait),
                    ms(solve),
                    ms(network),
                    ms(PUBLISH)
                );
                (Latency { declared_ns, reserve_ns: solve + PUBLISH }, why)
            }
        };
        self.found = Some(latency);
        Some((latency, why))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn a_latency_is_found_once_from_the_slowest_of_the_first_windows() {
        let mut finder = Finder::new(0.0);
        for took in [5, 20, 6, 5] {
            assert!(finder.solved(took * MS, 150 * MS, 3 * MS).is_none());
        }
        let (latency, why) = finder.solved(5 * MS, 150 * MS, 3 * MS).unwrap();
        assert_eq!(latency.declared_ns, 197 * MS);
        assert!(why.starts_with("197 ms: window from its first pose 150.0, solve 40.0"), "{why}");
        assert!(finder.solved(90 * MS, 150 * MS, 3 * MS).is_none());
        assert_eq!(finder.declared_ns(), Some(197 * MS));
    }

    #[test]
    fn a_given_latency_holds_and_says_when_it_is_too_short() {
        let (latency, why) = Finder::new(250.0).solved(5 * MS, 150 * MS, 0).unwrap();
        assert_eq!((latency.declared_ns, &*why), (250 * MS, "250.0 ms as configured"));
        let (_, why) = Finder::new(100.0).solved(5 * MS, 150 * MS, 0).unwrap();
        assert!(why.contains("coasted"), "{why}");
    }
}
