//! `bundlemocap export`

use std::path::PathBuf;

use clap::Args;

use super::Ended;
use super::failure::{Exit, Failure};
use super::figures::{frame_rate, losses};
use super::kept::KeptPose;
use super::output::{bvh, strip, text};
use super::terminal::{complain, say};
use crate::body::Skeleton;
use crate::record::{Message, Reader};

/// Write the poses of a solved recording for other tools.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  bundlemocap export out/poses.mcap --bvh take1.bvh
  bundlemocap export out/poses.mcap --picture take1.svg --figures 7")]
#[command(group = clap::ArgGroup::new("what").required(true).multiple(true))]
pub(super) struct Arguments {
    /// The poses.mcap of a solve.
    file: PathBuf,
    /// Biovision hierarchy: centimetres, y up, +z forward at rest.
    #[arg(long, value_name = "BVH", group = "what")]
    bvh: Option<PathBuf>,
    /// A strip of stick figures.
    #[arg(long, value_name = "SVG", group = "what")]
    picture: Option<PathBuf>,
    /// How many figures the picture shows.
    #[arg(long, default_value_t = 7, value_parser = clap::value_parser!(u8).range(1..))]
    figures: u8,
    /// Export the true poses of a synthetic recording instead.
    #[arg(long)]
    truth: bool,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let Solved { skeleton, poses, damage } = read(arguments)?;
    let fps = frame_rate(&poses).unwrap_or(60.0);
    if let Some(path) = &arguments.bvh {
        bvh(path, &poses, &skeleton, fps)?;
        say(&format!("{}: {} frames at {fps:.2} Hz", path.display(), poses.len()));
    }
    if let Some(path) = &arguments.picture {
        text(path, &strip(&poses, &skeleton, usize::from(arguments.figures)))?;
        say(&format!("{}: {} figures", path.display(), arguments.figures));
    }
    if damage.is_empty() {
        return Ok(Exit::Done);
    }
    complain("warning", &format!("{}: {}", arguments.file.display(), damage.join("; ")));
    Ok(Exit::InPart)
}

/// What a solved recording holds.
struct Solved {
    skeleton: Skeleton,
    /// In order of capture time.
    poses: Vec<KeptPose>,
    /// What was lost of the file.
    damage: Vec<String>,
}

fn read(arguments: &Arguments) -> Result<Solved, Failure> {
    let mut reader = Reader::open(&arguments.file)?;
    let (mut skeleton, mut poses) = (None, Vec::new());
    while let Some(entry) = reader.next() {
        let entry = entry?;
        let result = match (entry.message, arguments.truth) {
            (Message::Skeleton(wire), false) | (Message::TruthSkeleton(wire), true) => {
                wire.to_core().map(|body| skeleton = Some(body))
            }
            (Message::Pose(wire), false) | (Message::TruthPose(wire), true) => {
                wire.to_core().map(|pose| poses.push(KeptPose::from(&pose)))
            }
            _ => Ok(()),
        };
        if let Err(error) = result {
            reader.reject(&entry.topic, &error);
        }
    }
    let damage = losses(reader.report());
    match skeleton.filter(|_| !poses.is_empty()) {
        Some(skeleton) => Ok(Solved { skeleton, poses, damage }),
        None => {
            let fix = if arguments.truth {
                "only recordings from `bundlemocap synth` hold a truth"
            } else {
                "solve it first, and give the poses.mcap of `bundlemocap solve`"
            };
            let message = format!("{} holds no poses; {fix}", arguments.file.display());
            Err(Failure::new(Exit::NotOurs, message))
        }
    }
}
