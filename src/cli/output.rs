//! What `solve` writes: poses.mcap while it solves, poses.bvh and report.html at the end.
//!
//! All three are made beside their places and renamed, so that a failure leaves none in part.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::failure::{Exit, Failure};
use super::figures::Figures;
use super::run::{Run, WindowSummary};
use crate::body::{Joint, Posture, Skeleton};
use crate::camera::Rig;
use crate::eval::statistics::percentiles;
use crate::export::{
    AngleTrack, CameraErrors, ExportError, Picture, ReportData, StickFigures, WindowRow,
    flexion_deg, stick_figures, write_bvh, write_report,
};
use crate::msg::{StampedKeyframe, Topics};
use crate::record::{Provenance, Writer};
use crate::time::Timestamp;
use crate::track::{Event, KeyframeAt, Output};

/// Stick figures in the report.
const FIGURES: usize = 9;
/// Angles over time in the report.
const BENT: [Joint; 4] = [Joint::LKnee, Joint::RKnee, Joint::LElbow, Joint::RElbow];

impl From<ExportError> for Failure {
    fn from(error: ExportError) -> Self {
        Self::new(Exit::Unexpected, error.to_string())
    }
}

/// A folder for outputs. If it had to be made and stays empty, it goes when this is dropped.
pub(super) struct OutputFolder {
    path: PathBuf,
    made: bool,
}

impl OutputFolder {
    pub(super) fn make(path: &Path) -> Result<Self, Failure> {
        let made = !path.exists();
        std::fs::create_dir_all(path).map_err(|error| Failure::write(path, &error))?;
        Ok(Self { path: path.to_owned(), made })
    }

    pub(super) fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        if self.made {
            // Fails where there is something in it, as there should be.
            let _ = std::fs::remove_dir(&self.path);
        }
    }
}

/// Writes the machine's outputs to poses.mcap as they come.
pub(super) struct PoseFile {
    writer: Writer,
    rig: Arc<Rig>,
    cameras: Vec<String>,
    skeleton: Option<Arc<Skeleton>>,
    has_rig: bool,
}

impl PoseFile {
    /// `rig` is that of the recording, `solved` the cameras that the machine has.
    pub(super) fn create(
        path: &Path,
        rig: &Arc<Rig>,
        solved: &Rig,
        provenance: &Provenance,
    ) -> Result<Self, Failure> {
        Ok(Self {
            writer: Writer::create(path, Topics::default(), provenance)?,
            rig: Arc::clone(rig),
            cameras: solved.cameras.iter().map(|camera| camera.name.clone()).collect(),
            skeleton: None,
            has_rig: false,
        })
    }

    /// Writes one output.
    pub(super) fn write(&mut self, output: &Output) -> Result<(), Failure> {
        match output {
            Output::Skeleton(skeleton) => self.skeleton = Some(Arc::clone(skeleton)),
            Output::Pose(pose) => {
                let Some(skeleton) = self.skeleton.clone() else { return Ok(()) };
                if !self.has_rig {
                    self.writer.rig(&self.rig, pose.capture)?;
                    self.writer.skeleton(&skeleton, pose.capture)?;
                    self.has_rig = true;
                }
                self.writer.pose(pose, &skeleton)?;
            }
            Output::Keyframe(keyframe) => self.keyframe(keyframe)?,
            Output::Event(event) => self.event(event)?,
            Output::Window(_) | Output::Solve(_) => {}
        }
        Ok(())
    }

    fn keyframe(&mut self, at: &KeyframeAt) -> Result<(), Failure> {
        let Some(skeleton) = &self.skeleton else { return Ok(()) };
        let stamped = StampedKeyframe {
            capture: at.capture,
            window: at.window,
            keyframe: at.keyframe.clone(),
            shape: *skeleton.shape(),
        };
        Ok(self.writer.keyframe(&stamped)?)
    }

    fn event(&mut self, event: &Event) -> Result<(), Failure> {
        let camera = event.camera.and_then(|camera| self.cameras.get(camera)).cloned();
        Ok(self.writer.event(&crate::msg::Event {
            capture_time_ns: event.capture.ns(),
            kind: event.kind.name().to_owned(),
            camera,
            window: event.window,
            count: event.count.max(1),
            detail: event.detail.clone(),
        })?)
    }

    /// Puts the file in its place.
    pub(super) fn finish(self) -> Result<(), Failure> {
        Ok(self.writer.finish()?)
    }
}

/// Writes poses.bvh.
pub(super) fn bvh(path: &Path, run: &Run, skeleton: &Skeleton, fps: f64) -> Result<(), Failure> {
    Ok(write_bvh(path, skeleton, fps, run.poses.iter().map(|pose| &pose.pose))?)
}

/// Writes report.html.
pub(super) fn report(
    path: &Path,
    run: &Run,
    rig: &Rig,
    skeleton: &Skeleton,
    figures: &Figures,
) -> Result<(), Failure> {
    let start = run.poses.first().map_or_else(Timestamp::default, |pose| pose.capture);
    let postures: Vec<(f64, Posture)> = (run.poses.iter())
        .map(|pose| (pose.capture.seconds_since(start), pose.pose.posture(skeleton)))
        .collect();
    let recording = Path::new(&figures.recording).file_name().unwrap_or_default();
    let data = ReportData {
        title: recording.to_string_lossy().into_owned(),
        subtitle: format!("Solved by bundlemocap {}", figures.version),
        facts: figures.rows(),
        tables: Vec::new(),
        pictures: vec![Picture { title: "Poses".into(), svg: strip(&postures, FIGURES) }],
        cameras: camera_errors(run, rig, start),
        angles: BENT.into_iter().map(|joint| angle(joint, &postures)).collect(),
        windows: run.windows.iter().map(|window| row(window, start)).collect(),
    };
    Ok(write_report(path, &data)?)
}

/// Stick figures at `count` times, evenly spread.
pub(super) fn strip(postures: &[(f64, Posture)], count: usize) -> String {
    let last = postures.len().saturating_sub(1);
    let chosen: Vec<usize> = (0..count.min(postures.len()))
        .map(|i| i * last / (count.min(postures.len()) - 1).max(1))
        .collect();
    let captions: Vec<String> =
        chosen.iter().map(|&index| format!("{:.2} s", postures[index].0)).collect();
    let figures = chosen.iter().zip(&captions);
    let figures = figures.map(|(&index, caption)| (&postures[index].1, caption.as_str()));
    stick_figures(figures, &StickFigures::default())
}

/// Quartiles by frame.
fn camera_errors(run: &Run, rig: &Rig, start: Timestamp) -> Vec<CameraErrors> {
    let by_frame = |errors: &[(Timestamp, f32)]| {
        let frames = errors.chunk_by(|a, b| a.0 == b.0).filter_map(|frame| {
            let values: Vec<f64> = frame.iter().map(|(_, error)| f64::from(*error)).collect();
            let seconds = frame.first()?.0.seconds_since(start);
            Some((seconds, percentiles(&values, [25.0, 50.0, 75.0])?))
        });
        frames.collect()
    };
    (rig.cameras.iter().zip(&run.errors_px))
        .map(|(camera, errors)| CameraErrors {
            name: camera.name.clone(),
            frames: by_frame(errors),
        })
        .collect()
}

fn angle(joint: Joint, postures: &[(f64, Posture)]) -> AngleTrack {
    let degrees = postures
        .iter()
        .filter_map(|(seconds, posture)| Some((*seconds, flexion_deg(posture, joint)?)))
        .collect();
    AngleTrack { joint, degrees }
}

fn row(window: &WindowSummary, start: Timestamp) -> WindowRow {
    WindowRow {
        start_s: window.start.seconds_since(start),
        end_s: window.end.seconds_since(start),
        latent_norm: window.latent_norm,
        iterations: window.iterations,
        cost: window.cost,
        solve_ms: window.solve_ms,
        lost: window.lost,
    }
}
