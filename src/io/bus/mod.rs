//! The bus: messages by topic, as bytes with a capture time.
//!
//! One small trait, [`Bus`], over a network (zenoh), over the shared memory of one host
//! (iceoryx2), inside a process ([`Memory`]) and from a recording ([`Replay`]). Payloads are the
//! same Protocol Buffers on each. The topic's name sets its [`delivery`]: streams may lose samples
//! but never wait; states reach every subscriber, including late joiners.
//!
//! Topics and patterns consist of parts between slashes; in a pattern, `*` stands for one part and
//! `**` for any number of parts, including none. The rules for names are the same on every bus
//! ([`check_topic`], [`check_pattern`]).
//!
//! All buses guarantee: payload, capture time and encoding arrive unchanged; samples of one
//! publisher arrive in order; a late joiner gets the latest samples of states, first and in order,
//! and no samples of streams. Each bus documents its limits.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;

use crate::core::time::Timestamp;
use crate::io::wire::Topic;

#[cfg(feature = "zenoh")]
mod certificates;
mod commands;
mod config;
#[cfg(feature = "iceoryx2")]
mod frame;
#[cfg(feature = "iceoryx2")]
mod iceoryx2;
#[cfg(feature = "iceoryx2")]
mod iceoryx2_services;
mod memory;

mod name;
#[cfg(any(feature = "zenoh", feature = "iceoryx2"))]
mod receivers;
mod replay;
#[cfg(feature = "zenoh")]
mod zenoh;
#[cfg(feature = "zenoh")]
mod zenoh_settings;

pub use commands::CommandPublisher;
pub use config::{
    Config, Iceoryx2Config, Kind, TlsConfig, ZenohConfig, ZenohMode, open_client, open_node,
};
#[cfg(feature = "iceoryx2")]
pub use iceoryx2::Iceoryx2;
pub use memory::Memory;
#[cfg(feature = "live")]
pub(crate) use name::LONGEST_TOPIC;
pub use name::{check_pattern, check_topic, matches};
pub use replay::Replay;
#[cfg(feature = "zenoh")]
pub use zenoh::Zenoh;

/// A message on the bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample {
    /// The topic.
    pub topic: Arc<str>,
    /// Capture time of the content; 0 if a foreign publisher did not set it.
    pub capture: Timestamp,
    /// Type of the payload, such as `application/protobuf;bundlemocap.v1.Pose`; empty if a foreign
    /// publisher did not set it.
    pub encoding: Arc<str>,
    /// The message.
    pub payload: Vec<u8>,
}

/// A session that subscribes to topics.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Receiver {
    /// What its program is called, such as `bundlemocap record`.
    pub program: String,
    /// The name of its computer.
    pub computer: String,
    /// The number of its process, a dot, and a number that no other session has.
    pub session: String,
    /// The patterns that it subscribes to.
    pub patterns: BTreeSet<String>,
}

/// How the transport must deliver a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// Useful only while new: real-time priority, dropped rather than delayed.
    Stream,
    /// Reliable; this many of the latest samples are kept for late joiners.
    State {
        /// Number of samples.
        history: usize,
    },
}

/// Handles received samples. It is called on a thread of the transport, so it must not block.
pub type Sink = Box<dyn Fn(Sample) + Send + Sync>;

/// Answers a query with the latest payload, if there is one.
pub type Answer = Box<dyn Fn() -> Option<Sample> + Send + Sync>;

/// A way to move samples between nodes.
pub trait Bus: Send + Sync {
    /// A publisher for one topic.
    ///
    /// # Errors
    /// The name is not a topic, or the transport refuses it.
    fn publisher(&self, topic: &str) -> Result<Box<dyn Publisher>, BusError>;

    /// Passes every sample on matching topics to `sink`, until the guard is dropped.
    ///
    /// # Errors
    /// The text is not a pattern, or the transport refuses it.
    fn subscribe(&self, pattern: &str, sink: Sink) -> Result<Box<dyn Guard>, BusError>;

    /// Answers queries for a topic until the guard is dropped. `None`: this bus has no queries;
    /// late joiners use the history.
    ///
    /// # Errors
    /// The name is not a topic, or the transport refuses it.
    fn answer(&self, topic: &str, answer: Answer) -> Result<Option<Box<dyn Guard>>, BusError> {
        let _ = (topic, answer);
        Ok(None)
    }

    /// The answers to a query for matching topics that arrive within the time.
    ///
    /// # Errors
    /// The text is not a pattern, or the transport refuses it.
    fn query(&self, pattern: &str, within: Duration) -> Result<Vec<Sample>, BusError> {
        let _ = (pattern, within);
        Ok(Vec::new())
    }

    /// Announces that this program is there, under a name with the form of a topic, until the guard
    /// is dropped or the program ends in any way.
    ///
    /// # Errors
    /// The name has not the form of a topic, or the transport refuses it.
    fn announce(&self, name: &str) -> Result<Box<dyn Guard>, BusError>;

    /// The matching names that programs on this bus have announced, those of this program too.
    ///
    /// # Errors
    /// The text is not a pattern, or the transport refuses it or does not answer in time.
    fn announced(&self, pattern: &str) -> Result<Vec<String>, BusError>;

    /// Whether the router is reached; a bus without routers always is.
    fn is_connected(&self) -> bool {
        true
    }

    /// The other sessions that have announced that they receive any topic below a name, such as
    /// `mocap/stage/actor`. Our own sessions announce it; on a bus inside a process there are none.
    ///
    /// # Errors
    /// The name has not the form of a topic, or the transport refuses it.
    fn receivers(&self, below: &str) -> Result<Vec<Receiver>, BusError> {
        let _ = below;
        Ok(Vec::new())
    }

    /// Watches whether other sessions, announced or not, receive any topic that matches a pattern. `None` if the
    /// transport does not know it.
    ///
    /// # Errors
    /// The pattern is not one, or the transport refuses it.
    fn watch(&self, pattern: &str) -> Result<Option<Watch>, BusError> {
        check_pattern(pattern).map(|()| None)
    }
}

/// Whether another session receives any of the topics that are watched.
pub type Watch = Box<dyn Fn() -> bool + Send>;

/// Publishes on one topic.
pub trait Publisher: Send + Sync {
    /// Sends a payload. Returns as soon as the transport has taken it.
    ///
    /// # Errors
    /// The transport is closed or the payload is too large.
    fn put(&self, capture: Timestamp, encoding: &str, payload: &[u8]) -> Result<(), BusError>;
}

/// Keeps a subscription or a queryable alive.
pub trait Guard: Send {}

/// The delivery of a topic. Unknown topics are streams.
pub fn delivery(topic: &str) -> Delivery {
    match Topic::parse(topic).ok().and_then(|topic| topic.history()) {
        Some(history) => Delivery::State { history },
        None => Delivery::Stream,
    }
}

/// Why a call on the bus failed. Its text says what is wrong, with units.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum BusError {
    /// `what` is `topic` or `pattern`.
    #[error("{name:?} is not a {what}: {reason}")]
    Name { name: String, what: &'static str, reason: String },
    #[error(
        "cannot listen on {endpoint}: address in use; another node runs there, or choose another \
         with [bus.zenoh] listen"
    )]
    InUse { endpoint: String },
    /// `endpoints` are separated by commas.
    #[error(
        "nothing answers at {endpoints}; is `bundlemocap run` up? [bus.zenoh] connect says where \
         it is"
    )]
    NobodyAnswers { endpoints: String },
    #[error("cannot connect to {endpoint}: {reason}")]
    Refused { endpoint: String, reason: String },
    /// A setting that the transport refuses.
    /// `key` is that of the section `[bus]`, such as `zenoh.listen`.
    #[error("[bus] {key} = {value}: {reason}")]
    Setting { key: &'static str, value: String, reason: String },
    /// `kind` is also the name of the feature.
    #[error(
        "[bus] kind = {kind:?}: this program was built without it; build it with --features {kind}"
    )]
    NotBuilt { kind: &'static str },
    #[error("{topic}: a payload of {bytes} bytes; this bus carries at most {most}")]
    TooLarge { topic: String, bytes: usize, most: usize },
    #[error("the bus is closed")]
    Closed,
    /// The transport failed.
    #[error("{what}: {reason}")]
    Transport { what: String, reason: String },
}

#[cfg(any(feature = "zenoh", feature = "iceoryx2"))]
impl BusError {
    fn transport(what: impl Into<String>, reason: impl std::fmt::Display) -> Self {
        Self::Transport { what: what.into(), reason: reason.to_string() }
    }
}
