//! Why a recording cannot be solved.

use std::path::PathBuf;

use thiserror::Error;

use crate::core::camera::CameraError;
use crate::core::manifold::WeightsError;
use crate::io::formats::ExportError;
use crate::io::recording::RecordError;

/// Why a recording cannot be solved. No file is written then.
#[derive(Debug, Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum Error {
    /// The recording cannot be read, or poses.mcap cannot be written.
    #[error(transparent)]
    Recording(#[from] RecordError),
    #[error(
        "{} holds no keypoints but {held}; use a recording of `bundlemocap import` or \
         `bundlemocap synth`", path.display()
    )]
    NoKeypoints { path: PathBuf, held: String },
    #[error(
        "{}: {topic}: {reason}; import it again with the right --format",
        path.display()
    )]
    KeypointFormat { path: PathBuf, topic: String, reason: String },
    #[error("{} holds no calibrated rig; import it again with --calibration", path.display())]
    NoRig { path: PathBuf },
    #[error("{}: {reason}; correct the calibration and import it again", path.display())]
    BadRig { path: PathBuf, reason: String },
    #[error(
        "{}: camera {camera} was calibrated with images of {} x {}, its keypoints come from images \
         of {} x {}; calibrate at the detector's image size",
        path.display(), calibrated[0], calibrated[1], detected[0], detected[1]
    )]
    ImageSize { path: PathBuf, camera: String, calibrated: [u32; 2], detected: [u32; 2] },
    /// The chosen cameras are not a valid rig.
    #[error("{}: {source}", path.display())]
    Rig { path: PathBuf, source: CameraError },
    #[error(
        "{}: --cameras and --hold-out leave {left} of {all} cameras; two are needed", path.display()
    )]
    FewCameras { path: PathBuf, left: usize, all: usize },
    #[error(
        "{}: no calibration for camera {camera}; add it to the calibration and import again",
        path.display()
    )]
    Uncalibrated { path: PathBuf, camera: String },
    #[error("{} has no camera {name:?}; it has {known}", path.display())]
    NoSuchCamera { path: PathBuf, name: String, known: String },
    #[error(
        "{}: camera {camera} has no keypoints; record them, or name the other cameras with \
         --cameras", path.display()
    )]
    SilentCamera { path: PathBuf, camera: String },
    #[error("{}: camera {camera}: {reason}", path.display())]
    TimeUnit { path: PathBuf, camera: String, reason: String },
    #[error("{} has no keypoints from --start to --end", path.display())]
    EmptySpan { path: PathBuf },
    #[error("{}: nobody was found: {evidence}", path.display())]
    NobodyFound { path: PathBuf, evidence: String },
    #[error("all takes are too short to estimate a body; give longer ones")]
    ShortTakes,
    #[error("the embedded weights: {0}")]
    Weights(#[from] WeightsError),
    #[error("{} exists; choose another folder, or replace it with --overwrite", path.display())]
    Exists { path: PathBuf },
    #[error("{} is a file; the outputs need a folder", path.display())]
    NoFolder { path: PathBuf },
    #[error(
        "cannot write {}: {source}; check that the folder exists, is writable and has space",
        path.display()
    )]
    Write { path: PathBuf, source: std::io::Error },
    #[error(transparent)]
    Export(#[from] ExportError),
    /// The observer ended it.
    #[error("{} is not solved: it was stopped", path.display())]
    Stopped { path: PathBuf },
}
