//! The cameras of a recording, checked and corrected.

use serde::Serialize;

use super::Error;
use super::first_pass::{CameraOffset, FirstPass};
use super::options::{Observer, Options};
use super::recording::Recording;
use crate::core::calibration::{self, Correction};
use crate::core::camera::{Camera, Rig};

/// A camera's small correction.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraCorrection {
    /// The camera.
    pub camera: String,
    /// The correction.
    #[serde(flatten)]
    pub correction: Correction,
}

/// The cameras of a recording checked against the performer's motion.
#[derive(Clone, Debug)]
pub struct CheckedCameras {
    /// All cameras, with the significant offsets and corrections.
    pub rig: Rig,
    /// Their time offsets; none with [`Options::no_sync`].
    pub offsets: Vec<CameraOffset>,
    /// Their corrections, if asked for.
    pub corrections: Vec<CameraCorrection>,
    /// What else is wrong with their times; no calibration can correct it, [`solve`](super::solve) does.
    pub notes: Vec<String>,
}

/// Estimates the time offsets of a recording's cameras and, if wanted, corrects the cameras after
/// that.
///
/// # Errors
/// As [`solve`](super::solve).
pub fn check_cameras(
    recording: &mut Recording,
    options: &Options,
    refine: bool,
    observer: &mut dyn Observer,
) -> Result<CheckedCameras, Error> {
    let (mut rig, _) = recording.chosen(&options.cameras, &[])?;
    let period = recording.frame_period(&rig)?;
    let pass = FirstPass::run(recording, options, &mut rig, period, &mut [], observer)?;
    pass.lead(recording)?;
    let mut corrections = Vec::new();
    if refine {
        let found;
        (rig.cameras, found) = calibration::refine(&pass.tracks().1, &rig.cameras);
        let all = rig.cameras.iter().zip(found);
        let named = |(camera, correction): (&Camera, _)| CameraCorrection {
            camera: camera.name.clone(),
            correction,
        };
        corrections = all.map(named).collect();
    }
    let rig = recording.rig_with(rig.cameras.iter());
    Ok(CheckedCameras { rig, offsets: pass.offsets, corrections, notes: pass.notes })
}
