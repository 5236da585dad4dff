//! Several people in one recording: the nearer ones hide the others.

use nalgebra::{Vector2, Vector3};

use super::recording::Recording;
use crate::core::body::{Joint, Pose, Posture};
use crate::core::detections::{Detection, Detections, Person};
use crate::core::random::Draws;

/// Parts of a body that hide what is behind them: the joints at the ends, and the radius, metres.
const CAPSULES: [(Joint, Joint, f64); 12] = [
    (Joint::Pelvis, Joint::Spine3, 0.14),
    (Joint::Spine3, Joint::Neck, 0.14),
    (Joint::Neck, Joint::Head, 0.10),
    (Joint::LHip, Joint::LKnee, 0.08),
    (Joint::RHip, Joint::RKnee, 0.08),
    (Joint::LKnee, Joint::LAnkle, 0.05),
    (Joint::RKnee, Joint::RAnkle, 0.05),
    (Joint::LShoulder, Joint::LElbow, 0.05),
    (Joint::RShoulder, Joint::RElbow, 0.05),
    (Joint::LElbow, Joint::LWrist, 0.04),
    (Joint::RElbow, Joint::RWrist, 0.04),
    (Joint::LShoulder, Joint::RShoulder, 0.08),
];
/// A person with fewer points is not detected.
const FEWEST: usize = 5;
/// Longest time in which a detector gives points of a hidden person to the nearer one, seconds.
const MIXED_S: f64 = 0.3;
/// Separates these draws from others with the same seed.
const STREAM: u64 = 0x6372_6f77_6400;

/// People who move in front of the same cameras, without bystanders. Points behind another person are
/// missing, or guessed, or those of the nearer person, as far as the noise has such errors.
#[derive(Clone, Debug)]
pub struct Crowd<M> {
    /// One for each person, with the same cameras and times.
    people: Vec<Recording<M>>,
}

impl<M: Fn(f64) -> Pose> Crowd<M> {
    /// A crowd of the people of these recordings. All have the cameras, the times and the noise of the
    /// first; each has a seed of its own.
    pub fn new(mut people: Vec<Recording<M>>) -> Self {
        if let [first, others @ ..] = &mut people[..] {
            first.noise.strangers = 0.0;
            for (person, other) in (1..).zip(others) {
                (other.rig, other.noise) = (first.rig.clone(), first.noise.clone());
                (other.fps, other.frames, other.start) = (first.fps, first.frames, first.start);
                (other.format, other.stagger) = (first.format, first.stagger);
                other.bump = first.bump;
                other.seed = first.seed.wrapping_add(person << 32);
            }
        }
        Self { people }
    }

    /// One person, with bystanders.
    pub fn alone(person: Recording<M>) -> Self {
        Self { people: vec![person] }
    }

    /// A recording for each person, alone.
    pub fn people(&self) -> &[Recording<M>] {
        &self.people
    }

    /// The detections, ordered by capture time, then by camera; and whose each is: an index of
    /// [`Self::people`].
    pub fn detections(&self) -> impl Iterator<Item = (Detections, Vec<usize>)> + '_ {
        let mut each: Vec<_> = self.people.iter().map(Recording::detections).collect();
        std::iter::from_fn(move || {
            let frames: Option<Vec<Detections>> = each.iter_mut().map(Iterator::next).collect();
            frames.filter(|frames| !frames.is_empty()).map(|frames| self.together(frames))
        })
    }

    /// What a detector sees of all, from what it sees of each alone.
    fn together(&self, mut frames: Vec<Detections>) -> (Detections, Vec<usize>) {
        if frames.len() == 1 {
            let owners = vec![0; frames[0].people.len()];
            return (frames.remove(0), owners);
        }
        let frame = Detections { people: Vec::new(), ..frames[0] };
        let seconds = (frame.capture - self.people[0].start).seconds();
        let posture = |one: &Recording<M>| (one.motion)(seconds).posture(&one.skeleton);
        let postures: Vec<Posture> = self.people.iter().map(posture).collect();
        let mut found: Vec<(usize, Person)> = Vec::new();
        for (owner, alone) in frames.iter().enumerate() {
            let hiders = self.hiders(&frame, owner, &postures);
            for person in &alone.people {
                let mut person = person.clone();
                for (index, hider) in hiders.iter().enumerate() {
                    if let Some(hider) = hider {
                        let of_hider = frames[*hider].people.first();
                        let of_hider = of_hider.and_then(|hider| hider.points[index]);
                        let point = person.points[index];
                        person.points[index] = self.hidden(&frame, owner, index, point, of_hider);
                    }
                }
                found.push((owner, person));
            }
        }
        found.retain(|(_, person)| person.points.iter().flatten().count() >= FEWEST);
        let draws = self.draws(frame.camera);
        let order = |(owner, _): &(usize, Person)| draws.uniform(*owner as u64, frame.frame);
        found.sort_by(|a, b| order(a).total_cmp(&order(b)));
        let (owners, people) = found.into_iter().unzip();
        (Detections { people, ..frame }, owners)
    }

    /// By point of the format: the nearest other person who hides it.
    fn hiders(&self, frame: &Detections, owner: usize, postures: &[Posture]) -> Vec<Option<usize>> {
        let one = &self.people[owner];
        let eye = one.rig.cameras[frame.camera].centre_in_world();
        let hider = |point: Vector3<f64>| {
            let others = (0..postures.len()).filter(|other| *other != owner);
            let depths =
                others.filter_map(|other| Some((other, depth(&postures[other], &eye, &point)?)));
            depths.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(other, _)| other)
        };
        let points = frame.format.keypoints().iter();
        points.map(|&k| hider(one.body.position(k, &one.skeleton, &postures[owner]))).collect()
    }

    /// What a detector makes of a hidden point.
    fn hidden(
        &self,
        frame: &Detections,
        owner: usize,
        index: usize,
        point: Option<Detection>,
        of_hider: Option<Detection>,
    ) -> Option<Detection> {
        let one = &self.people[owner];
        let (noise, draws) = (&one.noise, self.draws(frame.camera));
        let seconds = (frame.capture - one.start).seconds();
        let of_person = 1000 * (1 + owner as u64);
        if draws.occurrence(of_person, seconds, noise.swaps, MIXED_S).is_some() {
            return of_hider.map(|seen| Detection { confidence: 0.6 * seen.confidence, ..seen });
        }
        let is_guessed = noise.occlusions > 0.0
            && draws.uniform(of_person + 1, (seconds / MIXED_S) as u64) < noise.hallucinated;
        let point = point.filter(|_| is_guessed)?;
        let smooth = draws.smooth_normals(of_person + 10 + index as u64, seconds, MIXED_S);
        let size = 0.4 * f64::from(one.rig.cameras[frame.camera].height);
        let error = Vector2::from(smooth) * (noise.hallucination * size);
        Some(Detection { pixel: point.pixel + error, confidence: 0.5 * point.confidence })
    }

    fn draws(&self, camera: usize) -> Draws {
        Draws { seed: self.people[0].seed, stream: STREAM + camera as u64 }
    }
}

/// Distance from the eye at which a body hides a point, metres. `None`: it does not.
fn depth(body: &Posture, eye: &Vector3<f64>, point: &Vector3<f64>) -> Option<f64> {
    let (ray, away) = ((point - eye).normalize(), (point - eye).norm());
    let mut nearest: Option<f64> = None;
    for (from, to, radius) in CAPSULES {
        let [from, to] = [from, to].map(|joint| body.positions[joint.index()]);
        // Balls along the part.
        let balls = ((to - from).norm() / radius).ceil();
        for ball in 0..=balls as usize {
            let centre = from.lerp(&to, ball as f64 / balls) - eye;
            let along = centre.dot(&ray);
            let is_before = along > 0.0 && along + radius < away;
            if is_before && (centre - ray * along).norm() < radius {
                nearest = Some(nearest.map_or(along, |nearest| nearest.min(along)));
            }
        }
    }
    nearest
}
