//! `bundlemocap export`

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::Ended;
use super::failure::{Exit, Failure};
use super::overwrite::{Overwrite, is_same_file};
use super::span::{SpanArguments, Times};
use super::terminal::{complain, say};
use crate::core::body::{Attachment, Joint, Pose, Skeleton, TrackingState};
use crate::core::detections::{Keypoint, KeypointFormat};
use crate::core::time::Timestamp;
use crate::io::formats::c3d::write_c3d;
use crate::io::formats::gltf::write_glb;
use crate::io::formats::npz::write_npz;
use crate::io::formats::pose_table::{TimedPose, write_csv, write_deviations};
use crate::io::formats::trc::{Markers, write_trc};
use crate::io::formats::usd::write_usda;
use crate::io::formats::{Description, ExportError};
#[cfg(feature = "view")]
use crate::io::new_file;
use crate::io::recording::{Message, Reader};
use crate::io::wire::Topic;
use crate::offline::bvh::{BvhFile, Fill};
use crate::offline::compact_pose::CompactPose;
use crate::offline::output::{strip, text};
use crate::offline::poses::frame_rate;

/// Write the poses of a solved recording for other tools.
#[derive(Debug, Args)]
#[command(after_help = "\
The ending of each file chooses the format:
  .glb    skin, skeleton and animation, for Blender, Unreal, Unity, Godot and browsers; metres
  .usda   the same as USD (UsdSkel), for Houdini, Omniverse, Maya, Blender and usdview; metres
  .bvh    skeleton and animation, for Blender, MotionBuilder and Maya; centimetres
  .trc    keypoints of the body and joint centres (_jc), for OpenSim and Pose2Sim; metres
  .c3d    the same markers, for Mokka, Visual3D and other tools of biomechanics; millimetres
  .csv    places and their standard deviations (metres), rotations (quaternions) of the joints
  .npz    rotation vectors of SMPL's joints with AMASS's fields; metres, z up
  .svg    a picture: a row of stick figures
  .mcap   performers and cameras in 3D, joint frames and keypoints, for Foxglove and Lichtblick
In all but .npz y is up; with all rotations zero the body is a T-pose that faces +z. In .glb,
.usda and .csv times are since the first pose of any performer. In .bvh, .trc, .c3d and .npz frames
are evenly spaced, from the performer's own first pose on. In a gap .bvh and .npz repeat the last
pose, for at most ten minutes in all; .trc and .c3d are empty there, and where the performer is
lost. Beside .trc and .c3d a .sd.csv has the standard deviations of the joint centres.

Examples:
  bundlemocap export out/poses.mcap --out take1.glb
  bundlemocap export out/poses.mcap --out take1.glb --out take1.bvh --out take1.svg
  bundlemocap export out/poses.mcap --out cut.bvh --start 01:00:10:00 --end 01:00:20:00
  bundlemocap export both/poses.mcap --out take1.glb             take1.p1.glb, take1.p2.glb
  bundlemocap export both/poses.mcap --out take1.glb --actor p2  take1.glb
  bundlemocap export take.mcap --out take.foxglove.mcap          its keypoints and cameras")]
pub(super) struct Arguments {
    /// The poses.mcap of `bundlemocap solve`.
    file: PathBuf,
    /// File to write. May be repeated.
    #[arg(long, value_name = "FILE", required = true)]
    out: Vec<PathBuf>,
    /// Format of all files, whatever their endings.
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Number of stick figures in a picture.
    #[arg(long, default_value_t = 7, value_parser = clap::value_parser!(u8).range(1..))]
    figures: u8,
    #[command(flatten)]
    span: SpanArguments,
    /// Export this performer alone; default: each, to a file named after the performer if the
    /// recording has several.
    #[arg(long, value_name = "NAME")]
    actor: Option<String>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Export the true poses of a synthetic recording instead.
    #[arg(long)]
    truth: bool,
}

/// A format of files; its name is also their ending.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// glTF.
    Glb,
    /// USD as text.
    Usda,
    /// BVH.
    Bvh,
    /// Markers for OpenSim.
    Trc,
    /// Markers for tools of biomechanics.
    C3d,
    /// A table of joints.
    Csv,
    /// numpy arrays with AMASS's fields.
    Npz,
    /// A row of stick figures.
    Svg,
    /// MCAP with the schemas of Foxglove.
    Mcap,
}

/// Writes a file of one performer; returns what it holds.
type WriteOne = fn(&Path, &Performer, &Export) -> Result<String, Failure>;

impl Format {
    /// The format that a file's ending names.
    fn of(path: &Path) -> Result<Self, Failure> {
        let ending = path.extension().unwrap_or_default().to_string_lossy();
        Self::from_str(&ending, true).map_err(|_| {
            let all = Self::value_variants().iter().filter_map(ValueEnum::to_possible_value);
            let all: Vec<String> = all.map(|value| format!(".{}", value.get_name())).collect();
            let (path, all) = (path.display(), all.join(", "));
            Failure::new(
                Exit::Usage,
                format!("{path}: unknown ending; use {all}, or give --format"),
            )
        })
    }

    /// `None`: a file holds the whole recording.
    fn of_one(self) -> Option<WriteOne> {
        match self {
            Self::Glb => Some(glb),
            Self::Usda => Some(usda),
            Self::Bvh => Some(bvh),
            Self::Trc => Some(trc),
            Self::C3d => Some(c3d),
            Self::Csv => Some(csv),
            Self::Npz => Some(npz),
            Self::Svg => Some(svg),
            Self::Mcap => None,
        }
    }
}

/// What the files of all performers share.
struct Export {
    times: Times,
    /// The first pose of any performer.
    start: Timestamp,
    /// Stick figures in a picture.
    figures: usize,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let (mut of_one, mut whole) = (Vec::new(), Vec::new());
    for path in &arguments.out {
        let format = arguments.format.map_or_else(|| Format::of(path), Ok)?;
        match format.of_one() {
            Some(write) => of_one.push((path, format, write)),
            None => whole.push(path.clone()),
        }
    }
    let is_in_part = arguments.truth || arguments.actor.is_some() || arguments.span.is_given();
    if !whole.is_empty() && is_in_part {
        let message =
            "a .mcap holds the whole recording; leave out --actor, --truth, --start and --end";
        return Err(Failure::new(Exit::Usage, message));
    }
    let times = Times::of(&arguments.file, None)?;
    let mut solved = Solved { performers: Vec::new(), damage: Vec::new() };
    if !of_one.is_empty() {
        solved = performers(arguments, &times)?;
    }
    let several = solved.performers.len() > 1;
    let (mut files, mut paths) = (Vec::new(), whole.clone());
    for one in &solved.performers {
        for (path, format, write) in &of_one {
            let path = path_of(path, several.then_some(&one.actor));
            if *format == Format::Bvh
                && let Some(beside) = times.sidecar(&path)
            {
                arguments.overwrite.check(&beside)?;
            }
            if matches!(format, Format::Trc | Format::C3d) {
                // Two files of markers may share it.
                paths
                    .extend(deviations_beside(&path, one).filter(|beside| !paths.contains(beside)));
            }
            paths.push(path.clone());
            files.push((path, one, write));
        }
    }
    check(&paths, arguments)?;
    for path in whole {
        solved.damage = write_foxglove(&arguments.file, &path)?;
    }
    let firsts = solved.performers.iter().filter_map(|one| Some(one.poses.first()?.capture));
    let (start, figures) = (firsts.min().unwrap_or_default(), arguments.figures.into());
    let export = Export { times, start, figures };
    for (path, one, write) in files {
        say(&format!("{}: {}", path.display(), write(&path, one, &export)?));
    }
    Ok(exit_of(&arguments.file, &solved.damage))
}

/// The performers who are exported, with the poses that are.
fn performers(arguments: &Arguments, times: &Times) -> Result<Solved, Failure> {
    let mut solved = read(&arguments.file, arguments.truth, arguments.actor.as_deref())?;
    if let Some([start, end]) = arguments.span.within(times)? {
        for one in &mut solved.performers {
            one.poses.retain(|pose| (start..=end).contains(&pose.capture));
        }
        solved.performers.retain(|one| !one.poses.is_empty());
        if solved.performers.is_empty() {
            return Err(Failure::new(Exit::Usage, "no poses from --start to --end"));
        }
    }
    Ok(solved)
}

/// Checks all files before the first is written.
fn check(paths: &[PathBuf], arguments: &Arguments) -> Result<(), Failure> {
    let mut seen = BTreeSet::new();
    for path in paths {
        let wrong = if is_same_file(&arguments.file, path) {
            "is the input"
        } else if !seen.insert(path) {
            "would be written twice"
        } else {
            arguments.overwrite.check(path)?;
            continue;
        };
        let message = format!("{} {wrong}; choose another name", path.display());
        return Err(Failure::new(Exit::Usage, message));
    }
    Ok(())
}

/// Hertz.
fn rate(one: &Performer) -> f64 {
    frame_rate(&one.poses).unwrap_or(60.0)
}

/// The description of a file with a skin and an animation, and its poses with their times, seconds.
fn animated<'a>(
    one: &'a Performer,
    export: &'a Export,
) -> (Description<'a>, impl Iterator<Item = (f64, Pose)>) {
    let timecode = export.times.timecode_at(Some(export.start));
    let seconds = |pose: &CompactPose| pose.capture.seconds_since(export.start);
    let poses = one.poses.iter().map(move |pose| (seconds(pose), pose.pose()));
    (Description { name: &one.actor, fps: rate(one), timecode }, poses)
}

fn glb(path: &Path, one: &Performer, export: &Export) -> Result<String, Failure> {
    let (about, poses) = animated(one, export);
    let keys = write_glb(path, &about, &one.skeleton, poses)?;
    Ok(format!("{keys} keys at {:.2} Hz", about.fps))
}

fn usda(path: &Path, one: &Performer, export: &Export) -> Result<String, Failure> {
    let (about, poses) = animated(one, export);
    let keys = write_usda(path, &about, &one.skeleton, poses)?;
    Ok(format!("{keys} keys at {:.2} Hz", about.fps))
}

fn bvh(path: &Path, one: &Performer, export: &Export) -> Result<String, Failure> {
    let fps = rate(one);
    let mut file = BvhFile::create(path, &one.skeleton, fps, None)?;
    one.poses.iter().try_for_each(|pose| file.write(pose))?;
    let (states, unfilled) = file.finish(path)?;
    unfilled.into_iter().for_each(|text| complain("note", &text));
    export.times.beside(path, one.poses.first().map(|pose| pose.capture))?;
    Ok(format!("{} frames at {fps:.2} Hz", states.frames()))
}

/// The poses at evenly spaced times; `None` in gaps. Says which gaps are not filled.
fn evenly<'a>(path: &Path, one: &'a Performer, fps: f64) -> Vec<Option<&'a CompactPose>> {
    let mut fill = Fill::new(fps);
    let mut frames = Vec::new();
    for pose in &one.poses {
        frames.resize(frames.len() + fill.gap_before(pose.capture), None);
        frames.push(Some(pose));
    }
    fill.note(path).into_iter().for_each(|text| complain("note", &text));
    frames
}

fn trc(path: &Path, one: &Performer, _: &Export) -> Result<String, Failure> {
    markers(path, one, write_trc)
}

fn c3d(path: &Path, one: &Performer, _: &Export) -> Result<String, Failure> {
    markers(path, one, write_c3d)
}

/// Writes the keypoints of the body and the joint centres, and the standard deviations beside them.
fn markers(
    path: &Path,
    one: &Performer,
    write: fn(&Path, &Markers) -> Result<(), ExportError>,
) -> Result<String, Failure> {
    let (fps, body) = (rate(one), &one.skeleton);
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
        of_points.chain(posture.positions).map(Some).collect::<Vec<_>>()
    };
    let is_known = |pose: &&CompactPose| pose.state != TrackingState::Lost;
    let poses = evenly(path, one, fps);
    let frames: Vec<_> = (poses.iter())
        .map(|pose| pose.filter(is_known).map_or_else(|| vec![None; names.len()], places))
        .collect();
    write(path, &Markers { fps, names: &names, frames: &frames })?;
    let mut about = format!("{} frames at {fps:.2} Hz, {} markers", frames.len(), names.len());
    if let Some(beside) = deviations_beside(path, one) {
        write_deviations(
            &beside,
            fps,
            poses.iter().map(|pose| pose.and_then(CompactPose::deviations)),
        )?;
        about += &format!("; standard deviations in {}", beside.display());
    }
    Ok(about)
}

/// The file of the standard deviations beside a file of markers, if any are known.
fn deviations_beside(path: &Path, one: &Performer) -> Option<PathBuf> {
    let is_known = one.poses.iter().any(|pose| pose.deviations().is_some());
    is_known.then(|| path.with_extension("sd.csv"))
}

/// A pose as files have it.
fn timed(time: f64, pose: &CompactPose) -> TimedPose {
    TimedPose { time, state: pose.state, pose: pose.pose(), deviations: pose.deviations() }
}

fn csv(path: &Path, one: &Performer, export: &Export) -> Result<String, Failure> {
    let seconds = |pose: &CompactPose| pose.capture.seconds_since(export.start);
    let poses = one.poses.iter().map(|pose| timed(seconds(pose), pose));
    write_csv(path, &one.skeleton, poses)?;
    Ok(format!("{} poses", one.poses.len()))
}

fn npz(path: &Path, one: &Performer, _: &Export) -> Result<String, Failure> {
    let fps = rate(one);
    let mut poses: Vec<TimedPose> = Vec::new();
    for (frame, pose) in evenly(path, one, fps).into_iter().enumerate() {
        let time = frame as f64 / fps;
        let repeated = || {
            let last = poses.last().cloned()?;
            Some(TimedPose { time, state: TrackingState::Lost, deviations: None, ..last })
        };
        poses.extend(pose.map(|pose| timed(time, pose)).or_else(repeated));
    }
    write_npz(path, fps, &one.skeleton, &poses)?;
    Ok(format!("{} frames at {fps:.2} Hz", poses.len()))
}

fn svg(path: &Path, one: &Performer, export: &Export) -> Result<String, Failure> {
    text(path, &strip(&one.poses, &one.skeleton, export.figures))?;
    Ok(format!("{} stick figures", export.figures))
}

/// `take1.p1.bvh` for `take1.bvh` of the performer p1; the path itself if there is only one performer.
pub(super) fn path_of(path: &Path, actor: Option<&String>) -> PathBuf {
    match (actor, path.extension()) {
        (None, _) => path.to_owned(),
        (Some(actor), None) => path.with_extension(actor),
        (Some(actor), Some(end)) => path.with_extension(format!("{actor}.{}", end.display())),
    }
}

/// Writes poses and keypoints with the schemas of Foxglove; returns the losses of a damaged recording.
#[cfg(feature = "view")]
fn write_foxglove(from: &Path, to: &Path) -> Result<Vec<String>, Failure> {
    let unwritten = |error: &dyn std::fmt::Display| {
        Failure::new(Exit::Unexpected, format!("cannot write {}: {error}", to.display()))
    };
    let file = new_file::temporary(to).map_err(|error| unwritten(&error))?;
    let mut file = crate::view::FoxgloveFile::new(std::io::BufWriter::new(file))
        .map_err(|error| unwritten(&error))?;
    let (mut reader, mut count) = (Reader::open(from)?, 0);
    for entry in reader.by_ref() {
        let entry = entry?;
        count += u64::from(file.add(&entry.topic, &entry.message));
    }
    if count == 0 {
        let message =
            format!("{} holds no poses and no keypoints of calibrated cameras", from.display());
        return Err(Failure::new(Exit::NotOurs, message));
    }
    let file = file.finish().map_err(|error| unwritten(&error))?;
    let file = file.into_inner().map_err(|error| unwritten(&error))?;
    file.persist(to).map_err(|error| unwritten(&error))?;
    say(&format!("{}: {count} poses and keypoint frames", to.display()));
    Ok(reader.report().losses())
}

#[cfg(not(feature = "view"))]
fn write_foxglove(_: &Path, to: &Path) -> Result<Vec<String>, Failure> {
    let message =
        format!("{}: build the program with --features view for this format", to.display());
    Err(Failure::new(Exit::Usage, message))
}

/// The exit code of a file that was read; says what a damaged one lost.
fn exit_of(file: &Path, damage: &[String]) -> Exit {
    if damage.is_empty() {
        return Exit::Done;
    }
    complain("warning", &format!("{}: {}", file.display(), damage.join("; ")));
    Exit::InPart
}

/// The content of a solved recording.
pub(super) struct Solved {
    /// By name; at least one.
    pub(super) performers: Vec<Performer>,
    /// Losses of a damaged file.
    pub(super) damage: Vec<String>,
}

/// The poses of a performer.
pub(super) struct Performer {
    pub(super) actor: String,
    pub(super) skeleton: Skeleton,
    /// Sorted by capture time, one per time.
    pub(super) poses: Vec<CompactPose>,
}

/// The poses of a solved recording, or the true ones of a synthetic recording; of one performer, if one
/// is named.
pub(super) fn read(file: &Path, truth: bool, actor: Option<&str>) -> Result<Solved, Failure> {
    let mut reader = Reader::open(file)?;
    let mut found = BTreeMap::<String, (Option<Skeleton>, Vec<CompactPose>)>::new();
    while let Some(entry) = reader.next() {
        let entry = entry?;
        let name = Topic::actor(&entry.topic);
        let result = match (entry.message, truth) {
            (Message::Skeleton(wire), false) | (Message::TruthSkeleton(wire), true) => {
                wire.to_core().map(|body| found.entry(name).or_default().0 = Some(body))
            }
            // Final poses replace provisional ones.
            (Message::Pose(wire), false) if wire.provisional => Ok(()),
            (Message::Pose(wire), false) | (Message::TruthPose(wire), true) => {
                wire.to_core().map(|pose| found.entry(name).or_default().1.push((&pose).into()))
            }
            _ => Ok(()),
        };
        if let Err(error) = result {
            reader.reject(&entry.topic, &error);
        }
    }
    let whole = |(actor, (skeleton, mut poses)): (String, (Option<_>, Vec<_>))| {
        in_order(&mut poses);
        (!poses.is_empty()).then_some(Performer { actor, skeleton: skeleton?, poses })
    };
    let mut performers: Vec<Performer> = found.into_iter().filter_map(whole).collect();
    if performers.is_empty() {
        let fix = if truth {
            "only recordings of `bundlemocap synth` have true poses"
        } else {
            "solve it first, then use the poses.mcap of `bundlemocap solve`"
        };
        let message = format!("{} holds no poses; {fix}", file.display());
        return Err(Failure::new(Exit::NotOurs, message));
    }
    if let Some(actor) = actor {
        let names: Vec<String> = performers.iter().map(|one| one.actor.clone()).collect();
        performers.retain(|one| one.actor == actor);
        if performers.is_empty() {
            let (file, names) = (file.display(), names.join(", "));
            let message = format!("{file} holds no poses of {actor}; --actor may be {names}");
            return Err(Failure::new(Exit::Usage, message));
        }
    }
    Ok(Solved { performers, damage: reader.report().losses() })
}

/// Sorts by capture time and keeps the last of several poses of one time.
fn in_order(poses: &mut Vec<CompactPose>) {
    poses.sort_by_key(|pose| pose.capture);
    poses.dedup_by(|later, kept| {
        let anew = later.capture == kept.capture;
        if anew {
            std::mem::swap(later, kept);
        }
        anew
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::compact_pose::tests::tracked;

    #[test]
    fn poses_are_put_in_order_and_the_newest_of_a_time_stays() {
        let mut poses: Vec<CompactPose> = [(30, 1.0), (10, 2.0), (20, 3.0), (10, 4.0), (10, 5.0)]
            .map(|(ns, x)| tracked(ns, x))
            .into();
        in_order(&mut poses);
        let left = poses.iter().map(|pose| (pose.capture.ns(), pose.pose().root_position.x));
        assert_eq!(left.collect::<Vec<_>>(), [(10, 5.0), (20, 3.0), (30, 1.0)]);
    }
}
