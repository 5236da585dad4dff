//! `bundlemocap solve`

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::{Args, ValueEnum};
use indicatif::ProgressBar;

use super::Ended;
use super::failure::{Exit, Failure, frame_rate_option};
use super::terminal::{complain, progress, say, table};
use crate::config::Config;
use crate::core::body::Skeleton;
use crate::core::camera::{Camera, Rig};
use crate::core::manifold::{Decoder, Interpolation};
use crate::core::optimise::OptimiserKind;
use crate::core::tracker::{EventKind, Input, Solver};
use crate::io::formats::Trc;
use crate::io::recording::{Provenance, Report};
use crate::offline::bvh;
use crate::offline::driver::{Driver, Run};
use crate::offline::figures::{Figures, Measured, True, frame_rate};
use crate::offline::input::{Item, Recording};
use crate::offline::kept::KeptPose;
use crate::offline::output::{self, OutputFolder, PoseFile};
use crate::offline::{FrameClock, HeldOut, HoldOut, compare};

/// Solve a recording: 2D keypoints in, smooth 3D poses out.
#[derive(Debug, Args)]
#[command(after_help = "\
Writes to the folder DIR: poses.mcap (skeleton, rig, poses, keyframes, events), poses.bvh
(centimetres, y up) and report.html. The recording is streamed; poses and errors are kept
in memory for the BVH and the report, 3.5 kB a frame: about 80 MB in all for five minutes of four
cameras at 60 fps.

Exit code 6 means that windows are lost or that the recording is damaged: what could be solved is
there, what could not is flagged.

Examples:
  bundlemocap solve recordings/walk.mcap --out out
  bundlemocap solve balancing.mcap --out out --json
  bundlemocap solve balancing.mcap --out out --hold-out cam01
  bundlemocap solve balancing.mcap --out out --reference pose2sim.trc
  bundlemocap solve balancing.mcap --out out --cameras cam01,cam02,cam04 --optimiser lbfgs")]
pub(super) struct Arguments {
    /// An MCAP recording with keypoints and a calibrated rig.
    file: PathBuf,
    /// The folder to write to; it is made if it is not there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Settings; config/default.toml lists them all.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Weights of a manifold, from `bundlemocap train`; the embedded ones if not given.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Use these cameras only, by name.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    cameras: Vec<String>,
    /// Do not solve with this camera; report the error in it.
    #[arg(long, value_name = "CAMERA")]
    hold_out: Option<String>,
    /// Report the distance to these marker positions (y up, frames as in the recording).
    #[arg(long, value_name = "TRC")]
    reference: Option<PathBuf>,
    /// Frames a second of the cameras, 1 to 1000; found from the recording if not given.
    #[arg(long, value_name = "HZ", allow_negative_numbers = true)]
    fps: Option<f64>,
    /// How latent codes run between keyframes.
    #[arg(long, value_enum)]
    interpolation: Option<InterpolationName>,
    /// The optimiser of the windows.
    #[arg(long, value_enum)]
    optimiser: Option<OptimiserName>,
    /// Print one JSON object, not the table.
    #[arg(long)]
    json: bool,
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

/// What streaming a recording through the machine gave.
struct Solved {
    run: Run,
    truth: True,
    clock: Option<FrameClock>,
    report: Report,
    elapsed: Duration,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let config = settings(arguments)?;
    let decoder = decoder(arguments.weights.as_deref())?;
    let trc = arguments.reference.as_deref().map(Trc::read).transpose()?;
    let recording = Recording::open(&arguments.file)?;
    let held_out = arguments.hold_out.as_deref().map(|name| recording.camera(name)).transpose()?;
    let rig = Arc::new(recording.chosen(&arguments.cameras, held_out)?);

    let folder = OutputFolder::make(&arguments.out)?;
    let provenance = Provenance {
        config: config.to_toml(),
        weights: format!("{:016x}", decoder.fingerprint()),
        ..Provenance::default()
    };
    let path = folder.file("poses.mcap");
    let mut file = PoseFile::create(&path, &recording.rig, &rig, &provenance)?;
    let bar = progress(recording.messages, "messages");
    let solved = solve(&recording, &rig, &config, decoder, &mut file, &bar)?;
    let Some(skeleton) = solved.run.skeleton.clone().filter(|_| solved.run.found_somebody()) else {
        return Err(nobody(&recording, &rig, &solved));
    };
    let figures = measure(&recording, &rig, &skeleton, &solved, held_out, trc.as_ref())?;

    let fps = frame_rate(&solved.run.poses).unwrap_or(60.0);
    bvh::write(&folder.file("poses.bvh"), &solved.run.poses, &skeleton, fps)?;
    output::report(&folder.file("report.html"), &solved.run, &rig, &skeleton, &figures)?;
    file.finish()?;
    bar.finish_and_clear();
    tell(arguments, &figures)?;
    Ok(ended(arguments, &figures))
}

fn measure(
    recording: &Recording,
    rig: &Rig,
    skeleton: &Skeleton,
    solved: &Solved,
    held_out: Option<&Camera>,
    trc: Option<&Trc>,
) -> Result<Figures, Failure> {
    let poses = &solved.run.poses;
    let hold_out =
        held_out.map(|camera| hold_out(recording, camera, skeleton, poses)).transpose()?;
    let reference =
        trc.zip(solved.clock).and_then(|(trc, clock)| compare(trc, clock, skeleton, poses));
    Ok(Figures::new(Measured {
        recording: &recording.path,
        run: &solved.run,
        rig,
        skeleton,
        truth: &solved.truth,
        hold_out,
        reference,
        report: &solved.report,
        elapsed: solved.elapsed,
    }))
}

/// Measures the error in a camera; the recording is read a second time for it.
fn hold_out(
    recording: &Recording,
    camera: &Camera,
    skeleton: &Skeleton,
    poses: &[KeptPose],
) -> Result<HoldOut, Failure> {
    // A rig has two cameras at least; only the first is looked at.
    let other = recording.rig.cameras.iter().find(|other| other.name != camera.name);
    let cameras = std::iter::once(camera).chain(other).cloned().collect();
    let rig = Rig::new(recording.rig.version, cameras)?;
    let mut held_out = HeldOut::new(camera, skeleton, poses);
    recording.stream(
        &rig,
        || {},
        |item| {
            if let Item::Detections(detections) = item
                && detections.camera == 0
            {
                held_out.add(&detections);
            }
            Ok(())
        },
    )?;
    Ok(held_out.finish())
}

fn settings(arguments: &Arguments) -> Result<Config, Failure> {
    let mut config = arguments.config.as_deref().map(Config::load).transpose()?.unwrap_or_default();
    if let Some(fps) = arguments.fps {
        config.tracker.frame_rate_hz = frame_rate_option(fps)?;
    }
    match arguments.interpolation {
        Some(InterpolationName::Slerp) => config.tracker.cost.interpolation = Interpolation::Slerp,
        Some(InterpolationName::Lerp) => config.tracker.cost.interpolation = Interpolation::Lerp,
        None => {}
    }
    match arguments.optimiser {
        Some(OptimiserName::Lm) => config.tracker.optimiser = OptimiserKind::LevenbergMarquardt,
        Some(OptimiserName::Lbfgs) => config.tracker.optimiser = OptimiserKind::Lbfgs,
        None => {}
    }
    Ok(config)
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

fn solve(
    recording: &Recording,
    rig: &Arc<Rig>,
    config: &Config,
    decoder: Decoder,
    file: &mut PoseFile,
    bar: &ProgressBar,
) -> Result<Solved, Failure> {
    let begin = Instant::now();
    let solver = Solver::new(decoder, config.tracker);
    let mut driver =
        Driver::new(config.tracker, Arc::clone(rig), solver, |output| file.write(output));
    let (mut truth, mut clock) = (True::default(), None);
    let report = recording.stream(
        rig,
        || bar.inc(1),
        |item| match item {
            Item::Detections(detections) => {
                let (frame, capture) = (detections.frame, detections.capture);
                if detections.camera == 0 {
                    clock.get_or_insert(FrameClock { frame, capture });
                }
                driver.feed(Input::Detections(detections))
            }
            Item::TrueBody(body) => {
                truth.body = *body;
                Ok(())
            }
            Item::TruePose(pose) => {
                truth.poses.push(pose.as_ref().into());
                Ok(())
            }
        },
    )?;
    driver.feed(Input::End)?;
    truth.poses.sort_by_key(|pose| pose.capture);
    Ok(Solved { run: driver.run, truth, clock, report, elapsed: begin.elapsed() })
}

fn nobody(recording: &Recording, rig: &Rig, solved: &Solved) -> Failure {
    let run = &solved.run;
    let unusable = run.count(EventKind::Unusable);
    let of_another =
        if unusable > 0 { format!(", {unusable} frames could not be used") } else { String::new() };
    let message = format!(
        "{}: nobody was found: no performer is seen by two of the {} cameras at once \
         ({} windows tried{of_another}{}); check the calibration, the keypoint format ({}) and \
         that the cameras share a clock",
        recording.path.display(),
        rig.cameras.len(),
        run.count(EventKind::NobodyFound) + run.lost() as u64,
        out_of_time(run.count(EventKind::Late), run.count(EventKind::Duplicate)),
        recording.format,
    );
    Failure::new(Exit::NobodyFound, message)
}

/// What a recording that is not sorted by capture time loses.
fn out_of_time(late: u64, duplicate: u64) -> String {
    if late == 0 && duplicate == 0 {
        return String::new();
    }
    format!(
        ", {late} frames came late and {duplicate} twice and were left out: is the recording \
         sorted by capture time?"
    )
}

fn tell(arguments: &Arguments, figures: &Figures) -> Result<(), Failure> {
    if arguments.json {
        let text = serde_json::to_string_pretty(figures);
        say(&text.map_err(|error| Failure::new(Exit::Unexpected, error.to_string()))?);
        return Ok(());
    }
    let mut rows = figures.rows();
    let out = arguments.out.join("");
    rows.push((
        "written to".into(),
        format!("{}: poses.mcap, poses.bvh, report.html", out.display()),
    ));
    say(&table(&rows));
    Ok(())
}

/// Done, or done in part with a line that says so.
fn ended(arguments: &Arguments, figures: &Figures) -> Exit {
    let without = figures.windows_without_performer;
    let mut parts = Vec::new();
    if figures.lost > 0 || without > 0 {
        let all = figures.windows as u64 + without;
        let solved = figures.windows - figures.lost;
        let lost = figures.lost;
        parts.push(format!(
            "{solved} of {all} windows solved, {lost} lost, {without} without a performer"
        ));
    }
    parts.extend(figures.damage.first().cloned());
    if figures.damage.len() > 1 {
        parts.push(format!("{} more losses", figures.damage.len() - 1));
    }
    if parts.is_empty() {
        return Exit::Done;
    }
    complain("warning", &format!("{}: {}", arguments.file.display(), parts.join("; ")));
    Exit::InPart
}
