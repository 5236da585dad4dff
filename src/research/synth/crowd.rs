//! Several people in one recording: the nearer ones hide the others.

use nalgebra::{Vector2, Vector3};

use super::points::limb_of;
use super::recording::Recording;
use crate::core::body::{Joint, Pose, Posture};
use crate::core::detections::{Detection, Detections, Person};
use crate::core::points::extent;
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
/// People overlap in the image if their middles are nearer than this share of the smaller one's size.
const OVERLAP: f64 = 0.35;
/// Share of the mixtures in which two people exchange a limb. In the others the nearer one is seen twice.
const EXCHANGES: f64 = 0.7;
/// Separates these draws from others with the same seed.
const STREAM: u64 = 0x6372_6f77_6400;
/// Key of the draws of mixtures; those of the two people are added.
const MIXTURE: u64 = 1 << 32;

/// People who move in front of the same cameras. Points behind another person are missing, or guessed, or
/// those of the nearer person, and people who overlap are mixed, as far as the noise has such errors.
#[derive(Clone, Debug)]
pub struct Crowd<M> {
    /// One for each person, with the same cameras and times.
    people: Vec<Recording<M>>,
    /// Number of the people who are not performers, the last ones; their truth is not written.
    pub bystanders: usize,
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
        Self { people, bystanders: 0 }
    }

    /// One person, with the strangers of the noise.
    pub fn alone(person: Recording<M>) -> Self {
        Self { people: vec![person], bystanders: 0 }
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
        let eye = self.people[0].rig.cameras[frame.camera].centre_in_world();
        let away = |owner: usize| (postures[owner].positions[0] - eye).norm();
        found.sort_by(|a, b| away(a.0).total_cmp(&away(b.0)));
        self.mix(&frame, seconds, &mut found);
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
        points.map(|&k| hider(one.places.of(k, &one.skeleton, &postures[owner]).0)).collect()
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

    /// Mixes people who overlap, as a detector does; the nearest is the first.
    fn mix(&self, frame: &Detections, seconds: f64, found: &mut [(usize, Person)]) {
        let (noise, draws) = (&self.people[0].noise, self.draws(frame.camera));
        for far in 1..found.len() {
            let (nearer, rest) = found.split_at_mut(far);
            let (of_far, far) = &mut rest[0];
            for (of_near, near) in nearer {
                let pair = [*of_near.min(of_far), *of_near.max(of_far)];
                let key = MIXTURE + 1000 * pair[0] as u64 + pair[1] as u64;
                let event = draws.occurrence(key, seconds, noise.mixed, noise.mixed_s);
                let Some(kind) = event.filter(|_| do_overlap(near, far)) else { continue };
                if kind >= EXCHANGES {
                    far.points.clone_from(&near.points);
                    continue;
                }
                let limb = (4.0 * kind / EXCHANGES) as usize;
                for (index, &keypoint) in frame.format.keypoints().iter().enumerate() {
                    if limb_of(keypoint)
                        .is_some_and(|(pair, side)| 2 * pair as usize + side == limb)
                    {
                        std::mem::swap(&mut near.points[index], &mut far.points[index]);
                    }
                }
            }
        }
    }

    fn draws(&self, camera: usize) -> Draws {
        Draws { seed: self.people[0].seed, stream: STREAM + camera as u64 }
    }
}

/// Whether two people are near each other in the image.
fn do_overlap(a: &Person, b: &Person) -> bool {
    let pixels = |person: &Person| -> Vec<Vector2<f64>> {
        person.points.iter().flatten().map(|seen| seen.pixel.coords).collect()
    };
    let [a, b] = [a, b].map(pixels);
    let middle = |all: &[Vector2<f64>]| all.iter().sum::<Vector2<f64>>() / all.len().max(1) as f64;
    let size = [&a, &b].map(|all| extent(all.iter().copied()));
    (middle(&a) - middle(&b)).norm() < OVERLAP * size[0].min(size[1])
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
