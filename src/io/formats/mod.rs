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

/// Why an import failed. Its text says what is wrong, with units.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum ImportError {
    #[error("{}: cannot be read ({source}); check the path and its permissions", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{}: {what}; `bundlemocap rig --help` lists what is read", path.display())]
    NotACalibration { path: PathBuf, what: String },
    /// A calibrated camera, or the set of them, cannot be used.
    #[error("{}: {source}", path.display())]
    Camera { path: PathBuf, source: CameraError },
    /// `not_understood` is a part of the message; it may be empty.
    #[error(
        "{}: no detections are found in it; give the folder with a subfolder or a file for each \
         camera{not_understood}", path.display()
    )]
    NoCameraFolders { path: PathBuf, not_understood: String },
    #[error(
        "{}: nobody is seen in any frame, so the order of the points is not known; give --format",
        path.display()
    )]
    NoPeople { path: PathBuf },
    #[error("{}: there is no {name}; there are {known}", path.display())]
    UnknownName { path: PathBuf, name: String, known: String },
    #[error(
        "{}: camera {camera} has no image size, and its points are shares of the image; add width and height",
        path.display()
    )]
    NoImageSize { path: PathBuf, camera: String },
    #[error(
        "{}: no calibration for {folders}; calibrated are {cameras}; calibrate the camera, or move \
         away what is of no camera or of one that has other files", path.display()
    )]
    CameraWithoutCalibration { path: PathBuf, folders: String, cameras: String },
    #[error(
        "{}: no folder for calibrated camera {cameras}; folders are {folders}; add its \
         detections or remove it from the calibration", path.display()
    )]
    CalibrationWithoutCamera { path: PathBuf, folders: String, cameras: String },
    /// There is no number, or one that is too large for a time.
    #[error(
        "{}: no usable frame number in the file name; name files like cam01_000123_keypoints.json",
        path.display()
    )]
    FrameNumber { path: PathBuf },
    #[error(
        "{}: frame {frame} appears twice ({first} and {second}); keep one recording per folder",
        path.display()
    )]
    DuplicateFrame { path: PathBuf, frame: u64, first: String, second: String },
    #[error("{}: {name} gives a folder or a camera twice; give each once", path.display())]
    GivenTwice { path: PathBuf, name: String },
    #[error("{}: {what}; `bundlemocap import --help` lists what is read", path.display())]
    NotDetections { path: PathBuf, what: String },
    /// `person` is the index in the frame.
    #[error(
        "{}: person {person} has {found} points, {} needs {}; {}",
        path.display(), order.name, order.needs(), fitting(*found)
    )]
    PointCount { path: PathBuf, person: usize, found: usize, order: Box<PointOrder> },
    #[error(
        "{}: people have {count} points, which no known order has; say with --points where they are",
        path.display()
    )]
    UnknownCount { path: PathBuf, count: usize },
    #[error("{}: {what}; --points FILE says where the points are", path.display())]
    Mapping { path: PathBuf, what: String },
    #[error("unknown keypoint format {name}; known are {known}")]
    UnknownFormat { name: String, known: String },
    /// `hz` is the rate of `path`, `other` that of `second`.
    #[error(
        "{} has {hz:.3} frames a second, {} has {other:.3}; give the detections' frame rate (--fps 60, and --fps CAMERA=30 for a camera with another rate)",
        path.display(), second.display()
    )]
    FrameRates { path: PathBuf, hz: f64, second: PathBuf, other: f64 },
    #[error("frame rate {fps} is not valid; give the cameras' rate, such as 60")]
    FrameRate { fps: f64 },
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
