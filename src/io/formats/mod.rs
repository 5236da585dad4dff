//! Files of other tools.
//!
//! - [`bvh`], [`gltf`], [`usd`], [`npz`] and [`pose_table`] (CSV): motions.
//! - Markers: [`trc`], [`c3d`], as [`Trajectories`]; [`joint_angles`] (.mot, CSV).
//! - [`read_calibration`]: calibrations of many programs, to a
//!   [`Rig`](crate::core::camera::Rig) in our world (metres, y up).
//! - [`DetectionFolder`]: the detections of many programs, as a stream of
//!   [`Detections`](crate::core::detections::Detections) in capture-time order.

mod animation;
pub mod bvh;
pub mod c3d;
mod calibration;
mod detections;
mod frame_rate;
pub mod gltf;
pub mod joint_angles;
pub mod npz;
mod pickle;
mod point_names;
pub mod pose_table;
mod style;
mod trajectories;
pub mod trc;
pub mod usd;

use std::path::{Path, PathBuf};

pub use self::calibration::{
    Auto, Calibration, Convention, Poses, UP_IS_GUESSED, Unit, Up, calibration_files,
    read_calibration, write_calibration, write_opencv,
};
pub use animation::Description;
pub use detections::{
    CameraReport, DetectionFolder, DetectionOptions, FolderMatch, MatchedBy, PointOrder,
};
pub use frame_rate::{FrameRate, frame_rate_beside};
pub use style::{JointAxes, JointNames, RestPose, Style};
pub use trajectories::{MarkerMap, Trajectories, TrajectoryError};

use crate::core::camera::CameraError;
use crate::core::detections::KeypointFormat;

/// Reads a TRC or a C3D file; its content tells which. With a map, the trajectories are those of its points.
///
/// # Errors
/// The file is neither, is broken, or no marker is a point of ours.
pub fn read_trajectories(
    path: &Path,
    map: Option<&MarkerMap>,
) -> Result<Trajectories, TrajectoryError> {
    let bytes = std::fs::read(path)
        .map_err(|source| TrajectoryError::Unreadable { path: path.into(), source })?;
    let read = match c3d::is_c3d(&bytes) {
        true => c3d::parse(&bytes),
        false => trc::parse(&String::from_utf8_lossy(&bytes)),
    };
    let mut read = read.map_err(|error| error.in_file(path))?;
    match map {
        Some(map) => read = read.mapped(map, path)?,
        None => read.check_subject().map_err(|error| error.in_file(path))?,
    }
    read.checked().map_err(|error| error.in_file(path))
}

/// Why an export failed. A file appears whole or not at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum ExportError {
    #[error("{path}: cannot be written: {source}; check that the folder exists and has room")]
    Write { path: PathBuf, source: std::io::Error },
    #[error("{path}: pose {frame} has a value that is not finite; leave lost poses out")]
    NotFinite { path: PathBuf, frame: usize },
    #[error("{path}: frame rate {fps} is not valid; give one above 0")]
    FrameRate { path: PathBuf, fps: f64 },
    #[error("{path}: this format cannot name a camera {name:?}; rename the camera")]
    Name { path: PathBuf, name: String },
}

impl ExportError {
    /// The error for a file at `path` that cannot be written.
    pub(crate) fn write(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Write { path: path.into(), source }
    }

    /// Refuses a frame rate that is not above 0.
    fn check_rate(path: &Path, fps: f64) -> Result<(), Self> {
        match fps.is_finite() && fps > 0.0 {
            true => Ok(()),
            false => Err(Self::FrameRate { path: path.into(), fps }),
        }
    }
}

/// Why an import failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// A file or folder cannot be read.
    #[error("{}: cannot be read ({source}); check the path and its permissions", path.display())]
    Read {
        /// Path of the file or folder.
        path: PathBuf,
        /// The reason from the system.
        source: std::io::Error,
    },
    /// The file is not a known kind of calibration.
    #[error("{}: {what}; `bundlemocap rig --help` lists what is read", path.display())]
    NotACalibration {
        /// Path of the file.
        path: PathBuf,
        /// The fault, with its line or field.
        what: String,
    },
    /// A calibrated camera, or the set of them, cannot be used.
    #[error("{}: {source}", path.display())]
    Camera {
        /// The calibration.
        path: PathBuf,
        /// The camera and its fault.
        source: CameraError,
    },
    /// No subfolder and no file holds detections.
    #[error(
        "{}: no detections are found in it; give the folder with a subfolder or a file for each \
         camera{not_understood}", path.display()
    )]
    NoCameraFolders {
        /// The folder.
        path: PathBuf,
        /// Its files that hold none, for the message; empty without any.
        not_understood: String,
    },
    /// No file has a person.
    #[error(
        "{}: nobody is seen in any frame, so the order of the points is not known; give --format",
        path.display()
    )]
    NoPeople {
        /// The folder.
        path: PathBuf,
    },
    /// A folder or camera that was named is not there.
    #[error("{}: there is no {name}; there are {known}", path.display())]
    UnknownName {
        /// Folder with the detections.
        path: PathBuf,
        /// The given name.
        name: String,
        /// The known names.
        known: String,
    },
    /// Points are shares of an image whose size nobody says.
    #[error(
        "{}: camera {camera} has no image size, and its points are shares of the image; add width and height",
        path.display()
    )]
    NoImageSize {
        /// The calibration.
        path: PathBuf,
        /// The camera.
        camera: String,
    },
    /// There are more folders than cameras.
    #[error(
        "{}: no calibration for {folders}; calibrated are {cameras}; calibrate the camera, or move \
         away what is of no camera or of one that has other files", path.display()
    )]
    CameraWithoutCalibration {
        /// Folder with a subfolder or a file for each camera.
        path: PathBuf,
        /// Folders and files without a camera.
        folders: String,
        /// The calibrated cameras.
        cameras: String,
    },
    /// There are more cameras than folders.
    #[error(
        "{}: no folder for calibrated camera {cameras}; folders are {folders}; add its \
         detections or remove it from the calibration", path.display()
    )]
    CalibrationWithoutCamera {
        /// Folder with one subfolder per camera.
        path: PathBuf,
        /// Folders with JSON files.
        folders: String,
        /// Cameras without a folder.
        cameras: String,
    },
    /// A file name without a number, or with a number that is too large for a time.
    #[error(
        "{}: no usable frame number in the file name; name files like cam01_000123_keypoints.json",
        path.display()
    )]
    FrameNumber {
        /// The file.
        path: PathBuf,
    },
    /// Two files of one camera with the same frame number.
    #[error(
        "{}: frame {frame} appears twice ({first} and {second}); keep one recording per folder",
        path.display()
    )]
    DuplicateFrame {
        /// The camera's folder.
        path: PathBuf,
        /// The frame number.
        frame: u64,
        /// The first file name.
        first: String,
        /// The second file name.
        second: String,
    },
    /// A folder or a camera is given twice.
    #[error("{}: {name} gives a folder or a camera twice; give each once", path.display())]
    GivenTwice {
        /// Folder with the detections.
        path: PathBuf,
        /// The folder and the camera.
        name: String,
    },
    /// A file that is broken, or holds no detections.
    #[error("{}: {what}; `bundlemocap import --help` lists what is read", path.display())]
    NotDetections {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// The number of a person's points does not fit the order.
    #[error(
        "{}: person {person} has {found} points, {} needs {}; {}",
        path.display(), order.name, order.needs(), fitting(*found)
    )]
    PointCount {
        /// The file.
        path: PathBuf,
        /// Index of the person in the frame.
        person: usize,
        /// How many points the person has.
        found: usize,
        /// The order of the points.
        order: Box<PointOrder>,
    },
    /// A number of points that no order has.
    #[error(
        "{}: people have {count} points, which no known order has; say with --points where they are",
        path.display()
    )]
    UnknownCount {
        /// The folder.
        path: PathBuf,
        /// The number of points.
        count: usize,
    },
    /// A mapping of points that cannot be used.
    #[error("{}: {what}; --points FILE says where the points are", path.display())]
    Mapping {
        /// The mapping file, or the detections.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// An unknown keypoint format.
    #[error("unknown keypoint format {name}; known are {known}")]
    UnknownFormat {
        /// The given name.
        name: String,
        /// The known names.
        known: String,
    },
    /// The videos of the cameras have different frame rates, hertz.
    #[error(
        "{} has {hz:.3} frames a second, {} has {other:.3}; give the detections' frame rate (--fps 60, and --fps CAMERA=30 for a camera with another rate)",
        path.display(), second.display()
    )]
    FrameRates {
        /// A video.
        path: PathBuf,
        /// Its frame rate.
        hz: f64,
        /// Another video.
        second: PathBuf,
        /// Its frame rate.
        other: f64,
    },
    /// A frame rate that is not positive and finite.
    #[error("frame rate {fps} is not valid; give the cameras' rate, such as 60")]
    FrameRate {
        /// The given rate.
        fps: f64,
    },
}

impl ImportError {
    fn read(path: &Path, source: std::io::Error) -> Self {
        Self::Read { path: path.to_owned(), source }
    }
}

/// The keypoint format with that name (see [`KeypointFormat::name`]).
///
/// # Errors
/// [`ImportError::UnknownFormat`], which lists the known ones.
pub fn keypoint_format(name: &str) -> Result<KeypointFormat, ImportError> {
    KeypointFormat::from_name(name)
        .ok_or_else(|| unknown_format(name, KeypointFormat::ALL.map(KeypointFormat::name)))
}

fn unknown_format(name: &str, known: impl IntoIterator<Item = &'static str>) -> ImportError {
    let known = known.into_iter().collect::<Vec<_>>().join(", ");
    ImportError::UnknownFormat { name: name.to_owned(), known }
}

/// The orders with that many points, in words.
fn fitting(count: usize) -> String {
    let all: Vec<String> =
        PointOrder::of_count(count).into_iter().map(|order| order.name).collect();
    match all.is_empty() {
        true => "no known order has as many".to_owned(),
        false => format!("{} has as many", all.join(" or ")),
    }
}
