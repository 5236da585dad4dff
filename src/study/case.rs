//! What methods are measured on: motions with a known truth, seen by noisy detectors.

use std::sync::Arc;

use nalgebra::Vector3;
use serde::Serialize;

use crate::baseline::Take;
use crate::body::{Pose, Shape, Skeleton, StampedPose};
use crate::camera::Rig;
use crate::so3;
use crate::synth::{Motion, MotionStyle, Noise, Recording, through};
use crate::train;

/// Seconds over which one clip turns into the next.
const BLEND_S: f64 = 0.5;

/// How a motion is seen.
#[derive(Clone, Debug)]
pub struct View {
    /// What tables call it.
    pub name: String,
    /// The cameras.
    pub rig: Arc<Rig>,
    /// How the detectors err.
    pub noise: Noise,
    /// Frames a second.
    pub fps: f64,
    /// Longest length, seconds.
    pub seconds: f64,
    /// Of all that is random.
    pub seed: u64,
}

/// A motion and who makes it.
#[derive(Clone, Debug)]
pub struct Subject {
    /// What tables call it.
    pub name: String,
    /// Sets its body and its detectors' errors apart from those of others.
    pub index: u64,
    /// The motion.
    pub source: Source,
}

/// Where a motion comes from.
#[derive(Clone, Debug)]
pub enum Source {
    /// Poses at [`train::FPS`]; the middle is taken if they are too long.
    Poses(Arc<Vec<Pose>>),
    /// Our own, for ever.
    Procedural(MotionStyle),
}

/// A motion seen in one way: enough to make its [`Sequence`], the same each time.
#[derive(Clone, Debug)]
pub struct Case {
    /// The motion.
    pub subject: Subject,
    /// How it is seen.
    pub view: View,
}

/// A take and its truth.
#[derive(Clone, Debug)]
pub struct Sequence {
    /// What the methods are given.
    pub take: Take,
    /// The true pose of each nominal frame.
    pub truth: Vec<StampedPose>,
    /// The true body.
    pub skeleton: Skeleton,
}

/// What of a case is written down.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CaseName {
    /// The motion.
    pub sequence: String,
    /// Of its noise.
    pub seed: u64,
}

impl Case {
    /// Its name.
    pub fn name(&self) -> CaseName {
        CaseName { sequence: self.subject.name.clone(), seed: self.seed() }
    }

    fn seed(&self) -> u64 {
        self.view.seed.wrapping_mul(1000).wrapping_add(self.subject.index)
    }

    /// The body: eight coefficients within 0.9, which no method is told.
    fn skeleton(&self) -> Skeleton {
        let phase = self.subject.index as f64 + self.view.seed as f64 + 0.3;
        Skeleton::new(Shape(std::array::from_fn(|i| 0.9 * ((i + 1) as f64 * phase * 1.7).sin())))
    }

    /// Makes it.
    pub fn make(&self) -> Sequence {
        let View { rig, noise, fps, seconds, .. } = &self.view;
        let skeleton = self.skeleton();
        let motion = self.subject.source.motion(&skeleton, *seconds);
        let mut recording = Recording::new(Rig::clone(rig), skeleton.clone(), motion.pose);
        recording.fps = *fps;
        recording.frames = (motion.seconds * fps).floor() as u64;
        recording.seed = self.seed();
        recording.noise = noise.clone();
        let take = Take {
            rig: Arc::clone(rig),
            format: recording.format,
            fps: *fps,
            frames: recording.detections().collect(),
        };
        Sequence { take, truth: recording.poses().collect(), skeleton }
    }
}

/// A motion of some length.
struct Playing {
    pose: Box<dyn Fn(f64) -> Pose>,
    seconds: f64,
}

impl Source {
    fn motion(&self, skeleton: &Skeleton, seconds: f64) -> Playing {
        match self {
            Self::Procedural(style) => {
                let motion = Motion::new(skeleton, *style);
                Playing { pose: Box::new(move |at| motion.pose(at)), seconds }
            }
            Self::Poses(poses) => {
                let most = ((seconds * train::FPS).round() as usize).min(poses.len());
                let first = (poses.len() - most) / 2;
                let part = centred(poses[first..first + most].to_vec());
                let seconds = most as f64 / train::FPS;
                Playing { pose: Box::new(through(part, train::FPS)), seconds }
            }
        }
    }
}

/// The subjects made of those clips.
pub fn subjects<'a>(clips: impl IntoIterator<Item = &'a train::Clip>) -> Vec<Subject> {
    let subject = |(index, clip): (u64, &train::Clip)| Subject {
        name: clip.name.clone(),
        index,
        source: Source::Poses(Arc::new(all_poses(clip))),
    };
    (1..).zip(clips).map(subject).collect()
}

/// Our own motion, that many times, each in another style; needs no files.
pub fn procedural(count: u64) -> Vec<Subject> {
    let subject = |index: u64| {
        let plain = MotionStyle::default();
        let share = (index % 5) as f64 / 5.0;
        let style = MotionStyle {
            step_time: plain.step_time * (1.0 - 0.2 * share),
            liveliness: plain.liveliness * (1.0 + 0.3 * share),
            ..plain
        };
        Subject { name: format!("procedural {index}"), index, source: Source::Procedural(style) }
    };
    (1..=count).map(subject).collect()
}

/// One motion of that many seconds, out of clips one after the other, from the first again when
/// they end. Each begins where the one before ended, with half a second from one to the next.
/// `None` without clips.
pub fn endless<'a>(
    clips: impl IntoIterator<Item = &'a train::Clip>,
    seconds: f64,
) -> Option<Subject> {
    let parts: Vec<Vec<Pose>> =
        clips.into_iter().map(all_poses).filter(|part| !part.is_empty()).map(centred).collect();
    if parts.is_empty() {
        return None;
    }
    let wanted = (seconds * train::FPS).ceil() as usize;
    let blend = (BLEND_S * train::FPS).round() as usize;
    let mut poses: Vec<Pose> = Vec::with_capacity(wanted);
    for part in parts.iter().cycle() {
        if let (Some(last), Some(first)) = (poses.last().cloned(), part.first()) {
            let share = |k: usize| k as f64 / blend as f64;
            poses.extend((1..blend).map(|k| between(&last, first, smooth(share(k)))));
        }
        poses.extend(part.iter().cloned());
        if poses.len() >= wanted {
            break;
        }
    }
    poses.truncate(wanted);
    let source = Source::Poses(Arc::new(poses));
    Some(Subject { name: "clips without end".into(), index: 1, source })
}

fn all_poses(clip: &train::Clip) -> Vec<Pose> {
    (0..clip.poses.len()).filter_map(|frame| clip.pose(frame)).collect()
}

/// Moved so that the mean of the pelvis is above the origin.
fn centred(mut poses: Vec<Pose>) -> Vec<Pose> {
    let sum: Vector3<f64> = poses.iter().map(|pose| pose.root_position).sum();
    let mean = sum / poses.len().max(1) as f64;
    for pose in &mut poses {
        pose.root_position -= Vector3::new(mean.x, 0.0, mean.z);
    }
    poses
}

/// From 0 to 1 without a kink at either end.
fn smooth(share: f64) -> f64 {
    share * share * (3.0 - 2.0 * share)
}

fn between(a: &Pose, b: &Pose, share: f64) -> Pose {
    Pose {
        root_rotation: so3::slerp(&a.root_rotation, &b.root_rotation, share),
        root_position: a.root_position.lerp(&b.root_position, share),
        local: std::array::from_fn(|j| so3::slerp(&a.local[j], &b.local[j], share)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::BODY_JOINTS;

    fn clip(name: &str, x: f64, frames: usize) -> train::Clip {
        let mut rest = [0.0; train::POSE];
        for joint in 0..BODY_JOINTS {
            rest[6 * joint] = 1.0;
            rest[6 * joint + 4] = 1.0;
        }
        let root = |frame: usize| {
            (nalgebra::Matrix3::identity(), Vector3::new(x + 0.01 * frame as f64, 0.9, 2.0))
        };
        train::Clip {
            name: name.into(),
            subject: "1".into(),
            poses: vec![rest; frames],
            roots: (0..frames).map(root).collect(),
        }
    }

    #[test]
    fn clips_follow_each_other_without_a_leap() {
        let clips = [clip("a", 5.0, 120), clip("b", -3.0, 60)];
        let subject = endless(&clips, 10.0).unwrap();
        let Source::Poses(poses) = subject.source else { panic!() };
        assert_eq!(poses.len(), 600);
        let step = |pair: &[Pose]| (pair[1].root_position - pair[0].root_position).norm();
        let largest = poses.windows(2).map(step).fold(0.0, f64::max);
        assert!(largest < 0.07, "{largest}");
        assert!(poses.iter().all(|pose| pose.root_position.x.abs() < 0.7));
        assert!(endless(&[], 10.0).is_none());
    }
}
