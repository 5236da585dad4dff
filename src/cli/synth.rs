//! `bundlemocap synth`

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::Ended;
use super::failure::{Exit, Failure, frame_rate_option, ratio, value_name};
use super::overwrite::{Overwrite, check_ending};
use super::terminal::{progress, say};
use crate::core::body::{Pose, Skeleton};
use crate::io::formats::keypoint_format;
use crate::io::recording::Provenance;
use crate::research::synth::{Crowd, Meeting, Motion, MotionStyle, Noise, Recording, ring_rig};

/// Radius of the ring and height of its cameras, metres.
pub(super) const RING: [f64; 2] = [4.0, 1.6];

/// Create a synthetic recording with ground truth.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  bundlemocap synth --out walk.mcap
  bundlemocap synth --out long.mcap --seconds 60 --fps 120 --cameras 6 --seed 7
  bundlemocap synth --out exact.mcap --noise none --format halpe_26
  bundlemocap synth --out crowd.mcap --performers 4 --meet")]
pub(super) struct Arguments {
    /// Recording to write.
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Duration, seconds.
    #[arg(long, default_value_t = 4.0, allow_negative_numbers = true)]
    seconds: f64,
    /// Frame rate of every camera, 1 to 1000 Hz; a number, or a ratio such as 60000/1001.
    #[arg(long, default_value_t = 60.0, value_parser = ratio, allow_negative_numbers = true)]
    fps: f64,
    /// Number of cameras around the performers, 2 to 64.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(2..=64))]
    cameras: u8,
    /// Seed of all random draws.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Noise level of the detectors.
    #[arg(long, value_enum, default_value_t = NoiseName::Studio)]
    noise: NoiseName,
    /// Keypoint format: body_25, body_25b, coco_17, halpe_26 or coco_wholebody_133.
    #[arg(long, default_value = "body_25")]
    format: String,
    /// Spread of the cameras' shutter times as a share of the frame period; 0 is genlock.
    #[arg(long, default_value_t = 0.0)]
    stagger: f64,
    /// Readout time of a rolling shutter, from the first row of an image to the last, milliseconds. The capture
    /// time is that of the middle row.
    #[arg(long, value_name = "MS", default_value_t = 0.0, allow_negative_numbers = true)]
    readout: f64,
    /// Number of performers, 1 to 32. Several cross the middle of the floor together, again and again,
    /// on bodies of their own, and hide each other; the truth is under `actor/p1`, `actor/p2`, ...
    #[arg(long, default_value_t = 1, value_name = "N",
        value_parser = clap::value_parser!(u8).range(1..=32))]
    performers: u8,
    /// Let the performers meet in pairs between the crossings, with that distance of their pelvises,
    /// metres: 0.7 is arm's length, 0.3 an embrace.
    #[arg(long, value_name = "METRES", num_args = 0..=1, default_missing_value = "0.7",
        allow_negative_numbers = true)]
    meet: Option<f64>,
    /// Turn the last camera by 3 degrees and move it by 10 cm after this time; the calibration stays.
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    bump: Option<f64>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
pub(super) enum NoiseName {
    /// Exact projections.
    None,
    /// Only jitter.
    Jitter,
    /// Small jitter and rare gaps.
    Clean,
    /// Typical of a studio: jitter, offset keypoints, gaps, outliers, swapped sides, bystanders.
    Studio,
    /// As studio, but much worse: long occlusions and wrong guesses.
    Sparse,
}

impl NoiseName {
    pub(super) fn noise(self) -> Noise {
        match self {
            Self::None => Noise::none(),
            Self::Jitter => Noise::jitter_only(),
            Self::Clean => Noise::clean(),
            Self::Studio => Noise::studio(),
            Self::Sparse => Noise::sparse(),
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let frames = frame_count(arguments)?;
    check_ending(&arguments.out, "mcap")?;
    arguments.overwrite.check(&arguments.out)?;
    let crowd = crowd(arguments, frames)?;
    let bar = progress(frames, "frames");
    crowd.write(&arguments.out, &provenance(arguments), || bar.inc(1))?;
    bar.finish_and_clear();
    let (people, cameras) = (crowd.people(), arguments.cameras);
    let of = match people.len() {
        1 => String::new(),
        count => format!(" and {count} performers"),
    };
    say(&format!("{}: {frames} frames of {cameras} cameras{of}", arguments.out.display()));
    Ok(Exit::Done)
}

type AnyMotion = Box<dyn Fn(f64) -> Pose>;

/// One performer as always, or several who meet.
fn crowd(arguments: &Arguments, frames: u64) -> Result<Crowd<AnyMotion>, Failure> {
    let (cameras, format) = (usize::from(arguments.cameras), keypoint_format(&arguments.format)?);
    let recording = |rig, skeleton, motion: AnyMotion| {
        let mut recording = Recording::new(rig, skeleton, motion);
        (recording.fps, recording.frames) = (arguments.fps, frames);
        (recording.format, recording.stagger) = (format, arguments.stagger);
        (recording.noise, recording.seed) = (arguments.noise.noise(), arguments.seed);
        recording.noise.readout_s = 1e-3 * arguments.readout;
        recording.bump = arguments.bump;
        recording
    };
    let mut people = Vec::new();
    if arguments.performers == 1 {
        let rig = ring_rig(cameras, RING[0], RING[1])?;
        let skeleton = Skeleton::default();
        let motion = Motion::new(&skeleton, MotionStyle::default());
        people.push(recording(rig, skeleton, Box::new(move |seconds| motion.pose(seconds))));
        return Ok(Crowd::alone(people.remove(0)));
    }
    let meeting = Meeting { people: arguments.performers.into(), distance: arguments.meet };
    let rig = meeting.rig(cameras)?;
    for person in 0..meeting.people {
        let (skeleton, motion) = meeting.person(person, arguments.seed);
        people.push(recording(rig.clone(), skeleton, Box::new(motion)));
    }
    Ok(Crowd::new(people))
}

fn frame_count(arguments: &Arguments) -> Result<u64, Failure> {
    let wrong = |option: &str, value: f64, allowed: &str| {
        Failure::new(Exit::Usage, format!("{option} is {value}, but must be {allowed}"))
    };
    let Arguments { seconds, stagger, readout, .. } = *arguments;
    let fps = frame_rate_option(arguments.fps)?;
    if !(0.0..1.0).contains(&stagger) {
        return Err(wrong("--stagger", stagger, "0 or more and below 1"));
    }
    if !(0.0..=100.0).contains(&readout) {
        return Err(wrong("--readout", readout, "from 0 to 100 ms"));
    }
    let frames = (seconds * fps).round();
    if let Some(metres) = arguments.meet.filter(|metres| !(0.2..=1.5).contains(metres)) {
        return Err(wrong("--meet", metres, "from 0.2 to 1.5 m"));
    }
    if arguments.meet.is_some() && arguments.performers == 1 {
        return Err(Failure::new(Exit::Usage, "--meet needs --performers 2 or more"));
    }
    if let Some(bump) = arguments.bump.filter(|bump| !(0.0..seconds).contains(bump)) {
        return Err(wrong("--bump", bump, "a time in the recording, from 0 s to below --seconds"));
    }
    if !(1.0..=1e8).contains(&frames) {
        return Err(wrong("--seconds", seconds, "from 1 to 1e8 frames long"));
    }
    Ok(frames as u64)
}

/// The arguments, so that the recording can be reproduced.
fn provenance(arguments: &Arguments) -> Provenance {
    let mut command = format!(
        "bundlemocap synth --seconds {} --fps {} --cameras {} --seed {} --noise {} --format {} \
         --stagger {}",
        arguments.seconds,
        arguments.fps,
        arguments.cameras,
        arguments.seed,
        value_name(arguments.noise),
        arguments.format,
        arguments.stagger
    );
    if arguments.readout > 0.0 {
        command += &format!(" --readout {}", arguments.readout);
    }
    if arguments.performers > 1 {
        command += &format!(" --performers {}", arguments.performers);
    }
    if let Some(metres) = arguments.meet {
        command += &format!(" --meet {metres}");
    }
    if let Some(seconds) = arguments.bump {
        command += &format!(" --bump {seconds}");
    }
    Provenance { more: BTreeMap::from([("command".to_owned(), command)]), ..Provenance::default() }
}
