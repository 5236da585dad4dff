//! Settings of the bus, and how it is opened.

use serde::{Deserialize, Serialize};

#[cfg(feature = "iceoryx2")]
use super::Iceoryx2;
#[cfg(feature = "zenoh")]
use super::Zenoh;
use super::{Bus, BusError};

/// Choice of the bus, and the settings of each kind.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The transport.
    pub kind: Kind,
    /// Settings of the network.
    pub zenoh: ZenohConfig,
    /// Settings of the shared memory.
    pub iceoryx2: Iceoryx2Config,
}

impl Config {
    /// The same settings for a program that others see under this name.
    pub fn named(mut self, name: &str) -> Self {
        self.zenoh.name = name.to_owned();
        self.iceoryx2.name = name.to_owned();
        self
    }
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
    /// The name in settings; also the name of the feature.
    fn name(self) -> &'static str {
        match self {
            Self::Zenoh => "zenoh",
            Self::Iceoryx2 => "iceoryx2",
        }
    }
}

/// Settings of the network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ZenohConfig {
    /// Role of the node in the network. Tools are always clients.
    pub mode: ZenohMode,
    /// Addresses on which the node can be reached.
    pub listen: Vec<String>,
    /// Addresses that the node and the tools connect to.
    pub connect: Vec<String>,
    /// Whether other programs are searched by multicast.
    pub scouting: bool,
    /// A configuration file of zenoh for the node, for what these settings cannot say, such as access
    /// control. These settings come before it. Empty: none.
    pub config: String,
    /// Certificates, for addresses that begin with `quic/`.
    pub tls: TlsConfig,
    /// What others see this program called. Empty: the name of its file.
    #[serde(skip)]
    pub name: String,
}

/// Certificates of the network: PEM files; empty: none.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TlsConfig {
    /// The authority that signed everybody's certificates.
    pub root_ca: String,
    /// The certificate of this program.
    pub certificate: String,
    /// The private key of that certificate.
    pub key: String,
    /// Whether a program without a certificate of that authority is refused.
    pub client_certificates: bool,
}

impl Default for TlsConfig {
    fn default() -> Self {
        let none = String::new;
        Self { root_ca: none(), certificate: none(), key: none(), client_certificates: true }
    }
}

/// Role of a node in a network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ZenohMode {
    /// Other programs connect to it; it forwards their samples.
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
            config: String::new(),
            tls: TlsConfig::default(),
            name: String::new(),
        }
    }
}

/// Settings of the shared memory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Iceoryx2Config {
    /// Prefix of the names of all resources. Programs with different prefixes do not see each
    /// other.
    pub prefix: String,
    /// What others see this program called. Empty: the name of its file.
    #[serde(skip)]
    pub name: String,
}

impl Default for Iceoryx2Config {
    fn default() -> Self {
        Self { prefix: "bundlemocap_".into(), name: String::new() }
    }
}

/// Opens the bus for the node.
///
/// # Errors
/// An address in use, a router that does not answer, or settings that the transport refuses.
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

/// Opens the bus for a tool: it connects to `connect` or, if that is empty, to the addresses on
/// which the node listens.
///
/// # Errors
/// No answer within about two seconds, or settings that the transport refuses.
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
