//! What the core knows of one performer.

use std::sync::Arc;

use super::status::{Poses, Windows};
use crate::core::body::{Skeleton, TrackingState};
use crate::core::time::Timestamp;
use crate::core::tracker::Tracker;
use crate::io::wire::{PlayoutCounters, Topics, WindowCounters};

/// One performer: its topics, and what was published on them.
#[derive(Default)]
pub(super) struct Performer {
    pub(super) topics: Topics,
    /// The body of the next pose.
    pub(super) skeleton: Option<Arc<Skeleton>>,
    pub(super) windows: Windows,
    pub(super) poses: Poses,
    /// Median distance of the detections from the body in the last window, pixels.
    pub(super) residual_px: f64,
    /// Place on the floor (x and z) and capture time of the last tracked pose.
    pub(super) tracked: Option<([f64; 2], Timestamp)>,
    /// When the performer was found, at last.
    pub(super) found: Timestamp,
    /// When the job that is out was sent.
    pub(super) sent: Option<Timestamp>,
    /// When the last pose leaves.
    pub(super) leaves: Timestamp,
    /// Number of the last set of its frames that was sent to the solvers.
    pub(super) sets: u64,
}

impl Performer {
    pub(super) fn new(topics: Topics) -> Self {
        Self { topics, ..Self::default() }
    }
}

/// What a performer's tracker does: counters and its state.
pub(super) struct Progress {
    pub(super) state: &'static str,
    pub(super) windows: WindowCounters,
    pub(super) playout: PlayoutCounters,
}

/// The state of all performers: the best one.
pub(super) fn state_of_all(states: &[&str]) -> &'static str {
    let names = ["tracking", "coasting", "acquiring", "lost", "idle"];
    let best = names.into_iter().find(|name| states.contains(name));
    best.unwrap_or("searching")
}

/// The counters of all performers together; times, iterations and costs are the largest.
pub(super) fn windows_of_all<'a>(all: impl Iterator<Item = &'a WindowCounters>) -> WindowCounters {
    let mut sum = WindowCounters::default();
    for windows in all {
        // Other nodes may send any number.
        sum.tracked = sum.tracked.saturating_add(windows.tracked);
        sum.coasted = sum.coasted.saturating_add(windows.coasted);
        sum.lost = sum.lost.saturating_add(windows.lost);
        sum.incomplete = sum.incomplete.saturating_add(windows.incomplete);
        sum.iterations = sum.iterations.max(windows.iterations);
        sum.solve_p50_ms = sum.solve_p50_ms.max(windows.solve_p50_ms);
        sum.solve_p99_ms = sum.solve_p99_ms.max(windows.solve_p99_ms);
        sum.age_p50_ms = sum.age_p50_ms.max(windows.age_p50_ms);
        sum.cost_p50 = sum.cost_p50.max(windows.cost_p50);
        sum.age_p99_ms = sum.age_p99_ms.max(windows.age_p99_ms);
        sum.termination.clone_from(&windows.termination);
    }
    sum
}

/// Sums of coasted and missed poses.
pub(super) fn coasted_and_missed(all: &[Progress]) -> (u64, u64) {
    let add =
        |sum: (u64, u64), one: &Progress| (sum.0 + one.playout.coasted, sum.1 + one.playout.missed);
    all.iter().fold((0, 0), add)
}

/// The tracker's state by its name in the status message.
pub(super) fn tracker_state(track: &Tracker) -> &'static str {
    match track.state() {
        _ if track.is_idle() => "idle",
        Some(TrackingState::Tracking) => "tracking",
        Some(TrackingState::Coasting) => "coasting",
        _ if track.sees_somebody() => "acquiring",
        Some(TrackingState::Lost) => "lost",
        None => "searching",
    }
}
