//! The `bundlemocap` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    bundlemocap::cli::main()
}
