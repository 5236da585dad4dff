//! The results of all windows of a solve, in memory that does not grow with their number.

use std::time::Duration;

use super::series::{Bin, Mean, Series};
use crate::core::points::CONFIDENT;
use crate::core::time::Timestamp;
use crate::core::tracker::{Residual, Verdict, WindowReport};
use crate::diagnose::CameraCheck;
use crate::metrics::statistics::percentiles;
use crate::metrics::{Distribution, FollowedSums};

/// A window in the report, or the worst values of several in a row.
#[derive(Clone, Debug)]
pub(crate) struct WindowSummary {
    pub(crate) start: Timestamp,
    pub(crate) end: Timestamp,
    pub(crate) latent_norm: f64,
    pub(crate) iterations: usize,
    pub(crate) cost: f64,
    /// Begin and end of what is lost.
    pub(crate) lost: Option<[Timestamp; 2]>,
    pub(crate) solve_ms: f64,
}

impl Bin for WindowSummary {
    fn merge(&mut self, next: Self) {
        self.end = next.end;
        self.latent_norm = self.latent_norm.max(next.latent_norm);
        self.iterations = self.iterations.max(next.iterations);
        self.cost = self.cost.max(next.cost);
        self.lost = match (self.lost, next.lost) {
            (Some([from, _]), Some([_, to])) => Some([from, to]),
            (one, other) => one.or(other),
        };
        self.solve_ms = self.solve_ms.max(next.solve_ms);
    }
}

/// Larger median errors, as parts of the performer's height, are not those of a detector.
const FAR: f64 = 0.05;

/// Reprojection errors of a camera in windows that are not lost, pixels.
#[derive(Clone, Debug, Default)]
pub(crate) struct CameraErrors {
    /// Of every confident point.
    pub(crate) all: Distribution,
    /// The same as parts of the performer's height in the image.
    relative: Distribution,
    /// Quartiles of every frame.
    pub(crate) frames: Series<Mean<Timestamp, 3>>,
}

/// All windows of a solve.
#[derive(Clone, Debug, Default)]
pub(crate) struct Windows {
    pub(crate) count: usize,
    /// Number of windows with flagged poses.
    pub(crate) lost: usize,
    /// Number of those in which too little of the performer was seen.
    pub(crate) hidden: usize,
    pub(crate) series: Series<WindowSummary>,
    pub(crate) solve_ms: Distribution,
    /// Points that are seen and not followed.
    pub(crate) followed: FollowedSums,
    /// Errors of all cameras together.
    pub(crate) errors_px: Distribution,
    /// By camera.
    pub(crate) cameras: Vec<CameraErrors>,
}

impl CameraErrors {
    /// A note if the camera, of which a check says nothing, sees the performer far from the poses.
    pub(crate) fn note(&self, check: &CameraCheck) -> Option<String> {
        if !check.findings.is_empty() {
            return None;
        }
        let relative = self.relative.median().filter(|relative| *relative > FAR)?;
        Some(format!(
            "camera {}: its points are {:.0} px from the poses, {:.0} % of the performer's height in its image: is its \
             calibration of this take?",
            check.camera,
            self.all.median()?,
            100.0 * relative
        ))
    }
}

impl Windows {
    pub(crate) fn of_cameras(cameras: usize) -> Self {
        Self { cameras: vec![CameraErrors::default(); cameras], ..Self::default() }
    }

    pub(crate) fn add(&mut self, report: &WindowReport, solve: Duration) {
        let lost = report.verdict != Verdict::Tracked;
        if !lost {
            self.add_errors(report);
        }
        self.followed.add(report);
        self.count += 1;
        self.lost += usize::from(lost);
        self.hidden += usize::from(lost && report.summary.is_none());
        let solve_ms = solve.as_secs_f64() * 1e3;
        self.solve_ms.add(solve_ms);
        self.series.push(WindowSummary {
            start: report.start,
            end: report.end,
            latent_norm: report.latent_norm,
            iterations: report.summary.map_or(0, |summary| summary.iterations),
            cost: report.summary.map_or(f64::NAN, |summary| summary.final_cost),
            lost: lost.then_some([report.start, report.end]),
            solve_ms,
        });
    }

    fn add_errors(&mut self, report: &WindowReport) {
        for (camera, errors) in self.cameras.iter_mut().enumerate() {
            let confident = |r: &&Residual| r.camera == camera && r.confidence > CONFIDENT;
            let mut seen: Vec<&Residual> = report.residuals.iter().filter(confident).collect();
            seen.sort_by_key(|residual| residual.capture);
            for residual in &seen {
                // In single precision, like the results of earlier versions.
                let error = f64::from(residual.error_px() as f32);
                errors.all.add(error);
                errors.relative.add(residual.error_relative);
                self.errors_px.add(error);
            }
            for frame in seen.chunk_by(|a, b| a.capture == b.capture) {
                let values: Vec<f64> = frame.iter().map(|residual| residual.error_px()).collect();
                if let Some(quartiles) = percentiles(&values, [25.0, 50.0, 75.0]) {
                    errors.frames.push(Mean::new(frame[0].capture, quartiles));
                }
            }
        }
    }
}
