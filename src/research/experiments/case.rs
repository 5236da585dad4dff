//! Test cases: motions with a known truth, seen by noisy detectors.

use std::sync::Arc;

use serde::Serialize;

use crate::core::body::{Pose, Skeleton, StampedPose};
use crate::core::camera::{Camera, Rig};
use crate::core::detections::{Detections, KeypointFormat};
use crate::research::methods::Take;
use crate::research::synth::{
    self, Body, Motion, MotionStyle, Noise, Places, Protocol, Recording, SequenceChoice, ring_rig,
    sequence, through,
};
use crate::research::train;

/// Blend time from one clip to the next, seconds.
const BLEND_S: f64 = 0.5;
/// Cameras that no method sees: number on a ring, its radius and their height, metres.
const HELD_OUT: (usize, f64, f64) = (5, 4.0, 2.2);

/// The view of a motion.
#[derive(Clone, Debug)]
pub struct View {
    /// The name in tables.
    pub name: String,
    /// The cameras.
    pub rig: Arc<Rig>,
    /// The keypoint positions of the detectors.
    pub format: KeypointFormat,
    /// The noise of the detectors.
    pub noise: Noise,
    /// The section of the motion, the frame rate, and the bodies.
    pub choice: SequenceChoice,
    /// The seed of all random numbers.
    pub seed: u64,
}

/// A motion.
#[derive(Clone, Debug)]
pub struct Subject {
    /// The name in tables; it gives the motion its own body and detector errors.
    pub name: String,
    /// The performer's name.
    pub subject: String,
    /// The skeleton of the motion's file, if it has one.
    pub skeleton: Option<Skeleton>,
    /// Poses at [`train::FPS`].
    pub poses: Arc<Vec<Pose>>,
}

impl Subject {
    /// The section of its motion that is used, on its own body; `None` if no section fits, see
    /// [`sequence`], or if the file's skeleton is asked for and there is none.
    pub fn section(&self, choice: &SequenceChoice, seed: u64) -> Option<synth::Sequence> {
        let seed = Protocol::seed_of(seed, &self.name);
        self.section_of_seed(choice, seed)
    }

    fn section_of_seed(&self, choice: &SequenceChoice, seed: u64) -> Option<synth::Sequence> {
        sequence(&self.poses, train::FPS, choice, seed, self.skeleton.as_ref())
    }
}

/// A motion with a view: the inputs of its [`Sequence`], which is the same each time.
#[derive(Clone, Debug)]
pub struct Case {
    name: CaseName,
    view: View,
    skeleton: Skeleton,
    places: Places,
    poses: Arc<Vec<Pose>>,
    frames: u64,
}

/// A take and its truth.
#[derive(Clone, Debug)]
pub struct Sequence {
    /// The input of the methods.
    pub take: Take,
    /// The true pose of each nominal frame.
    pub truth: Vec<StampedPose>,
    /// The true body.
    pub skeleton: Skeleton,
    /// Its kind. Only the limb joints of bodies of other origins are compared.
    pub body: Body,
    /// Cameras that no method sees, with the detector's places of the points, without its random
    /// errors.
    pub held_out: Vec<(Camera, Vec<Detections>)>,
}

/// The description of a case for the results.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CaseName {
    /// The motion.
    pub sequence: String,
    /// Whose motion it is.
    pub subject: String,
    /// Name of the true body, if it is a skinned one.
    pub body: Option<String>,
    /// Seed of its body, heading and noise.
    pub seed: u64,
}

impl Case {
    /// A subject with a view; `None` if no section of its motion fits, see [`Subject::section`].
    pub fn new(subject: &Subject, view: &View) -> Option<Self> {
        let seed = Protocol::seed_of(view.seed, &subject.name);
        let made = subject.section(&view.choice, view.seed)?;
        Some(Self {
            name: CaseName {
                sequence: subject.name.clone(),
                subject: subject.subject.clone(),
                body: made.places.name(),
                seed,
            },
            view: view.clone(),
            skeleton: made.skeleton,
            places: made.places,
            poses: Arc::new(made.poses),
            frames: made.frames,
        })
    }

    /// One motion of `seconds` on one body: the subjects in turn, repeated as needed. Each begins
    /// where the one before ended, with a blend of half a second. `None` if no subject fits.
    pub fn endless(subjects: &[Subject], view: &View, seconds: f64) -> Option<Self> {
        let seed = Protocol::seed_of(view.seed, "");
        let (skeleton, places, poses) = in_turn(subjects, &view.choice, seed, seconds)?;
        let name = format!("{} motions in turn", subjects.len());
        Some(Self {
            name: CaseName { subject: name.clone(), sequence: name, body: places.name(), seed },
            view: view.clone(),
            skeleton,
            places,
            frames: (poses.len() as f64 / train::FPS * view.choice.fps).floor() as u64,
            poses: Arc::new(poses),
        })
    }

    /// Its name.
    pub fn name(&self) -> &CaseName {
        &self.name
    }

    /// Frame rate of its cameras, Hz.
    pub fn fps(&self) -> f64 {
        self.view.choice.fps
    }

    /// Makes the sequence.
    pub fn make(&self) -> Sequence {
        let View { rig, noise, choice, format, .. } = &self.view;
        let motion = through(Vec::clone(&self.poses), train::FPS);
        let mut recording = Recording::new(Rig::clone(rig), self.skeleton.clone(), motion);
        recording.places = self.places;
        recording.fps = choice.fps;
        recording.frames = self.frames;
        recording.seed = self.name.seed;
        recording.format = *format;
        recording.noise = noise.clone();
        let frames = recording.detections().collect();
        let take = Take::new(Arc::clone(rig), *format, choice.fps, frames);
        let truth = recording.poses().collect();
        recording.noise = Noise { bias_m: noise.bias_m, ..Noise::none() };
        Sequence {
            take,
            truth,
            skeleton: self.skeleton.clone(),
            body: choice.body,
            held_out: held_out(recording),
        }
    }
}

/// The cameras that no method sees, with their detections of a recording's motion.
fn held_out<M: Fn(f64) -> Pose>(mut recording: Recording<M>) -> Vec<(Camera, Vec<Detections>)> {
    let (count, radius, height) = HELD_OUT;
    let Ok(rig) = ring_rig(count, radius, height) else { return Vec::new() };
    let mut seen = vec![Vec::new(); count];
    recording.rig = rig.clone();
    recording.detections().for_each(|frame| seen[frame.camera].push(frame));
    rig.cameras.into_iter().zip(seen).collect()
}

/// The motions of some clips.
pub fn subjects<'a>(clips: impl IntoIterator<Item = &'a train::Clip>) -> Vec<Subject> {
    let subject = |clip: &train::Clip| Subject {
        name: clip.name.clone(),
        subject: clip.subject.clone(),
        skeleton: Some(clip.skeleton.clone()),
        poses: Arc::new((0..clip.poses.len()).filter_map(|frame| clip.pose(frame)).collect()),
    };
    clips.into_iter().map(subject).collect()
}

/// Our own motion of `seconds`, `count` times, each in another style; needs no files.
pub fn procedural(count: usize, seconds: f64) -> Vec<Subject> {
    let subject = |index: usize| {
        let plain = MotionStyle::default();
        let share = (index % 5) as f64 / 5.0;
        let style = MotionStyle {
            step_time: plain.step_time * (1.0 - 0.2 * share),
            liveliness: plain.liveliness * (1.0 + 0.3 * share),
            ..plain
        };
        let motion = Motion::new(&Skeleton::default(), style);
        let frames = (seconds * train::FPS).ceil() as usize + 1;
        let poses = (0..frames).map(|frame| motion.pose(frame as f64 / train::FPS)).collect();
        let name = format!("procedural {index}");
        Subject { subject: name.clone(), name, skeleton: None, poses: Arc::new(poses) }
    };
    (1..=count).map(subject).collect()
}

/// A body, and poses of `seconds` at [`train::FPS`]: the subjects' sections in turn, repeated as needed, each
/// blended into the next within half a second. `None` if no subject fits.
pub fn in_turn<'a>(
    subjects: impl IntoIterator<Item = &'a Subject>,
    choice: &SequenceChoice,
    seed: u64,
    seconds: f64,
) -> Option<(Skeleton, Places, Vec<Pose>)> {
    let part = |subject: &Subject| subject.section_of_seed(choice, seed);
    let parts: Vec<_> = subjects.into_iter().filter_map(part).collect();
    let first = parts.first()?;
    let (skeleton, places) = (first.skeleton.clone(), first.places);
    Some((skeleton, places, joined(parts.iter().map(|part| &part.poses[..]), seconds)))
}

/// Repeats the parts in turn, with a blend between them, until there are enough frames.
fn joined<'a>(parts: impl Iterator<Item = &'a [Pose]> + Clone, seconds: f64) -> Vec<Pose> {
    let wanted = (seconds * train::FPS).ceil() as usize;
    let blend = (BLEND_S * train::FPS).round() as usize;
    let mut poses: Vec<Pose> = Vec::with_capacity(wanted);
    for part in parts.cycle().take_while(|part| !part.is_empty()) {
        if let (Some(last), Some(first)) = (poses.last().cloned(), part.first()) {
            let share = |k: usize| k as f64 / blend as f64;
            poses.extend((1..blend).map(|k| last.interpolate(first, smooth(share(k)))));
        }
        poses.extend(part.iter().cloned());
        if poses.len() >= wanted {
            break;
        }
    }
    poses.truncate(wanted);
    poses
}

/// Smooth step from 0 to 1.
fn smooth(share: f64) -> f64 {
    share * share * (3.0 - 2.0 * share)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::research::synth::rig_named;

    fn subject(name: &str, x: f64, frames: usize) -> Subject {
        let pose = |frame: usize| {
            let mut pose = Pose::rest();
            pose.root_position = Vector3::new(x + 0.005 * frame as f64, 0.9, 2.0);
            pose
        };
        let poses = Arc::new((0..frames).map(pose).collect());
        Subject { name: name.into(), subject: name.into(), skeleton: None, poses }
    }

    #[test]
    fn a_case_depends_on_its_motion_and_not_on_the_others() {
        let choice = SequenceChoice { least_seconds: 0.5, ..SequenceChoice::default() };
        let [one, other] = ["a", "b"].map(|name| subject(name, 0.0, 120));
        let shape = |subject: &Subject| *subject.section(&choice, 1).unwrap().skeleton.shape();
        assert_eq!(shape(&one), shape(&subject("a", 0.0, 120)));
        assert_ne!(shape(&one), shape(&other));
    }

    #[test]
    fn motions_follow_each_other_without_a_leap() {
        let view = View {
            name: String::new(),
            rig: Arc::new(rig_named("ring4", None).unwrap()),
            format: KeypointFormat::Body25,
            noise: Noise::none(),
            choice: SequenceChoice { least_seconds: 0.5, ..SequenceChoice::default() },
            seed: 1,
        };
        let subjects = [subject("a", 5.0, 120), subject("b", -3.0, 60)];
        let case = Case::endless(&subjects, &view, 10.0).unwrap();
        assert_eq!((case.poses.len(), case.frames), (600, 500));
        let step = |pair: &[Pose]| (pair[1].root_position - pair[0].root_position).norm();
        let largest = case.poses.windows(2).map(step).fold(0.0, f64::max);
        assert!(largest < 0.06, "{largest}");
        assert!(case.poses.iter().all(|pose| pose.root_position.xz().norm() < 0.5));
        assert!(Case::endless(&[], &view, 10.0).is_none());
    }
}
