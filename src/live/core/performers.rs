//! The performers of the core: their topics, trackers and counters.

use super::Core;
use super::performer::{Performer, Progress, tracker_state};
use crate::core::stage::{PerformerId, Stage};
use crate::core::tracker::Tracker;
use crate::io::wire::{Topic, Topics};

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

    /// The name of a performer in its topics: the node's if there is only one.
    pub(super) fn name_of(&self, number: usize) -> String {
        match self.is_several() {
            true => PerformerId(number).to_string(),
            false => self.topics.actor.clone(),
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
