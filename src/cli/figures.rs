//! The figures of a solve: what `--json` prints, and the table.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;

use super::hold_out::HoldOut;
use super::reference::Reference;
use super::run::Run;
use crate::body::{Posture, Skeleton, StampedPose, TrackingState};
use crate::camera::Rig;
use crate::eval::statistics::{median, percentiles};
use crate::eval::{PoseErrors, mean_acceleration, pose_errors};
use crate::record::Report;
use crate::time::Timestamp;
use crate::track::EventKind;

/// Everything measured. Field names are part of the interface; README.md documents them.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Figures {
    pub(super) version: &'static str,
    pub(super) recording: String,
    pub(super) frames: usize,
    pub(super) frames_lost: usize,
    pub(super) windows: usize,
    pub(super) lost: usize,
    pub(super) windows_without_performer: u64,
    pub(super) frame_rate_hz: Option<f64>,
    pub(super) reprojection: Reprojection,
    pub(super) hold_out: Option<HoldOut>,
    pub(super) mean_acceleration_m_s2: Option<f64>,
    pub(super) truth: Option<Truth>,
    pub(super) reference: Option<Reference>,
    pub(super) solve_ms: Option<SolveTime>,
    pub(super) frames_per_second: f64,
    pub(super) events: BTreeMap<&'static str, u64>,
    pub(super) damage: Vec<String>,
}

/// Median distance of detected points with confidence above 0.3 from the solved body, pixels.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Reprojection {
    pub(super) median_px: Option<f64>,
    pub(super) cameras: BTreeMap<String, Option<f64>>,
}

/// Distance from the recording's truth.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Truth {
    pub(super) frames: usize,
    pub(super) mpjpe_mm: f64,
    pub(super) mpjpe_root_relative_mm: f64,
    pub(super) rmse_mm: f64,
    pub(super) mae_deg: f64,
    pub(super) root_deg: f64,
    pub(super) pck3_percent: f64,
    pub(super) pck7_percent: f64,
}

/// Time to solve a window.
#[derive(Clone, Debug, Serialize)]
pub(super) struct SolveTime {
    pub(super) p50: f64,
    pub(super) p99: f64,
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

/// What the figures are made of.
pub(super) struct Measured<'a> {
    pub(super) recording: &'a std::path::Path,
    pub(super) run: &'a Run,
    pub(super) rig: &'a Rig,
    pub(super) skeleton: &'a Skeleton,
    pub(super) truth: &'a [(Timestamp, Box<Posture>)],
    pub(super) hold_out: Option<HoldOut>,
    pub(super) reference: Option<Reference>,
    pub(super) report: &'a Report,
    /// Reading and solving, without the outputs at the end.
    pub(super) elapsed: Duration,
}

impl Figures {
    pub(super) fn new(measured: Measured) -> Self {
        let Measured { run, rig, skeleton, .. } = &measured;
        let fps = frame_rate(&run.poses);
        let solve_ms: Vec<f64> = run.windows.iter().map(|window| window.solve_ms).collect();
        let is_lost = |pose: &&StampedPose| pose.state == TrackingState::Lost;
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

    /// Rows of a name and a value, for people.
    pub(super) fn rows(&self) -> Vec<(String, String)> {
        let mut rows = Vec::new();
        let mut row = |name: &str, value: String| rows.push((name.to_owned(), value));
        row("frames", with_part(self.frames, self.frames_lost, "flagged lost"));
        row("windows", with_part(self.windows, self.lost, "lost"));
        if self.windows_without_performer > 0 {
            row("windows without a performer", self.windows_without_performer.to_string());
        }
        row("reprojection, median", px(self.reprojection.median_px));
        for (camera, error) in &self.reprojection.cameras {
            row(&format!("  {camera}"), px(*error));
        }
        if let Some(held) = &self.hold_out {
            row(
                &format!("hold-out {}, median", held.camera),
                format!("{} ({} points, {} frames)", px(held.median_px), held.points, held.frames),
            );
        }
        row("mean joint acceleration", unit(self.mean_acceleration_m_s2, 2, "m/s^2"));
        if let Some(truth) = &self.truth {
            let (all, relative) = (truth.mpjpe_mm, truth.mpjpe_root_relative_mm);
            row("truth: MPJPE", format!("{all:.1} mm ({relative:.1} mm root-relative)"));
            row("truth: RMSE", format!("{:.1} mm", truth.rmse_mm));
            row("truth: MAE", format!("{:.2} deg (root {:.2})", truth.mae_deg, truth.root_deg));
            let (three, seven) = (truth.pck3_percent, truth.pck7_percent);
            row("truth: PCK 3 cm, 7 cm", format!("{three:.1} %, {seven:.1} %"));
        }
        if let Some(reference) = &self.reference {
            let frames = reference.frames;
            row("reference: mean", format!("{:.1} mm ({frames} frames)", reference.mean_mm));
            if let (Some(mm), Some(frame)) =
                (reference.worst_mid_hip_mm, reference.worst_mid_hip_frame)
            {
                row("reference: worst mid-hip", format!("{mm:.1} mm (frame {frame})"));
            }
        }
        if let Some(SolveTime { p50, p99 }) = self.solve_ms {
            row("solve time, p50, p99", format!("{p50:.1} ms, {p99:.1} ms a window"));
        }
        row("speed", format!("{:.0} frames/s", self.frames_per_second));
        let happened: Vec<String> = (self.events.iter().filter(|(_, count)| **count > 0))
            .map(|(kind, count)| format!("{kind} {count}"))
            .collect();
        row("events", if happened.is_empty() { "none".to_owned() } else { happened.join(", ") });
        for damage in &self.damage {
            row("damage", damage.clone());
        }
        rows
    }
}

impl Reprojection {
    fn new(run: &Run, rig: &Rig) -> Self {
        let values = |errors: &[(Timestamp, f32)]| -> Vec<f64> {
            errors.iter().map(|(_, error)| f64::from(*error)).collect()
        };
        let of_camera = |(camera, errors): (&crate::camera::Camera, &Vec<(Timestamp, f32)>)| {
            (camera.name.clone(), median(&values(errors)))
        };
        Self {
            median_px: median(&values(&run.errors_px.concat())),
            cameras: rig.cameras.iter().zip(&run.errors_px).map(of_camera).collect(),
        }
    }
}

/// Poses a second, from the median distance in time; `None` for fewer than two.
pub(super) fn frame_rate(poses: &[StampedPose]) -> Option<f64> {
    let periods: Vec<f64> =
        poses.windows(2).map(|pair| (pair[1].capture - pair[0].capture) as f64).collect();
    median(&periods).filter(|period| *period > 0.0).map(|period| 1e9 / period)
}

/// Mean joint acceleration over the runs of tracked poses without gaps, weighted by length.
fn acceleration(poses: &[StampedPose], skeleton: &Skeleton, fps: f64) -> Option<f64> {
    let longest = (1.5e9 / fps) as i64;
    let together = |a: &StampedPose, b: &StampedPose| {
        let tracked = [a, b].iter().all(|pose| pose.state == TrackingState::Tracking);
        tracked && b.capture - a.capture < longest
    };
    let (mut sum, mut count) = (0.0, 0.0);
    for run in poses.chunk_by(together).filter(|run| run.len() > 2) {
        let postures: Vec<Posture> = run.iter().map(|pose| pose.pose.posture(skeleton)).collect();
        if let Some(mean) = mean_acceleration(&postures, fps) {
            sum += mean * (run.len() - 2) as f64;
            count += (run.len() - 2) as f64;
        }
    }
    (count > 0.0).then(|| sum / count)
}

/// Errors of the tracked poses that have a true posture within a tenth of a frame.
fn truth(
    poses: &[StampedPose],
    skeleton: &Skeleton,
    truth: &[(Timestamp, Box<Posture>)],
    fps: f64,
) -> Option<Truth> {
    let tolerance = (0.1e9 / fps) as i64;
    let estimates: Vec<(Posture, &Posture)> = (poses.iter())
        .filter(|pose| pose.state == TrackingState::Tracking)
        .filter_map(|pose| {
            let next = truth.partition_point(|(at, _)| *at + tolerance < pose.capture);
            let (at, posture) = truth.get(next)?;
            (*at - pose.capture <= tolerance).then(|| (pose.pose.posture(skeleton), &**posture))
        })
        .collect();
    pose_errors(estimates.iter().map(|(estimate, truth)| (estimate, *truth))).map(Truth::from)
}

/// What was lost of a recording, a line each.
pub(super) fn losses(report: &Report) -> Vec<String> {
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
