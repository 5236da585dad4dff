//! `bundlemocap import`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;
use nalgebra::Vector3;
use tempfile::TempPath;

use super::Ended;
use super::failure::{Exit, Failure, failures, frame_rate_option, ratio};
use super::overwrite::{Overwrite, check_ending, is_no_input};
use super::rig::{ConventionArguments, tell};
use super::solve::Progress;
use super::terminal::{complain, note, progress, say, table};
use crate::core::camera::Rig;
use crate::diagnose::Check;
use crate::io::file_name;
use crate::io::formats::{
    Auto, Calibration, CameraReport, DetectionFolder, DetectionOptions, ExportError, FolderMatch,
    ImportError, MatchedBy, PointOrder, UP_IS_GUESSED, Unit, Up, frame_rate_beside,
};
use crate::io::new_file::temporary;
use crate::io::recording::{Provenance, Writer};
use crate::io::wire::Topics;
use crate::offline::{self, Recording};

/// Convert detections and calibration of other programs to a recording.
#[derive(Debug, Args)]
#[command(after_help = "\
FOLDER holds a subfolder or a file for each camera, found by content:
  OpenPose, Pose2Sim     a JSON file for each frame
  MMPose                 a JSON file for each frame, or one for all
  AlphaPose, COCO        a JSON file for all frames
  Ultralytics YOLO       a JSON file or a text file (labels) for each frame
  EasyMocap              a JSON file for each frame (annots)
  MediaPipe              a JSON file for each frame or one for all: points with x, y, visibility
  DeepLabCut             a CSV or h5 for all frames
  FreeMoCap              its recording folder, or the .npy with the 2D data of all cameras
  others                 a CSV with frame, NAME_x, NAME_y, NAME_c ..., perhaps camera and person
Also a trial's folder that holds these in `pose-sync` or `pose`, and one folder with the frames of all
videos, such as cam01_12.txt. Capture time is the frame number, in the file
or its name, divided by the frame rate.

The order of the points is found by their names or number; --format chooses another, and --points
gives any. This is a file for --points, with indices from 0 or the detector's names:
  [points]
  nose = 0
  left_shoulder = \"shoulder_L\"

The camera of a file is found by its name, or by the last number of its name. --camera gives it
otherwise. Files without such a name are given to the other cameras by order. If the images show that they belong to others of these cameras,
they are exchanged, and the list says so. Without --unit, the performer's height corrects the unit;
without --up, the performer tells the up axis where nothing else does.

At the end the recording is checked as `bundlemocap check` does. A broken, cut or empty file of a frame
is a missing frame. It is counted, and the first ten of each camera are named.

Examples:
  bundlemocap import Trial_1 --calibration Calib.toml --out trial.mcap
  bundlemocap import demo/pose --calibration demo/Calib.toml --fps 60 --out demo.mcap
  bundlemocap import take --calibration Calib.toml --fps 60 --fps phone=30 --out take.mcap
  bundlemocap import Trial_1 --calibration Calib.qca.txt --fps 60 --format body_25b --out t.mcap
  bundlemocap import json --calibration intri.yml --fps 60000/1001 --out take.mcap \\
      --camera left.json=cam01 --camera right.json=cam02")]
pub(super) struct Arguments {
    /// Folder with the detections of each camera, or a file with those of all.
    #[arg(required = true, num_args = 1..=2, value_name = "FOLDER")]
    folder: Vec<PathBuf>,
    /// Calibration; `bundlemocap rig --help` lists what is read.
    #[arg(long)]
    calibration: PathBuf,
    /// Frame rate of the cameras, 1 to 1000 Hz; a number, or a ratio such as 60000/1001. Without it, by
    /// Pose2Sim's Config.toml, or by the MP4 videos beside the detections. Also CAMERA=FPS, for a camera with another
    /// rate.
    #[arg(long, value_parser = rate, allow_negative_numbers = true, value_name = "FPS")]
    fps: Vec<(Option<String>, f64)>,
    /// Order of the points: body_25, body_25b, coco_17, halpe_26, coco_wholebody_133, mediapipe_33,
    /// openpose_18 or halpe_136. Without it, by their names or number.
    #[arg(long, conflicts_with = "points")]
    format: Option<String>,
    /// File that says where the points are in the detector's order.
    #[arg(long, value_name = "FILE")]
    points: Option<PathBuf>,
    /// Folder or file, and the camera that it is of. May be repeated.
    #[arg(long, value_name = "FOLDER=CAMERA", value_parser = assignment)]
    camera: Vec<(String, String)>,
    /// Recording to write.
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    convention: ConventionArguments,
    /// Refuse broken files, cameras of the calibration without detections, and detections of other cameras.
    #[arg(long)]
    strict: bool,
}

/// A frame rate, of a camera if it is named.
fn rate(text: &str) -> Result<(Option<String>, f64), String> {
    match text.split_once('=') {
        Some((camera, fps)) => Ok((Some(camera.to_owned()), ratio(fps)?)),
        None => Ok((None, ratio(text)?)),
    }
}

fn assignment(text: &str) -> Result<(String, String), String> {
    let (folder, camera) = text.split_once('=').ok_or("use FOLDER=CAMERA")?;
    Ok((folder.to_owned(), camera.to_owned()))
}

failures! {
    ImportError {
        ImportError::Read { .. } => Unreadable,
        ImportError::Camera { .. } | ImportError::NoImageSize { .. } => BadCalibration,
        ImportError::NoCameraFolders { .. } | ImportError::NoPeople { .. } => NoDetections,
        ImportError::CameraWithoutCalibration { .. } | ImportError::CalibrationWithoutCamera { .. } => CameraMismatch,
        ImportError::PointCount { .. }
        | ImportError::UnknownFormat { .. }
        | ImportError::UnknownCount { .. }
        | ImportError::Mapping { .. } => KeypointFormat,
        ImportError::FrameRate { .. }
        | ImportError::FrameRates { .. }
        | ImportError::UnknownName { .. }
        | ImportError::GivenTwice { .. } => Usage,
        _ => Malformed,
    }
}

impl Arguments {
    /// Cameras with a frame rate of their own.
    fn rates(&self) -> impl Iterator<Item = (String, f64)> {
        self.fps.iter().filter_map(|(camera, fps)| Some((camera.clone()?, *fps)))
    }

    /// `import openpose FOLDER` is `import FOLDER`: so it was once.
    fn folder(&self) -> Result<&Path, Failure> {
        match &self.folder[..] {
            [only] => Ok(only),
            [first, folder] if first.as_os_str() == "openpose" => Ok(folder),
            _ => Err(Failure::new(
                Exit::Usage,
                "give one folder: the one that holds the folders of the cameras".to_owned(),
            )),
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let path = arguments.folder()?;
    arguments.overwrite.check_beside(&arguments.calibration, &arguments.out)?;
    for input in arguments.points.iter().map(PathBuf::as_path).chain([path]) {
        is_no_input(input, &arguments.out)?;
    }
    check_ending(&arguments.out, "mcap")?;
    let order = arguments.format.as_deref().map(PointOrder::named).transpose()?;
    let fps = frame_rate(arguments, path)?;
    let (cameras, convention) = (arguments.camera.clone(), arguments.convention.clone());
    let attempt = Attempt { fps, order, cameras, convention };
    let mut best = Imported::of(arguments, path, attempt)?;
    best.exchange(arguments, path)?;
    best.measure(arguments, path)?;
    // Several orders have as many points: the one with which the cameras agree.
    for other in best.folder.others().to_vec() {
        let [one, another] = [&best.folder.order().name, &other.name].map(Clone::clone);
        let attempt = Attempt { order: Some(other), ..best.attempt.clone() };
        if best.replaced_by_better(arguments, path, attempt, Check::odd_order)? {
            complain("note", &format!("the points fit better as {another} than as {one}"));
            best.exchange(arguments, path)?;
            best.measure(arguments, path)?;
        }
    }
    tell(&arguments.calibration, &best.calibration);
    best.tell(&arguments.camera);
    let frames = best.folder.frame_count();
    best.file.persist(&arguments.out).map_err(|error| unwritable(arguments, error.error))?;
    say(&format!("{}: {frames} frames", arguments.out.display()));
    Ok(Exit::Done)
}

/// The given frame rate, or that of the files beside the detections.
fn frame_rate(arguments: &Arguments, folder: &Path) -> Result<f64, Failure> {
    let mut given = None;
    for (camera, fps) in &arguments.fps {
        let fps = frame_rate_option(*fps)?;
        if arguments.fps.iter().filter(|(other, _)| other == camera).count() > 1 {
            let message = match camera {
                Some(camera) => format!("--fps is given twice for camera {camera}"),
                None => "--fps is given twice; for one camera, write --fps CAMERA=FPS".to_owned(),
            };
            return Err(Failure::new(Exit::Usage, message));
        }
        if camera.is_none() {
            given = Some(fps);
        }
    }
    if let Some(fps) = given {
        return Ok(fps);
    }
    if let Err(error) = std::fs::metadata(folder) {
        let message = format!("{}: cannot be read ({error})", folder.display());
        return Err(Failure::new(Exit::Unreadable, message));
    }
    let Some((fps, file)) = frame_rate_beside(folder)? else {
        let message = format!(
            "{}: the frame rate is not known: no Config.toml with a number, no MP4 video; give --fps, such as --fps 60",
            folder.display()
        );
        return Err(Failure::new(Exit::Usage, message));
    };
    note(&format!("{fps:.3} frames a second, as {} has it (--fps)", file.display()));
    frame_rate_option(fps).map_err(|_| {
        let message = format!(
            "{}: {fps:.3} frames a second is no rate of cameras; give --fps",
            file.display()
        );
        Failure::new(Exit::Usage, message)
    })
}

/// What is not known until the cameras agree.
#[derive(Clone)]
struct Attempt {
    /// Frame rate, hertz.
    fps: f64,
    /// Order of the points; `None`: as their names or number tell.
    order: Option<PointOrder>,
    /// Files and their cameras, beside those by name.
    cameras: Vec<(String, String)>,
    /// How the calibration is read.
    convention: ConventionArguments,
}

fn unwritable(arguments: &Arguments, error: std::io::Error) -> Failure {
    ExportError::write(&arguments.out)(error).into()
}

/// A recording that was written, beside its place.
struct Imported {
    file: TempPath,
    /// Its cameras.
    calibration: Calibration,
    folder: DetectionFolder,
    attempt: Attempt,
    /// The judgement of the cameras, or why there is none.
    check: Result<Check, String>,
}

impl Imported {
    fn of(arguments: &Arguments, path: &Path, attempt: Attempt) -> Result<Self, Failure> {
        let file = temporary(&arguments.out);
        let file = file.map_err(|error| unwritable(arguments, error))?.into_temp_path();
        let calibration = attempt.convention.read(&arguments.calibration)?;
        let rig = &calibration.rig;
        let options = DetectionOptions {
            fps: attempt.fps,
            rates: arguments.rates().collect(),
            order: attempt.order.clone(),
            mapping: arguments.points.clone(),
            cameras: attempt.cameras.clone(),
            strict: arguments.strict,
        };
        let mut folder = DetectionFolder::open(path, rig, options)?;
        let provenance = provenance(arguments, path, &attempt);
        let mut writer = Writer::create(&file, Topics::default(), &provenance)?;
        let bar = progress(folder.frame_count(), "frames");
        let mut has_rig = false;
        for detections in folder.by_ref() {
            let detections = detections?;
            if !has_rig {
                writer.rig(rig, detections.capture)?;
                has_rig = true;
            }
            let camera = &rig.cameras[detections.camera];
            writer.keypoints(&detections, &camera.name, [camera.width, camera.height])?;
            bar.inc(1);
        }
        bar.finish_and_clear();
        if !has_rig {
            folder.notes().iter().for_each(|note| complain("note", note));
            let broken: u64 = folder.reports().iter().map(|report| report.broken_files).sum();
            let path = path.to_owned();
            return Err(match broken {
                0 => ImportError::NoPeople { path },
                _ => {
                    let what = format!("none of its {broken} files can be read");
                    ImportError::NotDetections { path, what }
                }
            }
            .into());
        }
        let both = folder.matches().iter().zip(folder.reports());
        let in_shares = both.filter(|(_, report)| report.shares);
        let mut cameras = in_shares.map(|(pair, _)| &rig.cameras[pair.camera].name);
        if let Some(camera) = cameras.find(|name| calibration.without_size.contains(*name)) {
            let (path, camera) = (arguments.calibration.clone(), camera.clone());
            return Err(ImportError::NoImageSize { path, camera }.into());
        }
        writer.finish()?;
        let check = check(&file).map(|mut check| {
            // The folder's notes say which cameras have no files.
            for (index, camera) in check.cameras.iter_mut().enumerate() {
                if folder.matches().iter().all(|pair| pair.camera != index) {
                    camera.findings.retain(|finding| finding.cause != "no_frames");
                }
            }
            check
        });
        Ok(Self { file, calibration, folder, attempt, check })
    }

    /// What is wrong with the cameras.
    fn warnings(&self) -> Vec<String> {
        match &self.check {
            Ok(check) => check.warnings().collect(),
            Err(error) => vec![format!("the cameras cannot be checked: {error}")],
        }
    }

    /// Imports in another way, and keeps it if the cameras agree and less is wrong.
    fn replaced_by_better(
        &mut self,
        arguments: &Arguments,
        path: &Path,
        attempt: Attempt,
        wrong: fn(&Check) -> f64,
    ) -> Result<bool, Failure> {
        let of = |one: &Self| one.check.as_ref().map_or(f64::INFINITY, wrong);
        let now = of(self);
        if now == 0.0 {
            return Ok(false);
        }
        // If that fails, the first recording stays.
        let Ok(again) = Self::of(arguments, path, attempt) else { return Ok(false) };
        let agrees = again.check.as_ref().is_ok_and(Check::agrees);
        let is_better = agrees && of(&again) < now;
        if is_better {
            *self = again;
        }
        Ok(is_better)
    }

    /// Gives the files without a camera's name to the cameras with which they agree.
    fn exchange(&mut self, arguments: &Arguments, path: &Path) -> Result<(), Failure> {
        while let Some(exchanged) = self.exchanged(&arguments.camera) {
            let cameras = arguments.camera.iter().cloned().chain(exchanged).collect();
            let order = Some(self.folder.order().clone());
            let attempt = Attempt { order, cameras, ..self.attempt.clone() };
            let wrong = |check: &Check| check.warnings().count() as f64;
            if !self.replaced_by_better(arguments, path, attempt, wrong)? {
                break;
            }
        }
        Ok(())
    }

    /// Imports with the calibration read in another way, and keeps that if less is wrong.
    fn read_again(
        &mut self,
        arguments: &Arguments,
        path: &Path,
        change: impl FnOnce(&mut ConventionArguments),
        wrong: fn(&Check) -> f64,
    ) -> Result<bool, Failure> {
        let mut attempt = self.attempt.clone();
        change(&mut attempt.convention);
        self.replaced_by_better(arguments, path, attempt, wrong)
    }

    /// Corrects what the performer shows to be wrong with the calibration, where the user says nothing.
    fn measure(&mut self, arguments: &Arguments, path: &Path) -> Result<(), Failure> {
        self.turn_poses(arguments, path)?;
        self.find_unit(arguments, path)?;
        self.find_up(arguments, path)
    }

    /// Turns all poses round if the cameras agree only then.
    fn turn_poses(&mut self, arguments: &Arguments, path: &Path) -> Result<(), Failure> {
        let inverse = Auto(Some(self.calibration.poses.inverse()));
        let is_inverted = |check: &Check| f64::from(check.finds("pose_inverted"));
        let is_open = arguments.convention.poses == Auto::default();
        if is_open && self.read_again(arguments, path, |how| how.poses = inverse, is_inverted)? {
            complain("note", &format!("the cameras agree if the poses are {inverse} (--poses)"));
        }
        Ok(())
    }

    /// Takes the unit in which the performer is an adult, if the performer is not as high as people are.
    fn find_unit(&mut self, arguments: &Arguments, path: &Path) -> Result<(), Failure> {
        let Calibration { unit, format, .. } = self.calibration;
        // COLMAP has no unit.
        if format == "COLMAP" {
            return Ok(());
        }
        let Ok(check) = self.check.as_ref() else { return Ok(()) };
        let Some(metres) = check.unit(unit.metres()) else { return Ok(()) };
        if arguments.convention.unit != Auto::default() {
            let fix = format!("with --unit {} the performer is an adult", Unit::of_metres(metres));
            complain("note", &fix);
            return Ok(());
        }
        let height = check.performer_height_m.unwrap_or_default() / unit.metres();
        let found = Unit::of_metres(metres);
        let change = |how: &mut ConventionArguments| how.unit = Auto(Some(found));
        if self.read_again(arguments, path, change, Check::odd_height)? {
            let text = format!(
                "the performer is {height:.1} units high: the unit is {found}, not {unit} (--unit)"
            );
            complain("note", &text);
        }
        Ok(())
    }

    /// Takes the performer's own up axis, if nothing else tells which axis is up.
    fn find_up(&mut self, arguments: &Arguments, path: &Path) -> Result<(), Failure> {
        let Calibration { up, up_is_guessed, .. } = self.calibration;
        let Some(check) = self.check.as_ref().ok().filter(|_| up_is_guessed) else { return Ok(()) };
        let upright = check.performer_up.map(Vector3::from);
        let found = upright.and_then(|upright| Up::along(&(up.calibration_from_world() * upright)));
        let is_lying = |check: &Check| f64::from(check.finds("up_axis"));
        if found == Some(up) {
            self.calibration.notes.retain(|note| note != UP_IS_GUESSED);
        } else if let Some(found) = found
            && self.read_again(arguments, path, |how| how.up = Auto(Some(found)), is_lying)?
        {
            let text = format!("{found} is taken as up: it points from hips to shoulders (--up)");
            complain("warning", &text);
        }
        Ok(())
    }

    /// The files that have no camera's name.
    fn unnamed<'a>(
        &'a self,
        given: &'a [(String, String)],
    ) -> impl Iterator<Item = &'a FolderMatch> {
        self.folder.matches().iter().filter(|pair| is_unnamed(pair, given))
    }

    /// The files without a camera's name, and the cameras whose images they have. `None`: they have these cameras
    /// already.
    fn exchanged(&self, given: &[(String, String)]) -> Option<Vec<(String, String)>> {
        let rig = &self.calibration.rig;
        let own: Vec<usize> = self.unnamed(given).map(|pair| pair.camera).collect();
        let check = self.check.as_ref().ok()?;
        let cameras = match (&own[..], self.folder.matches().len()) {
            ([], _) => return None,
            // Of two cameras nothing tells which one is wrong.
            ([a, b], 2) if rig.cameras.len() == 2 && !check.agrees() => {
                let mut all: Vec<usize> = (0..rig.cameras.len()).collect();
                all.swap(*a, *b);
                all
            }
            _ => check.exchanged(rig)?,
        };
        // A file with a camera's name keeps its camera. So do all files that would be exchanged with it.
        let has_file = |camera: usize| self.folder.matches().iter().any(|one| one.camera == camera);
        let is_free = |camera: usize| {
            let mut circle = std::iter::successors(Some(camera), |at| {
                Some(cameras[*at]).filter(|next| *next != camera)
            });
            circle.all(|one| own.contains(&one) || !has_file(one))
        };
        let of = |camera: usize| if is_free(camera) { cameras[camera] } else { camera };
        if own.iter().all(|camera| of(*camera) == *camera) {
            return None;
        }
        let pair = |pair: &FolderMatch| {
            (file_name(&pair.folder), rig.cameras[of(pair.camera)].name.clone())
        };
        Some(self.unnamed(given).map(pair).collect())
    }

    /// Says which files are whose, what was found, guessed and left out, and what is wrong.
    fn tell(&self, given: &[(String, String)]) {
        let Self { calibration: Calibration { rig, .. }, folder, check, .. } = self;
        say(&table(&matches(folder, rig, given)));
        let warnings = self.warnings();
        let unnamed = self.unnamed(given).count();
        if unnamed > 0 {
            let fits = |pair: &FolderMatch| {
                check.as_ref().is_ok_and(|check| check.cameras[pair.camera].fits())
            };
            let text =
                format!("{unnamed} of {} files have no camera's name", folder.matches().len());
            // If there are more cameras than files, other cameras may fit as well.
            let has_all = folder.matches().len() == rig.cameras.len();
            match has_all && warnings.is_empty() && self.unnamed(given).all(fits) {
                true => complain("note", &format!("{text}; the cameras agree")),
                false => complain(
                    "warning",
                    &format!("{text}, and may be of other cameras; use --camera"),
                ),
            }
        }
        for (pair, report) in folder.matches().iter().zip(folder.reports()) {
            say(&format!("{}: {}", rig.cameras[pair.camera].name, found(report)));
        }
        if folder.frame_counts_differ() {
            say("the cameras have different numbers of frames; missing frames are bridged");
        }
        for note in folder.notes() {
            complain("note", note);
        }
        for warning in &warnings {
            complain("warning", warning);
        }
    }
}

/// Judges the cameras of a recording.
fn check(path: &Path) -> Result<Check, String> {
    let checked = Recording::open(path).and_then(|mut recording| {
        let mut progress = Progress::over(recording.messages());
        let check = offline::check(&mut recording, &mut progress);
        progress.bar.finish_and_clear();
        check
    });
    checked.map_err(|error| error.to_string())
}

/// Whether neither the name nor the user says of which camera a file is.
fn is_unnamed(pair: &FolderMatch, given: &[(String, String)]) -> bool {
    let is_given = || given.iter().any(|(file, _)| *file == file_name(&pair.folder));
    match pair.by {
        MatchedBy::Name => false,
        MatchedBy::Order => true,
        MatchedBy::Given => !is_given(),
    }
}

/// The files and their cameras.
fn matches(
    folder: &DetectionFolder,
    rig: &Rig,
    given: &[(String, String)],
) -> Vec<(String, String)> {
    let rows = folder.matches().iter().map(|pair| {
        let by = match pair.by {
            MatchedBy::Given if is_unnamed(pair, given) => "exchanged",
            MatchedBy::Given => "as given",
            MatchedBy::Name => "by name",
            MatchedBy::Order => "by order",
        };
        (file_name(&pair.folder), format!("-> {} ({by})", rig.cameras[pair.camera].name))
    });
    rows.collect()
}

/// Counts of one camera, with all irregularities.
fn found(report: &CameraReport) -> String {
    let mut text = format!(
        "{} frames, numbers {} to {}, {} people, {} points",
        report.frames, report.first_frame, report.last_frame, report.people, report.points
    );
    let oddities = [
        (report.gaps, "frame numbers without a frame"),
        (report.broken_files, "broken files"),
        (report.frames_without_people, "frames without people"),
        (report.people_without_points, "skipped people without points"),
        (report.non_finite_points, "skipped points that are not finite"),
        (report.confidences_above_1, "confidences above 1, used as 1"),
    ];
    for (count, what) in oddities.into_iter().filter(|(count, _)| *count > 0) {
        text += &format!("; {count} {what}");
    }
    if report.left_out {
        text += "; points of hands and faces are left out";
    }
    text
}

/// The command, without the folders of its files.
fn provenance(arguments: &Arguments, folder: &Path, attempt: &Attempt) -> Provenance {
    let mut command = format!(
        "bundlemocap import {} --calibration {} --fps {}",
        file_name(folder),
        file_name(&arguments.calibration),
        attempt.fps,
    );
    for (camera, fps) in arguments.rates() {
        command += &format!(" --fps {camera}={fps}");
    }
    if let Some(format) = &arguments.format {
        command += &format!(" --format {format}");
    }
    if let Some(points) = &arguments.points {
        command += &format!(" --points {}", file_name(points));
    }
    for (file, camera) in &attempt.cameras {
        command += &format!(" --camera {file}={camera}");
    }
    command += &attempt.convention.words();
    if arguments.strict {
        command += " --strict";
    }
    Provenance { more: BTreeMap::from([("command".to_owned(), command)]), ..Provenance::default() }
}
