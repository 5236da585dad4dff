//! Streams that fall silent.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{Delivery, delivery};

/// A stream is silent after this time without a message.
const SILENT: Nanos = Nanos::from_ms(3000);
/// Most streams that are watched.
const MOST_STREAMS: usize = 65_536;
/// Most streams that are named at once.
const MOST_NAMES: usize = 8;

/// When the last message of each stream came, and whether its silence was reported.
#[derive(Default)]
pub(super) struct Silence(BTreeMap<Arc<str>, (Timestamp, bool)>);

impl Silence {
    /// Notes a message; states are not watched.
    pub(super) fn came(&mut self, topic: &Arc<str>, at: Timestamp) {
        let has_place = self.0.len() < MOST_STREAMS || self.0.contains_key(topic);
        if has_place && delivery(topic) == Delivery::Stream {
            self.0.insert(Arc::clone(topic), (at, false));
        }
    }

    /// Names the streams that fell silent since the last call.
    pub(super) fn report(&mut self, now: Timestamp) -> Option<String> {
        let mut silent: Vec<&str> = Vec::new();
        for (topic, (last, is_said)) in &mut self.0 {
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
