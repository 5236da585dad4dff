//! The options of every tool on the bus.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::WORDS;
use super::failure::{Exit, Failure};
use crate::config::Config;
use crate::io::bus::{self, Bus, Kind};
use crate::io::wire::{Topics, valid_name};

/// The bus, the stage and the actor.
#[derive(Debug, Args)]
#[command(next_help_heading = "Bus")]
pub(super) struct BusArguments {
    /// Settings file; config/default.toml lists every setting.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Bus; overrides the settings.
    #[arg(long, value_enum)]
    bus: Option<BusName>,
    /// Address of the node, such as tcp/192.168.1.10:7447; overrides the settings.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// Name of the capture volume; overrides the settings.
    #[arg(long, value_name = "NAME")]
    stage: Option<String>,
    /// Name of the performer; overrides the settings. Tools that print or write take all by default.
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
    /// The settings, overridden by the arguments.
    pub(super) fn settings(&self) -> Result<Config, Failure> {
        let mut config = self.config.as_deref().map(Config::load).transpose()?.unwrap_or_default();
        config.bus = config.bus.named(&program());
        if let Some(bus) = self.bus {
            config.bus.kind = bus.kind();
        }
        if !self.connect.is_empty() {
            if config.bus.kind != Kind::Zenoh {
                let text =
                    "--connect is for zenoh; iceoryx2 reaches the programs of this computer alone";
                return Err(Failure::new(Exit::Usage, text));
            }
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

    /// The performer who is named.
    pub(super) fn actor(&self) -> Option<&str> {
        self.actor.as_deref()
    }

    /// The topics of the stage, of all actors unless one is named.
    pub(super) fn topics(&self, config: &Config) -> Topics {
        // With several performers, that name is the node's.
        let is_set = || config.node.actor != Config::default().node.actor;
        let is_named = self.actor.is_some() || !config.stage.several() && is_set();
        let own = topics(config);
        if is_named { own } else { Topics { actor: "*".to_owned(), ..own } }
    }
}

/// How others see this program: its name and the command.
pub(super) fn program() -> String {
    let words = WORDS.get().into_iter().flatten().skip(1);
    let words = words.map(|word| word.to_string_lossy().into_owned());
    let command = words.into_iter().find(|word| !word.starts_with('-'));
    format!("{} {}", env!("CARGO_PKG_NAME"), command.unwrap_or_default())
}

/// Checks a name that becomes a part of a topic.
pub(super) fn check_name(option: &str, name: &str) -> Result<(), Failure> {
    valid_name(name).map_err(|error| Failure::new(Exit::Usage, format!("{option}: {error}")))
}

/// The topics of the configured stage and actor.
pub(super) fn topics(config: &Config) -> Topics {
    Topics { stage: config.node.stage.clone(), actor: config.node.actor.clone() }
}

/// Opens the bus as a client of a node.
pub(super) fn open(config: &Config) -> Result<Box<dyn Bus>, Failure> {
    Ok(bus::open_client(&config.bus)?)
}
