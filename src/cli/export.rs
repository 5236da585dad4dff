//! `bundlemocap export`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;

use super::Ended;
use super::failure::{Exit, Failure};
use super::overwrite::Overwrite;
#[cfg(feature = "view")]
use super::overwrite::is_same_file;
use super::span::{SpanArguments, Times};
use super::terminal::{complain, say};
use crate::core::body::Skeleton;
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
Examples:
  bundlemocap export out/poses.mcap --bvh take1.bvh
  bundlemocap export out/poses.mcap --bvh cut.bvh --start 01:00:10:00 --end 01:00:20:00
  bundlemocap export out/poses.mcap --picture take1.svg --figures 7
  bundlemocap export out/poses.mcap --foxglove take1.foxglove.mcap    for Foxglove and Lichtblick
  bundlemocap export both/poses.mcap --bvh take1.bvh             take1.p1.bvh, take1.p2.bvh
  bundlemocap export both/poses.mcap --bvh take1.bvh --actor p2  take1.bvh")]
#[command(group = clap::ArgGroup::new("what").required(true).multiple(true))]
pub(super) struct Arguments {
    /// The poses.mcap of `bundlemocap solve`.
    file: PathBuf,
    /// BVH file to write: centimetres, y up, +z forward at rest.
    #[arg(long, value_name = "BVH", group = "what")]
    bvh: Option<PathBuf>,
    /// Picture to write: a row of stick figures.
    #[arg(long, value_name = "SVG", group = "what")]
    picture: Option<PathBuf>,
    /// MCAP file to write with the schemas of Foxglove, for Foxglove and Lichtblick: performers and cameras in
    /// 3D, joint frames, keypoints.
    #[cfg(feature = "view")]
    #[arg(long, value_name = "MCAP", group = "what", conflicts_with_all = ["bvh", "picture", "figures", "truth", "actor", "start", "end"])]
    foxglove: Option<PathBuf>,
    /// Number of stick figures in the picture.
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

pub(super) fn run(arguments: &Arguments) -> Ended {
    #[cfg(feature = "view")]
    if let Some(path) = &arguments.foxglove {
        return write_foxglove(&arguments.file, path, &arguments.overwrite);
    }
    let actor = arguments.actor.as_deref();
    let Solved { mut performers, damage } = read(&arguments.file, arguments.truth, actor)?;
    let times = Times::of(&arguments.file, None)?;
    let several = performers.len() > 1;
    if let Some([start, end]) = arguments.span.within(&times)? {
        for one in &mut performers {
            one.poses.retain(|pose| (start..=end).contains(&pose.capture));
        }
        performers.retain(|one| !one.poses.is_empty());
        if performers.is_empty() {
            return Err(Failure::new(Exit::Usage, "no poses from --start to --end"));
        }
    }
    for Performer { actor, .. } in &performers {
        for path in arguments.bvh.iter().chain(&arguments.picture) {
            arguments.overwrite.check(&path_of(path, several.then_some(actor)))?;
        }
    }
    for Performer { actor, skeleton, poses } in &performers {
        let fps = frame_rate(poses).unwrap_or(60.0);
        if let Some(path) = &arguments.bvh {
            let path = path_of(path, several.then_some(actor));
            let frames = write_bvh(&path, poses, skeleton, fps)?;
            times.beside(&path, poses.first().map(|pose| pose.capture))?;
            say(&format!("{}: {frames} frames at {fps:.2} Hz", path.display()));
        }
        if let Some(path) = &arguments.picture {
            let path = path_of(path, several.then_some(actor));
            text(&path, &strip(poses, skeleton, usize::from(arguments.figures)))?;
            say(&format!("{}: {} stick figures", path.display(), arguments.figures));
        }
    }
    Ok(exit_of(&arguments.file, &damage))
}

/// `take1.p1.bvh` for `take1.bvh` of the performer p1; the path itself if there is only one performer.
pub(super) fn path_of(path: &Path, actor: Option<&String>) -> PathBuf {
    match (actor, path.extension()) {
        (None, _) => path.to_owned(),
        (Some(actor), None) => path.with_extension(actor),
        (Some(actor), Some(end)) => path.with_extension(format!("{actor}.{}", end.display())),
    }
}

/// Writes poses, sorted by capture time, as BVH; returns the number of frames.
fn write_bvh(
    path: &Path,
    poses: &[CompactPose],
    skeleton: &Skeleton,
    fps: f64,
) -> Result<usize, Failure> {
    let mut file = BvhFile::create(path, skeleton, fps, None)?;
    poses.iter().try_for_each(|pose| file.write(pose))?;
    let (states, unfilled) = file.finish(path)?;
    unfilled.into_iter().for_each(|text| complain("note", &text));
    Ok(states.frames())
}

/// Writes the poses and keypoints of a recording with the schemas of Foxglove.
#[cfg(feature = "view")]
fn write_foxglove(from: &Path, to: &Path, overwrite: &Overwrite) -> Ended {
    overwrite.check(to)?;
    if is_same_file(from, to) {
        let message = format!("{} is the input; choose another name", to.display());
        return Err(Failure::new(Exit::Usage, message));
    }
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
    Ok(exit_of(from, &reader.report().losses()))
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
