//! How the people of a crowd move: they cross in the middle of the floor, again and again, and meet in
//! pairs between.

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Rotation2, Vector2, Vector3};

use super::curves::{plateau, smoothstep};
use super::leg::{about_x, set};
use super::motion::{Motion, MotionStyle, about_y};
use super::ring::ring_around;
use crate::core::body::{Joint, Pose, Shape, Skeleton};
use crate::core::camera::{CameraError, Rig};
use crate::core::random::Draws;

/// Time from one side of the floor to the other, seconds for each metre of its radius: at most 1.3 m/s.
const WALK: f64 = 4.5;
/// Time of a meeting, and in it to turn to the partner, seconds.
const MEET: f64 = 5.0;
const TURN: f64 = 1.2;
/// Time from the edge of the floor to the partner, seconds.
const APPROACH: f64 = 1.8;
/// Distance of neighbours in the middle of the floor: arm's length, metres.
const APART: f64 = 0.65;
/// At this speed a person walks; slower ones make smaller steps, m/s.
const WALKING: f64 = 0.5;
/// Samples of the path that tell how far a person has walked.
const SAMPLES: usize = 2000;
/// The travel and the heading of a motion are means over this time, seconds.
const MEAN_S: f64 = 1.0;
/// Distance from the edge of the floor to bystanders who sit, and to those who walk around it, metres.
const SEATS: f64 = 0.9;
const PASSAGE: f64 = 1.4;
/// Speed of those who walk, m/s.
const PASSING: f64 = 1.2;
/// Separates these draws from others with the same seed.
const STREAM: u64 = 0x6d65_6574_0000;

/// Where everybody is. All walk ellipses around the middle of the floor at the same time, so that all
/// pass it together and nobody is in the way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Meeting {
    /// Number of people; they are distributed evenly around the floor.
    pub people: usize,
    /// Distance of the partners' pelvises in the meetings, metres: 0.7 is arm's length, 0.3 an embrace.
    /// `None`: they only cross.
    pub distance: Option<f64>,
}

impl Meeting {
    /// Distance from the middle of the floor at its edge, metres.
    pub fn radius(&self) -> f64 {
        (0.2 * self.people as f64).max(1.4)
    }

    /// Cameras around the floor that see everybody.
    ///
    /// # Errors
    /// `cameras` is below two.
    pub fn rig(&self, cameras: usize) -> Result<Rig, CameraError> {
        ring_around(cameras, self.radius() + 3.0, 2.2, self.radius() + 0.3)
    }

    /// The body of a person who walks, and its motion by seconds from the start.
    pub fn person(self, person: usize, seed: u64) -> (Skeleton, impl Fn(f64) -> Pose) {
        let (skeleton, gait) = walker(person, seed);
        let motion = self.motion(person, gait);
        (skeleton, motion)
    }

    /// A motion on the way of a person. `poses` are `1 / fps` seconds apart. They keep their heights and joints,
    /// and what they sway and turn within a second; their travel and heading become those of the way.
    pub fn lead(self, person: usize, mut poses: Vec<Pose>, fps: f64) -> Vec<Pose> {
        let floor = |at: Vector3<f64>| Vector3::new(at.x, 0.0, at.z);
        let reach = (0.5 * MEAN_S * fps) as usize;
        let travel: Vec<_> = poses.iter().map(|pose| floor(pose.root_position)).collect();
        // Where the left side is, for the front may point to the floor.
        let left: Vec<_> =
            poses.iter().map(|pose| floor(pose.root_rotation * Vector3::x())).collect();
        for (index, pose) in poses.iter_mut().enumerate() {
            let around = index.saturating_sub(reach)..(index + reach + 1).min(travel.len());
            let mean = travel[around.clone()].iter().sum::<Vector3<f64>>() / around.len() as f64;
            let left: Vector3<f64> = left[around].iter().sum();
            let (at, forward) = self.place(person, index as f64 / fps);
            let turn = about_y(forward.x.atan2(forward.y)) * about_y(left.z.atan2(left.x));
            let height = Vector3::y() * pose.root_position.y;
            let sway = turn * (floor(pose.root_position) - mean);
            pose.root_position = Vector3::new(at.x, 0.0, at.y) + sway + height;
            pose.root_rotation = turn * pose.root_rotation;
        }
        poses
    }

    /// The body of somebody who is not a performer, and its motion by seconds from the start. Every second one
    /// sits beyond the edge of the floor, the others walk around it.
    pub fn bystander(self, index: usize, seed: u64) -> (Skeleton, impl Fn(f64) -> Pose) {
        let (skeleton, gait) = walker(self.people + index, seed);
        let thigh = skeleton.offset(Joint::LKnee).norm();
        let turn = TAU * (0.1 + 0.37 * index as f64);
        let sits = index.is_multiple_of(2);
        let away = self.radius() + if sits { SEATS } else { PASSAGE };
        let motion = move |seconds: f64| {
            // At the angle 0 one is at +z, and walks to +x or looks to -z.
            let (walked, facing) = if sits { (0.0, PI) } else { (PASSING * seconds, 0.5 * PI) };
            let angle = turn + walked / away;
            let mut pose = gait.walk(walked, seconds, if sits { 0.0 } else { 1.0 });
            if sits {
                for (joint, bend) in [(Joint::LHip, -0.5 * PI), (Joint::LKnee, 0.5 * PI)] {
                    set(&mut pose.local, joint, about_x(bend));
                    set(&mut pose.local, joint.mirrored(), about_x(bend));
                }
                pose.root_position.y -= thigh;
            }
            pose.root_position = about_y(angle) * Vector3::new(0.0, pose.root_position.y, away);
            pose.root_rotation = about_y(angle + facing) * pose.root_rotation;
            pose
        };
        (skeleton, motion)
    }

    fn motion(self, person: usize, gait: Motion) -> impl Fn(f64) -> Pose {
        let walked = self.walked(person);
        move |seconds| {
            let ((at, forward), speed) = (self.place(person, seconds), self.speed(person, seconds));
            let (round, share) = self.round(seconds);
            let sample = share * (SAMPLES - 1) as f64;
            let (before, between) = (sample.floor() as usize, sample.fract());
            let within =
                walked[before] * (1.0 - between) + walked[(before + 1).min(SAMPLES - 1)] * between;
            let length = round * walked[SAMPLES - 1] + within;
            let mut pose = gait.walk(length, seconds, smoothstep(speed / WALKING));
            let heading: Matrix3<f64> = about_y(forward.x.atan2(forward.y));
            pose.root_position = Vector3::new(at.x, pose.root_position.y, at.y);
            pose.root_rotation = heading * pose.root_rotation;
            pose
        }
    }

    /// Seconds from one side of the floor to the other.
    fn walk(&self) -> f64 {
        WALK * self.radius()
    }

    /// Seconds from one crossing to the next.
    fn period(&self) -> f64 {
        self.walk() + if self.distance.is_some() { MEET } else { 0.0 }
    }

    /// The number of the crossing, and the share of its time that is over.
    fn round(&self, seconds: f64) -> (f64, f64) {
        let rounds = seconds / self.period();
        (rounds.floor(), rounds - rounds.floor())
    }

    /// Distance walked in a round, by time, metres.
    fn walked(&self, person: usize) -> Vec<f64> {
        let at = |sample: usize| {
            self.place(person, self.period() * sample as f64 / (SAMPLES - 1) as f64).0
        };
        let mut sum = 0.0;
        let steps = (1..SAMPLES).map(|sample| {
            sum += (at(sample) - at(sample - 1)).norm();
            sum
        });
        std::iter::once(0.0).chain(steps).collect()
    }

    /// m/s.
    fn speed(&self, person: usize, seconds: f64) -> f64 {
        let [before, after] = [-0.01, 0.01].map(|by| self.place(person, seconds + by).0);
        (after - before).norm() / 0.02
    }

    /// Place on the floor (x, z), metres, and the direction that the person faces.
    fn place(&self, person: usize, seconds: f64) -> (Vector2<f64>, Vector2<f64>) {
        let (round, share) = self.round(seconds);
        let since = share * self.period();
        let phase = PI * (round + smoothstep(since / self.walk()));
        let (at, along) = self.on_ellipse(person, phase);
        let (Some(distance), Some(partner)) = (self.distance, self.partner(person)) else {
            return (at, along);
        };
        let other = self.on_ellipse(partner, phase).0;
        let towards = (other - at).normalize();
        let station = (at + other - towards * distance) * 0.5;
        let met = plateau(since - self.walk(), 0.0, MEET, APPROACH);
        let turned = plateau(since - self.walk(), 0.0, MEET, TURN);
        let facing = along.normalize() * (1.0 - turned) + towards * turned;
        (at.lerp(&station, met), facing)
    }

    /// Place and direction on the person's ellipse.
    fn on_ellipse(&self, person: usize, phase: f64) -> (Vector2<f64>, Vector2<f64>) {
        let people = self.people.max(2) as f64;
        let (long, short) = (self.radius(), 0.5 * APART / (PI / people).sin());
        let turn = Rotation2::new(TAU * person as f64 / people + 0.3);
        let (sin, cos) = phase.sin_cos();
        (
            turn * Vector2::new(long * cos, short * sin),
            turn * Vector2::new(-long * sin, short * cos),
        )
    }

    /// Whom a person meets; the last of an odd number meets nobody.
    fn partner(&self, person: usize) -> Option<usize> {
        let partner = person ^ 1;
        (partner < self.people).then_some(partner)
    }
}

/// The body and the gait of a person.
fn walker(person: usize, seed: u64) -> (Skeleton, Motion) {
    let draws = Draws { seed, stream: STREAM + person as u64 };
    let [[a, b], [c, d]] = [0, 1].map(|item| draws.normals(0, item));
    let mut shape = Shape::default();
    shape.0[..4].copy_from_slice(&[a, b, c, d].map(|normal| normal.clamp(-2.0, 2.0)));
    let skeleton = Skeleton::new(shape);
    let step_time = 0.5 + 0.1 * draws.uniform(1, 0);
    let style = MotionStyle { step_time, ..MotionStyle::default() };
    let gait = Motion::new(&skeleton, style);
    (skeleton, gait)
}
