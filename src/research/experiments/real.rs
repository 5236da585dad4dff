//! Methods on a real recording without a truth: measured by its cameras and a reference.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Instant;

use nalgebra::Vector2;
use serde::Serialize;

use super::summary::number;
use crate::core::body::Attachment;
use crate::core::camera::{Camera, CameraError, Rig};
use crate::core::detections::{Detections, Keypoint};
use crate::core::manifold::Decoder;
use crate::core::random::Draws;
use crate::core::time::Timestamp;
use crate::io::formats::Trajectories;
use crate::io::report::Table;
use crate::metrics::statistics::median;
use crate::metrics::{
    COMPARED, Coverage, CoverageSums, DetectorStatistics, DetectorTracks, MeanAcceleration,
};
use crate::offline::{
    FrameClock, HeldOut, HoldOut, Located, Reference, ReferenceComparison, differences, distances,
    pose_at, positions,
};
use crate::research::methods::{Delay, Method, Motion, Solved, Take};

/// The median of a Rayleigh distribution, by its scale.
const RAYLEIGH_MEDIAN: f64 = 1.1774;

/// The results of one method on a recording.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RealScore {
    /// The method.
    pub method: String,
    /// Delay of a pose in frames; `None` until the recording's end.
    pub delay_frames: Option<usize>,
    /// Number of poses.
    pub frames: usize,
    /// Median distance of the fitted keypoints with confidence above 0.3, pixels; without a body, of
    /// the limb keypoints.
    pub reprojection_px: Option<f64>,
    /// The same by camera.
    pub cameras_px: BTreeMap<String, Option<f64>>,
    /// The error in each held-out camera: those of the take together, or each camera in turn; empty
    /// for two cameras.
    pub hold_out: Vec<HoldOut>,
    /// Mean of their medians, pixels.
    pub hold_out_px: Option<f64>,
    /// Share of the points in the held-out cameras within the standard deviations of body and detections;
    /// `None` for a method without deviations.
    pub coverage: Option<Coverage>,
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

/// The take in every Nth frame of each camera, with normally distributed errors added to its points,
/// pixels along each axis. They are new in each frame.
pub fn degraded(mut take: Take, every: usize, jitter_px: f64) -> Take {
    let mut seen = vec![0; take.rig.cameras.len()];
    take.frames.retain(|frame| {
        seen[frame.camera] += 1;
        (seen[frame.camera] - 1_usize).is_multiple_of(every)
    });
    take.fps /= every as f64;
    for frame in take.frames.iter_mut().filter(|_| jitter_px > 0.0) {
        let draws = Draws { seed: frame.capture.ns() as u64, stream: frame.camera as u64 };
        for (person, found) in frame.people.iter_mut().enumerate() {
            for (point, seen) in found.points.iter_mut().enumerate() {
                let Some(seen) = seen else { continue };
                let [x, y] = draws.normals(person as u64, point as u64);
                seen.pixel += jitter_px * Vector2::new(x, y);
            }
        }
    }
    take
}

/// Frames per second of the fastest camera, from the median intervals; `None` for fewer than two frames of each.
pub fn frame_rate(frames: &[Detections]) -> Option<f64> {
    let cameras = frames.iter().map(|frame| frame.camera + 1).max()?;
    let period = |camera: usize| {
        let own = frames.iter().filter(|frame| frame.camera == camera);
        let times: Vec<Timestamp> = own.map(|frame| frame.capture).collect();
        let periods: Vec<f64> =
            times.windows(2).map(|pair| (pair[1] - pair[0]).ns() as f64).collect();
        median(&periods)
    };
    let periods = (0..cameras).filter_map(period).filter(|period| *period > 0.0);
    periods.min_by(f64::total_cmp).map(|period| 1e9 / period)
}

/// A camera that no method sees, and its detections in order of capture time.
pub type HeldOutCamera = (Camera, Vec<Detections>);

/// Marker trajectories of a recording.
#[derive(Clone, Copy, Debug)]
pub struct Markers<'a> {
    /// The trajectories.
    pub trajectories: &'a Trajectories,
    /// The frames of the camera that counts the recording's frames, in order of time.
    pub frames: &'a [FrameClock],
    /// The recording's frame rate, hertz.
    pub fps: f64,
    /// Whether they are of another system, see [`ReferenceComparison::fit`].
    pub align: bool,
}

impl Markers<'_> {
    /// The distance of the poses; `None` if no pose has markers, or if they cannot be aligned.
    fn compare(&self, solved: &Solved) -> Option<Reference> {
        let fps = self.fps;
        let mut comparison = ReferenceComparison::new(self.trajectories);
        let body = |(index, capture): (usize, Timestamp)| {
            let next = self.frames.partition_point(|frame| frame.capture < capture);
            let near = self.frames.get(next).or(self.frames.last())?;
            Some((near.frame_at(capture, fps), solved.motion.frame(index)?))
        };
        let bodies = || solved.motion.times().into_iter().enumerate().filter_map(body);
        if self.align {
            let points: Vec<_> = bodies().map(|(frame, body)| (frame, positions(&body))).collect();
            comparison.fit(fps, &points).then_some(())?;
        }
        bodies().for_each(|(frame, body)| comparison.add(frame, fps, &body));
        comparison.finish()
    }
}

/// Solves and measures; `None` if nobody is found. Without `held_out` cameras, each camera of the
/// take is held out in turn. `each` is called after each solve.
///
/// # Errors
/// The rig has fewer than two cameras.
pub fn measure(
    take: &Take,
    held_out: &[HeldOutCamera],
    make: &dyn Fn() -> Box<dyn Method>,
    decoder: &Decoder,
    markers: Option<Markers>,
    each: &dyn Fn(),
) -> Result<Option<RealScore>, CameraError> {
    let mut method = make();
    let begin = Instant::now();
    let solved = method.solve(take, decoder);
    let ms = begin.elapsed().as_secs_f64() * 1e3;
    each();
    let Some(solved) = solved else { return Ok(None) };
    let cameras = take.rig.cameras.len();
    let mut hold_out: Vec<HoldOut> =
        held_out.iter().map(|(camera, seen)| error_in(camera, seen, &solved)).collect();
    let mut coverage = CoverageSums::default();
    let errors = relative_errors(take, &solved, |_| true);
    held_out.iter().for_each(|held_out| cover(held_out, &solved, &errors, &mut coverage));
    for camera in (0..cameras).filter(|_| held_out.is_empty() && cameras > 2) {
        let (rest, seen) = without_camera(take, camera)?;
        let rest = rest.with_body(decoder);
        if let Some(without) = make().solve(&rest, decoder) {
            let of_camera = relative_errors(take, &solved, |other| other == camera);
            let held_out = (take.rig.cameras[camera].clone(), seen);
            hold_out.push(error_in(&held_out.0, &held_out.1, &without));
            cover(&held_out, &without, &of_camera, &mut coverage);
        }
        each();
    }
    let (all, cameras_px) = reprojection(take, &solved);
    let frames = solved.motion.times().len();
    Ok(Some(RealScore {
        method: method.name(),
        delay_frames: match method.delay(take.fps) {
            Delay::Frames(frames) => Some(frames),
            Delay::Recording => None,
        },
        frames,
        reprojection_px: all,
        cameras_px,
        hold_out_px: HoldOut::of_all(&hold_out).and_then(|all| all.median_px),
        hold_out,
        coverage: coverage.finish(),
        reference: markers.and_then(|markers| markers.compare(&solved)),
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
        let Some(body) = solved.motion.at(detections.capture) else { continue };
        let found = distances(camera, &body, detections, &keypoints);
        errors[detections.camera].extend(found.into_iter().flatten());
    }
    let cameras = take.rig.cameras.iter().zip(&errors);
    let cameras = cameras.map(|(camera, errors)| (camera.name.clone(), median(errors)));
    (median(&errors.concat()), cameras.collect())
}

/// Mean joint acceleration over sections of poses without gaps, m/s^2; `None` without a body.
pub fn acceleration(solved: &Solved, fps: f64) -> Option<f64> {
    let mut acceleration = MeanAcceleration::new(fps);
    for (frame, capture) in solved.motion.times().into_iter().enumerate() {
        acceleration.add(capture, solved.motion.frame(frame)?.posture().cloned());
    }
    acceleration.mean()
}

/// The error in a held-out camera.
fn error_in(camera: &Camera, seen: &[Detections], solved: &Solved) -> HoldOut {
    let mut held_out = HeldOut::new(camera.clone());
    for frame in seen {
        if let Some(body) = solved.motion.at(frame.capture) {
            held_out.compare(frame, &body);
        }
    }
    held_out.finish()
}

/// The standard deviation along an axis of the detections of some cameras, relative to the performer's
/// height, for normally distributed errors with the measured median; by keypoint.
fn relative_errors(
    take: &Take,
    solved: &Solved,
    is_meant: impl Fn(usize) -> bool,
) -> BTreeMap<Keypoint, f64> {
    let mut errors = BTreeMap::<Keypoint, Vec<f64>>::new();
    for detections in take.frames.iter().filter(|frame| is_meant(frame.camera)) {
        let Some(body) = solved.motion.at(detections.capture) else { continue };
        let camera = &take.rig.cameras[detections.camera];
        let Some(found) = differences(camera, &body, detections, &COMPARED) else { continue };
        for (keypoint, way) in found.points {
            errors.entry(keypoint).or_default().push(way.norm() / found.height_px);
        }
    }
    let deviation = |(keypoint, errors): (Keypoint, Vec<f64>)| {
        Some((keypoint, median(&errors)? / RAYLEIGH_MEDIAN))
    };
    errors.into_iter().filter_map(deviation).collect()
}

/// Adds the points of a held-out camera to a coverage. The deviation of a point is that of its joint in the
/// image plus that of a detection.
fn cover(
    (camera, seen): &HeldOutCamera,
    solved: &Solved,
    relative_errors: &BTreeMap<Keypoint, f64>,
    coverage: &mut CoverageSums,
) {
    for frame in seen {
        let (Some(body), Some(deviations)) =
            (solved.motion.at(frame.capture), solved.deviations_at(frame.capture))
        else {
            continue;
        };
        let Some(found) = differences(camera, &body, frame, &COMPARED) else { continue };
        for (keypoint, way) in &found.points {
            let joint = Attachment::of(*keypoint).joint.index();
            let Some(point) = body.keypoint(*keypoint) else { continue };
            let Some((_, by_point)) = camera.project_with_jacobian(&point) else { continue };
            // The error is alike along all axes.
            let scale = by_point.norm() / std::f64::consts::SQRT_2;
            let Some(relative_error) = relative_errors.get(keypoint) else { continue };
            let of_detection = relative_error * found.height_px;
            coverage.add(way, (scale * deviations[joint]).hypot(of_detection));
        }
    }
}

/// Statistics of a recording's detector errors, with a solved body as the truth; `None` without a
/// body.
pub fn detectors(take: &Take, solved: &Solved) -> Option<DetectorStatistics> {
    let Motion::Poses(skeleton, poses) = &solved.motion else { return None };
    let posture = |at| Some(pose_at(poses, at)?.posture(skeleton));
    DetectorTracks::compare(&take.rig, take.format, &take.frames, skeleton, posture)
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
    header.push("held out px".into());
    header.extend(["in 1 sd %", "in 2 sd %"].map(str::to_owned));
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
        cells.push(number(score.hold_out_px, 2));
        let coverage = |of: fn(&Coverage) -> f64| number(score.coverage.as_ref().map(of), 0);
        cells.push(coverage(|coverage| coverage.within_1_percent));
        cells.push(coverage(|coverage| coverage.within_2_percent));
        cells.push(number(score.reference.as_ref().map(|reference| reference.mean_mm), 1));
        cells.push(number(score.mean_acceleration_m_s2, 2));
        cells.push(number(Some(score.ms_per_frame), 2));
        cells
    };
    Table { title: title.into(), header, rows: scores.iter().map(row).collect() }
}

/// The distance of each point from the reference, if there is one; one row per method.
pub fn table_of_points(scores: &[RealScore]) -> Option<Table> {
    let references: Vec<_> =
        scores.iter().filter_map(|score| Some((score, score.reference.as_ref()?))).collect();
    let points: BTreeSet<&String> =
        references.iter().flat_map(|(_, reference)| reference.points_mm.keys()).collect();
    let row = |(score, reference): &(&RealScore, &Reference)| {
        let mm = |point: &&String| number(reference.points_mm.get(*point).copied(), 1);
        std::iter::once(score.method.clone()).chain(points.iter().map(mm)).collect()
    };
    let names = points.iter().map(|point| format!("{point} mm"));
    (!references.is_empty()).then(|| Table {
        title: "Mean distance of each point to the reference".into(),
        header: std::iter::once("method".into()).chain(names).collect(),
        rows: references.iter().map(row).collect(),
    })
}
