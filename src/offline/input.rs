//! A recording that is to be solved: its cameras, its rate of progress, its detections.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use prost::Name;

use crate::cli::failure::{Exit, Failure};
use crate::core::body::{Skeleton, StampedPose};
use crate::core::camera::{Camera, Rig};
use crate::core::detections::Detections;
use crate::io::recording::{CameraInfo, Info, Message, Reader, Report, summary};
use crate::io::wire;

/// A recording with keypoints and a rig that fit each other.
pub(crate) struct Recording {
    pub(crate) path: PathBuf,
    /// All cameras of the recording.
    pub(crate) rig: Arc<Rig>,
    /// Messages in it, as far as its index tells.
    pub(crate) messages: u64,
    /// Name of the keypoint format.
    pub(crate) format: String,
    /// Calibrated cameras of a whole file that have no keypoints.
    silent: Vec<String>,
}

/// What a message of a recording means here.
pub(crate) enum Item {
    /// What a camera saw; the index is that of the camera in the chosen rig.
    Detections(Detections),
    /// The true body; comes before the true poses.
    TrueBody(Box<Skeleton>),
    /// A true pose.
    TruePose(Box<StampedPose>),
}

impl Recording {
    /// Opens a recording and checks that its cameras fit its rig.
    pub(crate) fn open(path: &Path) -> Result<Self, Failure> {
        let info = summary(path)?;
        if info.cameras.is_empty() {
            return Err(without_keypoints(path, &info));
        }
        let rig = Arc::new(first_rig(path, &info)?);
        let messages = info.topics.values().map(|topic| topic.count).sum();
        let format = info.cameras.values().map(|camera| camera.format.clone()).next();
        let format = format.unwrap_or_default();
        let names = rig.cameras.iter().map(|camera| camera.name.clone());
        let is_silent = |name: &String| info.report.is_clean() && !info.cameras.contains_key(name);
        let silent = names.filter(is_silent).collect();
        let recording = Self { path: path.to_owned(), rig, messages, format, silent };
        recording.check_cameras(&info.cameras)?;
        Ok(recording)
    }

    /// Every camera with keypoints must be in the rig, with images of the calibrated size.
    fn check_cameras(&self, seen: &BTreeMap<String, CameraInfo>) -> Result<(), Failure> {
        let path = self.path.display();
        for (name, info) in seen {
            let Some(index) = self.rig.index_of(name) else {
                let fix = "add it to the calibration and import again";
                let message = format!("{path}: no calibration for camera {name}; {fix}");
                return Err(Failure::new(Exit::CameraMismatch, message));
            };
            let camera = &self.rig.cameras[index];
            let ([width, height], (w, h)) = (info.image_size, (camera.width, camera.height));
            if width > 0 && height > 0 && (width, height) != (w, h) {
                let message = format!(
                    "{path}: camera {name} was calibrated with images of {w} x {h}, its keypoints \
                     are of images of {width} x {height}; calibrate at the size that is detected in"
                );
                return Err(Failure::new(Exit::BadCalibration, message));
            }
        }
        Ok(())
    }

    /// The name in the rig of the camera that the user means: the same name, else the only one
    /// that differs in case, in `_`, `-` or blanks, or in leading zeros alone.
    pub(crate) fn camera(&self, name: &str) -> Result<&Camera, Failure> {
        let cameras = &self.rig.cameras;
        let alike = || cameras.iter().filter(|camera| plain(&camera.name) == plain(name));
        let found = cameras.iter().find(|camera| camera.name == name).or_else(|| {
            let mut alike = alike();
            alike.next().filter(|_| alike.next().is_none())
        });
        found.ok_or_else(|| {
            let names: Vec<&str> = cameras.iter().map(|camera| camera.name.as_str()).collect();
            let message = format!(
                "{} has no camera {name:?}; it has {}",
                self.path.display(),
                names.join(", ")
            );
            Failure::new(Exit::CameraMismatch, message)
        })
    }

    /// The rig of `only` those cameras (all if empty) but the one held out.
    pub(crate) fn chosen(
        &self,
        only: &[String],
        held_out: Option<&Camera>,
    ) -> Result<Rig, Failure> {
        let mut wanted = Vec::new();
        for name in only {
            wanted.push(self.camera(name)?.name.as_str());
        }
        let chosen = self.rig.cameras.iter().filter(|camera| {
            (wanted.is_empty() || wanted.contains(&camera.name.as_str()))
                && held_out.is_none_or(|held_out| held_out.name != camera.name)
        });
        let rig = Rig::new(self.rig.version, chosen.cloned().collect()).map_err(|error| {
            let message = format!("{}: {error}", self.path.display());
            Failure::new(Exit::BadCalibration, message)
        })?;
        match self.silent.iter().find(|name| rig.index_of(name).is_some()) {
            None => Ok(rig),
            Some(name) => {
                let fix = "record them, or name the other cameras with --cameras";
                let path = self.path.display();
                let message = format!("{path}: camera {name} has no keypoints; {fix}");
                Err(Failure::new(Exit::CameraMismatch, message))
            }
        }
    }

    /// Streams the recording: every detection of a camera of `rig`, and the truth if there is
    /// some. Says what was lost of the file.
    pub(crate) fn stream(
        &self,
        rig: &Rig,
        mut each_message: impl FnMut(),
        mut take: impl FnMut(Item) -> Result<(), Failure>,
    ) -> Result<Report, Failure> {
        let mut reader = Reader::open(&self.path)?;
        while let Some(entry) = reader.next() {
            let entry = entry?;
            each_message();
            match entry.message {
                Message::Keypoints(frame) => {
                    let Some(camera) = rig.index_of(&frame.camera) else { continue };
                    match frame.to_core(|_| Some(camera)) {
                        Ok(detections) => take(Item::Detections(detections))?,
                        Err(error) => reader.reject(&entry.topic, &error),
                    }
                }
                Message::TruthSkeleton(skeleton) => match skeleton.to_core() {
                    Ok(skeleton) => take(Item::TrueBody(Box::new(skeleton)))?,
                    Err(error) => reader.reject(&entry.topic, &error),
                },
                Message::TruthPose(pose) => match pose.to_core() {
                    Ok(pose) => take(Item::TruePose(Box::new(pose)))?,
                    Err(error) => reader.reject(&entry.topic, &error),
                },
                _ => {}
            }
        }
        Ok(reader.report().clone())
    }
}

/// Why a recording in which no camera has keypoints cannot be solved.
fn without_keypoints(path: &Path, info: &Info) -> Failure {
    const SHOWN: usize = 8;
    if let Some((topic, reason)) = refused::<wire::KeypointFrame>(info) {
        let fix = "import it again with the --format that the keypoints are in";
        let message = format!("{}: {topic}: {reason}; {fix}", path.display());
        return Failure::new(Exit::KeypointFormat, message);
    }
    let topics: Vec<&str> = info.topics.keys().map(String::as_str).take(SHOWN).collect();
    let held = if topics.is_empty() { "nothing".to_owned() } else { topics.join(", ") };
    let message = format!(
        "{} holds no keypoints but {held}; give a recording from `bundlemocap import` or \
         `bundlemocap synth`",
        path.display()
    );
    Failure::new(Exit::NotOurs, message)
}

/// The first rig of a recording. It need not come before the first keypoints.
fn first_rig(path: &Path, info: &Info) -> Result<Rig, Failure> {
    let bad = |reason: &str| {
        let fix = "correct the calibration and import it again";
        Failure::new(Exit::BadCalibration, format!("{}: {reason}; {fix}", path.display()))
    };
    for entry in Reader::open(path)? {
        if let Message::Rig(rig) = entry?.message {
            return rig.to_core().map_err(|error| bad(&error.to_string()));
        }
    }
    Err(refused::<wire::Rig>(info).map_or_else(
        || {
            let fix = "import it again with --calibration";
            let message = format!("{} holds no calibrated rig; {fix}", path.display());
            Failure::new(Exit::NotOurs, message)
        },
        |(topic, reason)| bad(&format!("{topic}: {reason}")),
    ))
}

/// The first topic of a schema with messages that could not be used, and why the first could not.
fn refused<T: Name>(info: &Info) -> Option<(&str, &str)> {
    let schema = T::full_name();
    let of_schema = |topic: &&String| info.topics.get(*topic).is_some_and(|t| t.schema == schema);
    let topic = info.report.undecodable.keys().find(of_schema)?;
    Some((topic, &info.report.undecodable[topic].first))
}

/// A name without what differs between tools: case, separators, leading zeros of numbers.
fn plain(name: &str) -> String {
    let mut plain = String::new();
    let mut digits = String::new();
    for c in name.chars().chain(['\0']) {
        if c.is_ascii_digit() {
            digits.push(c);
            continue;
        }
        if !digits.is_empty() {
            let number = digits.trim_start_matches('0');
            plain.push_str(if number.is_empty() { "0" } else { number });
            digits.clear();
        }
        plain.extend(c.to_lowercase().filter(|c| c.is_alphanumeric()));
    }
    plain
}

#[cfg(test)]
mod tests {
    use super::plain;

    #[test]
    fn names_match_across_tools() {
        assert_eq!(plain("cam01"), plain("cam_1"));
        assert_eq!(plain("Cam 01"), plain("cam-01"));
        assert_ne!(plain("cam01"), plain("cam10"));
        assert_ne!(plain("cam0"), plain("cam"));
    }
}
