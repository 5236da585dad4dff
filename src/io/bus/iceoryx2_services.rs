//! The services of iceoryx2 in shared memory: their names, their limits, and how they are opened.

use std::time::{Duration, Instant};

use iceoryx2::node::Node;
use iceoryx2::prelude::{FileName, SemanticString, ServiceName, ipc_threadsafe};
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::{BusError, Delivery, delivery};

pub(super) type Shm = ipc_threadsafe::Service;

/// Samples kept for late joiners, by class of topics; the first class is streams.
pub(super) const CLASSES: [usize; 5] = [0, 1, 8, 64, 256];

/// Event id: a subscriber joined. Smaller ids are the class of a new sample.
pub(super) const JOINED: usize = CLASSES.len();

/// Longest wait for a service that others are creating or removing.
const PATIENCE: Duration = Duration::from_secs(3);

/// All limits: they are part of the services, so they must be equal in every program.
pub(super) struct Limits {
    pub(super) history: usize,
    buffer: usize,
    publishers: usize,
    subscribers: usize,
    borrowed: usize,
    nodes: usize,
}

pub(super) fn limits(class: usize) -> Limits {
    let history = CLASSES[class];
    let buffer = 2 * history + 64;
    // Each performer has topics of its own, and a node keeps those of everybody it has ever seen.
    Limits { history, buffer, publishers: 1024, subscribers: 32, borrowed: 2, nodes: 64 }
}

impl Limits {
    /// Most samples in use per publisher. All subscribers' buffers hold the same latest samples, so
    /// this is far less than their sum.
    pub(super) fn samples(&self) -> usize {
        self.buffer + self.history + self.borrowed * self.subscribers + 8
    }
}

/// The class of a topic.
pub(super) fn class(topic: &str) -> usize {
    let Delivery::State { history } = delivery(topic) else { return 0 };
    CLASSES.iter().position(|&kept| kept >= history).unwrap_or(CLASSES.len() - 1)
}

/// The classes of all topics that a pattern may match.
pub(super) fn classes(pattern: &str) -> std::ops::Range<usize> {
    match pattern.contains('*') {
        true => 0..CLASSES.len(),
        false => class(pattern)..class(pattern) + 1,
    }
}

pub(super) fn settings(prefix: &str) -> Result<iceoryx2::config::Config, BusError> {
    let wrong = |reason: String| BusError::Setting {
        key: "iceoryx2.prefix",
        value: format!("{prefix:?}"),
        reason,
    };
    if prefix.is_empty() || prefix.len() > 64 {
        return Err(wrong("it must have 1 to 64 characters".into()));
    }
    let mut config = iceoryx2::config::Config::default();
    config.global.prefix = FileName::new(prefix.as_bytes())
        .map_err(|error| wrong(format!("it cannot begin a file name ({error:?})")))?;
    Ok(config)
}

/// Retries until it succeeds or the wait is over. Services are unusable for a short time while
/// others create or remove them, and killed programs hold resources until they are removed.
pub(super) fn persist<T, E: std::fmt::Display>(
    what: &str,
    mut attempt: impl FnMut() -> Result<T, E>,
) -> Result<T, BusError> {
    let start = Instant::now();
    let mut pause = Duration::from_millis(1);
    loop {
        match attempt() {
            Ok(value) => return Ok(value),
            Err(error) if start.elapsed() > PATIENCE => {
                return Err(BusError::transport(what, error));
            }
            Err(_) => std::thread::sleep(pause),
        }
        pause = (pause * 2).min(Duration::from_millis(100));
    }
}

pub(super) fn service_name(name: &str) -> Result<ServiceName, BusError> {
    ServiceName::new(name).map_err(|error| BusError::transport(name, error))
}

pub(super) fn events(node: &Node<Shm>) -> Result<event::PortFactory<Shm>, BusError> {
    let name = service_name("mocap/events/1")?;
    let Limits { nodes, .. } = limits(0);
    persist("cannot open the events in shared memory", || {
        node.service_builder(&name)
            .event()
            .event_id_max_value(JOINED)
            .max_listeners(nodes)
            .max_notifiers(nodes)
            .max_nodes(nodes)
            .open_or_create()
    })
}

pub(super) fn service(
    node: &Node<Shm>,
    class: usize,
) -> Result<publish_subscribe::PortFactory<Shm, [u8], ()>, BusError> {
    let limits = limits(class);
    let name = service_name(&format!("mocap/history-{}/1", limits.history))?;
    persist("cannot open a service in shared memory", || {
        node.try_cleanup_dead_nodes();
        node.service_builder(&name)
            .publish_subscribe::<[u8]>()
            .history_size(limits.history)
            .subscriber_max_buffer_size(limits.buffer)
            .subscriber_max_borrowed_samples(limits.borrowed)
            .max_publishers(limits.publishers)
            .max_subscribers(limits.subscribers)
            .max_nodes(limits.nodes)
            .enable_safe_overflow(true)
            .open_or_create()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::wire::Topics;

    #[test]
    fn every_delivery_has_a_class_that_keeps_enough() {
        let topics = Topics::default();
        for topic in topics.outputs().into_iter().chain([topics.rig(), topics.keypoints("a")]) {
            let kept = match delivery(&topic) {
                Delivery::Stream => 0,
                Delivery::State { history } => history,
            };
            assert_eq!(limits(class(&topic)).history, kept, "{topic}");
        }
    }
}
