//! Streams that fall silent.

use std::collections::{BTreeMap, BTreeSet};
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
    /// The names that performers have or had.
    performers: BTreeSet<String>,
}

impl Silence {
    /// Notes a message; states are not watched.
    pub(super) fn came(&mut self, topic: &Arc<str>, at: Timestamp) {
        let has_place = self.streams.len() < MOST_STREAMS || self.streams.contains_key(topic);
        if has_place && delivery(topic) == Delivery::Stream {
            self.streams.insert(Arc::clone(topic), (at, false));
        }
    }

    /// Stops watching the performers who are not on the stage any more, or have another name.
    pub(super) fn forget_absent(&mut self, status: &StageStatus) {
        let names = status.performers.iter().map(|one| one.name.clone());
        self.performers.extend(names.take(MOST_STREAMS.saturating_sub(self.performers.len())));
        let is_here = |name: &str| {
            let life = |one: &StagePerformer| Life::from_name(&one.life).is_some_and(Life::is_here);
            status.performers.iter().any(|one| one.name == name && life(one))
        };
        self.streams.retain(|topic, _| match Topic::parse(topic) {
            Ok(Topic::Actor { actor, .. }) => is_here(actor) || !self.performers.contains(actor),
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
    fn performers_who_left_or_have_another_name_are_not_missed() {
        let mut silence = Silence::default();
        let at = |seconds: i64| Timestamp::from_ns(0) + Nanos::SECOND * seconds;
        let topics = Topics::default();
        let pose = |actor: &str| Topics { actor: actor.to_owned(), ..topics.clone() }.pose();
        for actor in ["p1", "p2", "p3", "solver"] {
            silence.came(&Arc::from(pose(actor)), at(0));
        }
        let status = |all: [(&str, Life); 3]| {
            let performer = |(name, life): (&str, Life)| StagePerformer {
                name: name.to_owned(),
                life: life.name().to_owned(),
                ..StagePerformer::default()
            };
            StageStatus { performers: all.map(performer).into(), ..StageStatus::default() }
        };
        let [here, left] = [Life::Confirmed, Life::Left];
        silence.forget_absent(&status([("p1", here), ("p2", here), ("p3", here)]));
        silence.forget_absent(&status([("p1", left), ("lead", here), ("p3", here)]));
        let expected = format!("silent for 3 s: {}, {}", pose("p3"), pose("solver"));
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
