//! Which bus, and how it is opened.

use serde::{Deserialize, Serialize};

#[cfg(feature = "iceoryx2")]
use super::Iceoryx2;
#[cfg(feature = "zenoh")]
use super::Zenoh;
use super::{Bus, BusError};

/// Which bus, and the settings of each.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The transport.
    pub kind: Kind,
    /// Of the network.
    pub zenoh: ZenohConfig,
    /// Of the shared memory.
    pub iceoryx2: Iceoryx2Config,
}

/// A transport between processes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// A network.
    #[default]
    Zenoh,
    /// The shared memory of one host.
    Iceoryx2,
}

#[cfg(not(all(feature = "zenoh", feature = "iceoryx2")))]
impl Kind {
    /// The name in settings, and of the feature.
    fn name(self) -> &'static str {
        match self {
            Self::Zenoh => "zenoh",
            Self::Iceoryx2 => "iceoryx2",
        }
    }
}

/// Of the network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ZenohConfig {
    /// What the node is in the network. Tools are always clients.
    pub mode: ZenohMode,
    /// Addresses on which the node can be reached.
    pub listen: Vec<String>,
    /// Addresses that the node and the tools connect to.
    pub connect: Vec<String>,
    /// Whether others are looked for by multicast.
    pub scouting: bool,
}

/// What a node is in a network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ZenohMode {
    /// Others connect to it, and hear each other through it.
    #[default]
    Router,
    /// Connects to other peers and routers directly.
    Peer,
    /// Connects to one router.
    Client,
}

impl Default for ZenohConfig {
    fn default() -> Self {
        Self {
            mode: ZenohMode::Router,
            listen: vec!["tcp/127.0.0.1:7447".into()],
            connect: Vec::new(),
            scouting: false,
        }
    }
}

/// Of the shared memory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Iceoryx2Config {
    /// Begins the names of all resources. Programs with different prefixes do not see each other.
    pub prefix: String,
}

impl Default for Iceoryx2Config {
    fn default() -> Self {
        Self { prefix: "bundlemocap_".into() }
    }
}

/// Opens the bus as the node does.
///
/// # Errors
/// An address in use, a router that does not answer, or settings that the transport does not take.
pub fn open_node(config: &Config) -> Result<Box<dyn Bus>, BusError> {
    match config.kind {
        #[cfg(feature = "zenoh")]
        Kind::Zenoh => Ok(Box::new(Zenoh::open_node(&config.zenoh)?)),
        #[cfg(feature = "iceoryx2")]
        Kind::Iceoryx2 => Ok(Box::new(Iceoryx2::open(&config.iceoryx2)?)),
        #[cfg(not(all(feature = "zenoh", feature = "iceoryx2")))]
        absent => Err(BusError::NotBuilt { kind: absent.name() }),
    }
}

/// Opens the bus as a tool beside a node does: it connects to `connect` or, if that is empty, to
/// where the node listens.
///
/// # Errors
/// Nobody answers within about two seconds, or settings that the transport does not take.
pub fn open_client(config: &Config) -> Result<Box<dyn Bus>, BusError> {
    match config.kind {
        #[cfg(feature = "zenoh")]
        Kind::Zenoh => Ok(Box::new(Zenoh::open_client(&config.zenoh)?)),
        #[cfg(feature = "iceoryx2")]
        Kind::Iceoryx2 => Ok(Box::new(Iceoryx2::open(&config.iceoryx2)?)),
        #[cfg(not(all(feature = "zenoh", feature = "iceoryx2")))]
        absent => Err(BusError::NotBuilt { kind: absent.name() }),
    }
}
