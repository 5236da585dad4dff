//! Draws training samples: two poses of a clip and true poses between them.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::corpus::{Clip, POSE, PoseVector, mirrored, subjects};
use super::restyle::{MeanPose, mean_pose, restyled};
use crate::core::body::Joint;

/// Settings of the sampler.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Share of samples whose legs come from another clip than the rest of the body.
    pub mix: f64,
    /// Share of mirrored samples.
    pub mirror: f64,
    /// Share of samples that are moved to another clip's mean pose.
    pub restyle: f64,
    /// Smallest and largest gain of these.
    pub gains: (f64, f64),
    /// Frames between the two poses of most samples.
    pub span: usize,
    /// Shortest and longest span of the other samples.
    pub spans: (usize, usize),
    /// Share of the samples with other spans.
    pub other_spans: f64,
    /// A subject's probability is proportional to its number of frames to this power.
    pub balance: f64,
}

/// Number of true poses between the two poses of a sample.
pub const BETWEEN: usize = 2;

/// Two poses, and true poses between them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Pose at the start.
    pub a: PoseVector,
    /// Pose at the end.
    pub b: PoseVector,
    /// Poses between, with their time as a fraction of the span, in (0, 1).
    pub between: [(PoseVector, f64); BETWEEN],
}

/// Clips to draw from, by subject.
pub struct Sampler<'a> {
    config: Config,
    subjects: Vec<Subject<'a>>,
}

struct Subject<'a> {
    /// Sum of the probabilities up to and including this subject.
    cumulative: f64,
    clips: Vec<(&'a Clip, MeanPose)>,
    frames: usize,
}

impl<'a> Sampler<'a> {
    /// A sampler of all clips that are longer than the longest span; `None` if there is none.
    pub fn new(clips: &'a [Clip], config: Config) -> Option<Self> {
        let longest = config.span.max(config.spans.1);
        let usable = || clips.iter().filter(|clip| clip.poses.len() > longest);
        let mut subjects: Vec<Subject> = subjects(usable())
            .into_iter()
            .map(|name| {
                let own = usable().filter(|clip| clip.subject == name);
                let clips: Vec<_> = own.map(|clip| (clip, mean_pose(clip))).collect();
                let frames = clips.iter().map(|(clip, _)| clip.poses.len()).sum();
                Subject { cumulative: (frames as f64).powf(config.balance), clips, frames }
            })
            .collect();
        let total: f64 = subjects.iter().map(|subject| subject.cumulative).sum();
        let mut sum = 0.0;
        for subject in &mut subjects {
            sum += subject.cumulative / total;
            subject.cumulative = sum;
        }
        (!subjects.is_empty()).then_some(Self { config, subjects })
    }

    /// Draws one sample.
    pub fn draw(&self, rng: &mut ChaCha8Rng) -> Sample {
        let config = &self.config;
        let span = if rng.random_bool(config.other_spans) {
            rng.random_range(config.spans.0..=config.spans.1)
        } else {
            config.span
        };
        let mut steps = [span; BETWEEN + 2];
        steps[0] = 0;
        steps[1..=BETWEEN].fill_with(|| rng.random_range(1..span));
        let mut poses = self.poses(steps, rng);
        if rng.random_bool(config.mix) {
            let legs = self.poses(steps, rng);
            poses.iter_mut().zip(&legs).for_each(|(pose, legs)| copy_legs(legs, pose));
        }
        let place = |index: usize| steps[index] as f64 / span as f64;
        Sample {
            a: poses[0],
            b: poses[BETWEEN + 1],
            between: std::array::from_fn(|index| (poses[index + 1], place(index + 1))),
        }
    }

    /// Poses of a random clip at `steps` frames after a random first frame; possibly restyled and
    /// mirrored.
    fn poses<const N: usize>(&self, steps: [usize; N], rng: &mut ChaCha8Rng) -> [PoseVector; N] {
        let (clip, from) = self.clip(rng);
        let span = steps.into_iter().max().unwrap_or(0);
        let first = rng.random_range(0..clip.poses.len() - span);
        let mut poses = steps.map(|step| clip.poses[first + step]);
        if rng.random_bool(self.config.restyle) {
            let (_, to) = self.clip(rng);
            let gain = rng.random_range(self.config.gains.0..=self.config.gains.1);
            poses.iter_mut().for_each(|pose| *pose = restyled(pose, from, to, gain));
        }
        if rng.random_bool(self.config.mirror) {
            poses.iter_mut().for_each(|pose| *pose = mirrored(pose));
        }
        poses
    }

    /// Draws a subject, then one of its clips in proportion to its frames.
    fn clip(&self, rng: &mut ChaCha8Rng) -> &(&'a Clip, MeanPose) {
        let at: f64 = rng.random();
        let index = self.subjects.partition_point(|subject| subject.cumulative < at);
        let subject = &self.subjects[index.min(self.subjects.len() - 1)];
        let mut frame = rng.random_range(0..subject.frames);
        for clip in &subject.clips {
            let length = clip.0.poses.len();
            if frame < length {
                return clip;
            }
            frame -= length;
        }
        &subject.clips[0]
    }
}

/// Copies the rotations of hips, knees, ankles and feet.
fn copy_legs(from: &PoseVector, to: &mut PoseVector) {
    let legs = [Joint::LHip, Joint::LKnee, Joint::LAnkle, Joint::LFoot];
    for joint in legs.into_iter().chain(legs.map(Joint::mirrored)) {
        let at = 6 * (joint.index() - 1);
        to[at..at + 6].copy_from_slice(&from[at..at + 6]);
    }
}

/// Mean and standard deviation of each pose component over all clips and their mirror images.
pub fn statistics(clips: &[Clip]) -> (PoseVector, PoseVector) {
    let (mut sum, mut square, mut count) = ([0.0f64; POSE], [0.0f64; POSE], 0.0);
    for pose in clips.iter().flat_map(|clip| &clip.poses) {
        for pose in [*pose, mirrored(pose)] {
            for (index, value) in pose.iter().enumerate() {
                sum[index] += f64::from(*value);
                square[index] += f64::from(*value) * f64::from(*value);
            }
            count += 1.0;
        }
    }
    let mean = sum.map(|sum| sum / count);
    let deviation = |index: usize| (square[index] / count - mean[index] * mean[index]).max(0.0);
    (mean.map(|m| m as f32), std::array::from_fn(|index| deviation(index).sqrt() as f32))
}
