//! Files of other tools.
//!
//! - [`bvh`] and [`gltf`]: motions.
//! - [`trc`]: markers, as a reference.
//! - [`read_calibration`]: Pose2Sim or aniposelib TOML, and Qualisys `.qca.txt`, to a
//!   [`Rig`](crate::core::camera::Rig) in our world (metres, y up).
//! - [`OpenposeFolder`]: a folder with one subfolder of OpenPose JSON files per camera, as a
//!   stream of [`Detections`](crate::core::detections::Detections) in capture-time order.

pub mod bvh;
mod calibration;
pub mod gltf;
mod openpose;
pub mod trc;

use std::path::{Path, PathBuf};

pub use self::calibration::{Up, read_calibration, write_calibration};
pub use openpose::{CameraReport, FolderMatch, MatchedBy, OpenposeFolder};
pub use trc::{Trc, TrcError};

use crate::core::camera::CameraError;
use crate::core::detections::KeypointFormat;

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
}

impl ExportError {
    /// The error for a file at `path` that cannot be written.
    pub(crate) fn write(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Write { path: path.into(), source }
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
    #[error("{}: {what}; give a Pose2Sim or aniposelib TOML, or a Qualisys .qca.txt", path.display())]
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
    /// No subfolder holds JSON files.
    #[error(
        "{}: no subfolder holds .json files; give the folder with one subfolder of OpenPose \
         JSON files per camera", path.display()
    )]
    NoCameraFolders {
        /// The folder.
        path: PathBuf,
    },
    /// The subfolder of a calibrated camera has no JSON file.
    #[error(
        "{}: the folder of camera {camera} holds no .json file; put its detections there, or \
         remove the camera from the calibration", path.display()
    )]
    EmptyCameraFolder {
        /// The subfolder.
        path: PathBuf,
        /// The calibrated camera.
        camera: String,
    },
    /// There are more folders than cameras.
    #[error(
        "{}: no calibration for {folders}; calibrated are {cameras}; calibrate the camera or \
         move its folder away", path.display()
    )]
    CameraWithoutCalibration {
        /// Folder with one subfolder per camera.
        path: PathBuf,
        /// Folders without a camera.
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
    /// A JSON file that is broken or not from OpenPose.
    #[error("{}: {what}; OpenPose writes {{\"people\": [{{\"pose_keypoints_2d\": [x, y, c, ...]}}]}}", path.display())]
    NotOpenpose {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// The number of a person's values does not fit the format.
    #[error(
        "{}: person {person} has {found} numbers, {} needs {}; {fits}",
        path.display(), format.name(), 3 * format.len()
    )]
    PointCount {
        /// The file.
        path: PathBuf,
        /// Index of the person in the file.
        person: usize,
        /// How many numbers the person has.
        found: usize,
        /// The requested format.
        format: KeypointFormat,
        /// The formats with that length.
        fits: String,
    },
    /// An unknown keypoint format.
    #[error("unknown keypoint format {name}; known are {}", known_formats())]
    UnknownFormat {
        /// The given name.
        name: String,
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
        .ok_or_else(|| ImportError::UnknownFormat { name: name.to_owned() })
}

fn known_formats() -> String {
    KeypointFormat::ALL.map(KeypointFormat::name).join(", ")
}
