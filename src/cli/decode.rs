//! `bundlemocap decode`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;

use super::Ended;
use super::failure::{Exit, Failure, done_or_in_part};
use super::overwrite::{Overwrite, check_ending};
use super::solve::decoder;
use super::span::Times;
use super::terminal::{complain, say};
use crate::core::body::Skeleton;
use crate::core::manifold::{Decoder, StampedKeyframe};
use crate::io::recording::{Message, Provenance, Reader, TAKE, Writer};
use crate::io::timecode::House;
use crate::io::wire::{self, Topic, Topics};

/// Decode the poses of a recording from its keyframes alone.
#[derive(Debug, Args)]
#[command(after_help = "\
A keyframe has about 100 numbers. This keyframe, the previous one and the weights of the manifold give
every pose between them exactly as solved, without the standard deviations.

Exit code 6: a keyframe and the poses after it are missing, or the recording is damaged.

Examples:
  bundlemocap decode take1.mcap --out poses.mcap
  bundlemocap decode out/poses.mcap --out again.mcap --weights my.safetensors")]
pub(super) struct Arguments {
    /// Recording with keyframes, from `bundlemocap record` or `solve`.
    file: PathBuf,
    /// Recording to write, with skeleton and poses.
    #[arg(long, value_name = "MCAP")]
    out: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Manifold weights of the solve; default: the embedded weights.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
}

/// Counts of the decoded data.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Decoded {
    keyframes: u64,
    poses: u64,
    /// Windows without their previous keyframe.
    cut_off: u64,
    /// Poses that are only recorded (true) or only decoded: topic and capture time, ns.
    alone: BTreeMap<(Arc<str>, i64), bool>,
}

impl Decoded {
    /// Takes a recorded or a decoded pose.
    fn meet(&mut self, pose: (Arc<str>, i64), is_recorded: bool) {
        if self.alone.remove(&pose).is_none() {
            self.alone.insert(pose, is_recorded);
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    arguments.overwrite.check_beside(&arguments.file, &arguments.out)?;
    check_ending(&arguments.out, "mcap")?;
    let decoder = decoder(arguments.weights.as_deref())?;
    let mut reader = Reader::open(&arguments.file)?;
    let weights = fingerprint(&decoder);
    // The settings have the timecode.
    let config = reader.own_metadata("config").cloned().unwrap_or_default();
    let provenance = Provenance { config, weights: weights.clone(), ..Provenance::default() };
    let mut writer = Writer::create(&arguments.out, Topics::default(), &provenance)?;
    let (mut performers, mut decoded) =
        (BTreeMap::<Arc<str>, Performer>::new(), Decoded::default());
    let timecode = Times::of(&arguments.file, None)?.house;
    let new = || Performer { timecode, last: None, skeleton: None };
    while let Some(entry) = reader.next() {
        let entry = entry?;
        let wire = match entry.message {
            Message::Keyframe(wire) => wire,
            Message::Pose(pose) => {
                if !pose.provisional {
                    decoded.meet((entry.topic, pose.capture_time_ns), true);
                }
                continue;
            }
            _ => continue,
        };
        let keyframe = match wire.to_core() {
            Ok(keyframe) => keyframe,
            Err(error) => {
                reader.reject(&entry.topic, &error);
                continue;
            }
        };
        if wire.weights != weights {
            return Err(other_weights(&arguments.file, &wire, &weights));
        }
        let performer = performers.entry(entry.topic.clone()).or_insert_with(new);
        performer.decode(&entry.topic, keyframe, &decoder, &mut writer, &mut decoded)?;
    }
    if let Some(take) = reader.metadata().get(TAKE) {
        writer.metadata(TAKE, take.clone())?;
    }
    let lost = reader.report().losses();
    if decoded.keyframes == 0 {
        return Err(without_keyframes(&arguments.file, &lost));
    }
    writer.finish()?;
    let Decoded { keyframes, poses, cut_off, alone } = decoded;
    say(&format!("{}: {poses} poses from {keyframes} keyframes", arguments.out.display()));
    let left_out = alone.values().filter(|is_recorded| **is_recorded).count();
    if left_out > 0 {
        complain("note", &format!("{left_out} poses have no keyframes, and are left out"));
    }
    let cut_off = (cut_off > 0).then(|| format!("{cut_off} windows have no previous keyframe"));
    let wrong: Vec<String> = lost.into_iter().chain(cut_off).collect();
    Ok(done_or_in_part(&arguments.file, &wrong))
}

/// The fingerprint of the weights, as in keyframes.
fn fingerprint(decoder: &Decoder) -> String {
    format!("{:016x}", decoder.fingerprint())
}

fn other_weights(path: &Path, keyframe: &wire::Keyframe, ours: &str) -> Failure {
    let message = format!(
        "{}: the keyframe of window {} was solved with the weights {}, but these are {ours}; give \
         the right ones with --weights",
        path.display(),
        keyframe.window,
        keyframe.weights
    );
    Failure::new(Exit::Weights, message)
}

fn without_keyframes(path: &Path, lost: &[String]) -> Failure {
    let fix = "use a recording of `bundlemocap record` or the poses.mcap of `solve`";
    let lost = if lost.is_empty() { String::new() } else { format!(" ({})", lost.join("; ")) };
    let message = format!("{} has no usable keyframes{lost}; {fix}", path.display());
    Failure::new(Exit::NotOurs, message)
}

/// Last keyframe and skeleton of one performer.
struct Performer {
    timecode: Option<House>,
    last: Option<StampedKeyframe>,
    skeleton: Option<Skeleton>,
}

impl Performer {
    fn decode(
        &mut self,
        topic: &str,
        keyframe: StampedKeyframe,
        decoder: &Decoder,
        writer: &mut Writer,
        decoded: &mut Decoded,
    ) -> Result<(), Failure> {
        if self.last.as_ref() == Some(&keyframe) {
            // A repetition for late joiners.
            return Ok(());
        }
        decoded.keyframes += 1;
        let poses = keyframe.poses(self.last.as_ref(), decoder);
        let skeleton = match self.skeleton.take().filter(|one| *one.shape() == keyframe.shape) {
            Some(skeleton) => skeleton,
            None => {
                let skeleton = Skeleton::new(keyframe.shape);
                let wire = wire::Skeleton::from_core(&skeleton);
                writer.write(&topics_of(topic).skeleton(), keyframe.capture, &wire)?;
                skeleton
            }
        };
        match poses {
            Some(poses) => {
                let topic: Arc<str> = topics_of(topic).pose().into();
                for pose in &poses {
                    decoded.meet((Arc::clone(&topic), pose.capture.ns()), false);
                    let wire = wire::Pose::from_core(pose, &skeleton, None);
                    let wire = wire.labelled(self.timecode);
                    writer.write(&topic, pose.capture, &wire)?;
                }
                decoded.poses += poses.len() as u64;
            }
            None => decoded.cut_off += 1,
        }
        (self.skeleton, self.last) = (Some(skeleton), Some(keyframe));
        Ok(())
    }
}

/// The topics of the performer with these keyframes; the default ones if the topic is unknown.
fn topics_of(keyframes: &str) -> Topics {
    Topic::parse(keyframes).ok().and_then(|topic| topic.topics()).unwrap_or_default()
}
