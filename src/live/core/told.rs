//! What the solvers of a stage tell of themselves and of their performers, once a second.
//!
//! A solver that tells nothing for three seconds hangs, or is cut off: the others go on with its performers. The node of the
//! stage, which solves nobody, puts what they tell into its own status, so that one status tells of the whole stage.

use std::collections::BTreeMap;

use super::Core;
use super::performer::{state_of_all, windows_of_all};
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::EventKind;
use crate::io::wire::{self, PlayoutCounters, Status};

/// A status of this age says nothing of now.
const OLD: Nanos = Nanos::from_ms(3000);
/// If no input came for this long, this node was stopped and not the others.
const STOPPED: Nanos = Nanos::from_ms(1500);

/// The newest status of each solver and performer, by actor, and when it came.
#[derive(Default)]
pub(super) struct Told {
    statuses: BTreeMap<String, (Timestamp, Status)>,
    /// At the front: solvers that tell nothing, as of the last second.
    silent: Vec<String>,
}

impl Told {
    /// A solver came just now.
    pub(super) fn comes(&mut self, solver: &str, now: Timestamp) {
        self.statuses.insert(solver.to_owned(), (now, Status::default()));
    }

    /// No input came for this long.
    pub(super) fn pause(&mut self, pause: Nanos) {
        if pause > STOPPED {
            self.statuses.values_mut().for_each(|(came, _)| *came = *came + pause);
        }
    }
}

impl Core {
    /// Another node tells its state, or that of a performer.
    pub(super) fn status_of_other(&mut self, actor: &str, payload: &[u8]) {
        match wire::decode::<Status>(payload) {
            Ok(status) => {
                self.told.statuses.insert(actor.to_owned(), (self.now, status));
            }
            Err(error) => self.event(EventKind::Unusable, None, error.to_string()),
        }
    }

    /// Whether the statuses of this actor are read: of other solvers, and at the front of performers.
    pub(super) fn reads_status(&self, actor: &str) -> bool {
        let is_performer = |actor: &str| self.performers.iter().any(|p| p.topics.actor == actor);
        self.is_other_solver(actor) || self.is_front() && is_performer(actor)
    }

    fn is_other_solver(&self, actor: &str) -> bool {
        let solvers = &self.settings.carried.solvers;
        *actor != self.topics.actor && solvers.iter().any(|solver| solver == actor)
    }

    /// The solvers that are there and tell their state, in order of their names.
    pub(super) fn solving(&self) -> Vec<String> {
        let solves = |solver: &&String| {
            let came = self.told.statuses.get(*solver).map_or(self.began, |(came, _)| *came);
            !self.is_other_solver(solver) || self.now - came <= OLD
        };
        self.settings.carried.solvers.iter().filter(solves).cloned().collect()
    }

    /// What was told of an actor, if it is not old.
    pub(super) fn told_of(&self, actor: &str) -> Option<&Status> {
        let (came, status) = self.told.statuses.get(actor)?;
        (self.now - *came <= OLD).then_some(status)
    }

    /// Once a second, at the front: says which solvers hang, and takes the cameras' residuals.
    pub(super) fn review_told(&mut self) {
        if !self.is_front() {
            return;
        }
        let mut statuses = std::mem::take(&mut self.told.statuses);
        statuses.retain(|actor, _| self.reads_status(actor));
        self.told.statuses = statuses;
        self.report_silent();
        let solvers = self.told_of_solvers();
        let mut cameras: BTreeMap<String, Vec<[f64; 2]>> = BTreeMap::new();
        for camera in solvers.iter().flat_map(|status| &status.cameras) {
            if camera.residual_px > 0.0 {
                let of_camera = cameras.entry(camera.camera.clone()).or_default();
                of_camera.push([camera.residual_px, camera.near]);
            }
        }
        for camera in &mut self.cameras {
            let Some(told) = cameras.get(camera.name()) else { continue };
            let [px, near] =
                [0, 1].map(|i| told.iter().map(|one| one[i]).sum::<f64>() / told.len() as f64);
            camera.set_residual(px, near);
        }
    }

    /// Says which solvers tell nothing any more, and which do again.
    fn report_silent(&mut self) {
        let (solving, mut silent) = (self.solving(), self.settings.carried.solvers.clone());
        silent.retain(|solver| !solving.contains(solver));
        let before = std::mem::replace(&mut self.told.silent, silent.clone());
        for solver in silent.iter().filter(|solver| !before.contains(solver)) {
            let detail = format!("solver {solver} says nothing: others go on with its performers");
            self.event(EventKind::Solver, None, detail);
        }
        for solver in before.iter().filter(|solver| solving.contains(solver)) {
            self.event(EventKind::Solver, None, format!("solver {solver} goes on"));
        }
    }

    fn told_of_solvers(&self) -> Vec<&Status> {
        let solvers = self.settings.carried.solvers.iter();
        solvers.filter_map(|solver| self.told_of(solver)).collect()
    }

    /// The status of this node with what was told.
    pub(super) fn with_told(&self, status: Status) -> Status {
        let solvers = self.told_of_solvers();
        let performers = self.performers.iter().filter_map(|p| self.told_of(&p.topics.actor));
        let states: Vec<&str> = performers.map(|one| one.tracker_state.as_str()).collect();
        let effort = solvers.iter().filter_map(|one| one.effort).max_by_key(|one| one.level);
        let latency = solvers.iter().map(|one| one.declared_latency_ns).max();
        let playout = solvers.iter().filter_map(|one| one.playout.as_ref());
        Status {
            windows: Some(windows_of_all(solvers.iter().filter_map(|one| one.windows.as_ref()))),
            effort: effort.or(status.effort),
            declared_latency_ns: latency.unwrap_or(0),
            tracker_state: state_of_all(&states).to_owned(),
            playout: status.playout.map(|own| playout.fold(own, sum_of)),
            ..status
        }
    }
}

/// The poses of two nodes together.
fn sum_of(mut sum: PlayoutCounters, other: &PlayoutCounters) -> PlayoutCounters {
    sum.published += other.published;
    sum.provisional += other.provisional;
    sum.coasted += other.coasted;
    sum.missed += other.missed;
    let add = |to: &mut Vec<u64>, from: &[u64]| {
        to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
    };
    add(&mut sum.deviation_counts, &other.deviation_counts);
    add(&mut sum.provisional_counts, &other.provisional_counts);
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_of_two_nodes_are_added_by_bin() {
        let one = PlayoutCounters {
            published: 3,
            missed: 1,
            deviation_counts: vec![2, 1],
            ..PlayoutCounters::default()
        };
        let sum = sum_of(one.clone(), &one);
        assert_eq!((sum.published, sum.missed, sum.coasted), (6, 2, 0));
        assert_eq!(sum.deviation_counts, [4, 2]);
    }
}
