//! What `solve` writes: poses.mcap while it solves, poses.bvh and report.html at the end.
//!
//! All three are made beside their places and renamed, so that a failure leaves none in part.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::driver::{Run, WindowSummary};
use super::figures::Figures;
use super::kept::KeptPose;
use crate::cli::failure::{Exit, Failure};
use crate::core::body::{Joint, Posture, Skeleton};
use crate::core::camera::Rig;
use crate::core::time::Timestamp;
use crate::core::tracker::{Event, Output};
use crate::io::formats::ExportError;
use crate::io::recording::{Provenance, Writer};
use crate::io::report::{
    AngleTrack, CameraErrors, Picture, ReportData, StickFigures, Table, WindowRow, flexion_deg,
    stick_figures, write_report,
};
use crate::io::wire::Topics;

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
pub(crate) struct OutputFolder {
    path: PathBuf,
    made: bool,
}

impl OutputFolder {
    pub(crate) fn make(path: &Path) -> Result<Self, Failure> {
        let made = !path.exists();
        std::fs::create_dir_all(path).map_err(|error| Failure::write(path, &error))?;
        Ok(Self { path: path.to_owned(), made })
    }

    pub(crate) fn file(&self, name: &str) -> PathBuf {
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
pub(crate) struct PoseFile {
    writer: Writer,
    rig: Arc<Rig>,
    cameras: Vec<String>,
    skeleton: Option<Arc<Skeleton>>,
    has_rig: bool,
    weights: String,
}

impl PoseFile {
    /// `rig` is that of the recording, `solved` the cameras that the machine has.
    pub(crate) fn create(
        path: &Path,
        rig: &Arc<Rig>,
        solved: &Rig,
        provenance: &Provenance,
    ) -> Result<Self, Failure> {
        Ok(Self {
            weights: provenance.weights.clone(),
            writer: Writer::create(path, Topics::default(), provenance)?,
            rig: Arc::clone(rig),
            cameras: solved.cameras.iter().map(|camera| camera.name.clone()).collect(),
            skeleton: None,
            has_rig: false,
        })
    }

    /// Writes one output.
    pub(crate) fn write(&mut self, output: &Output) -> Result<(), Failure> {
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
            Output::Keyframe(keyframe) => self.writer.keyframe(keyframe, &self.weights)?,
            Output::Event(event) => self.event(event)?,
            Output::Window(_) | Output::Solve(_) => {}
        }
        Ok(())
    }

    fn event(&mut self, event: &Event) -> Result<(), Failure> {
        let camera = event.camera.and_then(|camera| self.cameras.get(camera)).cloned();
        Ok(self.writer.event(&crate::io::wire::Event {
            capture_time_ns: event.capture.ns(),
            kind: event.kind.name().to_owned(),
            camera,
            window: event.window,
            count: event.count.max(1),
            detail: event.detail.clone(),
        })?)
    }

    /// Puts the file in its place.
    pub(crate) fn finish(self) -> Result<(), Failure> {
        Ok(self.writer.finish()?)
    }
}

/// Writes a text; the file appears whole or not at all.
pub(crate) fn text(path: &Path, text: &str) -> Result<(), Failure> {
    let failed = |error: std::io::Error| Failure::write(path, &error);
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let mut builder = tempfile::Builder::new();
    builder.prefix(".bundlemocap-").suffix(".part");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    let mut file = builder.tempfile_in(folder.unwrap_or_else(|| Path::new("."))).map_err(failed)?;
    file.write_all(text.as_bytes()).map_err(failed)?;
    file.persist(path).map_err(|error| failed(error.error))?;
    Ok(())
}

/// Writes report.html.
pub(crate) fn report(
    path: &Path,
    run: &Run,
    rig: &Rig,
    skeleton: &Skeleton,
    figures: &Figures,
) -> Result<(), Failure> {
    let start = run.poses.first().map_or_else(Timestamp::default, |pose| pose.capture);
    let recording = Path::new(&figures.recording).file_name().unwrap_or_default();
    let data = ReportData {
        title: recording.to_string_lossy().into_owned(),
        subtitle: format!("Solved by bundlemocap {}", figures.version),
        facts: figures.headline(),
        tables: vec![Table {
            title: "Figures".into(),
            header: vec!["figure".into(), "value".into()],
            rows: figures.rows().into_iter().map(|(name, value)| vec![name, value]).collect(),
        }],
        pictures: vec![Picture {
            title: "Poses".into(),
            svg: strip(&run.poses, skeleton, FIGURES),
        }],
        cameras: camera_errors(run, rig, start),
        angles: angles(&run.poses, skeleton, start),
        windows: run.windows.iter().map(|window| row(window, start)).collect(),
        ..ReportData::default()
    };
    Ok(write_report(path, &data)?)
}

/// Stick figures at `count` times, evenly spread.
pub(crate) fn strip(poses: &[KeptPose], skeleton: &Skeleton, count: usize) -> String {
    let (last, count) = (poses.len().saturating_sub(1), count.min(poses.len()));
    let chosen = (0..count).map(|i| &poses[i * last / (count - 1).max(1)]);
    let start = poses.first().map_or_else(Timestamp::default, |pose| pose.capture);
    let figures: Vec<(Posture, String)> = chosen
        .map(|pose| {
            let caption = format!("{:.2} s", pose.capture.seconds_since(start));
            (pose.pose().posture(skeleton), caption)
        })
        .collect();
    let figures = figures.iter().map(|(posture, caption)| (posture, caption.as_str()));
    stick_figures(figures, &StickFigures::default())
}

fn camera_errors(run: &Run, rig: &Rig, start: Timestamp) -> Vec<CameraErrors> {
    let cameras = rig.cameras.iter().zip(&run.errors_px).map(|(camera, errors)| {
        let frames = errors.frames.iter();
        let frames = frames.map(|(at, q)| (at.seconds_since(start), q.map(f64::from)));
        CameraErrors { name: camera.name.clone(), frames: frames.collect() }
    });
    cameras.collect()
}

fn angles(poses: &[KeptPose], skeleton: &Skeleton, start: Timestamp) -> Vec<AngleTrack> {
    let mut tracks = BENT.map(|joint| AngleTrack { joint, degrees: Vec::new() });
    for pose in poses {
        let seconds = pose.capture.seconds_since(start);
        let posture = pose.pose().posture(skeleton);
        for track in &mut tracks {
            track.degrees.extend(flexion_deg(&posture, track.joint).map(|deg| (seconds, deg)));
        }
    }
    tracks.into()
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
