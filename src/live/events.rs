//! Events on their way to the bus: all counted, and no more published than somebody can read.

use std::collections::BTreeMap;

use crate::core::time::Timestamp;
use crate::core::tracker::EventKind;
use crate::io::wire;

/// Events of one kind and camera that are published one by one in a second; more are put together.
const SINGLE: u64 = 8;

/// Bundles of a second; beyond, cameras of all names share one for each kind.
const MOST_BUNDLES: usize = 256;

/// What is put together of one kind and camera.
#[derive(Clone, Debug, Default)]
struct Bundle {
    published: u64,
    waiting: Option<wire::Event>,
}

/// An event with the name of its camera.
#[derive(Clone, Debug)]
pub(super) struct Named {
    pub(super) kind: EventKind,
    pub(super) capture: Timestamp,
    pub(super) camera: Option<String>,
    pub(super) window: Option<u64>,
    pub(super) count: u64,
    pub(super) detail: String,
}

/// Counts of all events, and what waits to be published.
#[derive(Clone, Debug, Default)]
pub(super) struct Events {
    counts: BTreeMap<EventKind, u64>,
    bundles: BTreeMap<(EventKind, Option<String>), Bundle>,
}

impl Events {
    /// Counts an event; gives it back if it is to be published now.
    pub(super) fn add(&mut self, event: Named) -> Option<wire::Event> {
        *self.counts.entry(event.kind).or_default() += event.count;
        let camera = event.camera.clone().filter(|_| self.bundles.len() < MOST_BUNDLES);
        let bundle = self.bundles.entry((event.kind, camera)).or_default();
        let message = wire::Event {
            capture_time_ns: event.capture.ns(),
            kind: event.kind.name().to_owned(),
            camera: event.camera,
            window: event.window,
            count: event.count.max(1),
            detail: event.detail,
        };
        if bundle.published < SINGLE {
            bundle.published += 1;
            return Some(message);
        }
        let before = bundle.waiting.take().map_or(0, |waiting| waiting.count);
        bundle.waiting = Some(wire::Event { count: before + message.count, ..message });
        None
    }

    /// What was put together in the last second.
    pub(super) fn second(&mut self) -> Vec<wire::Event> {
        let bundles = std::mem::take(&mut self.bundles);
        bundles.into_values().filter_map(|bundle| bundle.waiting).collect()
    }

    /// How often each kind happened.
    pub(super) fn counts(&self) -> Vec<wire::EventCount> {
        let count = |(kind, &count): (&EventKind, &u64)| wire::EventCount {
            kind: kind.name().to_owned(),
            count,
        };
        self.counts.iter().map(count).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_becomes_one_event_with_its_count() {
        let mut events = Events::default();
        let late = |detail: u64| Named {
            kind: EventKind::Late,
            capture: Timestamp::default(),
            camera: Some("left".into()),
            window: None,
            count: 1,
            detail: detail.to_string(),
        };
        let single = (0..1000).filter_map(|i| events.add(late(i))).count();
        assert_eq!(single as u64, SINGLE);
        let put_together = events.second();
        assert_eq!(put_together.len(), 1);
        assert_eq!((put_together[0].count, &*put_together[0].detail), (1000 - SINGLE, "999"));
        assert_eq!(events.counts()[0].count, 1000);
        assert!(events.second().is_empty());
        assert!(events.add(late(0)).is_some());
    }
}
