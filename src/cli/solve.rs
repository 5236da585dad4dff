//! `bundlemocap solve`

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{File, TryLockError};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::{Args, ValueEnum};
use indicatif::ProgressBar;

use super::Ended;
use super::clock::{ATTENTION, Stop};
use super::failure::{Exit, Failure, done_or_in_part, frame_rate_option, json, ratio};
use super::overwrite::is_no_input;
use super::rig::{ConventionArguments, read as read_rig};
use super::settings::changed;
use super::span::{SpanArguments, Times};
use super::stage::StageArguments;
use super::terminal::{complain, note, progress, say, table};
use crate::config::Config;
use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::manifold::{Decoder, Interpolation};
use crate::core::optimise::OptimiserKind;
use crate::core::stage::Performers;
use crate::core::time::Timestamp;
use crate::io::formats::{MarkerMap, Trajectories, calibration_files, read_trajectories};
use crate::io::recording::{body_file, body_files, last_body, summary};
use crate::io::wire::{ActorChannel, Topic, Topics};
use crate::offline::output::of_performer;
use crate::offline::{
    Group, NewCompanion, Observer, Options, PerformerSummary, Recording, Summary, solve_group,
};

/// The role of a known body's file in a manifest, before the person's name.
const BODY_OF: &str = "body of ";

/// Solve a recording: 2D keypoints in, smooth 3D poses out.
#[derive(Debug, Args)]
#[command(after_help = "\
Writes to the folder DIR:
  poses.mcap         skeleton, rig, poses, keyframes, events, and the state of the cameras. Foxglove
                     and Lichtblick show it in 3D
  poses.bvh          poses in centimetres, y up, from the recording's first frame (or --start) on;
                     frames before the performer is found repeat the first pose, gaps repeat the
                     previous pose
  poses.states.csv   first_frame,last_frame,state: runs of BVH frames, counted from 0, that are
                     tracking, coasting (extrapolated), lost (do not use) or held (repeated)
  report.html        metrics and plots
With --performers 2 or more, or auto, poses.mcap and report.html hold everybody; each performer has
poses.p1.bvh and poses.p1.states.csv, poses.p2.bvh ...

Several recordings, or one with --jobs, are each solved into a folder of their own, DIR/NAME. It
also gets summary.json (as of --json) and manifest.json (version, inputs, settings). A recording is
not solved again if these and its outputs are the same; if not, --overwrite is needed. One that
failed or was interrupted is solved again. One that fails does not stop the others. Several
processes on one computer may share the work: each waits at the end for the takes of the others.
With --names and --bodies, takes are solved one after the other, in the order of their names.
`bundlemocap summary DIR` prints all.

The recording is streamed: memory does not grow with its length. Percentiles are exact up to
131072 values (points or windows), and within 0.05 % above that.

Exit code 6: windows fit badly, a recording is damaged, or one of several failed. All solvable
parts are written; lost poses are flagged. Ctrl-C ends a solve, and leaves no half files.

Examples:
  bundlemocap solve recordings/walk.mcap --out out
  bundlemocap solve balancing.mcap --out out --json
  bundlemocap solve takes/*.mcap --out out --jobs 2
  bundlemocap solve balancing.mcap --out out --hold-out cam01
  bundlemocap solve two_people.mcap --out out --performers auto
  bundlemocap solve balancing.mcap --out out --body static/poses.mcap
  bundlemocap solve balancing.mcap --out out --reference pose2sim.trc
  bundlemocap solve balancing.mcap --out out --cameras cam01,cam02,cam04")]
pub(super) struct Arguments {
    /// MCAP recordings with keypoints and a calibrated rig.
    #[arg(required = true, value_name = "RECORDING")]
    pub(super) files: Vec<PathBuf>,
    /// Output folder; created if missing.
    #[arg(long, value_name = "DIR")]
    pub(super) out: PathBuf,
    /// Solve so many of several recordings at a time; default: 1. With it, one recording gets a folder of its
    /// own, too.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=64))]
    pub(super) jobs: Option<u8>,
    /// Threads of each solve. They solve several performers in parallel; the poses are the same with any number.
    /// Default: one for each processor; 1 with --jobs.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..))]
    threads: Option<u8>,
    /// Replace the files of an earlier solve.
    #[arg(long)]
    pub(super) overwrite: bool,
    #[command(flatten)]
    span: SpanArguments,
    /// Settings file; config/default.toml lists every setting.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Manifold weights of `bundlemocap train`; default: the embedded weights.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Calibration to use instead of the recording's, such as one of `calibrate`.
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    convention: ConventionArguments,
    /// Use only these cameras.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    cameras: Vec<String>,
    /// Solve without these cameras and report their reprojection errors.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    hold_out: Vec<String>,
    /// Recording that holds the performer's body, such as an earlier poses.mcap. Its bones are kept
    /// if they fit. Default: the body is estimated.
    #[arg(long, value_name = "FILE")]
    body: Option<PathBuf>,
    /// The performer of --body, if that recording has several.
    #[arg(long, value_name = "NAME", requires = "body")]
    body_actor: Option<String>,
    /// Report the distance to these marker trajectories (TRC with y up, or C3D; frames as in the recording); with
    /// several files, separated by commas, that of each performer to the nearest.
    #[arg(long, value_name = "FILE", value_delimiter = ',')]
    reference: Vec<PathBuf>,
    /// TOML file that names the markers of each point for --reference. Below [points],
    /// left_knee = ["LFLE", "LFME"] is the middle of two markers. Default: markers with names such as LKnee
    /// or left_knee.
    #[arg(long, value_name = "TOML", requires = "reference")]
    markers: Option<PathBuf>,
    #[command(flatten)]
    stage: StageArguments,
    /// Use the capture times as they are; default: correct those of cameras that are shifted.
    #[arg(long)]
    no_sync: bool,
    /// Frame rate of the cameras, 1 to 1000 Hz, such as 60 or 60000/1001; default: estimated from the
    /// recording.
    #[arg(long, value_name = "HZ", value_parser = ratio, allow_negative_numbers = true)]
    fps: Option<f64>,
    /// Interpolation of latent codes between keyframes.
    #[arg(long, value_enum)]
    interpolation: Option<InterpolationName>,
    /// The optimiser of the windows; lbfgs is for the paper's setting, --config config/paper.toml.
    #[arg(long, value_enum)]
    optimiser: Option<OptimiserName>,
    /// Leave out of poses.mcap what Foxglove and Lichtblick need to show it in 3D. The file is then a
    /// third smaller.
    #[cfg(feature = "view")]
    #[arg(long)]
    no_foxglove: bool,
    /// Print one JSON object instead of the table.
    #[arg(long)]
    pub(super) json: bool,
}

impl Arguments {
    #[cfg(feature = "view")]
    fn companion(&self) -> Option<NewCompanion> {
        (!self.no_foxglove).then_some(|| Box::new(crate::view::Beside::default()))
    }

    #[cfg(not(feature = "view"))]
    #[allow(clippy::unused_self)]
    fn companion(&self) -> Option<NewCompanion> {
        None
    }
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum InterpolationName {
    Slerp,
    Lerp,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum OptimiserName {
    Lm,
    Lbfgs,
}

/// A progress bar over the messages of the recording. A stop request ends the solve.
pub(super) struct Progress {
    pub(super) bar: ProgressBar,
    pub(super) stop: Stop,
}

impl Progress {
    /// One that is never asked to stop.
    pub(super) fn over(messages: u64) -> Self {
        Self { bar: progress(messages, "messages"), stop: Stop::default() }
    }
}

impl Observer for Progress {
    fn message(&mut self) -> ControlFlow<()> {
        self.bar.inc(1);
        if self.stop.is_set() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }
}

/// Solves one recording into the folder of --out.
pub(super) fn alone(arguments: &Arguments, prepared: &Prepared, file: &Path) -> Ended {
    let bar = |messages| progress(messages, "messages");
    let solved = prepared.solve(arguments, file, &arguments.out, arguments.overwrite, bar)?;
    solved.lines.iter().for_each(|(kind, text)| complain(kind, text));
    tell(arguments, &solved)?;
    Ok(solved.exit)
}

/// What all recordings of a command share.
pub(super) struct Prepared {
    config: Config,
    decoder: Decoder,
    body: Option<Arc<Skeleton>>,
    references: Vec<Trajectories>,
    rig: Option<Rig>,
    pub(super) stop: Stop,
}

/// A recording that was solved.
pub(super) struct Solved {
    group: Group,
    performers: Performers,
    has_timecode: bool,
    /// What to tell of it: `note` or `warning`, and a sentence.
    pub(super) lines: Vec<(&'static str, String)>,
    pub(super) exit: Exit,
}

impl Solved {
    fn of(file: &Path, group: Group, performers: Performers, has_timecode: bool) -> Self {
        let notes = group.performers.iter().flat_map(|one| one.summary.notes.clone());
        let mut seen = BTreeSet::new();
        let notes = notes.filter(|note| seen.insert(note.clone()));
        let mut lines: Vec<_> = notes.map(|note| ("note", note)).collect();
        if group.others > 0 {
            let people = if group.others == 1 { "person was" } else { "people were" };
            lines.push(("note", format!("{} more {people} seen, not solved", group.others)));
        }
        let mut exit = Exit::Done;
        for one in &group.performers {
            if ended(file, performers, one, &mut lines) != Exit::Done {
                exit = Exit::InPart;
            }
        }
        Self { group, performers, has_timecode, lines, exit }
    }

    /// The cameras' time offsets that are in use: what they are, and their values.
    pub(super) fn offsets(&self) -> impl Iterator<Item = (String, String)> {
        self.group.performers.first().into_iter().flat_map(|one| one.summary.offset_rows())
    }

    /// Whether the body with that role in the manifest is of somebody who was known, or became known.
    pub(super) fn knows(&self, role: &str) -> bool {
        let name = role.strip_prefix(BODY_OF);
        self.group.known.iter().any(|known| Some(&*known.name) == name)
    }

    /// The files that were written.
    pub(super) fn files(&self) -> Vec<String> {
        let names: Vec<_> = self.group.performers.iter().map(|one| one.performer.clone()).collect();
        files(&names, self.performers, self.has_timecode)
    }

    /// What `--json` prints.
    pub(super) fn json(&self) -> Result<String, Failure> {
        match self.group.performers.first() {
            Some(only) if self.performers.limit() == 1 => json(&only.summary),
            _ => json(&self.group),
        }
    }
}

impl Arguments {
    /// The files that all solves of this command read, by what they are for.
    pub(super) fn shared_inputs(&self) -> Result<Vec<(String, PathBuf)>, Failure> {
        let mut all = Vec::new();
        let mut add = |role: &str, files: &[PathBuf]| {
            all.extend(
                files.iter().enumerate().map(|(i, file)| (format!("{role} {i}"), file.clone())),
            );
        };
        if let Some(rig) = &self.rig {
            add("rig", &calibration_files(rig)?);
        }
        add("body", self.body.as_slice());
        add("reference", &self.reference);
        add("markers", self.markers.as_slice());
        Ok(all)
    }
}

impl Prepared {
    pub(super) fn of(arguments: &Arguments) -> Result<Self, Failure> {
        let config = settings(arguments)?;
        let decoder = decoder(arguments.weights.as_deref())?;
        let actor = arguments.body_actor.as_deref();
        let body = arguments.body.as_deref().map(|path| last_body(path, actor)).transpose()?;
        if config.stage.performers.limit() > 1 && body.is_some() {
            return Err(Failure::new(
                Exit::Usage,
                "--body is of one performer; leave out --performers",
            ));
        }
        let map = arguments.markers.as_deref().map(MarkerMap::read).transpose()?;
        let read = |path: &PathBuf| read_trajectories(path, map.as_ref());
        let references = arguments.reference.iter().map(read).collect::<Result<_, _>>()?;
        let rig = arguments.rig.as_deref();
        let rig = rig.map(|rig| read_rig(rig, &arguments.convention)).transpose()?;
        // A wrong file is said before the first take is solved.
        config.known_people()?;
        let (body, stop) = (body.map(Arc::new), Stop::on_signals()?);
        Ok(Self { config, decoder, body, references, rig, stop })
    }

    /// Whether people may become known, for the takes that follow.
    pub(super) fn makes_known(&self) -> bool {
        self.config.bodies_folder().is_some() && !self.config.stage.names.is_empty()
    }

    /// The files of known bodies that exist now, by their role in the manifest.
    pub(super) fn bodies(&self) -> Result<BTreeMap<String, PathBuf>, Failure> {
        let files = self.config.bodies_folder().map(body_files).transpose()?.unwrap_or_default();
        let role = |file: &PathBuf| {
            format!("{BODY_OF}{}", file.file_stem().unwrap_or_default().to_string_lossy())
        };
        Ok(files.into_iter().map(|file| (role(&file), file)).collect())
    }

    /// All that changes a solve beside its files.
    pub(super) fn settings(&self, arguments: &Arguments) -> serde_json::Value {
        // Threads, and the settings of node and bus, do not change the result.
        let Config { stage, mut tracker, timecode, .. } = self.config.clone();
        tracker.threads = Config::default().tracker.threads;
        let config = Config { stage, tracker, timecode, ..Config::default() };
        let mut settings = serde_json::json!({
            "config": config.to_toml(),
            "weights": format!("{:016x}", self.decoder.fingerprint()),
            "cameras": arguments.cameras,
            "hold_out": arguments.hold_out,
            "no_sync": arguments.no_sync,
            "body_actor": arguments.body_actor,
            "span": format!("{:?}", arguments.span),
            "convention": format!("{:?}", arguments.convention),
        });
        if arguments.companion().is_none() {
            settings["no_foxglove"] = true.into();
        }
        settings
    }

    /// Solves a recording into a folder. `bar`: shows the progress in that many messages.
    pub(super) fn solve(
        &self,
        arguments: &Arguments,
        file: &Path,
        out: &Path,
        overwrite: bool,
        bar: impl FnOnce(u64) -> ProgressBar,
    ) -> Result<Solved, Failure> {
        let performers = self.config.stage.performers;
        let shared = arguments.shared_inputs()?.into_iter().map(|(_, input)| input);
        let outputs = files(&[Topics::default().actor], Performers::default(), false);
        for input in shared.chain(arguments.config.clone()).chain([file.to_owned()]) {
            outputs.iter().try_for_each(|name| is_no_input(&input, &out.join(name)))?;
        }
        let mut recording = arguments.convention.open(file, self.rig.as_ref())?;
        let times = Times::of(file, Some(&self.config))?;
        let span = arguments.span.within(&times)?;
        recording = recording.within(span);
        let folder = self.config.bodies_folder().filter(|_| self.makes_known());
        let _alone = folder.map(|folder| self.lock(folder)).transpose()?;
        let timecode = times.timecode.clone();
        let one_each = arguments.jobs.filter(|_| !self.makes_known()).map(|_| 1);
        let options = Options {
            config: self.config.tracker,
            decoder: Some(self.decoder.clone()),
            cameras: arguments.cameras.clone(),
            hold_out: arguments.hold_out.clone(),
            references: self.references.clone(),
            performers,
            choice: self.config.stage.choice(),
            names: self.config.stage.names.clone(),
            // An earlier take may have brought more.
            known: self.config.known_people()?,
            body: self.body.clone(),
            out: Some(out.to_owned()),
            overwrite,
            no_sync: arguments.no_sync,
            timecode: times.house,
            threads: arguments.threads.or(one_each).map_or(0, usize::from),
            companion: arguments.companion(),
            config_toml: Some(Config { timecode, ..self.config.clone() }.to_toml()),
        };
        let earlier = if overwrite { performers_of(&out.join("poses.mcap")) } else { Vec::new() };
        let bar = bar(options.passes() * recording.messages());
        let mut progress = Progress { bar, stop: self.stop.clone() };
        let group = solve_group(&mut recording, &options, &mut progress)?;
        progress.bar.finish_and_clear();
        let of = |name: &str| of_performer(name, performers, "");
        let new: Vec<_> = group.performers.iter().map(|one| of(&one.performer)).collect();
        remove_others(out, &earlier, &new);
        self.save_bodies(&group)?;
        for one in &group.performers {
            let bvh = out.join(of_performer(&one.performer, performers, "bvh"));
            let first = one.summary.first_capture_time_ns.map(Timestamp::from_ns);
            times.beside(&bvh, first)?;
            if times.house.is_none() && overwrite {
                // An earlier solve had a timecode.
                let _ = std::fs::remove_file(bvh.with_extension("timecode.txt"));
            }
        }
        Ok(Solved::of(file, group, performers, times.house.is_some()))
    }

    /// Waits until no other solve makes people known in a folder. It is locked until the file is dropped. After a stop
    /// request it does not wait, and the solve ends.
    fn lock(&self, folder: &Path) -> Result<File, Failure> {
        let lock = || {
            std::fs::create_dir_all(folder)?;
            let file = File::create(folder.join(".lock"))?;
            locked(&file, Some(&self.stop)).map(|_| file)
        };
        lock().map_err(|error| {
            let message = format!("{}: cannot be locked ({error})", folder.display());
            Failure::new(Exit::Unexpected, message)
        })
    }

    /// Writes the bodies of performers with a name, and says which ones are not known well enough.
    fn save_bodies(&self, group: &Group) -> Result<(), Failure> {
        let Some(folder) = self.config.bodies_folder() else { return Ok(()) };
        for (name, file) in group.write_bodies(folder)? {
            note(&format!("the body of {name} is written to {}", file.display()));
        }
        let found = group.performers.iter().map(|one| &one.performer);
        let named = found.filter(|name| self.config.stage.names.contains(name));
        let is_new = |name: &&String| !body_file(folder, name).exists();
        for name in named.filter(|name| !group.was_seen_well(name)).filter(is_new) {
            note(&format!("no body of {name} is written: tracked too shortly, or lost too often"));
        }
        Ok(())
    }
}

/// Locks a file until it is dropped; false if another process has locked it. With `until`, waits for that process, at most
/// until the stop request.
pub(super) fn locked(file: &File, until: Option<&Stop>) -> std::io::Result<bool> {
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(true),
            Err(TryLockError::WouldBlock) if until.is_some_and(|stop| !stop.is_set()) => {
                std::thread::sleep(ATTENTION);
            }
            Err(TryLockError::WouldBlock) => return Ok(false),
            Err(TryLockError::Error(error)) => return Err(error),
        }
    }
}

/// Warns of what could not be used of a recording; the exit code says whether that is nothing.
pub(super) fn lost(recording: &Recording) -> Exit {
    done_or_in_part(recording.path(), &recording.losses())
}

/// The files of a solve.
fn files(names: &[String], performers: Performers, has_timecode: bool) -> Vec<String> {
    let suffixes = ["bvh", "states.csv"].into_iter().chain(has_timecode.then_some("timecode.txt"));
    let own = |suffix| names.iter().map(move |name| of_performer(name, performers, suffix));
    let first = std::iter::once("poses.mcap".to_owned());
    first.chain(suffixes.flat_map(own)).chain(["report.html".to_owned()]).collect()
}

/// The performers of a solved recording; none if it cannot be read.
fn performers_of(poses: &Path) -> Vec<String> {
    let topics = summary(poses).map(|info| info.topics).unwrap_or_default();
    let performers = topics.keys().filter_map(|topic| match Topic::parse(topic) {
        Ok(Topic::Actor { actor, channel: ActorChannel::Pose, .. }) => Some(actor.to_owned()),
        _ => None,
    });
    performers.collect()
}

/// Removes the files of performers whom only the `earlier` solve found. `new`: how the names of the new files begin.
fn remove_others(out: &Path, earlier: &[String], new: &[String]) {
    let alone = Topics::default().actor;
    for name in earlier {
        let performers = if *name == alone { Performers::default() } else { Performers::Auto };
        let start = of_performer(name, performers, "");
        if new.contains(&start) {
            continue;
        }
        for ending in ["bvh", "timecode.txt", "states.csv"] {
            // What cannot be removed stays.
            if std::fs::remove_file(out.join(format!("{start}{ending}"))).is_ok() {
                note(&format!("{start}{ending} of the earlier solve is removed"));
            }
        }
    }
}

fn settings(arguments: &Arguments) -> Result<Config, Failure> {
    changed(arguments.config.as_deref(), Config::conflict_of_people, |config| {
        if let Some(fps) = arguments.fps {
            config.tracker.frame_rate_hz = frame_rate_option(fps)?;
        }
        let tracker = &mut config.tracker;
        match arguments.interpolation {
            Some(InterpolationName::Slerp) => tracker.cost.interpolation = Interpolation::Slerp,
            Some(InterpolationName::Lerp) => tracker.cost.interpolation = Interpolation::Lerp,
            None => {}
        }
        match arguments.optimiser {
            Some(OptimiserName::Lm) => tracker.optimiser = OptimiserKind::LevenbergMarquardt,
            Some(OptimiserName::Lbfgs) => tracker.optimiser = OptimiserKind::Lbfgs,
            None => {}
        }
        arguments.stage.apply(&mut config.stage)
    })
}

/// The decoder of a weights file, or the embedded one.
pub(super) fn decoder(weights: Option<&Path>) -> Result<Decoder, Failure> {
    let Some(path) = weights else {
        return Decoder::embedded()
            .map_err(|error| Failure::weights(Path::new("the embedded weights"), &error));
    };
    let bytes = std::fs::read(path).map_err(|error| {
        let message =
            format!("cannot read the weights {}: {error}; check the path", path.display());
        Failure::new(Exit::Unreadable, message)
    })?;
    Decoder::from_bytes(&bytes).map_err(|error| Failure::weights(path, &error))
}

fn tell(arguments: &Arguments, solved: &Solved) -> Result<(), Failure> {
    if arguments.json {
        say(&solved.json()?);
        return Ok(());
    }
    let Solved { group, performers, .. } = solved;
    let mut rows = match group.performers.first() {
        Some(only) if performers.limit() == 1 => only.summary.rows(),
        _ => group.rows(),
    };
    let (out, files) = (arguments.out.join(""), solved.files().join(", "));
    rows.push(("written to".into(), format!("{}: {files}", out.display())));
    say(&table(&rows));
    Ok(())
}

/// Done, or partly done with a warning.
fn ended(
    file: &Path,
    performers: Performers,
    one: &PerformerSummary,
    lines: &mut Vec<(&'static str, String)>,
) -> Exit {
    let PerformerSummary { performer, summary } = one;
    let of = if performers.limit() > 1 { format!("{performer}: ") } else { String::new() };
    let Summary { windows, lost, hidden, .. } = summary;
    let mut parts = Vec::new();
    // Who enters late, leaves or is hidden is not lost.
    if lost > hidden {
        parts.push(format!("{} of {windows} windows fit badly", lost - hidden));
    }
    let without = summary.windows_without_performer;
    if *hidden > 0 {
        let searched = match without {
            0 => String::new(),
            _ => format!(", and not found in {without} more"),
        };
        let text = format!("{of}not seen well enough in {hidden} of {windows} windows{searched}");
        lines.push(("note", text));
    }
    parts.extend(summary.damage.first().cloned());
    if summary.damage.len() > 1 {
        parts.push(format!("{} more losses", summary.damage.len() - 1));
    }
    if parts.is_empty() {
        return Exit::Done;
    }
    lines.push(("warning", format!("{}: {of}{}", file.display(), parts.join("; "))));
    Exit::InPart
}
