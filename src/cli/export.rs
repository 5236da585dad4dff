//! `bundlemocap export`

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::Ended;
use super::failure::{Exit, Failure};
use super::overwrite::{Overwrite, is_same_file};
use super::span::{SpanArguments, Times};
use super::terminal::{complain, say};
use crate::core::body::Skeleton;
use crate::core::time::Timestamp;
use crate::io::formats::gltf::{Take, write_glb};
#[cfg(feature = "view")]
use crate::io::new_file;
use crate::io::recording::{Message, Reader};
use crate::io::wire::Topic;
use crate::offline::bvh::BvhFile;
use crate::offline::compact_pose::CompactPose;
use crate::offline::output::{strip, text};
use crate::offline::poses::frame_rate;

/// Write the poses of a solved recording for other tools.
#[derive(Debug, Args)]
#[command(after_help = "\
The ending of each file chooses the format:
  .glb    skin, skeleton and animation, for Blender, Unreal, Unity, Godot and browsers; metres
  .bvh    skeleton and animation, for Blender, MotionBuilder and Maya; centimetres
  .svg    a picture: a row of stick figures
  .mcap   performers and cameras in 3D, joint frames and keypoints, for Foxglove and Lichtblick
In .glb and .bvh y is up; with all rotations zero the body is a T-pose that faces +z. In .glb the
keys have the times since the first pose of any performer. In .bvh frames are evenly spaced; a gap
repeats the pose before it, ten minutes in all.

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
    /// BVH.
    Bvh,
    /// A row of stick figures.
    Svg,
    /// MCAP with the schemas of Foxglove.
    #[cfg(feature = "view")]
    Mcap,
}

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

    /// Whether a file has all performers.
    fn is_of_all(self) -> bool {
        match self {
            Self::Glb | Self::Bvh | Self::Svg => false,
            #[cfg(feature = "view")]
            Self::Mcap => true,
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let mut formats = Vec::new();
    for path in &arguments.out {
        formats.push((path, arguments.format.map_or_else(|| Format::of(path), Ok)?));
    }
    let (of_all, of_one): (Vec<_>, Vec<_>) =
        formats.into_iter().partition(|(_, format)| format.is_of_all());
    #[cfg(feature = "view")]
    if !of_all.is_empty()
        && (arguments.truth || arguments.actor.is_some() || arguments.span.is_given())
    {
        let message =
            "a .mcap holds the whole recording; leave out --actor, --truth, --start and --end";
        return Err(Failure::new(Exit::Usage, message));
    }
    let (mut solved, times) = (None, Times::of(&arguments.file, None)?);
    if !of_one.is_empty() {
        solved = Some(performers(arguments, &times)?);
    }
    let all = solved.iter().flat_map(|solved| &solved.performers).collect::<Vec<_>>();
    let several = all.len() > 1;
    let mut files = Vec::new();
    for one in all {
        let path = |path: &Path| path_of(path, several.then_some(&one.actor));
        files.extend(of_one.iter().map(|(to, format)| (path(to), *format, one)));
    }
    for (path, ..) in files.iter().filter(|(_, format, _)| *format == Format::Bvh) {
        times.sidecar(path).map_or(Ok(()), |path| arguments.overwrite.check(&path))?;
    }
    let zero = files.iter().filter_map(|(.., one)| Some(one.poses.first()?.capture)).min();
    let paths = files.iter().map(|(path, ..)| path).chain(of_all.iter().map(|(path, _)| *path));
    check(paths, arguments)?;
    #[cfg(feature = "view")]
    let mut damage = Vec::new();
    #[cfg(feature = "view")]
    for (path, _) in of_all {
        damage = write_foxglove(&arguments.file, path)?;
    }
    for (path, format, one) in files {
        write(&path, format, one, (&times, zero), usize::from(arguments.figures))?;
    }
    #[cfg(not(feature = "view"))]
    let damage = Vec::new();
    Ok(exit_of(&arguments.file, &solved.map_or(damage, |solved| solved.damage)))
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
fn check<'a>(
    paths: impl Iterator<Item = &'a PathBuf>,
    arguments: &Arguments,
) -> Result<(), Failure> {
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

/// Writes a file of a performer. Times in glTF are since `zero`, the same for all performers.
fn write(
    path: &Path,
    format: Format,
    one: &Performer,
    (times, zero): (&Times, Option<Timestamp>),
    figures: usize,
) -> Result<(), Failure> {
    let Performer { actor, skeleton, poses } = one;
    let first = poses.first().map(|pose| pose.capture);
    let fps = frame_rate(poses).unwrap_or(60.0);
    let said = match format {
        Format::Glb => {
            let seconds =
                |pose: &CompactPose| pose.capture.seconds_since(first.unwrap_or_default());
            let timed = poses.iter().map(|pose| (seconds(pose), pose.pose()));
            let about = Take { name: actor, fps, timecode: times.timecode_at(zero) };
            let keys = write_glb(path, &about, skeleton, timed)?;
            format!("{keys} keys at {fps:.2} Hz")
        }
        Format::Bvh => {
            let mut file = BvhFile::create(path, skeleton, fps, None)?;
            poses.iter().try_for_each(|pose| file.write(pose))?;
            let (states, unfilled) = file.finish(path)?;
            unfilled.into_iter().for_each(|text| complain("note", &text));
            times.beside(path, first)?;
            format!("{} frames at {fps:.2} Hz", states.frames())
        }
        Format::Svg => {
            text(path, &strip(poses, skeleton, figures))?;
            format!("{figures} stick figures")
        }
        #[cfg(feature = "view")]
        Format::Mcap => return Ok(()),
    };
    say(&format!("{}: {said}", path.display()));
    Ok(())
}

/// `take1.p1.bvh` for `take1.bvh` of the performer p1; the path itself if there is only one performer.
pub(super) fn path_of(path: &Path, actor: Option<&String>) -> PathBuf {
    match (actor, path.extension()) {
        (None, _) => path.to_owned(),
        (Some(actor), None) => path.with_extension(actor),
        (Some(actor), Some(end)) => path.with_extension(format!("{actor}.{}", end.display())),
    }
}

/// Writes the poses and keypoints of a recording with the schemas of Foxglove; returns the losses of a damaged one.
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
