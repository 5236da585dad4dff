//! What a window is worth: whether enough was seen, and how well it fits.

use super::association::{extent, median};
use super::config::Gate;
use super::job::{Job, Residual, TimedKeyframe, Verdict};
use crate::core::body::{BodyPoint, Pose, Skeleton};
use crate::core::camera::Rig;
use crate::core::cost::FrameObservations;

/// A view counts when it shows this many points a frame.
const MIN_VIEW: usize = 4;

/// Why too little was seen of the performer to solve the window, if so.
pub(super) fn hidden(
    gate: &Gate,
    job: &Job,
    observed_frames: &[FrameObservations],
) -> Option<String> {
    let frames = job.used_count();
    let observed: usize =
        observed_frames.iter().map(|observed_frame| observed_frame.observations().len()).sum();
    let per_frame = observed as f64 / frames as f64;
    if per_frame < gate.lost_observations {
        let least = gate.lost_observations;
        return Some(format!("{per_frame:.1} observations a frame, below {least}"));
    }
    let views = (0..job.rig.cameras.len())
        .filter(|&camera| {
            let seen =
                observed_frames.iter().flat_map(|observed_frame| observed_frame.observations());
            seen.filter(|o| o.camera == camera).count() >= MIN_VIEW * frames
        })
        .count();
    (views < 2).then(|| format!("{views} cameras see the performer, 2 are needed"))
}

/// What a solved window is worth, by how far what was seen lies from the body and by its codes.
pub(super) fn verdict(gate: &Gate, keyframes: &[TimedKeyframe], residuals: &[Residual]) -> Verdict {
    let median_error = median(&mut residuals.iter().map(|r| r.error_relative).collect::<Vec<_>>());
    if median_error > gate.lost_residual {
        return Verdict::Lost(format!(
            "median residual is {median_error:.3} of the performer's height, above {}",
            gate.lost_residual
        ));
    }
    let norms = keyframes.iter().map(|(_, keyframe)| crate::core::manifold::norm(&keyframe.z));
    let latent = norms.fold(0.0, f64::max);
    match latent > gate.lost_latent {
        true => {
            let most = gate.lost_latent;
            Verdict::Lost(format!("latent norm is {latent:.1}, above {most}"))
        }
        false => Verdict::Tracked,
    }
}

/// How far each observation lies from the body in its moment's pose.
pub(super) fn residuals<'m>(
    observed_frames: impl Iterator<Item = (&'m FrameObservations, Pose)>,
    points: &[BodyPoint],
    rig: &Rig,
    skeleton: &Skeleton,
) -> Vec<Residual> {
    let mut all = Vec::new();
    for (observed_frame, pose) in observed_frames {
        let posture = pose.posture(skeleton);
        let world: Vec<_> =
            points.iter().map(|p| p.attachment.position(&posture, skeleton)).collect();
        let heights: Vec<f64> = rig
            .cameras
            .iter()
            .map(|camera| extent(world.iter().filter_map(|point| camera.project(point))))
            .collect();
        all.extend(observed_frame.observations().iter().map(|seen| {
            let error_px = rig.cameras[seen.camera]
                .project(&world[seen.point])
                .map_or(f64::INFINITY, |pixel| (pixel - seen.pixel).norm());
            Residual {
                capture: observed_frame.capture,
                camera: seen.camera,
                point: points[seen.point].index,
                error_px,
                error_relative: error_px / heights[seen.camera].max(1.0),
                confidence: seen.confidence,
            }
        }));
    }
    all
}
