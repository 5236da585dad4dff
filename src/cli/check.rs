//! `bundlemocap check`

use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::json;

use super::Ended;
use super::failure::{Exit, Failure, json};
use super::rig::ConventionArguments;
use super::solve::{Progress, lost};
use super::terminal::{complain, say};
use crate::core::camera::Rig;
use crate::diagnose::Check;
use crate::offline;

/// Judge the cameras of a recording: what is wrong, and what would fix it.
#[derive(Debug, Args)]
#[command(after_help = "\
Compares each camera with the others that agree, and prints the share of its points that are within
5 % of the performer's height of where the others see them, the median error, and a verdict. If a
camera disagrees, known faults are undone on it, and the one that makes it agree is named: mirrored,
turned, scaled or stretched images, left and right exchanged, another camera's images, capture times
that are off or run too fast, lost frames, a wrong convention or unit of its pose, a wrong focal length,
principal point or distortion, and a camera that was turned or moved. If a fault begins or ends during
the recording, the time is named. Faults of the whole recording are named too: its scale, up axis,
keypoint order, shuffled or repeated frames. A camera that sees people, but not where the others see
somebody, is named without a cause.

With two cameras it is not known which one is wrong: what would make them agree is listed. If that is
only a shift of the capture times, one of the two is named. An error is named from about 2 % of the
performer's height on, an error of a clock from about 1 %.

Exit code 6: a recording, or a part of it, cannot be read. 15: with --strict, something is wrong.

Examples:
  bundlemocap check take.mcap
  bundlemocap check monday/*.mcap --strict
  bundlemocap check take.mcap --rig rig.toml --json")]
pub(super) struct Arguments {
    /// MCAP recordings with keypoints and a calibrated rig.
    #[arg(required = true, value_name = "RECORDING")]
    files: Vec<PathBuf>,
    /// Calibration to use instead of the recordings'.
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    convention: ConventionArguments,
    /// Fail with exit code 15 if something is wrong.
    #[arg(long)]
    strict: bool,
    /// Print one JSON array with an object for each recording instead of the tables.
    #[arg(long)]
    json: bool,
}

/// Judges a recording. The exit code says whether all of it could be read.
fn judge(file: &Path, rig: Option<&Rig>, arguments: &Arguments) -> Result<(Check, Exit), Failure> {
    let mut recording = arguments.convention.open(file, rig)?;
    let mut progress = Progress::over(recording.messages());
    let check = offline::check(&mut recording, &mut progress)?;
    progress.bar.finish_and_clear();
    recording.rig_note().iter().for_each(|note| complain("note", note));
    Ok((check, lost(&recording)))
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let rig = arguments.rig.as_deref();
    let rig = rig.map(|rig| super::rig::read(rig, &arguments.convention)).transpose()?;
    let (mut found, mut wrong, mut exit) = (Vec::new(), Vec::new(), Exit::Done);
    for file in &arguments.files {
        let (check, whole) = match judge(file, rig.as_ref(), arguments) {
            Ok(judged) => judged,
            Err(failure) if arguments.files.len() > 1 => {
                complain("error", &failure.line());
                exit = Exit::InPart;
                continue;
            }
            Err(failure) => return Err(failure),
        };
        if whole != Exit::Done {
            exit = whole;
        }
        if !arguments.json {
            if arguments.files.len() > 1 {
                say(&format!("{}:", file.display()));
            }
            say(&check.to_string());
        }
        if !check.is_clean() {
            wrong.push(file.display().to_string());
        }
        found.push(json!({ "recording": file.display().to_string(), "check": check }));
    }
    if arguments.json {
        say(&json(&found)?);
    }
    if wrong.is_empty() || !arguments.strict {
        return Ok(exit);
    }
    complain("warning", &format!("something is wrong in {}", wrong.join(", ")));
    Ok(Exit::Suspicious)
}
