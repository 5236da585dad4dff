//! A 2D detector that errs as real ones do: it jitters, misses, swaps sides, sees strangers.

use nalgebra::{Point2, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::motion::{Motion, MotionStyle};
use super::random::Draws;
use crate::body::{Attachment, Posture, Skeleton};
use crate::camera::Camera;
use crate::detect::{Detection, Detections, Keypoint, KeypointFormat, Person};
use crate::time::Timestamp;

/// How a detector errs. Rates are occurrences a second and camera; `_s` is the longest that one
/// lasts, in seconds. The default is a studio with plain backgrounds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Noise {
    /// Standard deviation of a limb's points along each axis, as a share of the person's height
    /// in pixels.
    pub jitter: f64,
    /// Time over which the jitter changes, seconds; a third of its variance is new in each frame.
    pub correlation_s: f64,
    /// How much the confidences fall short of 1 for an error of one standard deviation.
    pub doubt: f64,
    /// Probability that a point is missing.
    pub missing: f64,
    /// Probability that a point is grossly wrong, with a middling confidence.
    pub outliers: f64,
    /// A limb hidden from the camera: its points go missing, or are guessed badly.
    pub occlusions: f64,
    /// See `occlusions`; per limb.
    pub occlusion_s: f64,
    /// Left and right of the legs, or of the arms, swapped.
    pub swaps: f64,
    /// See `swaps`.
    pub swap_s: f64,
    /// A bystander at the edge of the floor is detected too.
    pub strangers: f64,
    /// See `strangers`.
    pub stranger_s: f64,
    /// The performer is reported as two people, trunk and legs.
    pub splits: f64,
    /// See `splits`.
    pub split_s: f64,
    /// Nobody is detected.
    pub blanks: f64,
    /// See `blanks`.
    pub blank_s: f64,
}

impl Default for Noise {
    fn default() -> Self {
        Self {
            jitter: 0.006,
            correlation_s: 0.12,
            doubt: 0.10,
            missing: 0.01,
            outliers: 0.003,
            occlusions: 0.05,
            occlusion_s: 0.8,
            swaps: 0.03,
            swap_s: 0.25,
            strangers: 0.06,
            stranger_s: 1.5,
            splits: 0.02,
            split_s: 0.2,
            blanks: 0.02,
            blank_s: 0.1,
        }
    }
}

impl Noise {
    /// Exact projections with confidence 1; only what lies outside the image is missing.
    pub fn none() -> Self {
        Self {
            jitter: 0.0,
            correlation_s: 0.12,
            doubt: 0.0,
            missing: 0.0,
            outliers: 0.0,
            occlusions: 0.0,
            occlusion_s: 0.8,
            swaps: 0.0,
            swap_s: 0.25,
            strangers: 0.0,
            stranger_s: 1.5,
            splits: 0.0,
            split_s: 0.2,
            blanks: 0.0,
            blank_s: 0.1,
        }
    }

    /// Jitter alone.
    pub fn jitter_only() -> Self {
        let Self { jitter, doubt, .. } = Self::default();
        Self { jitter, doubt, ..Self::none() }
    }
}

/// What draws are for; the numbers only need to differ.
mod topic {
    pub(super) const SWAP: u64 = 1;
    pub(super) const STRANGER: u64 = 2;
    pub(super) const SPLIT: u64 = 3;
    pub(super) const BLANK: u64 = 4;
    pub(super) const ORDER: u64 = 5;
    /// Plus the limb.
    pub(super) const OCCLUSION: u64 = 10;
    /// Plus the point.
    pub(super) const SLOW: u64 = 100;
    pub(super) const FAST: u64 = 200;
    pub(super) const MISSING: u64 = 300;
    pub(super) const OUTLIER: u64 = 400;
    pub(super) const CONFIDENCE: u64 = 500;
    /// Added for the stranger's points.
    pub(super) const OF_STRANGER: u64 = 1000;
}

/// The detector of one camera.
#[derive(Clone, Debug)]
pub(super) struct Detector<'a> {
    camera: &'a Camera,
    index: usize,
    format: KeypointFormat,
    noise: &'a Noise,
    draws: Draws,
    stranger: Posture,
}

impl<'a> Detector<'a> {
    pub(super) fn new(
        camera: &'a Camera,
        index: usize,
        format: KeypointFormat,
        noise: &'a Noise,
        seed: u64,
    ) -> Self {
        let stranger = stranger(Draws { seed, stream: u64::MAX });
        Self { camera, index, format, noise, draws: Draws { seed, stream: index as u64 }, stranger }
    }

    /// What it says of the body at `seconds`, the capture time.
    pub(super) fn detect(
        &self,
        frame: u64,
        capture: Timestamp,
        seconds: f64,
        body: (&Skeleton, &Posture),
    ) -> Detections {
        let (noise, draws) = (self.noise, &self.draws);
        let mut people = Vec::new();
        let blank = draws.stretch(topic::BLANK, seconds, noise.blanks, noise.blank_s);
        if blank.is_none() {
            let performer = self.person(frame, seconds, body, 0);
            let split = draws.stretch(topic::SPLIT, seconds, noise.splits, noise.split_s);
            match split {
                Some(_) => people.extend(self.split(performer)),
                None => people.push(performer),
            }
            let seen = draws.stretch(topic::STRANGER, seconds, noise.strangers, noise.stranger_s);
            if seen.is_some() {
                let other = (&Skeleton::default(), &self.stranger);
                people.push(self.person(frame, seconds, other, topic::OF_STRANGER));
            }
            people.retain(|person| person.points.iter().flatten().count() >= 3);
            if draws.uniform(topic::ORDER, frame) < 0.5 {
                people.reverse();
            }
        }
        Detections { camera: self.index, frame, capture, format: self.format, people }
    }

    fn person(
        &self,
        frame: u64,
        seconds: f64,
        (skeleton, posture): (&Skeleton, &Posture),
        base: u64,
    ) -> Person {
        let swapped = self
            .draws
            .stretch(base + topic::SWAP, seconds, self.noise.swaps, self.noise.swap_s)
            .map(|which| if which < 0.7 { Region::Leg } else { Region::Arm });
        let exact: Vec<Option<Vector2<f64>>> = (self.format.keypoints().iter())
            .map(|&keypoint| {
                let swap = swapped.is_some() && swapped == limb_of(keypoint).map(|(r, _)| r);
                let keypoint = if swap { mirrored(keypoint) } else { keypoint };
                self.camera.project(&position(keypoint, skeleton, posture))
            })
            .collect();
        let size = extent(&exact);
        let mut points = vec![None; self.format.len()];
        for (index, exact) in exact.iter().enumerate() {
            let at = At { frame, seconds, keypoint: self.format.keypoints()[index], size, base };
            points[index] = exact.and_then(|pixel| self.point(&at, index as u64, pixel));
        }
        Person { id: None, points }
    }

    /// One point, given where it truly is in the image.
    fn point(&self, at: &At, index: u64, exact: Vector2<f64>) -> Option<Detection> {
        let (noise, draws) = (self.noise, &self.draws);
        let topic = at.base + index;
        if draws.uniform(topic + topic::MISSING, at.frame) < noise.missing {
            return None;
        }
        let deviation = noise.jitter * at.size * difficulty(at.keypoint);
        let slow = draws.smooth_normals(topic + topic::SLOW, at.seconds, noise.correlation_s);
        let fast = draws.normals(topic + topic::FAST, at.frame);
        let unit = Vector2::from(slow) * (2f64 / 3.0).sqrt() + Vector2::from(fast) / 3f64.sqrt();
        let mut error = unit * deviation;
        let chance = draws.uniform(topic + topic::CONFIDENCE, at.frame);
        let mut confidence = 1.0 - noise.doubt * (0.7 * unit.norm() + 0.6 * chance);

        if self.occluded(at) {
            if draws.uniform(topic + topic::OUTLIER, at.frame) < 0.5 {
                return None;
            }
            error = (error + Vector2::from(slow) * deviation) * 3.0;
            confidence = 0.08 + 0.25 * chance;
        } else if draws.uniform(topic + topic::OUTLIER, at.frame) < noise.outliers {
            error = Vector2::from(fast) * (0.15 * at.size);
            confidence = 0.3 + 0.3 * chance;
        }
        let pixel = Point2::from(exact + error);
        self.in_image(&pixel).then(|| Detection { pixel, confidence: confidence.clamp(0.02, 1.0) })
    }

    fn occluded(&self, at: &At) -> bool {
        let Some((region, side)) = limb_of(at.keypoint) else { return false };
        let topic = at.base + topic::OCCLUSION + 2 * region as u64 + side as u64;
        let (rate, longest) = (self.noise.occlusions, self.noise.occlusion_s);
        self.draws.stretch(topic, at.seconds, rate, longest).is_some()
    }

    fn in_image(&self, pixel: &Point2<f64>) -> bool {
        let (width, height) = (f64::from(self.camera.width), f64::from(self.camera.height));
        (-0.5..width - 0.5).contains(&pixel.x) && (-0.5..height - 0.5).contains(&pixel.y)
    }

    /// The performer without legs, and the legs.
    fn split(&self, whole: Person) -> [Person; 2] {
        let mut legs = Person { id: None, points: vec![None; whole.points.len()] };
        let mut rest = whole;
        for (index, &keypoint) in self.format.keypoints().iter().enumerate() {
            if matches!(limb_of(keypoint), Some((Region::Leg, _))) {
                legs.points[index] = rest.points[index].take();
            }
        }
        [rest, legs]
    }
}

/// When, and of whom, a point is.
struct At {
    frame: u64,
    seconds: f64,
    keypoint: Keypoint,
    /// Of the person in the image, pixels.
    size: f64,
    base: u64,
}

/// Where a detector's point is in the world: P_j + G_j offset.
pub fn position(keypoint: Keypoint, skeleton: &Skeleton, posture: &Posture) -> Vector3<f64> {
    let attachment = Attachment::of(keypoint);
    let joint = attachment.joint.index();
    posture.positions[joint] + posture.rotations[joint] * attachment.offset(skeleton.shape())
}

/// Somebody who stands about at the edge of the floor, facing the middle.
fn stranger(draws: Draws) -> Posture {
    let skeleton = Skeleton::default();
    let style = MotionStyle { radius: 2.3, ..MotionStyle::default() };
    let mut pose = Motion::new(&skeleton, style).pose(0.0);
    let turn = super::motion::about_y(std::f64::consts::TAU * draws.uniform(0, 0));
    pose.root_position = turn * pose.root_position;
    pose.root_rotation = turn * super::motion::about_y(1.5) * pose.root_rotation;
    pose.posture(&skeleton)
}

/// The larger side of the box around the points, pixels.
fn extent(points: &[Option<Vector2<f64>>]) -> f64 {
    let seen = || points.iter().flatten();
    let low = seen().fold(Vector2::repeat(f64::MAX), |a, b| a.inf(b));
    let high = seen().fold(Vector2::repeat(f64::MIN), |a, b| a.sup(b));
    (high - low).max().max(0.0)
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Region {
    Arm,
    Leg,
}

/// The limb a point is on, if it is on one: region, and 0 for left or 1 for right.
fn limb_of(keypoint: Keypoint) -> Option<(Region, usize)> {
    use Keypoint as K;
    Some(match keypoint {
        K::LElbow | K::LWrist => (Region::Arm, 0),
        K::RElbow | K::RWrist => (Region::Arm, 1),
        K::LKnee | K::LAnkle | K::LBigToe | K::LSmallToe | K::LHeel => (Region::Leg, 0),
        K::RKnee | K::RAnkle | K::RBigToe | K::RSmallToe | K::RHeel => (Region::Leg, 1),
        _ => return None,
    })
}

/// The same point on the other side, for points on limbs.
fn mirrored(keypoint: Keypoint) -> Keypoint {
    use Keypoint as K;
    const PAIRS: [(Keypoint, Keypoint); 7] = [
        (K::LElbow, K::RElbow),
        (K::LWrist, K::RWrist),
        (K::LKnee, K::RKnee),
        (K::LAnkle, K::RAnkle),
        (K::LBigToe, K::RBigToe),
        (K::LSmallToe, K::RSmallToe),
        (K::LHeel, K::RHeel),
    ];
    PAIRS
        .into_iter()
        .find_map(|(l, r)| match keypoint {
            k if k == l => Some(r),
            k if k == r => Some(l),
            _ => None,
        })
        .unwrap_or(keypoint)
}

/// How much a point jitters, against a limb's.
fn difficulty(keypoint: Keypoint) -> f64 {
    use Keypoint as K;
    match keypoint {
        K::Nose | K::LEye | K::REye | K::LEar | K::REar => 0.6,
        K::HeadTop | K::Neck | K::UpperNeck => 0.9,
        K::LHip | K::RHip | K::MidHip => 1.5,
        K::LShoulder | K::RShoulder => 0.9,
        _ => 1.0,
    }
}
