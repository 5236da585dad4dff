//! The figures of a solve: what `--json` prints, and the table.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;

use super::driver::{CameraErrors, Run};
use super::kept::KeptPose;
use crate::core::body::{Skeleton, TrackingState};
use crate::core::camera::Rig;
use crate::core::time::Timestamp;
use crate::core::tracker::EventKind;
use crate::io::recording::Report;
use crate::metrics::statistics::{median, percentiles};
use crate::metrics::{PoseErrors, pose_errors};
use crate::offline::{HoldOut, Reference};
use crate::research::experiments::real::acceleration;

/// Everything measured. Field names are part of the interface; README.md documents them.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Figures {
    pub(crate) version: &'static str,
    pub(crate) recording: String,
    pub(crate) frames: usize,
    pub(crate) frames_lost: usize,
    pub(crate) windows: usize,
    pub(crate) lost: usize,
    pub(crate) windows_without_performer: u64,
    pub(crate) frame_rate_hz: Option<f64>,
    pub(crate) reprojection: Reprojection,
    pub(crate) hold_out: Option<HoldOut>,
    pub(crate) mean_acceleration_m_s2: Option<f64>,
    pub(crate) truth: Option<Truth>,
    pub(crate) reference: Option<Reference>,
    pub(crate) solve_ms: Option<SolveTime>,
    pub(crate) frames_per_second: f64,
    pub(crate) events: BTreeMap<&'static str, u64>,
    pub(crate) damage: Vec<String>,
}

/// Median distance of detected points with confidence above 0.3 from the solved body, pixels.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Reprojection {
    pub(crate) median_px: Option<f64>,
    pub(crate) cameras: BTreeMap<String, Option<f64>>,
}

/// Distance from the recording's truth.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Truth {
    pub(crate) frames: usize,
    pub(crate) mpjpe_mm: f64,
    pub(crate) mpjpe_root_relative_mm: f64,
    pub(crate) rmse_mm: f64,
    pub(crate) mae_deg: f64,
    pub(crate) root_deg: f64,
    pub(crate) pck3_percent: f64,
    pub(crate) pck7_percent: f64,
}

/// Time to solve a window.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct SolveTime {
    pub(crate) p50: f64,
    pub(crate) p99: f64,
}

impl From<PoseErrors> for Truth {
    fn from(errors: PoseErrors) -> Self {
        Self {
            frames: errors.frames,
            mpjpe_mm: errors.mpjpe_mm,
            mpjpe_root_relative_mm: errors.mpjpe_root_relative_mm,
            rmse_mm: errors.rmse_mm,
            mae_deg: errors.mae_deg,
            root_deg: errors.root_deg,
            pck3_percent: errors.pck3_percent,
            pck7_percent: errors.pck7_percent,
        }
    }
}

/// The truth that a synthetic recording carries; no poses in others.
#[derive(Clone, Debug, Default)]
pub(crate) struct True {
    pub(crate) body: Skeleton,
    /// In order of capture time.
    pub(crate) poses: Vec<KeptPose>,
}

/// What the figures are made of.
pub(crate) struct Measured<'a> {
    pub(crate) recording: &'a std::path::Path,
    pub(crate) run: &'a Run,
    pub(crate) rig: &'a Rig,
    pub(crate) skeleton: &'a Skeleton,
    pub(crate) truth: &'a True,
    pub(crate) hold_out: Option<HoldOut>,
    pub(crate) reference: Option<Reference>,
    pub(crate) report: &'a Report,
    /// Reading and solving, without the outputs at the end.
    pub(crate) elapsed: Duration,
}

impl Figures {
    pub(crate) fn new(measured: Measured) -> Self {
        let Measured { run, rig, skeleton, .. } = &measured;
        let fps = frame_rate(&run.poses);
        let solve_ms: Vec<f64> = run.windows.iter().map(|window| window.solve_ms).collect();
        let is_lost = |pose: &&KeptPose| pose.state != TrackingState::Tracking;
        Self {
            version: env!("CARGO_PKG_VERSION"),
            recording: measured.recording.display().to_string(),
            frames: run.poses.len(),
            frames_lost: run.poses.iter().filter(is_lost).count(),
            windows: run.windows.len(),
            lost: run.lost(),
            windows_without_performer: run.count(EventKind::NobodyFound),
            frame_rate_hz: fps,
            reprojection: Reprojection::new(run, rig),
            mean_acceleration_m_s2: fps.and_then(|fps| acceleration(&run.poses, skeleton, fps)),
            truth: fps.and_then(|fps| truth(&run.poses, skeleton, measured.truth, fps)),
            solve_ms: percentiles(&solve_ms, [50.0, 99.0]).map(|[p50, p99]| SolveTime { p50, p99 }),
            frames_per_second: run.poses.len() as f64 / measured.elapsed.as_secs_f64().max(1e-9),
            events: EventKind::ALL.map(|kind| (kind.name(), run.count(kind))).into(),
            damage: losses(measured.report),
            hold_out: measured.hold_out,
            reference: measured.reference,
        }
    }

    /// The few that matter most, as name and value.
    pub(crate) fn headline(&self) -> Vec<(String, String)> {
        let mut facts = vec![
            ("frames".to_owned(), self.frames.to_string()),
            ("lost windows".to_owned(), format!("{} of {}", self.lost, self.windows)),
            ("reprojection, median".to_owned(), px(self.reprojection.median_px)),
            ("joint acceleration".to_owned(), unit(self.mean_acceleration_m_s2, 1, "m/s²")),
        ];
        let mut fact = |name: &str, value: String| facts.push((name.to_owned(), value));
        if let Some(held) = &self.hold_out {
            fact(&format!("hold-out {}", held.camera), px(held.median_px));
        }
        if let Some(truth) = &self.truth {
            fact("MPJPE", format!("{:.1} mm", truth.mpjpe_mm));
        }
        if let Some(reference) = &self.reference {
            fact("from the reference", format!("{:.1} mm", reference.mean_mm));
        }
        if let Some(SolveTime { p50, .. }) = self.solve_ms {
            fact("window solve, median", format!("{p50:.1} ms"));
        }
        facts
    }

    /// Rows of a name and a value, for people.
    pub(crate) fn rows(&self) -> Vec<(String, String)> {
        let mut rows = Rows::default();
        rows.add("frames", with_part(self.frames, self.frames_lost, "flagged"));
        rows.add("windows", with_part(self.windows, self.lost, "lost"));
        if self.windows_without_performer > 0 {
            let windows = self.windows_without_performer.to_string();
            rows.add("windows without a performer", windows);
        }
        rows.add("reprojection, median", px(self.reprojection.median_px));
        for (camera, error) in &self.reprojection.cameras {
            rows.add(&format!("  {camera}"), px(*error));
        }
        self.hold_out.iter().for_each(|held| rows.add_hold_out(held));
        rows.add("mean joint acceleration", unit(self.mean_acceleration_m_s2, 2, "m/s²"));
        self.truth.iter().for_each(|truth| rows.add_truth(truth));
        self.reference.iter().for_each(|reference| rows.add_reference(reference));
        if let Some(SolveTime { p50, p99 }) = self.solve_ms {
            rows.add("solve time, p50, p99", format!("{p50:.1} ms, {p99:.1} ms a window"));
        }
        rows.add("speed", format!("{:.0} frames/s", self.frames_per_second));
        rows.add("events", self.events_in_words());
        for damage in &self.damage {
            rows.add("damage", damage.clone());
        }
        rows.0
    }

    fn events_in_words(&self) -> String {
        let happened = self.events.iter().filter(|(_, count)| **count > 0);
        let happened: Vec<String> =
            happened.map(|(kind, count)| format!("{kind} {count}")).collect();
        if happened.is_empty() { "none".to_owned() } else { happened.join(", ") }
    }
}

/// Rows of a table being made.
#[derive(Default)]
struct Rows(Vec<(String, String)>);

impl Rows {
    fn add(&mut self, name: &str, value: String) {
        self.0.push((name.to_owned(), value));
    }

    fn add_hold_out(&mut self, held: &HoldOut) {
        let HoldOut { camera, median_px, points, frames, .. } = held;
        let value = format!("{} ({points} points, {frames} frames)", px(*median_px));
        self.add(&format!("hold-out {camera}, median"), value);
        let without = held.frames_without_performer;
        self.add("  frames without the performer", without.to_string());
    }

    fn add_truth(&mut self, truth: &Truth) {
        let (all, relative) = (truth.mpjpe_mm, truth.mpjpe_root_relative_mm);
        self.add("truth: MPJPE", format!("{all:.1} mm ({relative:.1} mm root-relative)"));
        self.add("truth: RMSE", format!("{:.1} mm", truth.rmse_mm));
        self.add("truth: MAE", format!("{:.2}° (root {:.2}°)", truth.mae_deg, truth.root_deg));
        let (three, seven) = (truth.pck3_percent, truth.pck7_percent);
        self.add("truth: PCK 3 cm, 7 cm", format!("{three:.1} %, {seven:.1} %"));
    }

    fn add_reference(&mut self, reference: &Reference) {
        let Reference { frames, mean_mm, worst_mid_hip_mm, worst_mid_hip_frame } = reference;
        self.add("reference: mean", format!("{mean_mm:.1} mm ({frames} frames)"));
        if let (Some(mm), Some(frame)) = (worst_mid_hip_mm, worst_mid_hip_frame) {
            self.add("reference: worst mid-hip", format!("{mm:.1} mm (frame {frame})"));
        }
    }
}

impl Reprojection {
    fn new(run: &Run, rig: &Rig) -> Self {
        let values = |errors: &CameraErrors| -> Vec<f64> {
            errors.all.iter().map(|&error| f64::from(error)).collect()
        };
        let all: Vec<f64> = run.errors_px.iter().flat_map(values).collect();
        let cameras = rig.cameras.iter().zip(&run.errors_px);
        let cameras =
            cameras.map(|(camera, errors)| (camera.name.clone(), median(&values(errors))));
        Self { median_px: median(&all), cameras: cameras.collect() }
    }
}

/// Poses a second, from the median distance in time; `None` for fewer than two.
pub(crate) fn frame_rate(poses: &[KeptPose]) -> Option<f64> {
    let periods: Vec<f64> =
        poses.windows(2).map(|pair| (pair[1].capture - pair[0].capture) as f64).collect();
    median(&periods).filter(|period| *period > 0.0).map(|period| 1e9 / period)
}

/// Errors of the tracked poses that have a true pose within a tenth of a frame.
fn truth(poses: &[KeptPose], skeleton: &Skeleton, truth: &True, fps: f64) -> Option<Truth> {
    let tolerance = (0.1e9 / fps) as i64;
    let true_pose_at = |at: Timestamp| {
        let next = truth.poses.partition_point(|pose| pose.capture + tolerance < at);
        truth.poses.get(next).filter(|pose| pose.capture - at <= tolerance)
    };
    let pairs = poses.iter().filter(|pose| pose.is_tracked()).filter_map(|pose| {
        let true_posture = true_pose_at(pose.capture)?.pose().posture(&truth.body);
        Some((pose.pose().posture(skeleton), true_posture))
    });
    pose_errors(pairs).map(Truth::from)
}

/// What was lost of a recording, a line each.
pub(crate) fn losses(report: &Report) -> Vec<String> {
    let damage = report.damage.iter().map(ToString::to_string);
    let undecodable = report.undecodable.iter().map(|(topic, lost)| {
        format!("{} messages of {topic} cannot be used, the first: {}", lost.count, lost.first)
    });
    damage.chain(undecodable).collect()
}

fn with_part(all: usize, part: usize, what: &str) -> String {
    format!("{all} ({part} {what})")
}

fn px(value: Option<f64>) -> String {
    unit(value, 1, "px")
}

fn unit(value: Option<f64>, digits: usize, unit: &str) -> String {
    value.map_or_else(|| "none".to_owned(), |value| format!("{value:.digits$} {unit}"))
}
