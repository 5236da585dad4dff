//! `bundlemocap sync`

use std::path::PathBuf;

use clap::Args;

use super::Ended;
use super::calibrate::checked;
use super::failure::{Exit, Failure};
use super::overwrite::Overwrite;
use super::terminal::{say, table};
use crate::io::formats::{Up, write_calibration};
use crate::offline::CameraOffset;

/// Estimate the time offsets of a recording's cameras from the performer's motion.
#[derive(Debug, Args)]
#[command(after_help = "\
Prints for each camera what must be added to its capture times to agree with most of the cameras,
with the standard error, and a verdict:
  in sync   no significant offset (3 standard errors and 0.1 frames)
  shifted   a significant offset
  unknown   too little motion to tell (standard error above 0.25 frames)

Offsets of up to 6 frames are found. `solve` does the same and uses the significant offsets.
--out writes the calibration with them (time_offset_ms), for `solve --rig` and the node's `rig`.

Examples:
  bundlemocap sync balancing.mcap
  bundlemocap sync balancing.mcap --out rig.toml
  bundlemocap sync balancing.mcap --json")]
pub(super) struct Arguments {
    /// MCAP recording with keypoints and a calibrated rig.
    file: PathBuf,
    /// Calibration to write, with the significant offsets.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Up axis of the written calibration's world: y or z.
    #[arg(long, default_value = "z", value_parser = super::import::up)]
    up: Up,
    /// Settings file; config/default.toml lists every setting.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print one JSON array instead of the table.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    if let Some(out) = &arguments.out {
        arguments.overwrite.check(out)?;
    }
    let found = checked(&arguments.file, arguments.config.as_deref(), false)?;
    if arguments.json {
        let text = serde_json::to_string_pretty(&found.offsets);
        say(&text.map_err(|error| Failure::new(Exit::Unexpected, error.to_string()))?);
    } else {
        say(&table(&found.offsets.iter().map(row).collect::<Vec<_>>()));
    }
    if let Some(out) = &arguments.out {
        write_calibration(out, &found.rig, arguments.up)?;
    }
    Ok(Exit::Done)
}

fn row(found: &CameraOffset) -> (String, String) {
    let verdict = match found.verdict {
        "in_sync" => "in sync",
        "unknown" => "unknown: too little motion",
        shifted => shifted,
    };
    (found.camera.clone(), format!("{found}, {verdict}"))
}
