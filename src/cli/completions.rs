//! `bundlemocap completions`

use clap::{Args, CommandFactory};
use clap_complete::Shell;

use super::Ended;
use super::failure::Exit;
use super::terminal::say;

/// Print a completion script for a shell.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  bundlemocap completions bash > ~/.local/share/bash-completion/completions/bundlemocap"
)]
pub(super) struct Arguments {
    /// The shell.
    shell: Shell,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let mut script = Vec::new();
    let mut command = super::Arguments::command();
    clap_complete::generate(arguments.shell, &mut command, "bundlemocap", &mut script);
    say(String::from_utf8_lossy(&script).trim_end());
    Ok(Exit::Done)
}
