//! `bundlemocap retarget`

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use clap::Args;

use super::Ended;
use super::bus::{BusArguments, check_name, open};
use super::clock::Stop;
use super::export::{Changes, Lost, Solved, cut, path_of, read, states_of, write_states};
use super::failure::{Exit, Failure, done_or_in_part, failures};
use super::overwrite::{Overwrite, check_ending, is_no_input, is_same_file};
use super::retarget_file::{TargetFile, Written};
use super::retarget_live::{Live, Retargeted, warn_unwritten};
use super::span::{SpanArguments, Times};
use super::terminal::{complain, note, say};
use crate::core::body::Skeleton;
use crate::core::time::Timestamp;
use crate::io::file_name;
use crate::offline::Motion;
use crate::offline::bvh::Fill;
use crate::retarget::{Convention, Map, Retarget, RetargetError, Target};

/// Scales that differ by less keep the performers' distances.
const SAME_SCALE: f64 = 1.02;

/// Retarget poses to another skeleton, live or from a recording.
#[derive(Debug, Args)]
#[command(after_help = "\
The skeleton is the hierarchy of a BVH file; its frames are not used. The joint names of Mixamo, CMU,
MotionBuilder, Unity, Daz, Unreal, Biped and this program are known; a TOML file maps other names:

  scale = 1.05                 of the movement over the floor; default: the ratio of the leg lengths
  unit = \"cm\"                  of the file: m, dm, cm, mm, inch, foot or metres; default: guessed
  up = \"z\"                     of the file's world, y or z; default: from the zero pose
  [joints]
  left_knee = \"LeftLeg\"        ours = theirs; \"\" for none

Live poses are published on mocap/STAGE/actor/ACTOR/retargeted/NAME until Ctrl-C or SIGTERM. With
--out they are written meanwhile, to a hidden .part file that is then renamed. Several performers have
a file each: take1.p1.bvh, take1.p2.bvh. --actor chooses one. All files begin at one time: the first
frame of the recording, or live the first pose of anybody. Until a performer's first pose, the file
repeats that pose. If the first pose comes more than ten minutes later, the file begins with it. With
--from, --start, --end, --fps, --in-place and --lost are those of `export`.

Examples:
  bundlemocap retarget --skeleton robot.bvh
  bundlemocap retarget --skeleton robot.bvh --map robot.toml --name robot --out take1.bvh
  bundlemocap retarget --skeleton robot.bvh --from out/poses.mcap --out take1.bvh
  bundlemocap retarget --skeleton robot.bvh --from out/poses.mcap --out cut.bvh --start 240f")]
pub(super) struct Arguments {
    /// BVH file with the skeleton.
    #[arg(long, value_name = "BVH")]
    skeleton: PathBuf,
    /// Joint map of that file, TOML.
    #[arg(long, value_name = "TOML")]
    map: Option<PathBuf>,
    /// Last part of the topic; default: the name of the skeleton's file.
    #[arg(long)]
    name: Option<String>,
    /// BVH file to write.
    #[arg(long, value_name = "BVH")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Read a solved recording instead of the bus.
    #[arg(long, value_name = "MCAP", requires = "out",
        conflicts_with_all = ["name", "bus", "connect", "stage", "config"])]
    from: Option<PathBuf>,
    #[command(flatten)]
    span: SpanArguments,
    #[command(flatten)]
    changes: Changes,
    #[command(flatten)]
    bus: BusArguments,
}

failures! {
    RetargetError {
        RetargetError::Read { .. } => Unreadable,
        _ => Malformed,
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    if let Some(out) = &arguments.out {
        if is_same_file(out, &arguments.skeleton) {
            let message = format!("--out {} is the --skeleton; choose another name", out.display());
            return Err(Failure::new(Exit::Usage, message));
        }
        arguments.map.iter().try_for_each(|map| is_no_input(map, out))?;
        check_ending(out, "bvh")?;
    }
    if arguments.from.is_none() && (arguments.span.is_given() || arguments.changes.is_given()) {
        let message = "--start, --end, --fps, --in-place and --lost need a solved recording: give it \
                       with --from poses.mcap";
        return Err(Failure::new(Exit::Usage, message));
    }
    let mut retarget = character(&arguments.skeleton, arguments.map.as_deref())?;
    match (&arguments.from, &arguments.out) {
        (Some(from), Some(out)) => {
            note(&summary(&arguments.skeleton, &retarget));
            offline(&mut retarget, from, arguments, out)
        }
        _ => live(&mut retarget, arguments),
    }
}

/// The skeleton of a BVH file, with its joint map.
pub(super) fn character(skeleton: &Path, map: Option<&Path>) -> Result<Retarget, Failure> {
    let map = map.map(Map::read).transpose()?.unwrap_or_default();
    let retarget = Retarget::new(Target::read(skeleton, &map)?, &map)?;
    if !retarget.moves() {
        let text = "neither the hips nor a joint above them has three position channels: the figure stays in place";
        complain("warning", &format!("{}: {text}", skeleton.display()));
    }
    Ok(retarget)
}

/// One line about the skeleton and its joint map.
pub(super) fn summary(path: &Path, retarget: &Retarget) -> String {
    let target = retarget.target();
    let convention = target.convention().map_or("unknown", Convention::name);
    let (joints, unit) = (target.joints().len(), target.unit());
    let mapping = retarget.mapping().summary(target);
    format!("{}: {convention} names, {joints} joints, unit {unit} m: {mapping}", path.display())
}

fn offline(retarget: &mut Retarget, from: &Path, arguments: &Arguments, out: &Path) -> Ended {
    let Solved { mut performers, damage } = read(from, false, arguments.bus.actor())?;
    let several = performers.len() > 1;
    let (changes, mut times) = (&arguments.changes, Times::of(from, None)?);
    let start = cut(&mut performers, &arguments.span, changes, &mut times)?;
    let is_marked = changes.lost == Lost::Mark;
    for Motion { actor, .. } in &performers {
        let path = path_of(out, several.then_some(actor));
        let states = is_marked.then(|| states_of(&path));
        for path in times.sidecar(&path).into_iter().chain(states).chain([path]) {
            is_no_input(&arguments.skeleton, &path)?;
            arguments.overwrite.check_beside(from, &path)?;
        }
    }
    for one in &performers {
        let path = path_of(out, several.then_some(&one.actor));
        write(retarget, one, &path, start)?;
        changes.note_lost(one).iter().for_each(|text| complain("note", text));
        if is_marked {
            write_states(&path, one, start, Fill::new(one.fps))?;
        }
        times.beside(&path, Some(start))?;
    }
    let scales = performers.iter().map(|one| retarget.scale(&one.skeleton));
    let (least, most) = scales.fold((f64::MAX, 0.0), |(a, b): (f64, f64), s| (a.min(s), b.max(s)));
    if most > SAME_SCALE * least {
        let text = "the performers' movements have different scales, so their distances change; set `scale` in \
                    --map to give all the same";
        complain("note", text);
    }
    Ok(done_or_in_part(from, &damage))
}

/// Writes the retargeted poses, sorted by capture time, to a file that begins at `start`.
fn write(
    retarget: &mut Retarget,
    one: &Motion,
    out: &Path,
    start: Timestamp,
) -> Result<(), Failure> {
    let Motion { skeleton, poses, fps, .. } = one;
    let mut file = TargetFile::new(out, Some(*fps), start);
    for pose in poses {
        let figure = retarget.apply(&pose.pose(), skeleton)?;
        file.add(pose.capture, &figure, retarget)?;
    }
    if let Some(written) = file.finish(retarget)? {
        tell(&written, retarget, skeleton, out);
    }
    Ok(())
}

fn tell(written: &Written, retarget: &Retarget, skeleton: &Skeleton, out: &Path) {
    let Written { frames, fps, note } = written;
    note.iter().for_each(|text| complain("note", text));
    let scale = retarget.scale(skeleton);
    say(&format!("{}: {frames} frames at {fps:.2} Hz, scale {scale:.3}", out.display()));
}

fn live(retarget: &mut Retarget, arguments: &Arguments) -> Ended {
    let name = match &arguments.name {
        Some(name) => name.clone(),
        None => name_of(&arguments.skeleton),
    };
    check_name("--name", &name)?;
    if let Some(out) = &arguments.out {
        arguments.overwrite.check(out)?;
    }
    let config = arguments.bus.settings()?;
    let topics = arguments.bus.topics(&config);
    if let Some(out) = arguments.out.as_deref().filter(|_| topics.actor == "*") {
        // The performers are not known yet.
        let files = files_of_performers(out).into_iter();
        for path in files.filter(|path| !is_same_file(path, &arguments.skeleton)) {
            arguments.overwrite.check(&path)?;
        }
    }
    let bus = open(&config)?;
    let stop = Stop::on_signals()?;
    // The file of a lone performer has the given name.
    let out = |actor: &String| {
        let named = (topics.actor == "*" && *actor != config.node.actor).then_some(actor);
        let path = arguments.out.as_deref().map(|out| path_of(out, named));
        path.filter(|path| {
            let is_input = is_same_file(path, &arguments.skeleton);
            if is_input {
                let text = format!("{actor} is not written: {} is the --skeleton", path.display());
                complain("warning", &text);
            }
            !is_input
        })
    };
    let live = Live::open(&*bus, &topics, &name, retarget, &out)?;
    note(&format!("{} to {}; stop with Ctrl-C", topics.pose(), topics.retargeted(&name)));
    note(&summary(&arguments.skeleton, retarget));
    let served = live.serve(&stop)?;
    say(&served.to_string());
    let Some(out) = &arguments.out else { return Ok(Exit::Done) };
    let (mut is_written, mut unwritten) = (false, served.unwritten);
    for Retargeted { retarget, skeleton, file, .. } in served.performers.into_values() {
        let (Some(skeleton), Some(file)) = (skeleton, file) else { continue };
        let path = file.path().to_owned();
        match file.finish(&retarget) {
            Ok(Some(written)) => {
                tell(&written, &retarget, &skeleton, &path);
                is_written = true;
            }
            Ok(None) => {}
            Err(error) => {
                warn_unwritten(&error);
                unwritten += 1;
            }
        }
    }
    if unwritten > 0 {
        return Ok(Exit::InPart);
    }
    if is_written {
        return Ok(Exit::Done);
    }
    let fix = "check --stage, --actor and whether the node runs";
    complain("warning", &format!("{} not written: no poses arrived; {fix}", out.display()));
    Ok(Exit::InPart)
}

/// Existing files that may be of a performer, as [`path_of`] names them.
fn files_of_performers(out: &Path) -> Vec<PathBuf> {
    let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty());
    let all = std::fs::read_dir(folder.unwrap_or(Path::new("."))).into_iter().flatten().flatten();
    let text = |part: Option<&OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
    let (start, end) = (text(out.file_stem()) + ".", text(out.extension()));
    let is_of = |path: &PathBuf| {
        let name = file_name(path);
        name.strip_prefix(&start).is_some_and(|rest| match &*end {
            "" => true,
            end => rest.ends_with(&format!(".{end}")),
        })
    };
    all.map(|entry| entry.path()).filter(is_of).collect()
}

/// The file name without its extension, as a part of a topic.
fn name_of(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let fine = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    stem.chars().map(|c| if fine(c) { c } else { '_' }).collect()
}
