//! Simulates a 2D detector with realistic errors: jitter, gaps, swapped sides, bystanders.

use nalgebra::{Point2, Vector2, Vector3};

use super::body::Places;
use super::motion::{Motion, MotionStyle};
use super::noise::Noise;
use super::points::{Region, along, difficulty, limb_of, mirrored};
use crate::core::body::{Posture, Skeleton};
use crate::core::camera::Camera;
use crate::core::detections::{Detection, Detections, Keypoint, KeypointFormat, Person};
use crate::core::points::extent;
use crate::core::random::Draws;
use crate::core::time::Timestamp;

/// Keys of the random draws. The values are arbitrary but must differ.
mod topic {
    pub(super) const SWAP: u64 = 1;
    pub(super) const STRANGER: u64 = 2;
    pub(super) const SPLIT: u64 = 3;
    pub(super) const BLANK: u64 = 4;
    pub(super) const ORDER: u64 = 5;
    /// The index of the limb is added.
    pub(super) const OCCLUSION: u64 = 10;
    /// The index of the point is added, here and below.
    pub(super) const SLOW: u64 = 100;
    pub(super) const FAST: u64 = 200;
    pub(super) const MISSING: u64 = 300;
    pub(super) const OUTLIER: u64 = 400;
    pub(super) const CONFIDENCE: u64 = 500;
    pub(super) const HARDNESS: u64 = 600;
    pub(super) const WANDER: u64 = 700;
    pub(super) const GUESS: u64 = 800;
    pub(super) const BIAS: u64 = 900;
    pub(super) const SIDE: u64 = 950;
    pub(super) const VIEW: u64 = 990;
    /// Added for the bystander's points.
    pub(super) const OF_STRANGER: u64 = 1000;
}

/// The detector of one camera.
#[derive(Clone, Debug)]
pub(super) struct Detector<'a> {
    camera: Camera,
    index: usize,
    format: KeypointFormat,
    noise: &'a Noise,
    places: Places,
    /// Standard deviation of the slow shifts of this view.
    wander: f64,
    draws: Draws,
    /// Systematic offset of each point of the format, turned like its place, metres.
    biases: Vec<Vector3<f64>>,
    stranger: Posture,
}

impl<'a> Detector<'a> {
    pub(super) fn new(
        camera: Camera,
        index: usize,
        format: KeypointFormat,
        noise: &'a Noise,
        places: Places,
        seed: u64,
    ) -> Self {
        // Draws that all cameras share.
        let shared = Draws { seed, stream: u64::MAX };
        let points = format.keypoints().iter();
        let biases =
            points.map(|&keypoint| bias(keypoint, places, &shared) * noise.bias_m).collect();
        let stranger = stranger(shared);
        let draws = Draws { seed, stream: index as u64 };
        let wander = noise.wander * (noise.view_spread * draws.normals(topic::VIEW, 0)[0]).exp();
        Self { camera, index, format, noise, places, wander, draws, biases, stranger }
    }

    /// The detections of the body in one frame, captured at `seconds`. Its posture is asked for by time.
    pub(super) fn detect(
        &self,
        frame: u64,
        capture: Timestamp,
        seconds: f64,
        skeleton: &Skeleton,
        posture: &dyn Fn(f64) -> Posture,
    ) -> Detections {
        let (noise, draws) = (self.noise, &self.draws);
        let mut people = Vec::new();
        let blank = draws.occurrence(topic::BLANK, seconds, noise.blanks, noise.blank_s);
        if blank.is_none() {
            let performer = self.person(frame, seconds, skeleton, posture, 0);
            let split = draws.occurrence(topic::SPLIT, seconds, noise.splits, noise.split_s);
            match split {
                Some(_) => people.extend(self.split(performer)),
                None => people.push(performer),
            }
            let seen =
                draws.occurrence(topic::STRANGER, seconds, noise.strangers, noise.stranger_s);
            if seen.is_some() {
                let (other, still) = (Skeleton::default(), |_| self.stranger.clone());
                people.push(self.person(frame, seconds, &other, &still, topic::OF_STRANGER));
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
        skeleton: &Skeleton,
        posture: &dyn Fn(f64) -> Posture,
        base: u64,
    ) -> Person {
        let swapped = self
            .draws
            .occurrence(base + topic::SWAP, seconds, self.noise.swaps, self.noise.swap_s)
            .map(|which| if which < 0.7 { Region::Leg } else { Region::Arm });
        let readout = 0.5 * self.noise.readout_s;
        let posture_of = |row: f64| posture(seconds + row * readout);
        let middle = posture_of(0.0);
        let ends = (readout > 0.0).then(|| [-1.0, 1.0].map(posture_of));
        let exact: Vec<Option<Vector2<f64>>> = (self.format.keypoints().iter())
            .map(|&keypoint| {
                let swap = swapped.is_some() && swapped == limb_of(keypoint).map(|(r, _)| r);
                let keypoint = if swap { mirrored(keypoint) } else { keypoint };
                let pixel = |posture: &Posture| {
                    self.camera.project(&self.believed(keypoint, skeleton, posture))
                };
                let seen = pixel(&middle)?;
                let Some([first, last]) = &ends else { return Some(seen) };
                let height = f64::from(self.camera.height);
                Some(rolled(height, [pixel(first)?, seen, pixel(last)?]))
            })
            .collect();
        let size = extent(exact.iter().flatten().copied());
        let mut points = vec![None; self.format.len()];
        for (index, exact) in exact.iter().enumerate() {
            let at = At { frame, seconds, keypoint: self.format.keypoints()[index], size, base };
            points[index] = exact.and_then(|pixel| self.point(&at, index as u64, pixel));
        }
        if self.noise.one_confidence {
            let known = || points.iter().flatten().map(|seen: &Detection| seen.confidence);
            let mean = known().sum::<f64>() / known().count().max(1) as f64;
            points.iter_mut().flatten().for_each(|seen| seen.confidence = mean);
        }
        Person { id: None, points }
    }

    /// Where the detector places a point, world frame, metres: the true point plus its bias.
    fn believed(&self, keypoint: Keypoint, skeleton: &Skeleton, posture: &Posture) -> Vector3<f64> {
        let (position, rotation) = self.places.of(keypoint, skeleton, posture);
        let bias = self.format.index_of(keypoint).map_or(Vector3::zeros(), |i| self.biases[i]);
        position + rotation * bias
    }

    /// The detection of one point, given its pixel without random errors.
    fn point(&self, at: &At, index: u64, exact: Vector2<f64>) -> Option<Detection> {
        let noise = self.noise;
        let uniform = |what: u64| self.draws.uniform(at.base + what + index, at.frame);
        let smooth = |what: u64, period: f64| {
            Vector2::from(self.draws.smooth_normals(at.base + what + index, at.seconds, period))
        };
        let hardness = (noise.hardness * smooth(topic::HARDNESS, noise.hardness_s).x).exp();
        if uniform(topic::MISSING) < noise.missing * hardness * hardness {
            return None;
        }
        let fast = Vector2::from(self.draws.normals(at.base + topic::FAST + index, at.frame));
        let slow = smooth(topic::SLOW, noise.correlation_s);
        let unit = (slow * (1.0 - noise.new_share).sqrt() + fast * noise.new_share.sqrt())
            * (hardness * difficulty(at.keypoint));
        let wander = smooth(topic::WANDER, noise.wander_s) * self.wander;
        let mut error = (unit * noise.jitter + wander) * at.size;
        let chance = uniform(topic::CONFIDENCE);
        let mut confidence = noise.confidence - noise.doubt * (0.7 * unit.norm() + 0.6 * chance);
        if let Some(which) = self.occlusion(at) {
            if which >= noise.hallucinated {
                return None;
            }
            error += self.guess(at, index);
            confidence = noise.confidence * (0.25 + 0.4 * chance);
        } else if uniform(topic::OUTLIER) < noise.outliers {
            error = fast * (0.15 * at.size);
            confidence = noise.confidence * (0.3 + 0.3 * chance);
        }
        let pixel = Point2::from(exact + error);
        self.in_image(&pixel).then(|| Detection { pixel, confidence: confidence.clamp(0.02, 1.0) })
    }

    /// A number in [0, 1) drawn per occlusion, if the point is on a limb that is hidden now.
    fn occlusion(&self, at: &At) -> Option<f64> {
        let topic = at.base + topic::OCCLUSION + limb_number(at.keypoint)?;
        let (rate, longest) = (self.noise.occlusions, self.noise.occlusion_s);
        self.draws.occurrence(topic, at.seconds, rate, longest)
    }

    /// Error of the guess of a hidden point, pixels: an error shared by the limb plus one of the
    /// point, larger towards the limb's end.
    fn guess(&self, at: &At, index: u64) -> Vector2<f64> {
        let period = 0.6 * self.noise.occlusion_s.max(0.1);
        let normals = |what: u64| {
            Vector2::from(self.draws.smooth_normals(
                at.base + topic::GUESS + what,
                at.seconds,
                period,
            ))
        };
        let limb = normals(50 + limb_number(at.keypoint).unwrap_or(0));
        let unit = limb * 0.8f64.sqrt() + normals(index) * 0.2f64.sqrt();
        unit * (along(at.keypoint) * self.noise.hallucination * at.size)
    }

    fn in_image(&self, pixel: &Point2<f64>) -> bool {
        let (width, height) = (f64::from(self.camera.width), f64::from(self.camera.height));
        (-0.5..width - 0.5).contains(&pixel.x) && (-0.5..height - 0.5).contains(&pixel.y)
    }

    /// Splits the performer into a person without legs and a person with only legs.
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

/// The pixel of a moving point by a rolling shutter, from those that it has when the first, the middle and the last row
/// of an image of that height are read.
fn rolled(height: f64, [first, middle, last]: [Vector2<f64>; 3]) -> Vector2<f64> {
    let (slope, bend) = ((last - first) / 2.0, (first + last) / 2.0 - middle);
    // A point is seen by the row that it is on. It moves by much less than the image's height.
    (0..3).fold(middle, |seen, _| {
        let row = (2.0 * seen.y / height - 1.0).clamp(-1.0, 1.0);
        middle + slope * row + bend * (row * row)
    })
}

/// Frame, time and person of a point.
struct At {
    frame: u64,
    seconds: f64,
    keypoint: Keypoint,
    /// Size of the person in the image, pixels.
    size: f64,
    base: u64,
}

/// Position of a keypoint on a body of our model, world frame, metres.
pub fn position(keypoint: Keypoint, skeleton: &Skeleton, posture: &Posture) -> Vector3<f64> {
    Places::Own.of(keypoint, skeleton, posture).0
}

/// A standard normal offset for a point; left and right mirror each other, as far as those of `places`
/// do.
fn bias(keypoint: Keypoint, places: Places, draws: &Draws) -> Vector3<f64> {
    let (left, side) = keypoint.of_left();
    let normals = |topic: u64, key: Keypoint| {
        let [x, y] = draws.normals(topic, key as u64);
        Vector3::new(x, y, draws.normals(topic + 1, key as u64)[0])
    };
    let (both, own) = (normals(topic::BIAS, left), normals(topic::SIDE, keypoint));
    let drawn = both * (1.0 - places.asymmetry()).sqrt() + own * places.asymmetry().sqrt();
    // Points on the midline have no sideways offset.
    let middle = matches!(left, Keypoint::Nose | Keypoint::HeadTop | Keypoint::MidHip)
        || matches!(left, Keypoint::Neck | Keypoint::UpperNeck);
    Vector3::new(if middle { 0.0 } else { side * drawn.x }, drawn.y, drawn.z)
}

/// The index of the limb that a point is on, 0 to 3.
fn limb_number(keypoint: Keypoint) -> Option<u64> {
    limb_of(keypoint).map(|(region, side)| 2 * region as u64 + side as u64)
}

/// A bystander at the edge of the floor, facing the middle.
fn stranger(draws: Draws) -> Posture {
    let skeleton = Skeleton::default();
    let style = MotionStyle { radius: 2.3, ..MotionStyle::default() };
    let mut pose = Motion::new(&skeleton, style).pose(0.0);
    let turn = super::motion::about_y(std::f64::consts::TAU * draws.uniform(0, 0));
    pose.root_position = turn * pose.root_position;
    pose.root_rotation = turn * super::motion::about_y(1.5) * pose.root_rotation;
    pose.posture(&skeleton)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rolling_shutter_sees_a_point_when_its_row_is_read() {
        // It falls and slows down while the rows are read.
        let at = |row: f64| Vector2::new(400.0 + 30.0 * row, 700.0 + 40.0 * row - 8.0 * row * row);
        let seen = rolled(1000.0, [at(-1.0), at(0.0), at(1.0)]);
        let steps = (-100_000..=100_000).map(|step| f64::from(step) * 1e-5);
        let is_on = |row: &f64| (at(*row).y - 500.0 * (row + 1.0)).abs();
        let row = steps.min_by(|a, b| is_on(a).total_cmp(&is_on(b))).unwrap();
        assert!((seen - at(row)).norm() < 0.02, "{seen} {}", at(row));
    }
}
