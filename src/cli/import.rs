//! `bundlemocap import`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};

use super::Ended;
use super::failure::{Exit, Failure, frame_rate_option, ratio};
use super::overwrite::Overwrite;
use super::terminal::{complain, progress, say, table};
use crate::core::camera::Rig;
use crate::core::time::Timestamp;
use crate::io::formats::{
    CameraReport, ImportError, MatchedBy, OpenposeFolder, Up, keypoint_format, read_calibration,
};
use crate::io::recording::{Provenance, Writer};
use crate::io::wire::Topics;

/// Convert detections and calibration of other tools to a recording.
#[derive(Debug, Args)]
#[command(after_help = "\
Example:
  bundlemocap import openpose demo/pose --calibration demo/Calib_qualisys.toml \\
      --fps 60 --format body_25b --out demo.mcap")]
pub(super) struct Arguments {
    #[command(subcommand)]
    source: Source,
}

#[derive(Debug, Subcommand)]
enum Source {
    Openpose(Openpose),
}

/// A folder with one subfolder of OpenPose JSON files per camera.
#[derive(Debug, Args)]
#[command(after_help = "\
Capture time is the frame number in the file name divided by --fps. Subfolders are matched to
calibrated cameras by name, then by order; the matches are printed, with a warning for those by
order.

Example:
  bundlemocap import openpose demo/pose --calibration demo/Calib_qualisys.toml \\
      --fps 60 --format body_25b --out demo.mcap")]
struct Openpose {
    /// Folder with one subfolder per camera.
    folder: PathBuf,
    /// Calibration: Pose2Sim or aniposelib TOML, or Qualisys .qca.txt.
    #[arg(long)]
    calibration: PathBuf,
    /// Frame rate of the cameras, 1 to 1000 Hz; a number, or a ratio such as 60000/1001.
    #[arg(long, value_parser = ratio, allow_negative_numbers = true)]
    fps: f64,
    /// Keypoint format: body_25, body_25b, coco_17, halpe_26 or coco_wholebody_133.
    #[arg(long)]
    format: String,
    /// Recording to write.
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Up axis of the calibration's world: y or z.
    #[arg(long, default_value = "z", value_parser = up)]
    up: Up,
}

pub(super) fn up(name: &str) -> Result<Up, String> {
    Up::from_name(name).ok_or_else(|| "use y or z".to_owned())
}

impl From<ImportError> for Failure {
    fn from(error: ImportError) -> Self {
        use ImportError as E;
        let exit = match &error {
            E::Read { .. } => Exit::Unreadable,
            E::Camera { .. } => Exit::BadCalibration,
            E::NoCameraFolders { .. } | E::EmptyCameraFolder { .. } => Exit::NoDetections,
            E::CameraWithoutCalibration { .. } | E::CalibrationWithoutCamera { .. } => {
                Exit::CameraMismatch
            }
            E::PointCount { .. } | E::UnknownFormat { .. } => Exit::KeypointFormat,
            E::FrameRate { .. } => Exit::Usage,
            _ => Exit::Malformed,
        };
        Self::new(exit, error.to_string())
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    match &arguments.source {
        Source::Openpose(openpose) => run_openpose(openpose),
    }
}

fn run_openpose(arguments: &Openpose) -> Ended {
    arguments.overwrite.check(&arguments.out)?;
    let fps = frame_rate_option(arguments.fps)?;
    let format = keypoint_format(&arguments.format)?;
    let rig = read_calibration(&arguments.calibration, arguments.up)?;
    let mut folder = OpenposeFolder::open(&arguments.folder, &rig, format, fps)?;
    say(&table(&matches(&folder, &rig)));
    let by_order = folder.matches().iter().filter(|pair| pair.by == MatchedBy::Order).count();
    if by_order > 0 {
        let text = "folders have no camera's name and were matched by order, which may be wrong; \
                    `bundlemocap check` tells";
        complain("warning", &format!("{by_order} {text}"));
    }

    let mut writer = Writer::create(&arguments.out, Topics::default(), &provenance(arguments))?;
    let bar = progress(folder.file_count(), "files");
    let mut has_rig = false;
    for detections in folder.by_ref() {
        let detections = detections?;
        if !has_rig {
            writer.rig(&rig, detections.capture)?;
            has_rig = true;
        }
        let camera = &rig.cameras[detections.camera];
        writer.keypoints(&detections, &camera.name, [camera.width, camera.height])?;
        bar.inc(1);
    }
    if !has_rig {
        writer.rig(&rig, Timestamp::default())?;
    }
    writer.finish()?;
    bar.finish_and_clear();
    for (camera, report) in rig.cameras.iter().zip(folder.reports()) {
        say(&format!("{}: {}", camera.name, found(report)));
    }
    if folder.frame_counts_differ() {
        say("the cameras have different numbers of frames; missing frames are bridged");
    }
    say(&format!("{}: {} files", arguments.out.display(), folder.file_count()));
    Ok(Exit::Done)
}

fn matches(folder: &OpenposeFolder, rig: &Rig) -> Vec<(String, String)> {
    let rows = folder.matches().iter().map(|pair| {
        let name = pair.folder.file_name().unwrap_or_default().to_string_lossy();
        let by = match pair.by {
            MatchedBy::Name => "by name",
            MatchedBy::Order => "by order",
        };
        (name.into_owned(), format!("-> {} ({by})", rig.cameras[pair.camera].name))
    });
    rows.collect()
}

/// Counts of one camera, with all irregularities.
fn found(report: &CameraReport) -> String {
    let mut text = format!(
        "{} files, frames {} to {}, {} people, {} points",
        report.files, report.first_frame, report.last_frame, report.people, report.points
    );
    let oddities = [
        (report.gaps, "frame numbers without a file"),
        (report.empty_files, "empty files"),
        (report.frames_without_people, "frames without people"),
        (report.people_without_points, "skipped people without points"),
        (report.non_finite_points, "skipped points that are not finite"),
        (report.clamped_confidences, "confidences above 1 set to 1"),
    ];
    for (count, what) in oddities.into_iter().filter(|(count, _)| *count > 0) {
        text += &format!("; {count} {what}");
    }
    text
}

/// The command, without the folders of its files.
fn provenance(arguments: &Openpose) -> Provenance {
    let last = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let command = format!(
        "bundlemocap import openpose {} --calibration {} --fps {} --format {}",
        last(&arguments.folder),
        last(&arguments.calibration),
        arguments.fps,
        arguments.format
    );
    Provenance { more: BTreeMap::from([("command".to_owned(), command)]), ..Provenance::default() }
}
