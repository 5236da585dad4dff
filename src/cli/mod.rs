//! The command line, one file per subcommand.
//!
//! Results go to standard output, progress and warnings to standard error. An error is one line on
//! standard error, `error: ...`, and an exit code (see `--help`).

mod bench;
mod body;
mod bridge;
mod bus;
mod calibrate;
mod check;
pub(crate) mod clock;
mod completions;
mod decode;
mod doctor;
mod echo;
mod eval;
mod export;
pub(crate) mod failure;
mod import;
mod info;
mod lookout;
mod overwrite;
mod play;
mod record;
mod replay;
mod retarget;
mod retarget_file;
mod retarget_live;
mod rig;
mod run;
mod settings;
mod solve;
mod span;
mod stage;
mod synth;
mod take;
mod takes;
pub(crate) mod terminal;
mod tools;
mod train;
#[cfg(feature = "view")]
mod view;
mod wire;

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::OnceLock;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use failure::{EXIT_CODES, Exit, Failure};

/// Smooth 3D poses from the 2D keypoints of calibrated cameras.
#[derive(Debug, Parser)]
#[command(name = "bundlemocap", version, after_help = EXIT_CODES, max_term_width = 100)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Run(run::Arguments),
    Doctor(doctor::Arguments),
    Play(play::Arguments),
    Echo(echo::Arguments),
    Record(record::Arguments),
    Take(take::Arguments),
    Replay(replay::Arguments),
    Decode(decode::Arguments),
    Retarget(retarget::Arguments),
    Bridge(bridge::Arguments),
    Bench(bench::Arguments),
    Eval(Box<eval::Arguments>),
    Solve(solve::Arguments),
    Summary(takes::SummaryArguments),
    Body(body::Arguments),
    Check(check::Arguments),
    Calibrate(calibrate::Arguments),
    Import(import::Arguments),
    Rig(rig::Arguments),
    Info(info::Arguments),
    Synth(synth::Arguments),
    Train(train::Arguments),
    #[cfg(feature = "view")]
    View(view::Arguments),
    Export(export::Arguments),
    Completions(completions::Arguments),
}

/// Runs the command of this process and returns its exit code.
pub fn main() -> ExitCode {
    ExitCode::from(run_with(std::env::args_os().collect()))
}

/// The words of the command line: the program, then its arguments.
static WORDS: OnceLock<Vec<OsString>> = OnceLock::new();

/// Parses the words of a command line, the program first, runs the command and returns its exit code.
pub fn run_with(words: Vec<OsString>) -> u8 {
    let words = WORDS.get_or_init(|| words);
    let matches = unwrapped(Arguments::command()).get_matches_from(words);
    let arguments = Arguments::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    clock::clean_up_on_signals();
    let result = match arguments.command {
        Command::Run(arguments) => run::run(&arguments),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Play(arguments) => play::run(&arguments),
        Command::Echo(arguments) => echo::run(&arguments),
        Command::Record(arguments) => record::run(&arguments),
        Command::Take(arguments) => take::run(&arguments),
        Command::Replay(arguments) => replay::run(&arguments),
        Command::Decode(arguments) => decode::run(&arguments),
        Command::Retarget(arguments) => retarget::run(&arguments),
        Command::Bridge(arguments) => bridge::run(&arguments),
        Command::Bench(arguments) => bench::run(&arguments),
        Command::Eval(arguments) => eval::run(&arguments),
        Command::Solve(arguments) => takes::run(&arguments),
        Command::Summary(arguments) => takes::summary(&arguments),
        Command::Body(arguments) => body::run(&arguments),
        Command::Check(arguments) => check::run(&arguments),
        Command::Calibrate(arguments) => calibrate::run(&arguments),
        Command::Import(arguments) => import::run(&arguments),
        Command::Rig(arguments) => rig::run(&arguments),
        Command::Info(arguments) => info::run(&arguments),
        Command::Synth(arguments) => synth::run(&arguments),
        Command::Train(arguments) => train::run(&arguments),
        #[cfg(feature = "view")]
        Command::View(arguments) => view::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::Completions(arguments) => completions::run(&arguments),
    };
    let result = match (result, terminal::unwritten()) {
        (Ok(_), Some(reason)) => {
            let message = format!("standard output cannot be written: {reason}");
            Err(Failure::new(Exit::Unexpected, message))
        }
        (result, _) => result,
    };
    let exit = result.unwrap_or_else(|failure: Failure| {
        terminal::complain("error", &failure.line());
        failure.exit
    });
    exit as u8
}

/// A command whose help has a line for each paragraph below the options, for any width of the terminal.
fn unwrapped(command: clap::Command) -> clap::Command {
    let command = command.mut_subcommands(unwrapped);
    let Some(help) = command.get_after_help().map(ToString::to_string) else { return command };
    // Indented lines are examples, or rows of a list.
    let is_text = |line: &str| !line.is_empty() && !line.starts_with(' ');
    let mut text = String::new();
    for (before, line) in std::iter::once("").chain(help.lines()).zip(help.lines()) {
        text += if is_text(before) && is_text(line) { " " } else { "\n" };
        text += line;
    }
    command.after_help(text.trim_start_matches('\n').to_owned())
}

/// The path of this program. Where Python runs it, that of its script.
fn own_path() -> std::io::Result<PathBuf> {
    let word = WORDS.get().and_then(|words| words.first()).map(Path::new);
    let script = word.filter(|path| path.is_absolute() && path.is_file());
    script.map_or_else(std::env::current_exe, |path| Ok(path.to_owned()))
}

/// The exit code of a command, or why it failed.
type Ended = Result<Exit, Failure>;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn help_has_no_line_breaks_within_paragraphs() {
        let help = "A b\nc d.\n\nTwo:\n  one\n  two\n";
        let parent = clap::Command::new("a").subcommand(clap::Command::new("b").after_help(help));
        let parent = unwrapped(parent);
        let shown = parent.get_subcommands().next().and_then(clap::Command::get_after_help);
        assert_eq!(shown.unwrap().to_string(), "A b c d.\n\nTwo:\n  one\n  two");
    }

    #[test]
    fn the_arguments_are_sound_and_every_command_has_examples() {
        let command = Arguments::command();
        command.clone().debug_assert();
        for command in command.get_subcommands() {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            assert!(help.contains("Example"), "{}", command.get_name());
            // Rows of lists are indented, or they are joined.
            let row = help.lines().find(|line| !line.starts_with(' ') && line.contains("  "));
            assert_eq!(row, None, "{}", command.get_name());
        }
    }
}
