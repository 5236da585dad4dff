//! Streams that fall silent.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::core::stage::Life;
use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{Delivery, delivery};
use crate::io::wire::{StagePerformer, StageStatus, Topic};

/// A stream is silent after this time without a message.
const SILENT: Nanos = Nanos::from_ms(3000);
/// Most streams that are watched.
const MOST_STREAMS: usize = 65_536;
/// Most streams that are named at once.
const MOST_NAMES: usize = 8;

/// Which streams are watched.
#[derive(Default)]
pub(super) struct Silence {
    /// When the last message came, and whether the silence was reported.
    streams: BTreeMap<Arc<str>, (Timestamp, bool)>,
    /// The node of each performer, by present and former names.
    performers: BTreeMap<String, String>,
}

impl Silence {
    /// Notes a message; states are not watched.
    pub(super) fn came(&mut self, topic: &Arc<str>, at: Timestamp) {
        let has_place = self.streams.len() < MOST_STREAMS || self.streams.contains_key(topic);
        if has_place && delivery(topic) == Delivery::Stream {
            self.streams.insert(Arc::clone(topic), (at, false));
        }
    }

    /// Stops watching the performers of several who are lost, have left or have another name.
    pub(super) fn forget_absent(&mut self, status: &StageStatus) {
        let StageStatus { node, performers, .. } = status;
        let names = performers.iter().map(|one| (one.name.clone(), node.clone()));
        self.performers.extend(names.take(MOST_STREAMS.saturating_sub(self.performers.len())));
        let is_here = |name: &str| {
            let life = |one: &StagePerformer| Life::from_name(&one.life).is_some_and(Life::is_here);
            performers.iter().any(|one| one.name == name && life(one))
        };
        // A lone performer is called like its node, and stays watched.
        let is_absent =
            |name: &str| self.performers.get(name) == Some(node) && name != node && !is_here(name);
        self.streams.retain(|topic, _| match Topic::parse(topic) {
            Ok(Topic::Actor { actor, .. }) => !is_absent(actor),
            _ => true,
        });
    }

    /// Names the streams that fell silent since the last call.
    pub(super) fn report(&mut self, now: Timestamp) -> Option<String> {
        let mut silent: Vec<&str> = Vec::new();
        for (topic, (last, is_said)) in &mut self.streams {
            if now - *last > SILENT && !std::mem::replace(is_said, true) {
                silent.push(topic);
            }
        }
        let named = silent.get(..silent.len().min(MOST_NAMES)).filter(|list| !list.is_empty())?;
        let more = match silent.len() - named.len() {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        let (seconds, list) = (SILENT.seconds(), named.join(", "));
        Some(format!("silent for {seconds:.0} s: {list}{more}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::wire::Topics;

    #[test]
    fn silence_is_said_once() {
        let mut silence = Silence::default();
        let topic = Arc::from("mocap/stage/camera/a/keypoints");
        let at = |seconds: i64| Timestamp::from_ns(0) + Nanos::SECOND * seconds;
        silence.came(&topic, at(0));
        assert_eq!(silence.report(at(2)), None);
        assert!(silence.report(at(4)).is_some());
        assert_eq!(silence.report(at(5)), None, "said before");
        silence.came(&topic, at(6));
        assert!(silence.report(at(10)).is_some(), "silent again");
    }

    #[test]
    fn performers_who_are_lost_or_have_another_name_are_not_missed() {
        let mut silence = Silence::default();
        let at = |seconds: i64| Timestamp::from_ns(0) + Nanos::SECOND * seconds;
        let topics = Topics::default();
        let pose = |actor: &str| Topics { actor: actor.to_owned(), ..topics.clone() }.pose();
        for actor in ["p1", "p2", "p3", "p4", "alone", "solver"] {
            silence.came(&Arc::from(pose(actor)), at(0));
        }
        let mut told = |node: &str, all: &[(&str, Life)]| {
            let performer = |&(name, life): &(&str, Life)| StagePerformer {
                name: name.to_owned(),
                life: life.name().to_owned(),
                ..StagePerformer::default()
            };
            let (node, performers) = (node.to_owned(), all.iter().map(performer).collect());
            silence.forget_absent(&StageStatus { node, performers, ..StageStatus::default() });
        };
        let [here, lost, left] = [Life::Confirmed, Life::Lost, Life::Left];
        told("front", &[("p1", here), ("p2", here), ("p3", here), ("p4", here)]);
        told("alone", &[("alone", lost)]);
        told("front", &[("p1", left), ("p2", lost), ("p3", here), ("lead", here)]);
        let expected = ["alone", "p3", "solver"].map(pose).join(", ");
        let expected = format!("silent for 3 s: {expected}");
        assert_eq!(silence.report(at(4)), Some(expected));
    }

    #[test]
    fn known_streams_are_watched_when_there_are_too_many() {
        let mut silence = Silence::default();
        let topic = |i: usize| Arc::from(format!("mocap/stage/camera/{i}/keypoints"));
        let at = |seconds: i64| Timestamp::from_ns(0) + Nanos::SECOND * seconds;
        (0..=MOST_STREAMS).for_each(|i| silence.came(&topic(i), at(0)));
        (2..MOST_STREAMS).for_each(|i| silence.came(&topic(i), at(4)));
        let said = silence.report(at(5)).unwrap();
        let names = [0, 1].map(|i| topic(i).to_string()).join(", ");
        assert_eq!(said, format!("silent for 3 s: {names}"));
    }
}
