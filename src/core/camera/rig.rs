//! The cameras of one calibration.

use super::{Camera, CameraError};
use crate::core::time::Nanos;

/// Clocks of other epochs are less than a hundred years apart.
const MOST_OFFSET: Nanos = Nanos::new(100 * 365 * 24 * 3600 * 1_000_000_000);

/// Cameras with a common world frame.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Rig {
    /// Version of the calibration; a new calibration has a larger one.
    pub version: u64,
    /// At least two cameras with unique names. Other modules refer to a camera by its index here.
    pub cameras: Vec<Camera>,
}

impl Rig {
    /// Makes a rig. Checks that it has at least two cameras, with unique names and possible time offsets.
    ///
    /// # Errors
    /// [`CameraError::TooFewCameras`], [`CameraError::DuplicateName`] or [`CameraError::TimeOffset`].
    pub fn new(version: u64, cameras: Vec<Camera>) -> Result<Self, CameraError> {
        if cameras.len() < 2 {
            return Err(CameraError::TooFewCameras { found: cameras.len() });
        }
        for (i, camera) in cameras.iter().enumerate() {
            if camera.time_offset.abs() > MOST_OFFSET {
                let (camera, ms) = (camera.name.clone(), camera.time_offset.ms());
                return Err(CameraError::TimeOffset { camera, ms });
            }
            if cameras[..i].iter().any(|other| other.name == camera.name) {
                return Err(CameraError::DuplicateName { name: camera.name.clone() });
            }
        }
        Ok(Self { version, cameras })
    }

    /// The index of the camera with a name.
    pub fn index_of(&self, name: &str) -> Option<usize> {
        self.cameras.iter().position(|camera| camera.name == name)
    }

    /// Whether both have cameras of the same names in the same order.
    pub fn has_cameras_of(&self, other: &Self) -> bool {
        let names = self.cameras.iter().map(|camera| &camera.name);
        names.eq(other.cameras.iter().map(|camera| &camera.name))
    }

    /// By camera, by how much a new calibration of the same cameras changes the time offsets of this rig. These offsets
    /// include `corrections`, by camera. The result is empty if the calibrated offsets stay the same. Otherwise all
    /// corrections end, because they are relative to each other.
    pub fn offset_changes(&self, corrections: &[Nanos], new: &Self) -> Vec<Nanos> {
        let both = self.cameras.iter().zip(&new.cameras);
        let all: Vec<Nanos> = both.map(|(old, new)| new.time_offset - old.time_offset).collect();
        let is_same = all.iter().zip(corrections).all(|(by, correction)| *by == -*correction);
        if is_same { Vec::new() } else { all }
    }

    /// Adds to the time offsets, by camera; cameras without a value keep theirs.
    pub fn shift_times(&mut self, by: &[Nanos]) {
        by.iter().enumerate().for_each(|(camera, by)| self.shift_time(camera, *by));
    }

    /// Adds to the time offset of a camera, if there is that camera.
    pub fn shift_time(&mut self, camera: usize, by: Nanos) {
        if let Some(camera) = self.cameras.get_mut(camera) {
            camera.time_offset = camera.time_offset + by;
        }
    }
}
