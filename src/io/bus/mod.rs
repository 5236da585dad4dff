//! The bus: bytes by topic, with the capture time that they are about.
//!
//! One small trait, [`Bus`], over a network (zenoh), over the shared memory of one host
//! (iceoryx2), inside a process ([`Memory`]) and from a recording ([`Replay`]). Payloads are the
//! same Protocol Buffers on each. What a topic needs of the transport follows from its name,
//! [`delivery`]: streams may lose a sample rather than wait, states reach everyone, late joiners
//! too.
//!
//! Topics and patterns are made of parts between slashes; in a pattern, `*` stands for one part and
//! `**` for any number of them, none too. What a name may hold is the same on every bus
//! ([`check_topic`], [`check_pattern`]).
//!
//! What all of them promise: payload, capture time and encoding arrive unchanged; samples of one
//! publisher arrive in order; a late joiner gets the latest samples of states, first and in order,
//! and none of streams. What they cannot is said at each.

use std::sync::Arc;
use std::time::Duration;

use crate::core::time::Timestamp;

mod config;
#[cfg(feature = "iceoryx2")]
mod frame;
#[cfg(feature = "iceoryx2")]
mod iceoryx2;
mod memory;
mod name;
mod replay;
#[cfg(feature = "zenoh")]
mod zenoh;

pub use config::{Config, Iceoryx2Config, Kind, ZenohConfig, ZenohMode, open_client, open_node};
#[cfg(feature = "iceoryx2")]
pub use iceoryx2::Iceoryx2;
pub use memory::Memory;
pub use name::{check_pattern, check_topic, matches};
pub use replay::Replay;
#[cfg(feature = "zenoh")]
pub use zenoh::Zenoh;

/// What travels on the bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample {
    /// Where it was published.
    pub topic: Arc<str>,
    /// The capture time that it is about; 0 where a foreign publisher did not say.
    pub capture: Timestamp,
    /// What the payload is, such as `application/protobuf;bundlemocap.v1.Pose`; empty where a
    /// foreign publisher did not say.
    pub encoding: Arc<str>,
    /// The message.
    pub payload: Vec<u8>,
}

/// What a topic needs of the transport.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// Of use only while it is new: real-time priority, dropped rather than waited for.
    Stream,
    /// Reliable; this many of the latest samples are kept for late joiners.
    State {
        /// How many.
        history: usize,
    },
}

/// What is done with samples that come; called on a thread of the transport, so it must not wait.
pub type Sink = Box<dyn Fn(Sample) + Send + Sync>;

/// What answers a query; the latest payload, if there is one.
pub type Answer = Box<dyn Fn() -> Option<Sample> + Send + Sync>;

/// A way to move samples between nodes.
pub trait Bus: Send + Sync {
    /// Something to publish on one topic with.
    ///
    /// # Errors
    /// A name that is no topic, or a transport that does not take it.
    fn publisher(&self, topic: &str) -> Result<Box<dyn Publisher>, BusError>;

    /// Gives every sample on the topics that match to `sink`, until the guard is dropped.
    ///
    /// # Errors
    /// A text that is no pattern, or a transport that does not take it.
    fn subscribe(&self, pattern: &str, sink: Sink) -> Result<Box<dyn Guard>, BusError>;

    /// Answers queries for a topic until the guard is dropped. `None`: this bus has no queries;
    /// late joiners then rely on the history.
    ///
    /// # Errors
    /// A name that is no topic, or a transport that does not take it.
    fn answer(&self, topic: &str, answer: Answer) -> Result<Option<Box<dyn Guard>>, BusError> {
        let _ = (topic, answer);
        Ok(None)
    }

    /// What answers to a query for the topics that match, within the time.
    ///
    /// # Errors
    /// A text that is no pattern, or a transport that does not take it.
    fn query(&self, pattern: &str, within: Duration) -> Result<Vec<Sample>, BusError> {
        let _ = (pattern, within);
        Ok(Vec::new())
    }
}

/// Publishes on one topic.
pub trait Publisher: Send + Sync {
    /// Sends a payload. Returns as soon as the transport has it.
    ///
    /// # Errors
    /// A transport that is closed or cannot take a payload of this size.
    fn put(&self, capture: Timestamp, encoding: &str, payload: &[u8]) -> Result<(), BusError>;
}

/// Keeps a subscription or a queryable alive.
pub trait Guard: Send {}

/// The delivery that a topic needs, from its name.
pub fn delivery(topic: &str) -> Delivery {
    match topic.rsplit('/').next() {
        Some("rig" | "skeleton" | "status") => Delivery::State { history: 1 },
        Some("keyframe") => Delivery::State { history: 8 },
        Some("events") => Delivery::State { history: 64 },
        Some("journal") => Delivery::State { history: 256 },
        _ => Delivery::Stream,
    }
}

/// Why the bus does not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// A topic or a pattern that cannot be one.
    #[error("{name:?} is no {what}: {reason}")]
    Name {
        /// As given.
        name: String,
        /// `topic` or `pattern`.
        what: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// An address to listen on that somebody has.
    #[error(
        "cannot listen on {endpoint}: address in use; another node runs there, or choose another \
         with [bus.zenoh] listen"
    )]
    InUse {
        /// As configured.
        endpoint: String,
    },
    /// Addresses of which none answers.
    #[error(
        "nothing answers at {endpoints}; is `bundlemocap run` up? [bus.zenoh] connect says where \
         it is"
    )]
    NobodyAnswers {
        /// As tried, with commas between.
        endpoints: String,
    },
    /// A setting that the transport does not take.
    #[error("[bus] {key} = {value}: {reason}")]
    Setting {
        /// The key, such as `zenoh.listen`.
        key: &'static str,
        /// As configured.
        value: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A transport that this program was built without.
    #[error(
        "[bus] kind = {kind:?}: this program was built without it; build it with --features {kind}"
    )]
    NotBuilt {
        /// Its name, also that of the feature.
        kind: &'static str,
    },
    /// A payload above what the bus carries.
    #[error("{topic}: a payload of {bytes} bytes; this bus carries at most {most}")]
    TooLarge {
        /// Where it was to go.
        topic: String,
        /// Its size.
        bytes: usize,
        /// The limit.
        most: usize,
    },
    /// The transport was closed.
    #[error("the bus is closed")]
    Closed,
    /// The transport failed.
    #[error("{what}: {reason}")]
    Transport {
        /// What was tried.
        what: String,
        /// The transport's words.
        reason: String,
    },
}

impl BusError {
    fn transport(what: impl Into<String>, reason: impl std::fmt::Display) -> Self {
        Self::Transport { what: what.into(), reason: reason.to_string() }
    }
}
