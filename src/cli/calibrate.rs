//! `bundlemocap calibrate`

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::Ended;
use super::failure::Exit;
use super::overwrite::{Overwrite, check_ending};
use super::solve::{Progress, lost};
use super::span::{SpanArguments, Times};
use super::terminal::{complain, say, table};
use crate::config::Config;
use crate::core::calibration::{OFFSET_REACH, offset_step};
use crate::core::time::Nanos;
use crate::io::formats::{Up, write_calibration};
use crate::offline::{
    CameraCorrection, CameraOffset, ChangedCamera, CheckedCameras, Options, Recording,
    check_cameras,
};

/// Estimate the time offsets of a recording's cameras and small corrections of their calibration, from
/// the performer's motion.
#[derive(Debug, Args)]
#[command(after_help = "\
Time offsets: prints for each camera what must be added to its capture times to agree with most of the
cameras, with the standard error, and a verdict:
  in sync   no significant offset (3 standard errors and 0.1 frames)
  shifted   a significant offset
  unknown   too little motion to tell (standard error above 0.25 frames)
Above 125 Hz, a frame here is the shortest whole number of frames that lasts at least 8 ms.
Larger offsets, other frame rates and lost frames are corrected first, as `check` names them. `solve`
does the same and uses the significant offsets.

Calibration: compares the limbs in each view with those triangulated from the other views, and corrects
the rotation, position and focal length of as few cameras as possible. Prints each camera's
disagreement (median, pixels) before and after, and each correction with its standard error. A
correction counts if it is above 3 standard errors and above 0.1 degrees, 5 mm or 0.3 %, and if it
lowers the disagreement of its camera by a tenth. Large corrections are underestimated: of a shift of
10 cm, some centimetres may be missing. The standard error does not include this. Errors of many degrees
need a new calibration. At least three cameras are needed. A camera that is moved during the recording
is not corrected (exit code 6): --start and --end choose the part after or before that.

--out writes the calibration with the significant offsets (time_offset_ms) and corrections, for
`solve --rig` and the node's `rig`. Check it on another recording with `solve --rig FILE --hold-out
CAMERA`.

Examples:
  bundlemocap calibrate take.mcap
  bundlemocap calibrate take.mcap --out rig.toml
  bundlemocap calibrate take.mcap --start 31 --out rig.toml
  bundlemocap calibrate take.mcap --time-only --json
  bundlemocap solve other.mcap --out out --rig rig.toml --hold-out cam01")]
pub(super) struct Arguments {
    /// MCAP recording with keypoints and a calibrated rig.
    file: PathBuf,
    /// Calibration to write.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Only estimate time offsets.
    #[arg(long)]
    time_only: bool,
    #[command(flatten)]
    span: SpanArguments,
    /// Up axis of the written calibration's world: x, y, z, -x, -y or -z.
    #[arg(long, default_value_t, allow_hyphen_values = true)]
    up: Up,
    /// Settings file; config/default.toml lists every setting.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print one JSON object instead of the table.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    if let Some(out) = &arguments.out {
        arguments.overwrite.check_beside(&arguments.file, out)?;
        check_ending(out, "toml")?;
    }
    let config = arguments.config.as_deref().map(Config::load).transpose()?.unwrap_or_default();
    let times = Times::of(&arguments.file, Some(&config))?;
    let mut recording = Recording::open(&arguments.file)?.within(arguments.span.within(&times)?);
    let options = Options { config: config.tracker, ..Options::default() };
    let mut progress = Progress::over(recording.messages());
    let found = check_cameras(&mut recording, &options, !arguments.time_only, &mut progress)?;
    progress.bar.finish_and_clear();
    let told = recording.silent_note().into_iter().chain(recording.rig_note());
    told.for_each(|note| complain("note", &note));
    for note in &found.notes {
        complain("note", &format!("{note}; no calibration can correct it, `solve` does"));
    }
    let is_far = |one: &CameraOffset| {
        let Some((ms, frames)) = one.offset_ms.zip(one.offset_frames) else { return false };
        let step = offset_step(Nanos::rounded(1e6 * ms / frames));
        one.applied && ms.abs() > (step * OFFSET_REACH).ms()
    };
    if arguments.out.is_some() && found.offsets.iter().any(is_far) {
        let note =
            "the offsets of cameras that were started at different times hold for this take alone";
        complain("note", note);
    }
    if arguments.json {
        let CheckedCameras { offsets, corrections, notes, changed, .. } = &found;
        let change = |ChangedCamera { camera, what, at }: &ChangedCamera| {
            let at_s = at.seconds_since(times.first);
            json!({ "camera": camera, "what": what, "at_s": at_s })
        };
        let all = json!({
            "time_offsets": offsets, "corrections": corrections, "notes": notes,
            "changed": changed.iter().map(change).collect::<Vec<_>>(),
        });
        say(&format!("{all:#}"));
    } else {
        let offsets = found.offsets.iter().map(offset);
        say(&table(&offsets.chain(found.corrections.iter().flat_map(rows)).collect::<Vec<_>>()));
        say(&conclusion(&found));
    }
    if let Some(out) = &arguments.out {
        write_calibration(out, &found.rig, arguments.up)?;
    }
    let from = match arguments.span.is_given() {
        true => " (seconds since the first frame that is used)",
        false => "",
    };
    for ChangedCamera { camera, what, at } in &found.changed {
        let at = at.seconds_since(times.first);
        let fix = format!("calibrate the part before or after {at:.1} s with --end or --start");
        complain("warning", &format!("{camera}: {what}{from}; it is not corrected: {fix}"));
    }
    let exit = lost(&recording);
    Ok(if found.changed.is_empty() { exit } else { Exit::InPart })
}

fn offset(found: &CameraOffset) -> (String, String) {
    let verdict = match found.verdict {
        "in_sync" => "in sync",
        "unknown" => "unknown: too little motion",
        shifted => shifted,
    };
    (found.camera.clone(), format!("{found}, {verdict}"))
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

fn conclusion(found: &CheckedCameras) -> String {
    let corrected = found.corrections.iter().filter(|camera| camera.correction.significant);
    let shifted = found.offsets.iter().filter(|offset| offset.applied);
    let mut changes: Vec<String> =
        corrected.map(|camera| format!("{} corrected", camera.camera)).collect();
    changes.extend(shifted.map(|offset| format!("{} shifted by {offset}", offset.camera)));
    let is_judged = |one: &CameraCorrection| one.correction.disagreement_px[0].is_some();
    match changes.is_empty() {
        true if !found.corrections.is_empty() && !found.corrections.iter().any(is_judged) => {
            "the calibration is not judged: at least three cameras must see the performer"
                .to_owned()
        }
        true => "nothing to correct".to_owned(),
        false => changes.join(", "),
    }
}
