//! Counts events, and bundles them when there are too many to publish one by one.

use std::collections::BTreeMap;

use crate::core::stage::PerformerId;
use crate::core::tracker::{Event, EventKind};
use crate::io::wire;

/// Events per second, kind and camera that are published one by one; more are bundled.
const SINGLE: u64 = 8;

/// Most bundles in a second; beyond it, there is one bundle per kind for all cameras.
const MOST_BUNDLES: usize = 256;

/// Bundled events of one kind and camera.
#[derive(Clone, Debug, Default)]
struct Bundle {
    published: u64,
    waiting: Option<wire::Event>,
}

/// Counts of all events, and bundles that wait to be published.
#[derive(Clone, Debug, Default)]
pub(super) struct Events {
    counts: BTreeMap<EventKind, u64>,
    /// By kind, performer and camera.
    bundles: BTreeMap<(EventKind, Option<PerformerId>, Option<String>), Bundle>,
}

impl Events {
    /// Counts an event. `performer` is the one of several on whose topics it is published, `camera` the
    /// name of the camera that it concerns. Returns the message if it is to be published now.
    pub(super) fn add(
        &mut self,
        event: &Event,
        performer: Option<PerformerId>,
        camera: Option<&str>,
    ) -> Option<wire::Event> {
        // Other nodes send any number.
        let total = self.counts.entry(event.kind).or_default();
        *total = total.saturating_add(event.count);
        let message = wire::Event::from_core(event, camera);
        let camera = camera.filter(|_| self.bundles.len() < MOST_BUNDLES).map(str::to_owned);
        let bundle = self.bundles.entry((event.kind, performer, camera)).or_default();
        if bundle.published < SINGLE {
            bundle.published += 1;
            return Some(message);
        }
        let before = bundle.waiting.take().map_or(0, |waiting| waiting.count);
        bundle.waiting =
            Some(wire::Event { count: message.count.saturating_add(before), ..message });
        None
    }

    /// The bundles of the last second.
    pub(super) fn second(&mut self) -> Vec<(EventKind, Option<PerformerId>, wire::Event)> {
        let bundles = std::mem::take(&mut self.bundles).into_iter();
        let waiting =
            |((kind, performer, _), bundle): (_, Bundle)| Some((kind, performer, bundle.waiting?));
        bundles.filter_map(waiting).collect()
    }

    /// Number of events of each kind.
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
    use crate::core::time::Timestamp;

    #[test]
    fn a_flood_becomes_one_event_with_its_count() {
        let mut events = Events::default();
        let late = |detail: u64| Event {
            kind: EventKind::Late,
            capture: Timestamp::default(),
            camera: Some(0),
            window: None,
            count: 1,
            detail: detail.to_string(),
        };
        let single = (0..1000).filter_map(|i| events.add(&late(i), None, Some("left"))).count();
        assert_eq!(single as u64, SINGLE);
        let put_together = events.second();
        assert_eq!(put_together.len(), 1);
        let (kind, _, together) = &put_together[0];
        assert_eq!((kind, together.count), (&EventKind::Late, 1000 - SINGLE));
        assert_eq!((&*together.detail, together.camera.as_deref()), ("999", Some("left")));
        assert_eq!(events.counts()[0].count, 1000);
        assert!(events.second().is_empty());
        assert!(events.add(&late(0), None, Some("left")).is_some());
        // Of another node.
        (0..2).for_each(|_| drop(events.add(&Event { count: u64::MAX, ..late(0) }, None, None)));
        assert_eq!(events.counts()[0].count, u64::MAX);
    }
}
