//! What leaves the machine as poses, and what takes the place of a pose that is not there in time.
//!
//! Offline, every pose leaves as soon as it is solved. Live, the pose of capture time t is due at
//! t plus the declared latency: from then on at the latest there is one, on the output's grid, and
//! if its window is not solved by then the motion is carried on and flagged.

use std::collections::BTreeSet;

use nalgebra::Matrix3;

use crate::body::Pose;
use crate::so3;
use crate::time::{Grid, Timestamp};

/// How long before its due time a pose is given up, so that its message is there in time; ns.
pub(super) const MARGIN: i64 = 3_000_000;
/// A motion that is carried on dies away in this time, seconds.
const DECAY: f64 = 0.1;

/// How a live machine differs from one that solves a recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Live {
    /// Whether the open window is fitted and the newest pose given, flagged provisional.
    pub provisional: bool,
    /// Poses a second; 0: one for each nominal frame.
    pub output_rate_hz: f64,
}

/// The latency that a live machine keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Latency {
    /// From the capture of a pose to its publication, ns.
    pub declared_ns: i64,
    /// How much of that is kept for solving and publishing: a window's deadline is this much
    /// before its first pose is due, ns.
    pub reserve_ns: i64,
}

/// What has been given out and what is known.
#[derive(Clone, Debug, Default)]
pub(super) struct Playout {
    /// The capture time of the last final pose that was given out.
    pub(super) given: Option<Timestamp>,
    /// The last two final poses known.
    known: [Option<(Timestamp, Pose)>; 2],
    /// The newest provisional one.
    live: Option<(Timestamp, Pose)>,
    /// Capture times of provisional poses whose final ones are still to come.
    provisional: BTreeSet<Timestamp>,
    /// Carried on since nothing else was there.
    pub(super) carried: u64,
    /// Solved only after they were due.
    pub(super) missed: u64,
}

impl Playout {
    /// Keeps a solved pose.
    pub(super) fn know(&mut self, capture: Timestamp, pose: &Pose) {
        if self.known[1].as_ref().is_none_or(|(last, _)| capture > *last) {
            self.known.swap(0, 1);
            self.known[1] = Some((capture, pose.clone()));
        }
        if self.live.as_ref().is_some_and(|(live, _)| *live <= capture) {
            self.live = None;
        }
    }

    /// Keeps a provisional pose.
    pub(super) fn know_live(&mut self, capture: Timestamp, pose: &Pose) {
        self.live = Some((capture, pose.clone()));
        self.provisional.insert(capture);
    }

    /// Whether the final pose of that time takes the place of a provisional one; asked once, in
    /// order of time.
    pub(super) fn supersedes(&mut self, capture: Timestamp) -> bool {
        let later = self.provisional.split_off(&capture);
        self.provisional = later;
        self.provisional.remove(&capture)
    }

    /// The last pose begins a path: it does not go on from the one before.
    pub(super) fn begin_anew(&mut self) {
        self.known[0] = None;
    }

    /// The last pose known, if there is one.
    pub(super) fn last(&self) -> Option<&Pose> {
        self.known[1].as_ref().map(|(_, pose)| pose)
    }

    /// The time of the pose that follows the last one given.
    pub(super) fn next(&self, grid: &Grid) -> Option<Timestamp> {
        self.given.map(|given| grid.time(grid.at_or_before(given + same(grid)) + 1))
    }

    /// Whether the pose of that time was given, perhaps on another grid's time.
    pub(super) fn is_given(&self, capture: Timestamp, grid: &Grid) -> bool {
        self.given.is_some_and(|given| given + same(grid) >= capture)
    }

    /// A pose at `capture` from what is known: towards the provisional one, or carried on.
    pub(super) fn carry_on(&self, capture: Timestamp) -> Option<Pose> {
        let (at, last) = self.known[1].as_ref()?;
        if let Some((live_at, live)) = self.live.as_ref().filter(|(live_at, _)| live_at > at) {
            let s = (capture - *at) as f64 / (*live_at - *at) as f64;
            return Some(between(last, live, s.clamp(0.0, 1.0)));
        }
        let Some((before_at, before)) = &self.known[0] else { return Some(last.clone()) };
        let step = at.seconds_since(*before_at);
        let ahead = capture.seconds_since(*at).max(0.0);
        let s = DECAY * (1.0 - libm::exp(-ahead / DECAY)) / step;
        Some(between(before, last, 1.0 + s))
    }
}

/// Times this close are the same pose's; ns.
fn same(grid: &Grid) -> i64 {
    (grid.period_ns / 4.0) as i64
}

/// The pose at `s`, 0 at `a` and 1 at `b`; joint by joint, beyond them too.
fn between(a: &Pose, b: &Pose, s: f64) -> Pose {
    let slerp = |a: &Matrix3<f64>, b: &Matrix3<f64>| so3::slerp(a, b, s);
    Pose {
        root_rotation: slerp(&a.root_rotation, &b.root_rotation),
        root_position: a.root_position.lerp(&b.root_position, s),
        local: std::array::from_fn(|joint| slerp(&a.local[joint], &b.local[joint])),
    }
}
