//! `bundlemocap bridge`

mod osc;
mod vmc;

use clap::{Args, Subcommand};

use super::Ended;

/// Connect other programs: send them poses, or take commands from them.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  bundlemocap bridge vmc --to 192.168.1.30:39539
  bundlemocap bridge osc --listen 0.0.0.0:8000")]
pub(super) struct Arguments {
    #[command(subcommand)]
    protocol: Protocol,
}

#[derive(Debug, Subcommand)]
enum Protocol {
    Vmc(vmc::Arguments),
    Osc(osc::Arguments),
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    match &arguments.protocol {
        Protocol::Vmc(arguments) => vmc::run(arguments),
        Protocol::Osc(arguments) => osc::run(arguments),
    }
}
