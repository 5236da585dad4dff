//! The cameras of a recording, checked and corrected.

use serde::Serialize;

use super::Error;
use super::first_pass::{CameraOffset, FirstPass};
use super::options::{Observer, Options};
use super::recording::Recording;
use crate::core::calibration::{self, Correction};
use crate::core::camera::Rig;
use crate::core::time::Timestamp;
use crate::diagnose::Finding;

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
    /// Cameras that change during the recording, for example because they are moved: they are not corrected.
    pub changed: Vec<ChangedCamera>,
}

/// A camera that changes during a recording: no calibration is right before and after it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChangedCamera {
    /// The camera.
    pub camera: String,
    /// How, for people; a time in it counts from the first used frame.
    pub what: String,
    /// Capture time of the change.
    pub at: Timestamp,
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
    let (mut corrections, mut changed) = (Vec::new(), Vec::new());
    if refine {
        let (cameras, found) = calibration::refine(&pass.tracks().1, &rig.cameras);
        let check = pass.evidence.check(&rig);
        let all = rig.cameras.iter_mut().zip(cameras).zip(found).zip(check.cameras);
        for (((camera, corrected), correction), check) in all {
            let name = camera.name.clone();
            let change = |finding: &Finding| Some((finding.what.clone(), finding.changes_at_ns?));
            // Wrong times are corrected.
            let change = check.findings.iter().find_map(change).filter(|_| check.times.is_none());
            match change {
                Some((what, ns)) => {
                    changed.push(ChangedCamera { camera: name, what, at: Timestamp::from_ns(ns) });
                }
                None => {
                    corrections.push(CameraCorrection { camera: name, correction });
                    *camera = corrected;
                }
            }
        }
    }
    let rig = recording.rig_with(rig.cameras.iter());
    Ok(CheckedCameras { rig, offsets: pass.offsets, corrections, notes: pass.notes, changed })
}
