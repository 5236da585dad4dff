//! One node for each performer, and one for the several performers of a stage: every node announces itself, and the one
//! that came later stands back.

use std::collections::BTreeSet;
use std::sync::Arc;

use crate::core::fnv::fnv1a;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{self, EventKind};
use crate::io::bus::{Bus, BusError, Guard};
use crate::io::wire::{Event, Schema, Topics, encode, media_type, valid_name};
use crate::live::clock::wall::WallClock;
use crate::live::error::{Elder, NodeError};

/// The announcement of a node. It ends when it is dropped, or with the process.
pub struct Presence {
    bus: Arc<dyn Bus>,
    topics: Topics,
    /// What it is alone with.
    roots: Vec<String>,
    /// Its name below them. Begins with the time of the announcement, so that names are in order of time.
    name: String,
    _guards: Vec<Box<dyn Guard>>,
}

impl Presence {
    /// Announces a node of that stage and actor at `now`, the wall clock's time; `several`: it publishes the poses of
    /// several performers, or gives them to solvers. It must not publish while there is an [`elder`](Self::elder). Nodes
    /// that are there already are elder, whatever their clocks say.
    ///
    /// # Errors
    /// The bus refuses the name, or is closed.
    pub fn announce(
        bus: Arc<dyn Bus>,
        topics: Topics,
        several: bool,
        now: Timestamp,
    ) -> Result<Self, NodeError> {
        let Topics { stage, actor } = &topics;
        let of_stage = several.then(|| format!("mocap/{stage}/several/node/"));
        let of_actor = format!("mocap/{stage}/actor/{actor}/node/");
        let roots: Vec<String> = std::iter::once(of_actor).chain(of_stage).collect();
        let others = known(others(&*bus, &roots))?.unwrap_or_default();
        let last = others.iter().filter_map(|name| Some(elder(name)?.since)).max();
        let since = last.map_or(now, |last| now.max(last + Nanos::new(1)));
        let id = fnv1a(format!("{} {}", since.ns(), std::process::id()).as_bytes());
        let name = format!("{:020}-{id:016x}", since.ns());
        let guards = roots.iter().map(|root| bus.announce(&format!("{root}{name}")));
        let guards = guards.collect::<Result<_, _>>()?;
        Ok(Self { bus, topics, roots, name, _guards: guards })
    }

    /// The node of this performer, or of the several performers of this stage, that was announced first, if it is another
    /// one.
    ///
    /// # Errors
    /// The bus is closed, or does not answer in time: then nothing is known.
    pub fn elder(&self) -> Result<Option<Elder>, BusError> {
        let others = others(&*self.bus, &self.roots)?;
        let first = others.into_iter().filter(|name| *name < self.name).min();
        Ok(first.and_then(|name| elder(&name)))
    }

    /// This announcement if no elder node is known.
    ///
    /// # Errors
    /// [`NodeError::Occupied`] if there is one; the bus is told so. The bus is closed.
    pub fn alone(self) -> Result<Self, NodeError> {
        match known(self.elder())?.flatten() {
            None => Ok(self),
            Some(elder) => Err(self.stand_back(elder)),
        }
    }

    /// The take that recorders of the stage record; empty: none, or different ones.
    ///
    /// # Errors
    /// The bus is closed, or does not answer in time.
    pub fn recorded_take(&self) -> Result<String, BusError> {
        let names = self.bus.announced(&self.topics.recorded_take("*"))?;
        let root = self.topics.recorded_take("");
        let takes: BTreeSet<&str> =
            names.iter().filter_map(|name| name.strip_prefix(&root)).collect();
        let only = takes.first().filter(|name| takes.len() == 1 && valid_name(name).is_ok());
        Ok(only.map_or_else(String::new, |take| (*take).to_owned()))
    }

    /// As [`Bus::is_connected`].
    pub fn is_connected(&self) -> bool {
        self.bus.is_connected()
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

/// Names of the nodes below the roots.
fn others(bus: &dyn Bus, roots: &[String]) -> Result<Vec<String>, BusError> {
    let mut all = Vec::new();
    for root in roots {
        let names = bus.announced(&format!("{root}*"))?;
        all.extend(names.iter().filter_map(|name| Some(name.strip_prefix(root)?.to_owned())));
    }
    Ok(all)
}

/// `None` if the bus did not answer in time. A node that starts does not wait for that: it looks again while it runs.
fn known<T>(asked: Result<T, BusError>) -> Result<Option<T>, BusError> {
    match asked {
        Err(BusError::Closed) => Err(BusError::Closed),
        Err(error) => {
            tracing::warn!("whether another node runs is not known: {error}");
            Ok(None)
        }
        Ok(found) => Ok(Some(found)),
    }
}

/// The node with that name.
fn elder(name: &str) -> Option<Elder> {
    let (since, id) = name.split_once('-')?;
    Some(Elder { id: id.to_owned(), since: Timestamp::from_ns(since.parse().ok()?) })
}
