//! The statuses of the other nodes of a stage, once a second each.
//!
//! A solver without a status for three seconds hangs, or is cut off: the others go on with its performers. The node of the
//! stage, which solves nobody, puts the counters of the solvers into its own status.

use std::collections::BTreeMap;

use super::Core;
use super::performer::{state_of_all, windows_of_all};
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::EventKind;
use crate::io::wire::{self, PlayoutCounters, Status, WindowCounters};

/// An older status says nothing of now.
const MAX_AGE: Nanos = Nanos::from_ms(3000);
/// After a pause of this length, this node was cut off or stopped; the others were not. They may solve its performers by
/// now: its last status is up to a second older than the pause.
const MIN_PAUSE: Nanos = Nanos::from_ms(2000);
/// Most bins of a histogram that are read.
const MOST_BINS: usize = 32;

/// The newest status of a node, or of a performer.
struct Peer {
    /// When it was heard last.
    heard: Timestamp,
    status: Status,
}

/// The other nodes, and the performers that they solve.
#[derive(Default)]
pub(super) struct Peers {
    /// By actor.
    all: BTreeMap<String, Peer>,
    /// At the front: the status up to which each solver is counted. One that is away may come back.
    counted: BTreeMap<String, Status>,
    /// At the front: what all solvers have counted, also before it started.
    windows: WindowCounters,
    playout: PlayoutCounters,
    /// At the front: solvers that hang, as of the last second.
    silent: Vec<String>,
    /// When a message came last, from whomever.
    last_message: Option<Timestamp>,
    /// Since when the statuses are read.
    read_since: Option<Timestamp>,
}

impl Peers {
    /// A node is there.
    pub(super) fn heard(&mut self, actor: &str, now: Timestamp) {
        match self.all.get_mut(actor) {
            Some(peer) => peer.heard = now,
            None => {
                let peer = Peer { heard: now, status: Status::default() };
                self.all.insert(actor.to_owned(), peer);
            }
        }
    }

    /// Notes a message, from whomever. Returns whether this node was cut off before.
    fn message(&mut self, now: Timestamp) -> bool {
        let before = self.last_message.replace(now);
        let pause = before.map_or(Nanos::ZERO, |before| now - before);
        let is_back = pause > MIN_PAUSE;
        if is_back {
            self.all.values_mut().for_each(|peer| peer.heard = peer.heard + pause);
        }
        is_back
    }

    /// Counts what a solver has done since its status before.
    fn count(&mut self, solver: &str, status: &Status) {
        let before = self.counted.insert(solver.to_owned(), status.clone());
        let before = before.filter(|before| before.run_id == status.run_id);
        let before = &before.unwrap_or_default();
        let windows = [status, before].map(|one| one.windows.clone().unwrap_or_default());
        let playout = [status, before].map(|one| one.playout.clone().unwrap_or_default());
        add_windows(&mut self.windows, &windows);
        add_playout(&mut self.playout, &playout);
    }
}

impl Core {
    /// Sets the time. After a pause, others may solve the performers of this node.
    pub(super) fn note_time(&mut self, now: Timestamp) {
        let pause = now - self.now;
        self.now = self.now.max(now);
        if pause > MIN_PAUSE {
            self.step_back();
        }
    }

    /// Notes a message, from whomever. After a pause, others may solve the performers of this node.
    pub(super) fn note_message(&mut self) {
        if self.peers.message(self.now) {
            self.step_back();
        }
    }

    /// Another node tells its state, or that of a performer.
    pub(super) fn status_of_other(&mut self, actor: &str, payload: &[u8]) {
        let status = match wire::decode::<Status>(payload) {
            Ok(status) => status,
            Err(error) => return self.event(EventKind::Unusable, None, error.to_string()),
        };
        let is_solver = self.is_other_solver(actor);
        let peer = Peer { heard: self.now, status: status.clone() };
        self.peers.all.insert(actor.to_owned(), peer);
        if is_solver && self.is_front() {
            self.peers.count(actor, &status);
        }
    }

    /// Whether the statuses of this actor are read. Solvers read those of other solvers, the front also those of performers.
    /// Before the first performer enters none are read, so that the journal of an idle node stays empty.
    pub(super) fn reads_status(&self, actor: &str) -> bool {
        self.peers.read_since.is_some() && (self.is_other_solver(actor) || self.is_performer(actor))
    }

    /// Whether an actor is a performer whom another node solves.
    fn is_performer(&self, actor: &str) -> bool {
        self.is_front() && self.performers.iter().any(|performer| performer.topics.actor == actor)
    }

    pub(super) fn is_other_solver(&self, actor: &str) -> bool {
        let solvers = &self.settings.carried.solvers;
        *actor != self.topics.actor && solvers.iter().any(|solver| solver == actor)
    }

    /// The solvers that are there and do not hang, in order of their names.
    pub(super) fn responding(&self) -> Vec<String> {
        let responds = |solver: &&String| {
            let Some(since) = self.peers.read_since.filter(|_| self.is_other_solver(solver)) else {
                return true;
            };
            let heard = self.peers.all.get(*solver).map_or(since, |peer| peer.heard.max(since));
            self.now - heard <= MAX_AGE
        };
        self.settings.carried.solvers.iter().filter(responds).cloned().collect()
    }

    /// The status of an actor, if it is not old.
    pub(super) fn status_of(&self, actor: &str) -> Option<&Status> {
        let peer = self.peers.all.get(actor)?;
        (self.now - peer.heard <= MAX_AGE).then_some(&peer.status)
    }

    fn statuses_of_solvers(&self) -> Vec<&Status> {
        let solvers = self.settings.carried.solvers.iter();
        solvers.filter_map(|solver| self.status_of(solver)).collect()
    }

    /// Once a second: forgets who is not there any more. At the front, says which solvers hang, and takes the cameras'
    /// residuals.
    pub(super) fn review_peers(&mut self) {
        let is_solving = !self.performers.is_empty() || !self.sharing.is_empty();
        if self.looks_for_solvers() && is_solving {
            self.peers.read_since.get_or_insert(self.now);
        }
        let mut all = std::mem::take(&mut self.peers.all);
        all.retain(|actor, _| self.is_other_solver(actor) || self.is_performer(actor));
        self.peers.all = all;
        if self.is_front() {
            self.report_silent();
            self.take_residuals();
        }
    }

    fn report_silent(&mut self) {
        let (responding, mut silent) = (self.responding(), self.settings.carried.solvers.clone());
        silent.retain(|solver| !responding.contains(solver));
        let before = std::mem::replace(&mut self.peers.silent, silent.clone());
        for solver in silent.iter().filter(|solver| !before.contains(solver)) {
            let next = match responding.is_empty() {
                true => "no other solver is there",
                false => "others go on with its performers",
            };
            let detail = format!("no status from solver {solver}: {next}");
            self.event(EventKind::Solver, None, detail);
        }
        for solver in before.iter().filter(|solver| responding.contains(solver)) {
            self.event(EventKind::Solver, None, format!("solver {solver} is back"));
        }
    }

    /// The residual of a camera is the mean of those at the solvers that track somebody.
    fn take_residuals(&mut self) {
        let mut cameras: BTreeMap<String, Vec<[f64; 2]>> = BTreeMap::new();
        let solvers = self.statuses_of_solvers().into_iter();
        let tracking = solvers.filter(|status| status.tracker_state == "tracking");
        for camera in tracking.flat_map(|status| &status.cameras) {
            if camera.residual_px > 0.0 && camera.residual_px.is_finite() {
                let of_camera = cameras.entry(camera.camera.clone()).or_default();
                of_camera.push([camera.residual_px, camera.near]);
            }
        }
        for camera in &mut self.cameras {
            let Some(all) = cameras.get(camera.name()) else { continue };
            let [px, near] =
                [0, 1].map(|i| all.iter().map(|one| one[i]).sum::<f64>() / all.len() as f64);
            camera.set_residual(px, near);
        }
    }

    /// The status of the front, with the counters of the solvers. Times, iterations and costs are the largest.
    pub(super) fn with_solvers(&self, status: Status) -> Status {
        let solvers = self.statuses_of_solvers();
        let performers = self.performers.iter().filter_map(|p| self.status_of(&p.topics.actor));
        let states: Vec<&str> = performers.map(|one| one.tracker_state.as_str()).collect();
        let effort = solvers.iter().filter_map(|one| one.effort).max_by_key(|one| one.level);
        let latency = solvers.iter().map(|one| one.declared_latency_ns).max();
        let times = windows_of_all(solvers.iter().filter_map(|one| one.windows.as_ref()));
        let WindowCounters { tracked, coasted, lost, incomplete, .. } = self.peers.windows;
        let mut playout = status.playout.unwrap_or_default();
        add_playout(&mut playout, &[self.peers.playout.clone(), PlayoutCounters::default()]);
        Status {
            windows: Some(WindowCounters { tracked, coasted, lost, incomplete, ..times }),
            effort: effort.or(status.effort),
            declared_latency_ns: latency.unwrap_or(0),
            tracker_state: state_of_all(&states).to_owned(),
            playout: Some(playout),
            ..status
        }
    }
}

/// Adds what was counted from one time to another.
fn add(sum: &mut u64, [now, before]: [u64; 2]) {
    *sum = sum.saturating_add(now.saturating_sub(before));
}

fn add_windows(sum: &mut WindowCounters, [now, before]: &[WindowCounters; 2]) {
    add(&mut sum.tracked, [now.tracked, before.tracked]);
    add(&mut sum.coasted, [now.coasted, before.coasted]);
    add(&mut sum.lost, [now.lost, before.lost]);
    add(&mut sum.incomplete, [now.incomplete, before.incomplete]);
}

fn add_playout(sum: &mut PlayoutCounters, [now, before]: &[PlayoutCounters; 2]) {
    add(&mut sum.published, [now.published, before.published]);
    add(&mut sum.provisional, [now.provisional, before.provisional]);
    add(&mut sum.coasted, [now.coasted, before.coasted]);
    add(&mut sum.missed, [now.missed, before.missed]);
    let add_bins = |sum: &mut Vec<u64>, now: &[u64], before: &[u64]| {
        sum.resize(sum.len().max(now.len().min(MOST_BINS)), 0);
        let before = before.iter().copied().chain(std::iter::repeat(0));
        let both = now.iter().copied().zip(before);
        sum.iter_mut().zip(both).for_each(|(sum, (now, before))| add(sum, [now, before]));
    };
    add_bins(&mut sum.deviation_counts, &now.deviation_counts, &before.deviation_counts);
    add_bins(&mut sum.provisional_counts, &now.provisional_counts, &before.provisional_counts);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status(run_id: u64, published: u64, bins: [u64; 2]) -> Status {
        let playout = PlayoutCounters {
            published,
            deviation_counts: bins.to_vec(),
            ..PlayoutCounters::default()
        };
        let windows = WindowCounters { tracked: published / 5, ..WindowCounters::default() };
        Status { run_id, playout: Some(playout), windows: Some(windows), ..Status::default() }
    }

    #[test]
    fn counts_of_solvers_never_fall() {
        let mut peers = Peers::default();
        let told = [status(1, 10, [8, 2]), status(1, 15, [11, 4]), status(2, 5, [5, 0])];
        peers.count("a", &told[0]);
        peers.count("a", &told[1]);
        // It was started again.
        peers.count("a", &told[2]);
        assert_eq!((peers.playout.published, peers.windows.tracked), (20, 4));
        assert_eq!(peers.playout.deviation_counts, [16, 4]);
        peers.count("a", &status(2, u64::MAX, [u64::MAX, 0]));
        assert_eq!(peers.playout.published, u64::MAX);
    }

    #[test]
    fn who_was_cut_off_itself_does_not_miss_the_others() {
        let at = |ms: i64| Timestamp::default() + Nanos::from_ms(ms);
        let mut peers = Peers::default();
        peers.message(at(0));
        peers.heard("b", at(0));
        assert!(!peers.message(at(1000)));
        assert_eq!(peers.all["b"].heard, at(0));
        assert!(peers.message(at(5000)));
        assert_eq!(peers.all["b"].heard, at(4000));
    }
}
