//! Counters of windows and publications for the status message.

use std::collections::VecDeque;

use crate::core::time::Nanos;
use crate::core::tracker::{Verdict, WindowReport};
use crate::io::wire::{PlayoutCounters, WindowCounters};

/// Number of recent windows for solve times and iterations.
const RECENT: usize = 256;
/// Upper ends of the bins of deviations from due times, microseconds.
const DEVIATION_BINS_US: [u32; 9] = [100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000];
/// Upper ends of the bins of provisional latencies, microseconds.
const LIVE_BINS_US: [u32; 9] = [1000, 2000, 3000, 5000, 7500, 10_000, 20_000, 50_000, 100_000];

/// Counters of windows.
#[derive(Clone, Debug, Default)]
pub(super) struct Windows {
    counters: WindowCounters,
    /// Solve time in milliseconds, iterations and cost of the recent windows.
    recent: VecDeque<[f64; 3]>,
    /// Age of the first pose of recent windows when they were given to the solvers, milliseconds.
    ages: VecDeque<f64>,
}

impl Windows {
    /// Counts a solved window.
    pub(super) fn solved(&mut self, report: &WindowReport, took: Nanos) {
        let counter = match report.verdict {
            Verdict::Tracked => &mut self.counters.tracked,
            Verdict::Coasted(_) => &mut self.counters.coasted,
            Verdict::Lost(_) => &mut self.counters.lost,
        };
        *counter += 1;
        let Some(summary) = report.summary else { return };
        self.counters.termination = summary.termination.name().to_owned();
        push(&mut self.recent, [took.ms(), summary.iterations as f64, summary.final_cost]);
    }

    /// Counts a window that is given to the solvers, at that age of its first pose.
    pub(super) fn given(&mut self, age: Nanos) {
        push(&mut self.ages, age.ms());
    }

    /// Counts a window that closed without a camera.
    pub(super) fn incomplete(&mut self) {
        self.counters.incomplete += 1;
    }

    pub(super) fn counters(&self) -> WindowCounters {
        let recent = |index: usize| self.recent.iter().map(|one| one[index]).collect();
        let [mut times, mut iterations, mut costs]: [Vec<f64>; 3] = [0, 1, 2].map(recent);
        let mut ages: Vec<f64> = self.ages.iter().copied().collect();
        WindowCounters {
            iterations: quantile(&mut iterations, 0.5),
            solve_p50_ms: quantile(&mut times, 0.5),
            solve_p99_ms: quantile(&mut times, 0.99),
            age_p50_ms: quantile(&mut ages, 0.5),
            age_p99_ms: quantile(&mut ages, 0.99),
            cost_p50: quantile(&mut costs, 0.5),
            ..self.counters.clone()
        }
    }
}

fn push<T>(recent: &mut VecDeque<T>, newest: T) {
    recent.push_back(newest);
    while recent.len() > RECENT {
        recent.pop_front();
    }
}

/// The quantile at `part`, 0 to 1; 0 if there are no values.
pub(super) fn quantile(values: &mut [f64], part: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let index = (values.len() as f64 * part).ceil() as usize;
    values.get(index.saturating_sub(1)).copied().unwrap_or(0.0)
}

/// Numbers of a performer's poses.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Poses {
    /// Final and provisional ones that were put out.
    pub(super) published: u64,
    pub(super) provisional: u64,
}

impl Poses {
    pub(super) fn counters(self, (coasted, missed): (u64, u64)) -> PlayoutCounters {
        let Self { published, provisional } = self;
        PlayoutCounters { published, provisional, coasted, missed, ..PlayoutCounters::default() }
    }
}

/// Counters of the publications of all performers.
#[derive(Clone, Debug)]
pub(super) struct Published {
    counters: PlayoutCounters,
}

impl Published {
    pub(super) fn new() -> Self {
        let counters = PlayoutCounters {
            deviation_bins_us: DEVIATION_BINS_US.to_vec(),
            deviation_counts: vec![0; DEVIATION_BINS_US.len() + 1],
            provisional_bins_us: LIVE_BINS_US.to_vec(),
            provisional_counts: vec![0; LIVE_BINS_US.len() + 1],
            ..PlayoutCounters::default()
        };
        Self { counters }
    }

    /// Counts published final poses, each with its deviation from the due time.
    pub(super) fn played(&mut self, deviations_us: &[i32]) {
        self.counters.published += deviations_us.len() as u64;
        for deviation in deviations_us {
            let bin = bin(&DEVIATION_BINS_US, deviation.unsigned_abs());
            self.counters.deviation_counts[bin] += 1;
        }
    }

    /// Counts a provisional pose; the latency is from the last message of its frame set.
    pub(super) fn provisional(&mut self, latency_us: u32) {
        self.counters.provisional += 1;
        self.counters.provisional_counts[bin(&LIVE_BINS_US, latency_us)] += 1;
    }

    pub(super) fn counters(&self, (coasted, missed): (u64, u64)) -> PlayoutCounters {
        PlayoutCounters { coasted, missed, ..self.counters.clone() }
    }
}

fn bin(ends: &[u32], value: u32) -> usize {
    ends.iter().position(|end| value <= *end).unwrap_or(ends.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pose_is_in_one_bin() {
        let mut published = Published::new();
        published.played(&[0, -100, 101, i32::MIN, i32::MAX, 2000]);
        published.provisional(u32::MAX);
        let counters = published.counters((1, 2));
        assert_eq!(counters.published, 6);
        assert_eq!(counters.deviation_counts, [2, 1, 0, 0, 1, 0, 0, 0, 0, 2]);
        assert_eq!(counters.provisional_counts.last(), Some(&1));
        assert_eq!((counters.coasted, counters.missed), (1, 2));
    }

    #[test]
    fn quantiles_are_values_that_occurred() {
        assert_eq!(quantile(&mut [], 0.5), 0.0);
        assert_eq!(quantile(&mut [3.0, 1.0, 2.0], 0.5), 2.0);
        assert_eq!(quantile(&mut [3.0, 1.0, 2.0], 0.99), 3.0);
    }
}
