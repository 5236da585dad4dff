//! `bundlemocap export`

mod files;
mod options;

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

use clap::{Args, ValueEnum};

pub(super) use self::files::{states_of, write_states};
use self::options::Options;
pub(super) use self::options::{Changes, Lost};
use super::Ended;
use super::failure::{Exit, Failure, done_or_in_part, value_name};
use super::overwrite::Overwrite;
use super::span::{SpanArguments, Times};
use super::terminal::{complain, say};
use crate::core::time::{Nanos, Timestamp};
use crate::io::file_name;
use crate::io::formats::Style;
#[cfg(feature = "view")]
use crate::io::new_file;
#[cfg(feature = "view")]
use crate::io::recording::Reader;
use crate::offline::{Motion, read_motions};

/// Files begin at the take's first frame if it is at most this long before the first pose, seconds.
const LONGEST_LEAD_S: f64 = 600.0;
/// A time this near to a frame is that of the frame, periods.
const ON_FRAME: f64 = 0.01;

/// Write the poses of a solved recording for other tools.
#[derive(Debug, Args)]
#[command(after_help = "\
The ending of each file chooses the format:
  .glb    skin, skeleton and animation, for Blender, Unreal, Unity, Godot and browsers; metres
  .usda   the same as USD (UsdSkel), for Houdini, Omniverse, Maya, Blender and usdview; metres
  .bvh    skeleton and animation, for Blender, MotionBuilder and Maya; centimetres
  .trc    keypoints of the body and joint centres (_jc), for OpenSim and Pose2Sim; metres
  .c3d    the same markers, for Mokka, Visual3D and other tools of biomechanics; millimetres
  .csv    places of the joints in the world and their standard deviations (metres), rotations in their
          parents (quaternions)
  .mot    joint angles as OpenSim's Rajagopal models have them; degrees, metres
  .angles.csv  the same as a table
  .npz    rotation vectors of SMPL's joints with AMASS's fields; metres, z up
  .svg    a picture: a row of stick figures
  .mcap   performers and cameras in 3D, joint frames and keypoints, for Foxglove and Lichtblick
In all but .npz y is up, if --up does not say z. At rest the body is a T-pose (or what --rest says)
that faces +z; in .mot it stands with straight legs and hanging arms, and x of the ground is z of the
other files. All rotations are zero then. In .glb and .usda they are zero with --axes world only; else
the joints have y along their bones. In .usda a `:` of a joint's name is `_`. Frames and times count
from the first frame of the take, or from --start of export or of solve. Without --start, frame n of
.bvh, .trc, .c3d, .mot, .npz and .usda is frame n of the video, if the cameras run at the rate of
the poses. Before a performer's first pose and in gaps, .bvh, .mot and .npz repeat a pose, and .trc
(nan) and .c3d are empty. At most ten minutes per file are filled. In gaps longer than 0.25 s and
1.5 periods, .glb and .usda hold the pose; in shorter gaps, programs interpolate. .trc and .c3d are
also empty where the performer is lost or coasting; .c3d has events there. take1.trc.sd.csv has the
standard deviations of the joint centres, in metres, for take1.trc; the same for .c3d.

Examples:
  bundlemocap export out/poses.mcap --out take1.glb
  bundlemocap export out/poses.mcap --out take1.glb --out take1.bvh --out take1.svg
  bundlemocap export out/poses.mcap --out cut.bvh --start 01:00:10:00 --end 01:00:20:00
  bundlemocap export out/poses.mcap --out cut.bvh --start 240f --end 479f --fps 30 --in-place
  bundlemocap export out/poses.mcap --out ue.glb --rest a --names unreal
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
    #[arg(long, visible_alias = "to", value_enum)]
    format: Option<Format>,
    /// Number of stick figures in a picture; default: 7.
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..))]
    figures: Option<u8>,
    #[command(flatten)]
    span: SpanArguments,
    /// Export this performer alone; default: each, to a file named after the performer if the
    /// recording has several.
    #[arg(long, value_name = "NAME")]
    actor: Option<String>,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    options: Options,
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
    /// Joint angles for OpenSim.
    Mot,
    /// A table of joint angles.
    #[value(name = "angles.csv")]
    Angles,
    /// numpy arrays with AMASS's fields.
    Npz,
    /// A row of stick figures.
    Svg,
    /// MCAP with the schemas of Foxglove.
    Mcap,
}

impl Format {
    /// The format that a file's ending names.
    fn of(path: &Path) -> Result<Self, Failure> {
        let name = file_name(path).to_lowercase();
        let is_of = |format: &Self| name.ends_with(&format!(".{}", format.name()));
        // The longest ending counts: .angles.csv before .csv.
        let all = Self::value_variants().iter().copied().filter(is_of);
        all.max_by_key(|format| format.name().len()).ok_or_else(|| {
            let all = Self::value_variants().iter().map(|format| format!(".{}", format.name()));
            let all: Vec<String> = all.collect();
            let (path, all) = (path.display(), all.join(", "));
            Failure::new(
                Exit::Usage,
                format!("{path}: unknown ending; use {all}, or give --format"),
            )
        })
    }

    /// Its name, which is also the ending of its files.
    fn name(self) -> String {
        value_name(self)
    }
}

/// What the files of all performers share.
struct Export {
    times: Times,
    /// The time of the first frame.
    start: Timestamp,
    style: Style,
    lost: Lost,
    /// Stick figures in a picture.
    figures: usize,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let (mut of_one, mut whole, mut has_picture) = (Vec::new(), Vec::new(), false);
    for path in &arguments.out {
        let format = arguments.format.map_or_else(|| Format::of(path), Ok)?;
        arguments.options.check(format)?;
        has_picture |= format == Format::Svg;
        match format.of_one() {
            Some(write) => of_one.push((path, format, write)),
            None => whole.push(path.clone()),
        }
    }
    if arguments.figures.is_some() && !has_picture {
        return Err(Failure::new(Exit::Usage, "--figures is for .svg, and no --out is one"));
    }
    let is_in_part = arguments.truth
        || arguments.actor.is_some()
        || arguments.span.is_given()
        || arguments.options.changes.changes_poses();
    if !whole.is_empty() && is_in_part {
        let message = "a .mcap holds the whole recording; leave out --actor, --truth, --start, --end, \
                       --fps, --in-place and --lost skip";
        return Err(Failure::new(Exit::Usage, message));
    }
    let mut solved = Solved { performers: Vec::new(), damage: Vec::new() };
    let mut several = false;
    let (mut times, mut start) = (Times::of(&arguments.file, None)?, Timestamp::default());
    if !of_one.is_empty() {
        solved = read(&arguments.file, arguments.truth, arguments.actor.as_deref())?;
        several = solved.performers.len() > 1;
        let changes = &arguments.options.changes;
        start = cut(&mut solved.performers, &arguments.span, changes, &mut times)?;
    }
    let export = Export {
        times,
        start,
        style: arguments.options.style(),
        lost: arguments.options.changes.lost,
        figures: arguments.figures.unwrap_or(7).into(),
    };
    let (mut files, mut paths, mut old) = (Vec::new(), whole.clone(), Vec::new());
    for one in &solved.performers {
        let mut besides = Vec::new();
        for (path, format, write) in &of_one {
            let path = path_of(path, several.then_some(&one.actor));
            for (beside, is_written) in format.beside(&path, one, &export) {
                let all = if is_written { &mut besides } else { &mut old };
                if !all.contains(&beside) {
                    all.push(beside);
                }
            }
            paths.push(path.clone());
            files.push((path, one, format, write));
        }
        paths.extend(besides);
    }
    check(&paths, arguments)?;
    if of_one.iter().any(|(_, format, _)| format.is_animation()) {
        let notes = |one| arguments.options.changes.note_lost(one);
        solved.performers.iter().filter_map(notes).for_each(|text| complain("note", &text));
    }
    for path in whole {
        solved.damage = write_foxglove(&arguments.file, &path)?;
    }
    for (path, one, format, write) in files {
        say(&format!("{}: {}", path.display(), write(&path, one, &export)?));
        if !format.has_timecode() {
            export.times.beside(&path, Some(export.start))?;
        }
    }
    for path in old.iter().filter(|path| !paths.contains(path) && path.exists()) {
        // Those of `solve` are beside the recording and have its name.
        let stem = arguments.file.with_extension("");
        if !path.to_string_lossy().starts_with(&format!("{}.", stem.display())) {
            complain("note", &format!("{} is of another export, not of this one", path.display()));
        }
    }
    Ok(done_or_in_part(&arguments.file, &solved.damage))
}

/// Leaves what is exported of the performers; returns the time of the files' first frame: that of --start or of
/// the take's first frame, on the grid of the poses.
pub(super) fn cut(
    performers: &mut Vec<Motion>,
    part: &SpanArguments,
    changes: &Changes,
    times: &mut Times,
) -> Result<Timestamp, Failure> {
    let Some((first, fps)) = first_pose(performers) else { return Ok(Timestamp::default()) };
    times.rate = Some(fps);
    let last = performers.iter().filter_map(|one| Some(one.poses.last()?.capture)).max();
    let mut wanted = file_start(first, times.first);
    let (span, is_resampled) = (part.within(times)?, changes.is_resampled());
    let slack = Nanos::rounded(ON_FRAME / fps * 1e9);
    if let Some([from, to]) = span {
        // Between two poses one before and one after are needed.
        let more = if is_resampled { Nanos::rounded(1e9 / fps) + slack } else { slack };
        for one in performers.iter_mut() {
            let is_in = |at: Timestamp| at + more >= from && at - more <= to;
            one.poses.retain(|pose| is_in(pose.capture));
        }
        wanted = wanted.max(from);
    }
    let start = match part.first(times).filter(|_| is_resampled) {
        // The same times as without --start, if it is one of them.
        Some(asked) => asked.max(wanted),
        None => {
            let start = frame_from((first, fps), wanted);
            // A pose on the grid may be a moment earlier; files have no negative times.
            let all = performers.iter().filter_map(|one| Some(one.poses.first()?.capture));
            all.min().map_or(start, |earliest| start.min(earliest))
        }
    };
    for one in performers.iter_mut() {
        let poses = std::mem::take(&mut one.poses);
        (one.poses, one.fps) = changes.apply(poses, start, one.fps);
        if let Some([_, to]) = span.filter(|_| is_resampled) {
            let is_in = |at: Timestamp| at + slack >= start && at - slack <= to;
            one.poses.retain(|pose| is_in(pose.capture));
        }
    }
    let (left, gone): (Vec<Motion>, Vec<Motion>) =
        performers.drain(..).partition(|one| !one.poses.is_empty());
    *performers = left;
    if performers.is_empty() {
        let but = if changes.lost == Lost::Skip { " but lost or coasting ones" } else { "" };
        return Err(Failure::new(
            Exit::Usage,
            format!(
                "no poses from --start to --end{but}; the take has poses from {:.2} to {:.2} s",
                first.seconds_since(times.first),
                last.unwrap_or(first).seconds_since(times.first)
            ),
        ));
    }
    for one in gone {
        complain("note", &format!("{} has no poses there, and no file", one.actor));
    }
    Ok(start)
}

/// The capture time of the earliest pose of all, and its frame rate.
fn first_pose(performers: &[Motion]) -> Option<(Timestamp, f64)> {
    let poses = |one: &Motion| Some((one.poses.first()?.capture, one.fps));
    performers.iter().filter_map(poses).min_by_key(|one| one.0)
}

/// When a file begins whose first pose is at `first`: at the take's first frame, unless that is too long before.
pub(super) fn file_start(first: Timestamp, take: Timestamp) -> Timestamp {
    let is_near = (-LONGEST_LEAD_S..0.0).contains(&take.seconds_since(first));
    if is_near { take } else { first }
}

/// The first frame at `start` or later, whole frames from the pose at `first`. `fps` is in hertz.
fn frame_from((first, fps): (Timestamp, f64), start: Timestamp) -> Timestamp {
    let frames = (start.seconds_since(first) * fps - ON_FRAME).ceil();
    first + Nanos::rounded(frames / fps * 1e9)
}

/// Checks all files before the first is written.
fn check(paths: &[PathBuf], arguments: &Arguments) -> Result<(), Failure> {
    let mut seen = BTreeSet::new();
    for path in paths {
        if !seen.insert(plain(path)) {
            let message = format!("{} would be written twice; choose another name", path.display());
            return Err(Failure::new(Exit::Usage, message));
        }
        arguments.overwrite.check_beside(&arguments.file, path)?;
    }
    Ok(())
}

/// A path without `.` in it.
fn plain(path: &Path) -> PathBuf {
    path.components().filter(|part| *part != Component::CurDir).collect()
}

/// `take1.p1.bvh` for `take1.bvh` of the performer p1; the path itself if there is only one performer.
pub(super) fn path_of(path: &Path, actor: Option<&String>) -> PathBuf {
    let Some(actor) = actor else { return path.to_owned() };
    let (stem, ending) = stem_and_ending(path);
    match path.extension() {
        // Of no format.
        Some(other) if ending.is_empty() => {
            path.with_extension(format!("{actor}.{}", other.display()))
        }
        _ => path.with_file_name(format!("{stem}.{actor}{ending}")),
    }
}

/// The file name without the ending of its format, and that ending with its dot, such as `.angles.csv`; empty if it is
/// of no format.
fn stem_and_ending(path: &Path) -> (String, String) {
    let name = file_name(path);
    let length = Format::of(path).map_or(0, |format| format.name().len() + 1);
    let (stem, ending) = name.split_at_checked(name.len() - length).unwrap_or((&name, ""));
    (stem.to_owned(), ending.to_owned())
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
    // The writer does not say why it failed before.
    let file = file.finish().map_err(|error| unwritten(&format!("{error}; is the disk full?")))?;
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

/// The content of a solved recording.
pub(super) struct Solved {
    /// By name; at least one.
    pub(super) performers: Vec<Motion>,
    /// Losses of a damaged file.
    pub(super) damage: Vec<String>,
}

/// The poses of a solved recording, or the true ones of a synthetic recording; of one performer, if one
/// is named.
pub(super) fn read(file: &Path, truth: bool, actor: Option<&str>) -> Result<Solved, Failure> {
    let (mut performers, report) = read_motions(file, truth)?;
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
    Ok(Solved { performers, damage: report.losses() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_performers_name_stands_before_the_whole_ending() {
        let of_p1 = |path: &str| path_of(Path::new(path), Some(&"p1".to_owned()));
        for (path, named) in [
            ("a/take.v2.bvh", "a/take.v2.p1.bvh"),
            ("take.angles.csv", "take.p1.angles.csv"),
            ("take.dat", "take.p1.dat"),
            ("take", "take.p1"),
        ] {
            assert_eq!(of_p1(path), Path::new(named));
        }
    }
}
