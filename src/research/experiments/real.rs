//! Methods on a real recording without a truth: measured by its cameras and a reference.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

use super::summary::number;
use crate::core::camera::{Camera, CameraError, Rig};
use crate::core::detections::Detections;
use crate::core::manifold::Decoder;
use crate::core::time::Timestamp;
use crate::io::formats::Trc;
use crate::io::report::Table;
use crate::metrics::statistics::median;
use crate::metrics::{DetectorStatistics, DetectorTracks, MeanAcceleration};
use crate::offline::{
    FrameClock, HeldOut, HoldOut, Reference, ReferenceComparison, distances, pose_at,
};
use crate::research::methods::{Delay, Method, Solved, Take};

/// The results of one method on a recording.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RealScore {
    /// The method.
    pub method: String,
    /// Delay of a pose in frames; `None` until the recording's end.
    pub delay_frames: Option<usize>,
    /// Number of poses.
    pub frames: usize,
    /// Median distance of the fitted keypoints with confidence above 0.3, pixels.
    pub reprojection_px: Option<f64>,
    /// The same by camera.
    pub cameras_px: BTreeMap<String, Option<f64>>,
    /// The error in each camera when it is held out of the solve; empty for two cameras.
    pub hold_out: Vec<HoldOut>,
    /// The distance from the reference, if there is one.
    pub reference: Option<Reference>,
    /// Mean magnitude of the joints' acceleration, m/s^2.
    pub mean_acceleration_m_s2: Option<f64>,
    /// Mean wall time per frame, milliseconds.
    pub ms_per_frame: f64,
}

/// The take without one camera, and the detections of that camera (as camera 0).
///
/// # Errors
/// Fewer than two cameras remain.
pub fn without_camera(take: &Take, camera: usize) -> Result<(Take, Vec<Detections>), CameraError> {
    let kept = |index: &usize| *index != camera;
    let cameras = (0..take.rig.cameras.len()).filter(kept);
    let cameras = cameras.map(|index| take.rig.cameras[index].clone()).collect();
    let rig = Arc::new(Rig::new(take.rig.version, cameras)?);
    let (mut frames, mut seen) = (Vec::new(), Vec::new());
    for detections in &take.frames {
        let mut detections = detections.clone();
        if detections.camera == camera {
            detections.camera = 0;
            seen.push(detections);
        } else {
            detections.camera -= usize::from(detections.camera > camera);
            frames.push(detections);
        }
    }
    Ok((Take { rig, frames, ..take.clone() }, seen))
}

/// Frames per second of the first camera, from the median interval; `None` for fewer than two
/// frames.
pub fn frame_rate(frames: &[Detections]) -> Option<f64> {
    let times: Vec<Timestamp> =
        frames.iter().filter(|frame| frame.camera == 0).map(|frame| frame.capture).collect();
    let periods: Vec<f64> = times.windows(2).map(|pair| (pair[1] - pair[0]).ns() as f64).collect();
    median(&periods).filter(|period| *period > 0.0).map(|period| 1e9 / period)
}

/// Solves and measures; `None` if nobody is found. `each` is called after each solve.
///
/// # Errors
/// The rig has fewer than two cameras.
pub fn measure(
    take: &Take,
    make: &dyn Fn() -> Box<dyn Method>,
    decoder: &Decoder,
    reference: Option<(&Trc, FrameClock)>,
    each: &dyn Fn(),
) -> Result<Option<RealScore>, CameraError> {
    let mut method = make();
    let begin = Instant::now();
    let solved = method.solve(take, decoder);
    let ms = begin.elapsed().as_secs_f64() * 1e3;
    each();
    let Some(solved) = solved else { return Ok(None) };
    let cameras = take.rig.cameras.len();
    let mut hold_out = Vec::new();
    for camera in (0..cameras).filter(|_| cameras > 2) {
        let (rest, seen) = without_camera(take, camera)?;
        if let Some(solved) = make().solve(&rest, decoder) {
            hold_out.push(held_out(&take.rig.cameras[camera], seen, &solved));
        }
        each();
    }
    let (all, cameras_px) = reprojection(take, &solved);
    let frames = solved.poses.len();
    Ok(Some(RealScore {
        method: method.name(),
        delay_frames: match method.delay() {
            Delay::Frames(frames) => Some(frames),
            Delay::Recording => None,
        },
        frames,
        reprojection_px: all,
        cameras_px,
        hold_out,
        reference: reference.and_then(|(trc, clock)| compare(trc, clock, &solved)),
        mean_acceleration_m_s2: acceleration(&solved, take.fps),
        ms_per_frame: ms / frames.max(1) as f64,
    }))
}

fn reprojection(take: &Take, solved: &Solved) -> (Option<f64>, BTreeMap<String, Option<f64>>) {
    let keypoints: Vec<_> =
        crate::core::body::fitted_points(take.format).iter().map(|point| point.keypoint).collect();
    let mut errors = vec![Vec::new(); take.rig.cameras.len()];
    for detections in &take.frames {
        let Some(camera) = take.rig.cameras.get(detections.camera) else { continue };
        let Some(pose) = pose_at(&solved.poses, detections.capture) else { continue };
        let found = distances(camera, &solved.skeleton, &pose, detections, &keypoints);
        errors[detections.camera].extend(found.into_iter().flatten());
    }
    let cameras = take.rig.cameras.iter().zip(&errors);
    let cameras = cameras.map(|(camera, errors)| (camera.name.clone(), median(errors)));
    (median(&errors.concat()), cameras.collect())
}

/// Mean joint acceleration over sections of poses without gaps, m/s^2.
pub fn acceleration(solved: &Solved, fps: f64) -> Option<f64> {
    let mut acceleration = MeanAcceleration::new(fps);
    for (capture, pose) in &solved.poses {
        acceleration.add(*capture, Some(pose.posture(&solved.skeleton)));
    }
    acceleration.mean()
}

/// The distance from the reference; `None` if no row of it has a pose.
fn compare(trc: &Trc, clock: FrameClock, solved: &Solved) -> Option<Reference> {
    let mut comparison = ReferenceComparison::new(trc);
    for (capture, pose) in &solved.poses {
        comparison.add_pose(clock, *capture, Some(pose), &solved.skeleton);
    }
    comparison.finish()
}

/// The error in a held-out camera.
fn held_out(camera: &Camera, seen: Vec<Detections>, solved: &Solved) -> HoldOut {
    let mut held_out = HeldOut::new(camera.clone());
    let mut seen = seen.into_iter().peekable();
    for (capture, pose) in &solved.poses {
        while let Some(frame) = seen.next_if(|frame| frame.capture <= *capture) {
            held_out.add_frame(frame);
        }
        held_out.add_pose(*capture, Some(pose.clone()), &solved.skeleton);
    }
    held_out.finish()
}

/// Statistics of a recording's detector errors, with a solved body as the truth.
pub fn detectors(take: &Take, solved: &Solved) -> Option<DetectorStatistics> {
    let posture = |at| Some(pose_at(&solved.poses, at)?.posture(&solved.skeleton));
    DetectorTracks::compare(&take.rig, take.format, &take.frames, &solved.skeleton, posture)
        .statistics(take.fps)
}

/// The table, one row per method.
pub fn table(title: &str, scores: &[RealScore]) -> Table {
    let mut header: Vec<String> =
        ["method", "delay", "frames", "reprojection px"].map(str::to_owned).into();
    let held_out = scores.iter().map(|score| &score.hold_out).max_by_key(|all| all.len());
    let cameras: Vec<&str> =
        held_out.into_iter().flatten().map(|held| held.camera.as_str()).collect();
    header.extend(cameras.iter().map(|camera| format!("without {camera} px")));
    header.extend(["reference mm", "accel. m/s²", "ms/frame"].map(str::to_owned));
    let row = |score: &RealScore| {
        let delay = score.delay_frames.map_or("all".into(), |frames| frames.to_string());
        let mut cells = vec![
            score.method.clone(),
            delay,
            score.frames.to_string(),
            number(score.reprojection_px, 2),
        ];
        cells.extend(cameras.iter().map(|camera| {
            let held = score.hold_out.iter().find(|held| held.camera == *camera);
            number(held.and_then(|held| held.median_px), 2)
        }));
        cells.push(number(score.reference.as_ref().map(|reference| reference.mean_mm), 1));
        cells.push(number(score.mean_acceleration_m_s2, 2));
        cells.push(number(Some(score.ms_per_frame), 2));
        cells
    };
    Table { title: title.into(), header, rows: scores.iter().map(row).collect() }
}
