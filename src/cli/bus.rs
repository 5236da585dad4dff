//! The options that every tool on the bus has.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::failure::{Exit, Failure};
use crate::config::Config;
use crate::io::bus::{self, Bus, Kind};
use crate::io::wire::Topics;

/// Which bus, which stage, which actor.
#[derive(Debug, Args)]
#[command(next_help_heading = "Bus")]
pub(super) struct BusArguments {
    /// Settings; config/default.toml lists them all.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The bus, instead of the configured one.
    #[arg(long, value_enum)]
    bus: Option<BusName>,
    /// Where the node is, such as tcp/192.168.1.10:7447, instead of the configured address.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// The capture volume, instead of the configured one.
    #[arg(long, value_name = "NAME")]
    stage: Option<String>,
    /// The performer, instead of the configured one.
    #[arg(long, value_name = "NAME")]
    actor: Option<String>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
pub(super) enum BusName {
    /// A network.
    Zenoh,
    /// The shared memory of this host.
    Iceoryx2,
}

impl BusName {
    pub(super) const fn kind(self) -> Kind {
        match self {
            Self::Zenoh => Kind::Zenoh,
            Self::Iceoryx2 => Kind::Iceoryx2,
        }
    }
}

impl BusArguments {
    /// The settings, with what the arguments put in their place.
    pub(super) fn settings(&self) -> Result<Config, Failure> {
        let mut config = self.config.as_deref().map(Config::load).transpose()?.unwrap_or_default();
        if let Some(bus) = self.bus {
            config.bus.kind = bus.kind();
        }
        if !self.connect.is_empty() {
            config.bus.zenoh.connect.clone_from(&self.connect);
        }
        let names = [
            ("--stage", &self.stage, &mut config.node.stage),
            ("--actor", &self.actor, &mut config.node.actor),
        ];
        for (option, given, setting) in names {
            if let Some(name) = given {
                check_name(option, name)?;
                setting.clone_from(name);
            }
        }
        Ok(config)
    }
}

/// A part of a topic: not empty, without slashes and wildcards.
pub(super) fn check_name(option: &str, name: &str) -> Result<(), Failure> {
    let fine = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if !name.is_empty() && name.chars().all(fine) {
        return Ok(());
    }
    let message = format!("{option} is {name:?}; use letters, digits, `-`, `_` and `.`");
    Err(Failure::new(Exit::Usage, message))
}

/// The topics of the settings' stage and actor.
pub(super) fn topics(config: &Config) -> Topics {
    Topics { stage: config.node.stage.clone(), actor: config.node.actor.clone() }
}

/// Opens the bus as a tool beside a node.
pub(super) fn open(config: &Config) -> Result<Box<dyn Bus>, Failure> {
    Ok(bus::open_client(&config.bus)?)
}
