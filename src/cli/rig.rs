//! `bundlemocap rig`

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use nalgebra::Vector2;

use super::Ended;
use super::failure::{Exit, Failure};
use super::overwrite::{Overwrite, check_ending, is_no_input};
use super::terminal::{complain, note, say, table};
use crate::core::body::Joint;
use crate::core::camera::{Camera, Rig};
use crate::io::formats::{
    Auto, Calibration, Convention, Poses, Unit, Up, calibration_files, read_calibration,
    write_calibration, write_opencv,
};
use crate::io::recording::summary;
use crate::io::report::{Drawn, draw_rig};
use crate::offline::Recording;
use crate::offline::output::text;

/// Poses of a drawn path, at most.
const MAX_PATH: usize = 500;

/// Show, draw and convert the calibration of the cameras.
#[derive(Debug, Args)]
#[command(after_help = "\
Calibrations are found by their content. Read are:
  TOML     Pose2Sim, aniposelib, FreeMoCap, Caliscope, and this program's own
  JSON     Panoptic Studio, Human3.6M, multical, and alike
  YAML     OpenCV, EasyMocap (intri.yml and extri.yml beside each other, or their folder), Kalibr
  XML      OpenCV, Qualisys .qca.txt, Vicon .xcp, OptiTrack .mcal
  pickle   OpenCap's cameraIntrinsicsExtrinsics.pickle, in a folder for each camera
  text     COLMAP's cameras.txt and images.txt
A folder may hold a file for each camera. Cameras of TOML, JSON, YAML and XML need a matrix (K), a
rotation (R) and a translation (t), from the world to the camera, under any of the usual names.

Examples:
  bundlemocap rig show Calib.toml
  bundlemocap rig show intri.yml --out rig.svg
  bundlemocap rig show out/poses.mcap --out rig.svg
  bundlemocap rig convert cameras.json --out rig.toml
  bundlemocap rig convert take.mcap --out opencv.yml")]
pub(super) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Show(Show),
    Convert(Convert),
}

/// Print the cameras, and draw them from above and from the side.
#[derive(Debug, Args)]
#[command(after_help = "\
Prints for each camera the image size, the horizontal field of view, the position in metres (in
the world of the calibration, turned y up), and how far it looks up or down.

Of a recording of `solve`, the performers are drawn too: their way over the floor and one posture.

Examples:
  bundlemocap rig show Calib.toml
  bundlemocap rig show out/poses.mcap --out rig.svg")]
struct Show {
    /// Calibration, or recording with a calibration.
    file: PathBuf,
    /// Picture to write (SVG).
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    convention: ConventionArguments,
    #[command(flatten)]
    overwrite: Overwrite,
}

/// Convert a calibration to TOML or to OpenCV's YAML.
#[derive(Debug, Args)]
#[command(after_help = "\
The TOML is that of Pose2Sim and aniposelib, in metres with z up; it also says its unit and axis.
The YAML is OpenCV's FileStorage with EasyMocap's names (K_, dist_, R_, T_): EasyMocap reads a copy
of it as intri.yml and as extri.yml.

Examples:
  bundlemocap rig convert Calib.qca.txt --out rig.toml
  bundlemocap rig convert cameras.json --unit mm --up=-y --out rig.toml
  bundlemocap rig convert take.mcap --out opencv.yml")]
struct Convert {
    /// Calibration, or recording with a calibration.
    file: PathBuf,
    /// File to write; its ending (.toml, .yml) chooses the format.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Format, whatever the ending.
    #[arg(long, value_enum)]
    format: Option<Format>,
    #[command(flatten)]
    convention: ConventionArguments,
    #[command(flatten)]
    overwrite: Overwrite,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Format {
    /// Pose2Sim's and aniposelib's TOML.
    Toml,
    /// OpenCV's YAML with EasyMocap's names.
    Opencv,
}

impl Format {
    fn of(path: &Path) -> Result<Self, Failure> {
        let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
        match ending.to_str() {
            Some("toml") => Ok(Self::Toml),
            Some("yml" | "yaml") => Ok(Self::Opencv),
            _ => Err(Failure::new(
                Exit::Usage,
                format!("{}: the ending must be .toml or .yml; or give --format", path.display()),
            )),
        }
    }
}

/// How a calibration is read.
#[derive(Clone, Debug, Args)]
pub(super) struct ConventionArguments {
    /// Axis of the calibration's world that points up: x, y, z, -x, -y or -z; auto: by the cameras' images.
    #[arg(long, default_value_t, allow_hyphen_values = true)]
    pub(super) up: Auto<Up>,
    /// The calibration's unit of length: m, cm, mm, in, ft, or metres; auto: by the kind of file, or by the
    /// cameras' distances.
    #[arg(long, default_value_t)]
    pub(super) unit: Auto<Unit>,
    /// What the calibration's poses are: camera-from-world, as in OpenCV, or world-from-camera; auto: by where
    /// the cameras look.
    #[arg(long, default_value_t)]
    pub(super) poses: Auto<Poses>,
    /// Of several poses of the cameras in the calibration, those under this name, such as a subject's.
    #[arg(long, value_name = "NAME")]
    set: Option<String>,
}

impl ConventionArguments {
    pub(super) fn read(&self, path: &Path) -> Result<Calibration, Failure> {
        let Self { up, unit, poses, set } = self.clone();
        let convention = Convention { up, unit, poses, set, file_first: false };
        Ok(read_calibration(path, &convention)?)
    }

    /// Opens a recording with `rig`, or else with its own calibration, read in this way.
    pub(super) fn open(&self, path: &Path, rig: Option<&Rig>) -> Result<Recording, Failure> {
        let rig = rig.cloned().map_or_else(|| self.recorded_rig(path), |rig| Ok(Some(rig)))?;
        Ok(Recording::open_with(path, rig)?)
    }

    /// The calibration of a recording, read in this way; `None` if nothing was given.
    fn recorded_rig(&self, recording: &Path) -> Result<Option<Rig>, Failure> {
        if self.words().is_empty() {
            return Ok(None);
        }
        if self.set.is_some() {
            return Err(Failure::new(Exit::Usage, "--set needs a calibration file"));
        }
        // A recording always has these poses.
        let poses = Auto(self.poses.0.or(Some(Poses::CameraFromWorld)));
        let how = Self { poses, ..self.clone() };
        // As if it came from a calibration file.
        let file = tempfile::Builder::new().suffix(".toml").tempfile();
        let file = file.map_err(|error| Failure::new(Exit::Unexpected, error.to_string()))?;
        write_calibration(file.path(), &own_rig(recording)?, Up::Y)?;
        let read = how.read(file.path())?;
        tell(recording, &read);
        Ok(Some(read.rig))
    }

    /// As words of a command, each with a space before it; empty if nothing was given.
    pub(super) fn words(&self) -> String {
        let Self { up, unit, poses, set } = self;
        let up = (*up != Auto::default()).then(|| format!(" --up {up}"));
        let unit = (*unit != Auto::default()).then(|| format!(" --unit {unit}"));
        let set = set.as_ref().map(|set| format!(" --set {set}"));
        let poses = (*poses != Auto::default()).then(|| format!(" --poses {poses}"));
        up.into_iter().chain(unit).chain(poses).chain(set).collect()
    }
}

/// Says what kind of calibration it is, and what may be wrong.
pub(super) fn tell(path: &Path, read: &Calibration) {
    note(&format!("{}: {}", path.display(), read.summary()));
    for text in &read.notes {
        complain("warning", &format!("{}: {text}", path.display()));
    }
}

/// Reads a calibration and tells of it.
pub(super) fn read(path: &Path, how: &ConventionArguments) -> Result<Rig, Failure> {
    let read = how.read(path)?;
    tell(path, &read);
    Ok(read.rig)
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    match &arguments.command {
        Command::Show(show) => run_show(show),
        Command::Convert(convert) => run_convert(convert),
    }
}

fn run_convert(arguments: &Convert) -> Ended {
    let format = arguments.format.map_or_else(|| Format::of(&arguments.out), Ok)?;
    let inputs = calibration_files(&arguments.file)?;
    inputs.iter().try_for_each(|input| is_no_input(input, &arguments.out))?;
    arguments.overwrite.check(&arguments.out)?;
    let rig = of_file(&arguments.file, &arguments.convention)?;
    if matches!(format, Format::Opencv)
        && rig.cameras.iter().any(|camera| camera.time_offset.ns() != 0)
    {
        complain(
            "note",
            "the time offsets of the cameras have no place in the YAML; TOML keeps them",
        );
    }
    match format {
        Format::Toml => write_calibration(&arguments.out, &rig, Up::Z)?,
        Format::Opencv => write_opencv(&arguments.out, &rig, Up::Z)?,
    }
    say(&format!("{}: {} cameras, unit m, z up", arguments.out.display(), rig.cameras.len()));
    Ok(Exit::Done)
}

fn run_show(arguments: &Show) -> Ended {
    if let Some(out) = &arguments.out {
        arguments.overwrite.check_beside(&arguments.file, out)?;
        check_ending(out, "svg")?;
    }
    let rig = of_file(&arguments.file, &arguments.convention)?;
    say(&table(&rig.cameras.iter().map(row).collect::<Vec<_>>()));
    if let Some(out) = &arguments.out {
        // Poses are in the world of the recording's own calibration.
        let is_own = arguments.convention.words().is_empty();
        let people = if is_own { people(&arguments.file) } else { Vec::new() };
        text(out, &draw_rig(&rig, &people))?;
        say(&format!("{}: the cameras from above and from the side", out.display()));
    }
    Ok(Exit::Done)
}

/// The rig of a calibration or of a recording.
fn of_file(path: &Path, how: &ConventionArguments) -> Result<Rig, Failure> {
    if !is_recording(path) {
        return read(path, how);
    }
    how.recorded_rig(path)?.map_or_else(|| own_rig(path), Ok)
}

/// The rig of a recording.
fn own_rig(path: &Path) -> Result<Rig, Failure> {
    let rig = summary(path)?.first_rig.ok_or_else(|| {
        let what = format!("{} holds no calibration of cameras", path.display());
        Failure::new(Exit::NotOurs, what)
    })?;
    rig.to_core()
        .map_err(|error| Failure::new(Exit::BadCalibration, format!("{}: {error}", path.display())))
}

fn is_recording(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("mcap"))
}

fn row(camera: &Camera) -> (String, String) {
    let centre = camera.centre_in_world();
    // Between the rays of the middles of the left and the right edge.
    let [left, right] = [-0.5, f64::from(camera.width) - 0.5].map(|x| {
        let edge = Vector2::new(x, 0.5 * f64::from(camera.height) - 0.5);
        camera.undistort(&edge).map(|at| at.x.atan().to_degrees())
    });
    let view = left
        .zip(right)
        .map_or(String::new(), |(left, right)| format!("{:.0} degrees wide, ", right - left));
    let down = camera.rotation[(2, 1)].clamp(-1.0, 1.0).asin().to_degrees();
    let text = format!(
        "{} x {}, {view}at x {:.2}, y {:.2}, z {:.2} m, looks {:.0} degrees {}",
        camera.width,
        camera.height,
        centre.x,
        centre.y,
        centre.z,
        down.abs(),
        if down > 0.0 { "up" } else { "down" },
    );
    (camera.name.clone(), text)
}

/// The performers of a recording with poses.
fn people(path: &Path) -> Vec<Drawn> {
    if !is_recording(path) {
        return Vec::new();
    }
    let Ok(solved) = super::export::read(path, false, None) else { return Vec::new() };
    let drawn = |one: crate::offline::Motion| {
        let every = one.poses.len().div_ceil(MAX_PATH);
        let pelvis = |posture: crate::core::body::Posture| posture.positions[Joint::Pelvis.index()];
        let path = one.poses.iter().step_by(every);
        let path = path.map(|pose| pelvis(pose.pose().posture(&one.skeleton))).collect();
        let posture = one.poses[one.poses.len() / 2].pose().posture(&one.skeleton);
        Drawn { name: one.actor, posture, path }
    };
    solved.performers.into_iter().map(drawn).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::core::camera::Lens;

    #[test]
    fn the_width_of_view_is_that_of_the_lens() {
        let k = Matrix3::new(800.0, 0.0, 639.5, 0.0, 800.0, 511.5, 0.0, 0.0, 1.0);
        for (lens, wide) in [(Lens::Fisheye([0.0; 4]), 92), (Lens::IDEAL, 77)] {
            let (turn, at) = (Matrix3::identity(), Vector3::zeros());
            let camera = Camera::new("a", [1280, 1024], &k, lens, turn, at).unwrap();
            let said = row(&camera).1;
            assert!(said.contains(&format!("{wide} degrees wide")), "{said}");
        }
    }
}
