//! The verdict on a window: whether enough was seen, and the quality of the fit.

use nalgebra::Vector2;

use super::config::Gate;
use super::job::{Job, Task, Verdict};
use super::noise::Residual;
use crate::core::body::{BodyPoint, Pose, Skeleton};
use crate::core::camera::Rig;
use crate::core::cost::FrameObservations;
use crate::core::manifold::{self, TimedKeyframe};
use crate::core::points::{extent, median};

/// A view counts if it shows this many points per frame.
const MIN_VIEW: usize = 4;
/// A camera without frames after the first part of a whole window, one in this many, has stopped.
const STOPPED: i64 = 4;

/// What a camera shows of the performer in a window. Some cameras are slower than others.
#[derive(Clone, Default)]
struct View {
    /// Number of its frames.
    frames: usize,
    observations: usize,
    /// Whether it has not stopped early.
    goes_on: bool,
}

/// The reason why too little was seen to solve the window; `None` if enough was seen.
pub(super) fn hidden(gate: &Gate, job: &Job, observations: &[FrameObservations]) -> Option<String> {
    let is_open = matches!(job.task, Task::Provisional { .. });
    let early = job.start + (job.end - job.start) / STOPPED;
    let mut views = vec![View::default(); job.rig.cameras.len()];
    for frame in job.used_frames() {
        let view = &mut views[frame.camera];
        view.frames += 1;
        view.goes_on |= is_open || frame.capture > early;
    }
    for seen in observations.iter().flat_map(|frame| frame.observations()) {
        views[seen.camera].observations += 1;
    }
    views.retain(|view| view.goes_on && view.observations > 0);
    let frames = views.iter().map(|view| view.frames).max().unwrap_or(1);
    let observed: usize = views.iter().map(|view| view.observations).sum();
    let per_frame = observed as f64 / frames as f64;
    if per_frame < gate.lost_observations {
        let least = gate.lost_observations;
        return Some(format!("{per_frame:.1} observations a frame, below {least}"));
    }
    let views = views.iter().filter(|view| view.observations >= MIN_VIEW * view.frames).count();
    (views < 2).then(|| format!("{views} cameras see the performer, 2 are needed"))
}

/// The verdict on a solved window, from its residuals and its codes.
pub(super) fn verdict(gate: &Gate, keyframes: &[TimedKeyframe], residuals: &[Residual]) -> Verdict {
    let median_error =
        median(&mut residuals.iter().map(|r| r.error_relative).collect::<Vec<_>>()).unwrap_or(0.0);
    if median_error > gate.lost_residual {
        return Verdict::Lost(format!(
            "median residual is {median_error:.3} of the performer's height, above {}",
            gate.lost_residual
        ));
    }
    let norms = keyframes.iter().map(|at| manifold::norm(&at.keyframe.z));
    let latent = norms.fold(0.0, f64::max);
    match latent > gate.lost_latent {
        true => {
            let most = gate.lost_latent;
            Verdict::Lost(format!("latent norm is {latent:.1}, above {most}"))
        }
        false => Verdict::Tracked,
    }
}

/// The distance of each observation from the body at the pose of its frame.
pub(super) fn residuals<'m>(
    observations: impl Iterator<Item = (&'m FrameObservations, &'m Pose)>,
    points: &[BodyPoint],
    rig: &Rig,
    skeleton: &Skeleton,
) -> Vec<Residual> {
    let mut all = Vec::new();
    for (frame, pose) in observations {
        let posture = pose.posture(skeleton);
        let world: Vec<_> =
            points.iter().map(|p| p.attachment.position(&posture, skeleton)).collect();
        let heights: Vec<f64> = rig
            .cameras
            .iter()
            .map(|camera| extent(world.iter().filter_map(|point| camera.project(point))))
            .collect();
        all.extend(frame.observations().iter().map(|seen| {
            let projected = rig.cameras[seen.camera].project(&world[seen.point]);
            let way_px =
                projected.map_or(Vector2::repeat(f64::INFINITY), |pixel| pixel - seen.pixel);
            Residual {
                capture: frame.capture,
                camera: seen.camera,
                point: points[seen.point].index,
                way_px,
                error_relative: way_px.norm() / heights[seen.camera].max(1.0),
                confidence: seen.confidence,
            }
        }));
    }
    all
}
