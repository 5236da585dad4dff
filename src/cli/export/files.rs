//! Writes the poses of one performer in each format.

use std::path::{Path, PathBuf};

use super::options::Lost;
use super::{Export, Format, stem_and_ending};
use crate::cli::failure::Failure;
use crate::cli::terminal::complain;
use crate::core::body::{Attachment, Joint, Pose, TrackingState};
use crate::core::detections::{Keypoint, KeypointFormat};
use crate::core::time::Timestamp;
use crate::io::formats::c3d::write_c3d;
use crate::io::formats::gltf::write_glb;
use crate::io::formats::joint_angles::{write_angles, write_mot};
use crate::io::formats::npz::write_npz;
use crate::io::formats::pose_table::{TimedPose, write_csv, write_deviations};
use crate::io::formats::trc::{Markers, write_trc};
use crate::io::formats::usd::write_usda;
use crate::io::formats::{Description, ExportError, Unit};
use crate::io::with_ending;
use crate::offline::Motion;
use crate::offline::bvh::{BvhFile, Fill, HELD, States};
use crate::offline::compact_pose::CompactPose;
use crate::offline::output::{strip, text};

/// Writes a file of one performer; returns what it holds.
pub(super) type WriteOne = fn(&Path, &Motion, &Export) -> Result<String, Failure>;

impl Format {
    /// `None`: a file holds the whole recording.
    pub(super) fn of_one(self) -> Option<WriteOne> {
        match self {
            Self::Glb => Some(glb),
            Self::Usda => Some(usda),
            Self::Bvh => Some(bvh),
            Self::Trc => Some(trc),
            Self::C3d => Some(c3d),
            Self::Csv => Some(csv),
            Self::Mot => Some(mot),
            Self::Angles => Some(angles),
            Self::Npz => Some(npz),
            Self::Svg => Some(svg),
            Self::Mcap => None,
        }
    }

    /// The files that may be beside a file of this format, and whether this export writes them. Two files of a
    /// performer may share them.
    pub(super) fn beside(self, path: &Path, one: &Motion, export: &Export) -> Vec<(PathBuf, bool)> {
        let timecode = export.times.sidecar(path).filter(|_| !self.has_timecode());
        let more = match self {
            _ if self.is_animation() => Some((states_of(path), export.lost == Lost::Mark)),
            Self::Trc | Self::C3d => Some((deviations_of(path), has_deviations(one))),
            _ => None,
        };
        timecode.map(|path| (path, true)).into_iter().chain(more).collect()
    }

    /// Whether a file has no place for the states of its poses.
    pub(super) fn is_animation(self) -> bool {
        matches!(self, Self::Bvh | Self::Glb | Self::Usda | Self::Mot)
    }

    /// Whether a file has the timecode itself, or needs none.
    pub(super) fn has_timecode(self) -> bool {
        matches!(self, Self::Glb | Self::Usda | Self::Svg | Self::Mcap)
    }
}

/// The file beside `take1.trc`: `take1.trc.sd.csv`. It has the rate of that file.
fn deviations_of(path: &Path) -> PathBuf {
    with_ending(path, ".sd.csv")
}

/// The file beside an animation that says which frames are lost.
pub(in crate::cli) fn states_of(path: &Path) -> PathBuf {
    let (stem, _) = stem_and_ending(path);
    path.with_file_name(format!("{stem}.states.csv"))
}

/// The description of a file with a skin and an animation, and its poses with their times, seconds.
fn animated<'a>(
    one: &'a Motion,
    export: &'a Export,
) -> (Description<'a>, impl Iterator<Item = (f64, Pose)>) {
    let timecode = export.times.timecode_at(Some(export.start));
    let seconds = |pose: &CompactPose| pose.capture.seconds_since(export.start);
    let poses = one.poses.iter().map(move |pose| (seconds(pose), pose.pose()));
    let (name, fps, style) = (&*one.actor, one.fps, &export.style);
    (Description { name, fps, timecode, style }, poses)
}

fn glb(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    let (about, poses) = animated(one, export);
    let keys = write_glb(path, &about, &one.skeleton, poses)?;
    mark(path, one, export, Fill::without_limit(one.fps))?;
    Ok(format!("{keys} keys at {:.2} Hz", about.fps))
}

fn usda(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    let (about, poses) = animated(one, export);
    let keys = write_usda(path, &about, &one.skeleton, poses)?;
    mark(path, one, export, Fill::without_limit(one.fps))?;
    Ok(format!("{keys} keys at {:.2} Hz", about.fps))
}

fn bvh(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    let (fps, start) = (one.fps, Some(export.start));
    let mut file = BvhFile::create(path, &one.skeleton, fps, start, &export.style)?;
    one.poses.iter().try_for_each(|pose| file.write(pose))?;
    let (states, unfilled) = file.finish(path)?;
    unfilled.into_iter().for_each(|text| complain("note", &text));
    mark(path, one, export, Fill::new(fps))?;
    Ok(format!("{} frames at {fps:.2} Hz", states.frames()))
}

/// Writes beside an animation which of its frames are lost, if that is asked for.
fn mark(path: &Path, one: &Motion, export: &Export, fill: Fill) -> Result<(), Failure> {
    if export.lost == Lost::Mark { write_states(path, one, export.start, fill) } else { Ok(()) }
}

/// Writes beside an animation that begins at `start` which of its frames are lost.
pub(in crate::cli) fn write_states(
    path: &Path,
    one: &Motion,
    start: Timestamp,
    fill: Fill,
) -> Result<(), Failure> {
    let (mut states, mut fill) = (States::default(), fill.from(start));
    for pose in &one.poses {
        if let Some(gap) = fill.gap_before(pose.capture) {
            states.add(gap, HELD);
            states.add(1, pose.state.name());
        }
    }
    Ok(text(&states_of(path), &states.csv())?)
}

/// The poses at evenly spaced times from the start; `None` in gaps. Says which gaps are not filled.
fn evenly<'a>(path: &Path, one: &'a Motion, start: Timestamp) -> Vec<Option<&'a CompactPose>> {
    let mut fill = Fill::new(one.fps).from(start);
    let mut frames = Vec::new();
    for pose in &one.poses {
        if let Some(gap) = fill.gap_before(pose.capture) {
            frames.resize(frames.len() + gap, None);
            frames.push(Some(pose));
        }
    }
    fill.note(path).into_iter().for_each(|text| complain("note", &text));
    frames
}

fn trc(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    markers(path, one, export, Unit::M, write_trc)
}

fn c3d(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    markers(path, one, export, Unit::MM, write_c3d)
}

/// Writes the keypoints of the body and the joint centres, and the standard deviations beside them.
fn markers(
    path: &Path,
    one: &Motion,
    export: &Export,
    usual: Unit,
    write: fn(&Path, &Markers) -> Result<(), ExportError>,
) -> Result<String, Failure> {
    let (fps, body, style) = (one.fps, &one.skeleton, &export.style);
    let mut points: Vec<Keypoint> = Vec::new();
    for point in KeypointFormat::ALL.iter().flat_map(|format| format.keypoints()) {
        if !points.contains(point) {
            points.push(*point);
        }
    }
    let of_point = |point: &Keypoint| match point {
        Keypoint::HeadTop => "Head".to_owned(),
        Keypoint::MidHip => "Hip".to_owned(),
        point => format!("{point:?}"),
    };
    let of_joints = Joint::ALL.into_iter().map(|joint| format!("{}_jc", joint.name()));
    let names: Vec<String> = points.iter().map(of_point).chain(of_joints).collect();
    let places = |pose: &CompactPose| {
        let posture = pose.pose().posture(body);
        let of_points = points.iter().map(|point| Attachment::of(*point).position(&posture, body));
        let all = of_points.chain(posture.positions);
        all.map(|place| Some(style.place(&place))).collect::<Vec<_>>()
    };
    let is_known = |pose: &&CompactPose| pose.is_tracked();
    let poses = evenly(path, one, export.start);
    let frames: Vec<_> = (poses.iter())
        .map(|pose| pose.filter(is_known).map_or_else(|| vec![None; names.len()], places))
        .collect();
    let (up, unit) = (style.up, style.unit.unwrap_or(usual));
    write(path, &Markers { fps, unit, up, names: &names, frames: &frames })?;
    let mut about = format!("{} frames at {fps:.2} Hz, {} markers", frames.len(), names.len());
    if has_deviations(one) {
        let beside = deviations_of(path);
        write_deviations(
            &beside,
            fps,
            poses.iter().map(|pose| pose.and_then(CompactPose::deviations)),
        )?;
        about += &format!("; standard deviations in {}", beside.display());
    }
    Ok(about)
}

fn has_deviations(one: &Motion) -> bool {
    one.poses.iter().any(|pose| pose.deviations().is_some())
}

/// A pose as files have it.
fn timed(time: f64, pose: &CompactPose) -> TimedPose {
    TimedPose { time, state: pose.state, pose: pose.pose(), deviations: pose.deviations() }
}

fn csv(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    let seconds = |pose: &CompactPose| pose.capture.seconds_since(export.start);
    let poses = one.poses.iter().map(|pose| timed(seconds(pose), pose));
    write_csv(path, &one.skeleton, &export.style, poses)?;
    Ok(format!("{} poses", one.poses.len()))
}

fn angles(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    let seconds = |pose: &CompactPose| pose.capture.seconds_since(export.start);
    write_angles(path, &one.skeleton, one.poses.iter().map(|pose| timed(seconds(pose), pose)))?;
    Ok(format!("{} poses", one.poses.len()))
}

fn mot(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    let (fps, poses) = (one.fps, filled(path, one, export));
    let frames = poses.len();
    write_mot(path, fps, &one.skeleton, poses.into_iter().map(|pose| pose.pose))?;
    mark(path, one, export, Fill::new(fps))?;
    Ok(format!("{frames} frames at {fps:.2} Hz"))
}

/// The poses at evenly spaced times from the start; in gaps the last one again, as lost.
fn filled(path: &Path, one: &Motion, export: &Export) -> Vec<TimedPose> {
    let fps = one.fps;
    let mut poses: Vec<TimedPose> = Vec::new();
    for (frame, pose) in evenly(path, one, export.start).into_iter().enumerate() {
        let time = frame as f64 / fps;
        let repeated = || {
            let first = || Some(timed(time, one.poses.first()?));
            let last = poses.last().cloned().or_else(first)?;
            Some(TimedPose { time, state: TrackingState::Lost, deviations: None, ..last })
        };
        poses.extend(pose.map(|pose| timed(time, pose)).or_else(repeated));
    }
    poses
}

fn npz(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    let (fps, poses) = (one.fps, filled(path, one, export));
    write_npz(path, fps, &one.skeleton, &poses)?;
    Ok(format!("{} frames at {fps:.2} Hz", poses.len()))
}

fn svg(path: &Path, one: &Motion, export: &Export) -> Result<String, Failure> {
    text(path, &strip(&one.poses, &one.skeleton, export.figures, export.start))?;
    Ok(format!("{} stick figures", export.figures.min(one.poses.len())))
}
