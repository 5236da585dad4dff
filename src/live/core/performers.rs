//! The performers of the core: their topics, trackers and counters.

use super::Core;
use super::performer::{Performer, Progress, tracker_state};
use crate::core::stage::{PerformerId, Stage};
use crate::core::tracker::Tracker;
use crate::io::wire::{PerformerLabel, Topic, Topics};

impl Core {
    /// Whether people are told from each other.
    pub(super) fn is_several(&self) -> bool {
        self.settings.stage.several()
    }

    /// Whether a topic is the node's, and not that of one of several performers.
    pub(crate) fn is_of_node(&self, topic: &str) -> bool {
        match Topic::parse(topic) {
            Ok(Topic::Actor { actor, .. }) => *actor == *self.topics.actor,
            _ => true,
        }
    }

    /// Whether it tells people from each other for solvers.
    pub(super) fn is_front(&self) -> bool {
        !self.settings.stage.solve
    }

    /// Whether it is to be told which solvers are there.
    pub(crate) fn looks_for_solvers(&self) -> bool {
        self.is_front() || self.is_solver()
    }

    /// The folder of known bodies; empty: none.
    pub(crate) fn bodies_folder(&self) -> &str {
        &self.settings.stage.bodies
    }

    /// The name of a performer in its topics: the node's if there is only one.
    pub(super) fn name_of(&self, number: usize) -> String {
        match (&self.stage, PerformerId(number)) {
            _ if !self.is_several() => self.topics.actor.clone(),
            _ if self.is_solver() => {
                let name = self.sharing.name_of(PerformerId(number));
                name.map_or_else(|| PerformerId(number).to_string(), str::to_owned)
            }
            (Some(stage), performer) => stage.name_of(performer),
            (None, performer) => performer.to_string(),
        }
    }

    /// Somebody new has a number. It may have been somebody else's.
    pub(super) fn entered(&mut self, performer: PerformerId) {
        if let Some(label) = self.settings.carried.labels.get_mut(performer.0) {
            *label = PerformerLabel::default();
        }
        self.performer(performer).skeleton = None;
        self.use_name(performer);
    }

    /// From here on the performer's topics have its name.
    pub(super) fn use_name(&mut self, id: PerformerId) {
        let actor = self.name_of(id.0);
        let performer = self.performer(id);
        if performer.topics.actor != actor {
            performer.topics.actor = actor;
            if let Some(skeleton) = performer.skeleton.clone() {
                self.skeleton(id, skeleton);
            }
        }
    }

    /// The performer.
    pub(super) fn performer(&mut self, id: PerformerId) -> &mut Performer {
        while self.performers.len() <= id.0 {
            let actor = self.name_of(self.performers.len());
            self.performers.push(Performer::new(Topics { actor, ..self.topics.clone() }));
        }
        &mut self.performers[id.0]
    }

    /// The performer, if it is one of several.
    pub(super) fn one_of_several(&self, id: PerformerId) -> Option<PerformerId> {
        self.is_several().then_some(id)
    }

    /// Number of performers who are followed.
    pub(super) fn count_followed(&self) -> usize {
        if self.is_several() { self.followed().len() } else { 1 }
    }

    pub(super) fn trackers(&self) -> &[Tracker] {
        self.stage.as_ref().map_or(&[], Stage::trackers)
    }

    /// Counters and state of each performer.
    pub(super) fn progress(&self) -> Vec<Progress> {
        let one = |(number, performer): (usize, &Performer)| {
            let tracker = self.trackers().get(number);
            let coasted = tracker.map_or((0, 0), Tracker::extrapolated_and_missed);
            Progress {
                state: tracker.map_or("searching", tracker_state),
                windows: performer.windows.counters(),
                playout: performer.poses.counters(coasted),
            }
        };
        self.performers.iter().enumerate().map(one).collect()
    }
}
