//! The declared latency: configured, or measured in the first windows.
//!
//! It changes only for good: up when frames stay later than it allows, down after half a minute in
//! which far less would do.

use crate::core::time::Nanos;
use crate::core::tracker::{Config, Latency};

/// Number of windows that are measured.
const WINDOWS: usize = 5;
/// Factor on the slowest solve time; gives the time reserved for a solve.
const SOLVE_FACTOR: i64 = 2;
/// Least time reserved for a solve, and for one that waits for those of other performers.
const LEAST_SOLVE: Nanos = Nanos::from_ms(22);
const LEAST_OF_SEVERAL: Nanos = Nanos::from_ms(40);
/// Least time reserved for the network.
const LEAST_NETWORK: Nanos = Nanos::from_ms(2);
/// Time reserved for a solve when the latency is configured.
const GIVEN_SOLVE: Nanos = Nanos::from_ms(10);
/// Time from the end of a solve to its first pose on the bus.
const PUBLISH: Nanos = Nanos::from_ms(4);
/// Measured latencies are rounded up to a multiple of this.
const ROUND: Nanos = Nanos::from_ms(1);

/// Windows wait long enough if frames come less than this later than is allowed for: most are then
/// still in time, and the others are in the first half of the next window.
const EXCESS: Nanos = Nanos::from_ms(5);
/// A latency is lowered by at least this much.
const LEAST_CHANGE: Nanos = Nanos::from_ms(20);
/// A latency holds for a frame period within one part in this many.
const SAME_RATE: i64 = 20;
/// Reviews in a row, one per second, in which less would do, before a latency is lowered.
const CALM: u32 = 30;

/// Finds the latency to declare.
#[derive(Clone, Debug, Default)]
pub(super) struct Finder {
    given: Option<Nanos>,
    least_solve: Nanos,
    /// The latency of the run before, if there was one, and its part for a solve; 0: not known.
    before: Option<[Nanos; 2]>,
    solves: Vec<Nanos>,
    found: Option<Latency>,
    /// Times that it allows for: window from its first pose, solve and network.
    parts: [Nanos; 3],
    /// The frame period that it holds for.
    period: Nanos,
    /// Seconds in which less would do, and the most that was needed in them.
    calm: (u32, Nanos),
}

impl Finder {
    /// For a configured latency in milliseconds, 0 to measure it, and that of the run before with the part for a solve (0:
    /// not known); for one performer or `several`.
    pub(super) fn new(given_ms: f64, before: Option<[Nanos; 2]>, several: bool) -> Self {
        let given = (given_ms > 0.0).then(|| Nanos::new((given_ms * 1e6) as i64));
        let least_solve = if several { LEAST_OF_SEVERAL } else { LEAST_SOLVE };
        Self { given, least_solve, before, ..Self::default() }
    }

    /// The latency, once it is declared.
    pub(super) fn declared(&self) -> Option<Nanos> {
        self.found.map(|latency| latency.declared)
    }

    /// The time reserved for a solve, once the latency is declared.
    pub(super) fn solve(&self) -> Option<Nanos> {
        self.found.map(|_| self.parts[1])
    }

    /// Time that a window's solve may take, once the latency is declared: the time reserved for it,
    /// or, if no pose waits for it, half of a frame `period`.
    pub(super) fn solve_time(&self, period: Nanos) -> Option<Nanos> {
        let latency = self.found?;
        let [wait, _, delay] = self.parts;
        // A configured latency may leave more than is reserved.
        let left = self.given.map_or(Nanos::ZERO, |declared| declared - wait - delay);
        let solve = latency.reserve.max(left) - PUBLISH;
        Some(latency.look_ahead.map_or(solve, |_| period / 2))
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
        // The latency of the run before holds if it leaves enough time to solve.
        if let Some([before, solve]) = self.before.take().filter(|_| self.given.is_none()) {
            let rest = before - wait - PUBLISH;
            let most = rest - delay.max(LEAST_NETWORK);
            let solve = if solve > Nanos::ZERO { solve.min(most) } else { most };
            if solve >= self.least_solve.min(wait) {
                return Some(self.declare([wait, solve, rest - solve], period, config));
            }
        }
        self.solves.push(took);
        if self.given.is_none() && self.solves.len() < WINDOWS {
            return None;
        }
        let slowest = self.solves.iter().max().copied().unwrap_or_default();
        let solve = (slowest * SOLVE_FACTOR).max(self.least_solve).min(wait);
        Some(self.declare([wait, solve, delay], period, config))
    }

    /// Declares another latency if the frame rate has changed, or if frames have come after `lasting`
    /// again and again and that is more than it allows for; `delay` is then the delay to allow for. The other times are as in
    /// [`Finder::solved`].
    pub(super) fn raise(
        &mut self,
        lasting: Nanos,
        [wait, delay, period]: [Nanos; 3],
        config: &Config,
    ) -> Option<(Latency, String)> {
        let [allowed_wait, solve, allowed] = self.parts;
        self.found?;
        let is_other_rate = (period - self.period).abs() > self.period / SAME_RATE;
        if lasting <= allowed + EXCESS && wait <= allowed_wait + ROUND && !is_other_rate {
            return None;
        }
        // A little more, so that it does not change again soon.
        let delay = match lasting > allowed + EXCESS {
            true => with_margin(delay.max(lasting)).max(allowed + LEAST_CHANGE),
            false => allowed,
        };
        Some(self.declare([wait, solve, delay], period, config))
    }

    /// Declares a lower latency if less would have done for a while; called once a second.
    pub(super) fn lower(
        &mut self,
        [wait, delay, period]: [Nanos; 3],
        config: &Config,
    ) -> Option<(Latency, String)> {
        let [allowed_wait, solve, allowed] = self.parts;
        self.found?;
        let spare = allowed_wait - wait + allowed - with_margin(delay);
        if spare < LEAST_CHANGE.max(allowed / 4) {
            self.calm = (0, Nanos::ZERO);
            return None;
        }
        self.calm = (self.calm.0 + 1, self.calm.1.max(delay));
        let delay = with_margin(self.calm.1);
        (self.calm.0 >= CALM).then(|| self.declare([wait, solve, delay], period, config))
    }

    /// The latency for a window, a solve and a network, with its reason.
    fn declare(&mut self, parts: [Nanos; 3], period: Nanos, config: &Config) -> (Latency, String) {
        let [wait, solve, delay] = parts;
        self.calm = (0, Nanos::ZERO);
        (self.parts, self.period) = ([wait, solve, delay.max(LEAST_NETWORK)], period);
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
            None => {
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
        (latency, why)
    }
}

/// A delay with room for a little more.
fn with_margin(delay: Nanos) -> Nanos {
    delay * 9 / 8
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
        let mut finder = Finder::new(0.0, None, false);
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
    fn the_latency_of_the_run_before_holds_if_it_is_enough() {
        let declared = |before: i64, delay: i64| {
            let before = Some([MS * before, MS * 40]);
            let found = solved(&mut Finder::new(0.0, before, false), 5, delay);
            found.map(|(latency, why)| {
                assert!(why.contains("solve 40.0, network"), "{why}");
                latency.declared
            })
        };
        assert_eq!(declared(197, 3), Some(MS * 197));
        assert_eq!(declared(251, 3), Some(MS * 251), "the rest is network");
        assert_eq!(declared(197, 30), None, "measured anew");
    }

    #[test]
    fn a_given_latency_holds_with_the_look_ahead_that_it_allows() {
        let of = |given: f64, delay: i64| {
            solved(&mut Finder::new(given, None, false), 5, delay).unwrap()
        };
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
    fn a_latency_changes_for_good_and_without_flutter() {
        let mut finder = Finder::new(0.0, None, false);
        (0..WINDOWS).for_each(|_| drop(solved(&mut finder, 5, 3)));
        let config = Config::default();
        let times = |delay: i64| [MS * 150, MS * delay, MS * 16];
        assert_eq!(finder.declared(), Some(MS * 179));
        assert!(finder.raise(MS * 8, times(9), &config).is_none());
        assert!(finder.raise(MS * 43, times(44), &config).is_some());
        assert_eq!(finder.declared(), Some(MS * 226));
        assert!(finder.raise(MS * 49, times(49), &config).is_none());
        for _ in 1..CALM {
            assert!(finder.lower(times(20), &config).is_none());
        }
        assert!(finder.lower(times(40), &config).is_none(), "too little to gain");
        for _ in 1..CALM {
            assert!(finder.lower(times(4), &config).is_none());
        }
        assert!(finder.lower(times(4), &config).is_some());
        assert_eq!(finder.declared(), Some(MS * 181));
    }

    #[test]
    fn a_latency_that_is_too_short_is_reported_with_the_smallest_possible_one() {
        let (latency, why) = solved(&mut Finder::new(10.0, None, false), 5, 20).unwrap();
        assert_eq!((latency.declared, latency.look_ahead), (MS * 10, Some(0)));
        assert!(why.contains("the smallest possible latency is 26.0 ms"), "{why}");
    }
}
