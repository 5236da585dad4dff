//! `bundlemocap calibrate`

use std::path::{Path, PathBuf};

use clap::Args;

use super::Ended;
use super::failure::{Exit, Failure};
use super::overwrite::Overwrite;
use super::solve::Progress;
use super::terminal::{progress, say, table};
use crate::config::Config;
use crate::io::formats::{Up, write_calibration};
use crate::offline::{CameraCorrection, CheckedCameras, Options, Recording, check_cameras};

/// Correct a calibration by small amounts, from the performer in a recording.
#[derive(Debug, Args)]
#[command(after_help = "\
Compares the limbs in each view with those triangulated from the other views, and corrects the
rotation, position and focal length of as few cameras as possible. A correction counts if it is
above 3 standard errors and above 0.1 degrees, 5 mm or 0.3 %, and if it lowers the disagreement of
its camera by a tenth. It is held small: errors of many degrees need a new calibration. Time offsets
are estimated before (see `bundlemocap sync`) and written too. At least three cameras are needed.

Prints each camera's disagreement (median, pixels) before and after, and each correction with its
standard error. Check the file on another recording with `solve --rig FILE --hold-out CAMERA`.

Examples:
  bundlemocap calibrate --refine take.mcap --out rig.toml
  bundlemocap solve other.mcap --out out --rig rig.toml --hold-out cam01")]
pub(super) struct Arguments {
    /// MCAP recording with keypoints and the calibrated rig to correct.
    #[arg(long, value_name = "RECORDING")]
    refine: PathBuf,
    /// Calibration to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Up axis of the written calibration's world: y or z.
    #[arg(long, default_value = "z", value_parser = super::import::up)]
    up: Up,
    /// Settings file; config/default.toml lists every setting.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    arguments.overwrite.check(&arguments.out)?;
    let found = checked(&arguments.refine, arguments.config.as_deref(), true)?;
    say(&table(&found.corrections.iter().flat_map(rows).collect::<Vec<_>>()));
    say(&conclusion(&found, &arguments.out));
    write_calibration(&arguments.out, &found.rig, arguments.up)?;
    Ok(Exit::Done)
}

/// The cameras of a recording checked with the settings of a file, with progress; corrected too, with
/// `refine`.
pub(super) fn checked(
    recording: &Path,
    config: Option<&Path>,
    refine: bool,
) -> Result<CheckedCameras, Failure> {
    let config = config.map(Config::load).transpose()?.unwrap_or_default();
    let mut recording = Recording::open(recording)?;
    let options = Options { config: config.tracker, ..Options::default() };
    let mut bar = Progress(progress(recording.messages(), "messages"));
    let found = check_cameras(&mut recording, &options, refine, &mut bar)?;
    bar.0.finish_and_clear();
    Ok(found)
}

fn rows(
    CameraCorrection { camera, correction: found }: &CameraCorrection,
) -> Vec<(String, String)> {
    let px = |value: Option<f64>| value.map_or("none".to_owned(), |px| format!("{px:.1}"));
    let [before, after] = found.disagreement_px.map(px);
    let mut rows = vec![(camera.clone(), format!("{before} px before, {after} px after"))];
    if found.significant {
        let mut row = |name: &str, [value, error]: [f64; 2], scale: f64, unit: &str| {
            let text = format!("{:.2} ± {:.2} {unit}", value * scale, error * scale);
            rows.push((format!("  {name}"), text));
        };
        row("turned by", found.rotation, 1f64.to_degrees(), "degrees");
        row("moved by", found.position, 1e3, "mm");
        row("focal length", found.focal, 100.0, "%");
    }
    rows
}

fn conclusion(found: &CheckedCameras, out: &Path) -> String {
    let corrected = found.corrections.iter().filter(|camera| camera.correction.significant);
    let shifted = found.offsets.iter().filter(|offset| offset.applied);
    let mut changes: Vec<String> =
        corrected.map(|camera| format!("{} corrected", camera.camera)).collect();
    changes.extend(shifted.map(|offset| format!("{} shifted by {offset}", offset.camera)));
    match changes.is_empty() {
        true => format!("nothing to correct; {} is the recording's calibration", out.display()),
        false => format!("{}: {}", out.display(), changes.join(", ")),
    }
}
