//! The performer's limbs in each view over time.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::core::body::{Attachment, Pose, Skeleton};
use crate::core::camera::Camera;
use crate::core::detections::{Detections, Keypoint, Person};
use crate::core::points::{CONFIDENT, median};
use crate::core::time::{Nanos, Timestamp};

/// The collected points: those that detectors place best.
pub const LIMBS: [Keypoint; 12] = [
    Keypoint::LShoulder,
    Keypoint::RShoulder,
    Keypoint::LElbow,
    Keypoint::RElbow,
    Keypoint::LWrist,
    Keypoint::RWrist,
    Keypoint::LHip,
    Keypoint::RHip,
    Keypoint::LKnee,
    Keypoint::RKnee,
    Keypoint::LAnkle,
    Keypoint::RAnkle,
];
/// The places of the limbs in the world, metres.
pub type Limbs = [Vector3<f64>; LIMBS.len()];
/// Length of a section.
const SECTION: Nanos = Nanos::from_ms(2000);
/// More sections than this are thinned out to half.
const MOST_SECTIONS: usize = 12;
/// A person is the performer if the median distance of the limbs is below this fraction of the
/// performer's height in the image.
const GATE: f64 = 0.25;
/// Half of the time over which a track is smoothed, at least this many frames of its camera.
const SMOOTHED: Nanos = Nanos::from_ms(60);
const SMOOTHED_FRAMES: f64 = 3.5;
/// Cameras that need a longer time have no tracks: a quadratic does not fit so much motion.
const MOST_SMOOTHED: Nanos = Nanos::from_ms(400);
/// A smoothed point has samples on both sides, up to this part of that time or further.
const REACH: f64 = 0.4;

/// The limbs in a frame, pixels as detected.
#[derive(Clone, Debug)]
struct Sample {
    capture: Timestamp,
    limbs: [Option<Vector2<f64>>; LIMBS.len()],
}

/// The performer's limbs in each view, in sections of two seconds, spread over the whole time. At
/// most 12 sections are kept.
#[derive(Clone, Debug)]
pub struct Tracks {
    cameras: usize,
    start: Option<Timestamp>,
    /// Every this many sections are kept.
    stride: i64,
    /// By section, the frames of each camera in order of capture time.
    sections: BTreeMap<i64, Vec<Vec<Sample>>>,
}

/// A smoothed point: normalised coordinates (distortion removed), and their change per step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moving {
    at: Vector2<f64>,
    change: Vector2<f64>,
}

/// Smoothed limbs at the steps of a section.
pub(super) type Track = Vec<[Option<Moving>; LIMBS.len()]>;

impl Tracks {
    /// No frames yet, of that many cameras.
    pub fn new(cameras: usize) -> Self {
        Self { cameras, start: None, stride: 1, sections: BTreeMap::new() }
    }

    /// Adds the performer in a frame of `camera` (its index is `frame.camera`). The performer is the
    /// person nearest to the body in `pose`, which may be some frames off. Frames of a camera come in
    /// order of capture time; others are ignored.
    pub fn add(&mut self, frame: &Detections, camera: &Camera, pose: &Pose, body: &Skeleton) {
        let start = *self.start.get_or_insert(frame.capture);
        let section = (frame.capture - start).ns().div_euclid(SECTION.ns());
        if section.rem_euclid(self.stride) != 0 || frame.camera >= self.cameras {
            return;
        }
        let Some(person) = performer(frame, camera, &limbs(pose, body)) else { return };
        let limbs = LIMBS.map(|limb| pixel(person, frame, limb));
        let cameras = self.cameras;
        let section = self.sections.entry(section).or_insert_with(|| vec![Vec::new(); cameras]);
        let samples = &mut section[frame.camera];
        if samples.last().is_none_or(|last| last.capture < frame.capture) {
            samples.push(Sample { capture: frame.capture, limbs });
        }
        if self.sections.len() > MOST_SECTIONS {
            self.stride *= 2;
            let stride = self.stride;
            self.sections.retain(|section, _| section.rem_euclid(stride) == 0);
        }
    }

    /// Takes out the first section, once a later one has begun.
    pub(super) fn take_complete(&mut self) -> Option<Self> {
        let first = self.sections.pop_first()?;
        if self.sections.is_empty() {
            self.sections.extend([first]);
            return None;
        }
        Some(Self { sections: [first].into(), ..*self })
    }

    /// The smoothed tracks of each camera, section by section, at steps of that length.
    pub(super) fn smoothed(&self, cameras: &[Camera], step: Nanos) -> Vec<Vec<Track>> {
        let start = self.start.unwrap_or_default();
        let sections = self.sections.iter().map(|(section, samples)| {
            let begin = start + SECTION * *section;
            let tracks = cameras.iter().zip(samples);
            tracks.map(|(camera, samples)| smoothed(samples, camera, begin, step)).collect()
        });
        sections.collect()
    }
}

/// Where the limbs of a body are in the world, metres.
pub fn limbs(pose: &Pose, body: &Skeleton) -> Limbs {
    let posture = pose.posture(body);
    LIMBS.map(|limb| Attachment::of(limb).position(&posture, body))
}

/// The person nearest to the performer's limbs (in the world, metres); `None` if nobody is near enough.
pub(super) fn performer<'d>(
    frame: &'d Detections,
    camera: &Camera,
    limbs: &Limbs,
) -> Option<&'d Person> {
    let expected = limbs.map(|limb| camera.project(&limb));
    let seen = || expected.iter().flatten();
    let low = seen().copied().reduce(|low, pixel| low.inf(&pixel))?;
    let high = seen().copied().reduce(|high, pixel| high.sup(&pixel))?;
    let distance = |person: &Person| {
        let limbs = LIMBS.iter().zip(&expected).filter_map(|(&limb, expected)| {
            Some((pixel(person, frame, limb)? - (*expected)?).norm())
        });
        median(&mut limbs.collect::<Vec<f64>>())
    };
    let people = frame.people.iter().filter_map(|person| Some((distance(person)?, person)));
    let (nearest, person) = people.min_by(|a, b| a.0.total_cmp(&b.0))?;
    (nearest < GATE * (high - low).max()).then_some(person)
}

pub(super) fn pixel(person: &Person, frame: &Detections, limb: Keypoint) -> Option<Vector2<f64>> {
    let point = (*person.points.get(frame.format.index_of(limb)?)?)?;
    (point.confidence > CONFIDENT).then_some(point.pixel.coords)
}

/// A local quadratic fit of each limb at each step of a section.
fn smoothed(samples: &[Sample], camera: &Camera, begin: Timestamp, step: Nanos) -> Track {
    let steps = SECTION.ns() / step.ns().max(1);
    let mut gaps: Vec<f64> =
        samples.windows(2).map(|pair| (pair[1].capture - pair[0].capture).ns() as f64).collect();
    let reach = SMOOTHED_FRAMES * median(&mut gaps).unwrap_or_default();
    let reach = Nanos::rounded(reach.max(SMOOTHED.ns() as f64));
    if reach > MOST_SMOOTHED {
        return (0..steps).map(|_| Default::default()).collect();
    }
    let at_step = |k: i64| {
        let time = begin + step * k;
        let first = samples.partition_point(|sample| sample.capture < time - reach);
        let end = samples.partition_point(|sample| sample.capture <= time + reach);
        let near = &samples[first..end];
        std::array::from_fn(|limb| {
            let points = near.iter().filter_map(|sample| {
                let at = (sample.capture - time).ns() as f64 / reach.ns() as f64;
                Some((at, sample.limbs[limb]?))
            });
            let (pixel, change) = quadratic(points)?;
            let change = change * (step.ns() as f64 / reach.ns() as f64);
            let normalised = camera.undistort(&pixel)?;
            // The lens bends little within a step.
            Some(Moving {
                at: normalised,
                change: camera.undistort(&(pixel + change))? - normalised,
            })
        })
    };
    (0..steps).map(at_step).collect()
}

/// Value and slope at 0 of the quadratic through points with times in \[-1, 1\], by least squares
/// with the weights 1 - t^2. `None` without enough points on both sides.
fn quadratic(
    points: impl Iterator<Item = (f64, Vector2<f64>)>,
) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let mut normal = Matrix3::zeros();
    let mut right = [Vector3::zeros(); 2];
    let (mut low, mut high, mut count) = (0.0_f64, 0.0_f64, 0);
    for (t, pixel) in points {
        let basis = Vector3::new(1.0, t, t * t);
        let weighted = basis * (1.0 - t * t).max(0.0);
        normal += weighted * basis.transpose();
        right[0] += weighted * pixel.x;
        right[1] += weighted * pixel.y;
        (low, high, count) = (low.min(t), high.max(t), count + 1);
    }
    if count < 5 || low > -REACH || high < REACH {
        return None;
    }
    let factor = normal.cholesky()?;
    let [x, y] = right.map(|right| factor.solve(&right));
    Some((Vector2::new(x[0], y[0]), Vector2::new(x[1], y[1])))
}

/// The normalised point of a limb at a time, in steps: the cubic between two smoothed points.
pub(super) fn at(track: &Track, limb: usize, time: f64) -> Option<Vector2<f64>> {
    let before = time.floor();
    if before < 0.0 {
        return None;
    }
    let s = time - before;
    let a = (*track.get(before as usize)?)[limb]?;
    if s == 0.0 {
        return Some(a.at);
    }
    let b = (*track.get(before as usize + 1)?)[limb]?;
    let rise = s * s * (3.0 - 2.0 * s);
    let cubic = a.at.lerp(&b.at, rise) + a.change * (s * (1.0 - s) * (1.0 - s));
    Some(cubic - b.change * (s * s * (1.0 - s)))
}
