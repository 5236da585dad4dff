//! One node for each performer: every node announces itself, and the one that came later stands back.

use std::sync::Arc;

use crate::core::fnv::fnv1a;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{self, EventKind};
use crate::io::bus::{Bus, BusError, Guard};
use crate::io::wire::{Event, Schema, Topics, encode, media_type};
use crate::live::clock::wall::WallClock;
use crate::live::error::{Elder, NodeError};

/// The announcement of a node of one performer. It ends when it is dropped, or with the process.
pub struct Presence {
    bus: Arc<dyn Bus>,
    topics: Topics,
    /// Begins with the time of the announcement, so that names are in order of time.
    name: String,
    _guard: Box<dyn Guard>,
}

impl Presence {
    /// Announces a node of that stage and actor at `now`, the wall clock's time. It must not publish
    /// while there is an [`elder`](Self::elder). Nodes that are there already are elder, whatever
    /// their clocks say.
    ///
    /// # Errors
    /// The bus refuses the name.
    pub fn announce(bus: Arc<dyn Bus>, topics: Topics, now: Timestamp) -> Result<Self, NodeError> {
        let root = root(&topics);
        let names = bus.announced(&format!("{root}*"))?;
        let last = names.iter().filter_map(|name| Some(elder(&root, name)?.since)).max();
        let since = last.map_or(now, |last| now.max(last + Nanos::new(1)));
        let id = fnv1a(format!("{} {}", since.ns(), std::process::id()).as_bytes());
        let name = format!("{root}{:020}-{id:016x}", since.ns());
        let guard = bus.announce(&name)?;
        Ok(Self { bus, topics, name, _guard: guard })
    }

    /// The node of this performer that was announced first, if it is another one.
    ///
    /// # Errors
    /// The bus is closed.
    pub fn elder(&self) -> Result<Option<Elder>, BusError> {
        let root = root(&self.topics);
        let names = self.bus.announced(&format!("{root}*"))?;
        let first = names.into_iter().filter(|name| *name < self.name).min();
        Ok(first.and_then(|name| elder(&root, &name)))
    }

    /// This announcement if there is no elder node.
    ///
    /// # Errors
    /// [`NodeError::Occupied`] if there is one; the bus is told so.
    pub fn alone(self) -> Result<Self, NodeError> {
        match self.elder()? {
            None => Ok(self),
            Some(elder) => Err(self.stand_back(elder)),
        }
    }

    /// Publishes the event that two nodes met; returns the error with which this one ends.
    pub fn stand_back(&self, elder: Elder) -> NodeError {
        let Topics { stage, actor } = self.topics.clone();
        let id = self.name.rsplit('-').next().unwrap_or_default();
        let event = tracker::Event {
            capture: WallClock::start().now(),
            kind: EventKind::SecondNode,
            camera: None,
            window: None,
            count: 1,
            detail: format!("node {id} stands back; {elder} publishes"),
        };
        let put = || {
            let publisher = self.bus.publisher(&self.topics.actor_events())?;
            let bytes = encode(&Event::from_core(&event, None));
            publisher.put(event.capture, &media_type(Event::FULL_NAME), &bytes)
        };
        if let Err(error) = put() {
            tracing::warn!("cannot publish an event: {error}");
        }
        NodeError::Occupied { stage, actor, elder }
    }
}

/// The node with that announcement.
fn elder(root: &str, name: &str) -> Option<Elder> {
    let (since, id) = name.strip_prefix(root)?.split_once('-')?;
    Some(Elder { id: id.to_owned(), since: Timestamp::from_ns(since.parse().ok()?) })
}

fn root(topics: &Topics) -> String {
    format!("mocap/{}/actor/{}/node/", topics.stage, topics.actor)
}
