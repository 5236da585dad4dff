//! `bundlemocap synth`

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::Ended;
use super::failure::{Exit, Failure, frame_rate_option, ratio};
use super::terminal::{progress, say};
use crate::core::body::{Shape, Skeleton};
use crate::io::formats::keypoint_format;
use crate::io::recording::{Provenance, Writer};
use crate::io::wire::Topics;
use crate::research::synth::{Motion, MotionStyle, Noise, Recording, ring_rig};

/// Radius of the ring and height of its cameras, metres.
pub(super) const RING: [f64; 2] = [4.0, 1.6];

/// Create a synthetic recording with ground truth.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  bundlemocap synth --out walk.mcap
  bundlemocap synth --out long.mcap --seconds 60 --fps 120 --cameras 6 --seed 7
  bundlemocap synth --out exact.mcap --noise none --format halpe_26")]
pub(super) struct Arguments {
    /// Recording to write.
    #[arg(long)]
    out: PathBuf,
    /// Duration, seconds.
    #[arg(long, default_value_t = 4.0, allow_negative_numbers = true)]
    seconds: f64,
    /// Frame rate of every camera, 1 to 1000 Hz; a number, or a ratio such as 60000/1001.
    #[arg(long, default_value_t = 60.0, value_parser = ratio, allow_negative_numbers = true)]
    fps: f64,
    /// Number of cameras around the performer, 2 to 64.
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

    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Jitter => "jitter",
            Self::Clean => "clean",
            Self::Studio => "studio",
            Self::Sparse => "sparse",
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let frames = frame_count(arguments)?;
    let format = keypoint_format(&arguments.format)?;
    let rig = ring_rig(usize::from(arguments.cameras), RING[0], RING[1])?;
    let skeleton = Skeleton::new(Shape::default());
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let mut recording = Recording::new(rig, skeleton, |seconds| motion.pose(seconds));
    recording.fps = arguments.fps;
    recording.frames = frames;
    recording.format = format;
    recording.noise = arguments.noise.noise();
    recording.stagger = arguments.stagger;
    recording.seed = arguments.seed;

    let mut writer = Writer::create(&arguments.out, Topics::default(), &provenance(arguments))?;
    let start = recording.start;
    writer.rig(&recording.rig, start)?;
    writer.truth_skeleton(&recording.skeleton, start)?;
    let bar = progress(frames, "frames");
    let cameras = recording.rig.cameras.len();
    let mut truth = recording.poses();
    for (index, detections) in recording.detections().enumerate() {
        if index % cameras == 0
            && let Some(pose) = truth.next()
        {
            writer.truth_pose(&pose, &recording.skeleton)?;
            bar.inc(1);
        }
        let camera = &recording.rig.cameras[detections.camera];
        writer.keypoints(&detections, &camera.name, [camera.width, camera.height])?;
    }
    writer.finish()?;
    bar.finish_and_clear();
    say(&format!("{}: {frames} frames of {cameras} cameras", arguments.out.display()));
    Ok(Exit::Done)
}

fn frame_count(arguments: &Arguments) -> Result<u64, Failure> {
    let wrong = |option: &str, value: f64, allowed: &str| {
        Failure::new(Exit::Usage, format!("{option} is {value}, but must be {allowed}"))
    };
    let Arguments { seconds, stagger, .. } = *arguments;
    let fps = frame_rate_option(arguments.fps)?;
    if !(0.0..1.0).contains(&stagger) {
        return Err(wrong("--stagger", stagger, "0 or more and below 1"));
    }
    let frames = (seconds * fps).round();
    if !(1.0..=1e8).contains(&frames) {
        return Err(wrong("--seconds", seconds, "from 1 to 1e8 frames long"));
    }
    Ok(frames as u64)
}

/// The arguments, so that the recording can be reproduced.
fn provenance(arguments: &Arguments) -> Provenance {
    let command = format!(
        "bundlemocap synth --seconds {} --fps {} --cameras {} --seed {} --noise {} --format {} \
         --stagger {}",
        arguments.seconds,
        arguments.fps,
        arguments.cameras,
        arguments.seed,
        arguments.noise.name(),
        arguments.format,
        arguments.stagger
    );
    Provenance { more: BTreeMap::from([("command".to_owned(), command)]), ..Provenance::default() }
}
