//! Finds cameras that were moved while they run.
//!
//! In each view, the performer's limbs are compared with the solved body: a shift of the image, a turn
//! about the performer, a scale. Detector, body and lens give each camera its own pattern, so it is
//! compared with its own past. A camera that was moved has a new pattern, and the others change far
//! less. It is left out until its pattern is the old one again. If two change alike, neither is left out.
//! The past needs about 30 s.

use std::collections::VecDeque;

use nalgebra::Vector2;

use super::mend;
use super::tracks::{LIMBS, limbs, performer, pixel};
use crate::core::body::{Pose, Skeleton};
use crate::core::camera::{Camera, Rig};
use crate::core::detections::Detections;
use crate::core::points::median;
use crate::core::time::{Nanos, Timestamp};

/// Length of a section; its pattern is the median of those of its frames.
const SECTION: Nanos = Nanos::SECOND;
/// Frames with a pattern that a section needs; it stays open for longer until it has them.
const FRAMES: usize = 8;
/// The newest sections; their median is the present pattern. Patterns older than as many sections are
/// the past.
const NEWEST: usize = 7;
/// Patterns of the past that must be known before a change counts.
const KNOWN: f64 = 10.0;
/// Patterns of the past that count.
const PAST: f64 = 120.0;
/// Numbers in a pattern: shift (x, y; radians), turn about the performer (radians), scale.
const NUMBERS: usize = 4;
/// Changes below these do not count: 0.1 degrees, 0.9 degrees, 2 %.
const LEAST: [f64; NUMBERS] = [0.0017, 0.0017, 0.0157, 0.02];
/// Nor do those below this many standard deviations of the camera's past, and more while little is
/// known.
const SIGNIFICANT: f64 = 5.0;
/// The change of a moved camera is this many times as large as that of any other one.
const ALONE: f64 = 1.5;
/// A camera fits again if its change is below this part of what counts.
const BACK: f64 = 0.6;
/// Points further from the frame's median than this part of the performer's height are left out.
const OUTLIER: f64 = 0.1;
/// Limbs that a pattern needs.
const LEAST_LIMBS: usize = 6;

/// The pattern of a frame that shows somebody, but nobody where the performer is expected.
const ELSEWHERE: Pattern = [1.0, 1.0, 0.0, 0.0];

/// How a camera sees the performer, compared with the solved body.
type Pattern = [f64; NUMBERS];

/// What the watchdog found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Finding {
    /// This camera no longer fits its calibration; the shift in its image, pixels, or `None` if it sees
    /// nobody where the performer is.
    Moved(usize, Option<f64>),
    /// This camera was left out and fits again.
    FitsAgain(usize),
    /// One of these two cameras no longer fits its calibration; the shift in the image of the first,
    /// pixels.
    OneMoved([usize; 2], f64),
}

/// A camera's patterns.
#[derive(Clone, Debug, Default)]
struct Watched {
    /// Patterns of the frames of the open section.
    open: Vec<Pattern>,
    /// Patterns of the newest sections, and their medians over [`NEWEST`] sections.
    newest: VecDeque<Pattern>,
    medians: VecDeque<Pattern>,
    /// Number of older medians, at most [`PAST`], their mean and variance.
    known: f64,
    mean: Pattern,
    variance: Pattern,
    is_left_out: bool,
}

impl Watched {
    /// Closes the section, if it has enough frames. Returns whether it did.
    fn close(&mut self) -> bool {
        if self.open.len() < FRAMES {
            return false;
        }
        let open = std::mem::take(&mut self.open);
        self.newest.push_back(typical(open.iter()));
        if self.newest.len() <= NEWEST {
            return true;
        }
        self.newest.pop_front();
        self.medians.push_back(typical(self.newest.iter()));
        if self.medians.len() > NEWEST
            && let Some(old) = self.medians.pop_front()
            && !self.is_left_out
        {
            self.known = (self.known + 1.0).min(PAST);
            for (k, value) in old.into_iter().enumerate() {
                let off = value - self.mean[k];
                self.mean[k] += off / self.known;
                self.variance[k] += (off * (value - self.mean[k]) - self.variance[k]) / self.known;
            }
        }
        true
    }

    /// The present pattern less that of the past, once both are known.
    fn change(&self) -> Option<Pattern> {
        let now = self.medians.back().filter(|_| self.known >= KNOWN)?;
        Some(std::array::from_fn(|k| now[k] - self.mean[k]))
    }

    /// The largest number of a change, as a part of the least one that counts.
    fn significance(&self, change: &Pattern) -> f64 {
        let factor = SIGNIFICANT * (1.0 + KNOWN / self.known);
        let limit = |k: usize| LEAST[k].max(factor * libm::sqrt(self.variance[k]));
        (0..NUMBERS).map(|k| change[k].abs() / limit(k)).fold(0.0, f64::max)
    }
}

/// Compares each camera with its past.
#[derive(Clone, Debug)]
pub struct Watchdog {
    cameras: Vec<Watched>,
    /// End of the open section.
    until: Option<Timestamp>,
}

impl Watchdog {
    /// Nothing is known of that many cameras.
    pub fn new(cameras: usize) -> Self {
        Self { cameras: vec![Watched::default(); cameras], until: None }
    }

    /// Whether the camera does not fit its calibration.
    pub fn is_left_out(&self, camera: usize) -> bool {
        self.cameras.get(camera).is_some_and(|camera| camera.is_left_out)
    }

    /// The capture clock has jumped: times of before are forgotten.
    pub fn clock_jumped(&mut self) {
        self.until = None;
        self.cameras.iter_mut().for_each(|camera| camera.open.clear());
    }

    /// Whether any frame was added.
    pub fn has_begun(&self) -> bool {
        self.until.is_some()
    }

    /// Adds a frame and the performer's pose at its time.
    pub fn add(&mut self, frame: &Detections, rig: &Rig, pose: &Pose, body: &Skeleton) {
        self.until.get_or_insert(frame.capture + SECTION);
        let cameras = rig.cameras.get(frame.camera).zip(self.cameras.get_mut(frame.camera));
        let Some((camera, watched)) = cameras else { return };
        watched.open.extend(pattern(frame, camera, pose, body));
    }

    /// Judges the cameras once a second, at capture time `now`.
    pub fn judge(&mut self, now: Timestamp, rig: &Rig) -> Option<Finding> {
        if self.until.is_none_or(|until| now < until) {
            return None;
        }
        self.until = Some(now + SECTION);
        let has_new: Vec<bool> = self.cameras.iter_mut().map(Watched::close).collect();
        let changes: Vec<_> = self.cameras.iter().map(Watched::change).collect();
        let back = (0..self.cameras.len()).find(|&i| {
            let camera = &self.cameras[i];
            let fits = |change: Pattern| camera.significance(&change) < BACK;
            camera.is_left_out && has_new[i] && changes[i].is_some_and(fits)
        });
        if let Some(camera) = back {
            self.cameras[camera].is_left_out = false;
            self.forget(camera);
            return Some(Finding::FitsAgain(camera));
        }

        let in_use = (0..self.cameras.len()).filter(|&i| !self.cameras[i].is_left_out);
        let mut found: Vec<(f64, usize, Pattern)> =
            in_use.filter_map(|i| Some((size(&changes[i]?), i, changes[i]?))).collect();
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        let &(largest, camera, change) = found.first()?;
        if !has_new[camera] || self.cameras[camera].significance(&change) < 1.0 {
            return None;
        }
        let focal = rig.cameras.get(camera).map_or(0.0, |camera| camera.focal.mean());
        let pixels = focal * Vector2::new(change[0], change[1]).norm();
        let size = |rank: usize| found.get(rank).map_or(0.0, |found| found.0);
        if found.len() > 2 && largest > ALONE * size(1) {
            self.cameras[camera].is_left_out = true;
            self.forget(camera);
            let is_seen = change[0].abs() < 0.5 * ELSEWHERE[0];
            return Some(Finding::Moved(camera, is_seen.then_some(pixels)));
        }
        let second = found.get(1).filter(|second| second.0 > ALONE * size(2))?.1;
        self.forget(camera);
        Some(Finding::OneMoved([camera, second], pixels))
    }

    /// The fit has changed with `camera`: the past of all cameras is void. But a camera that is left
    /// out can only come back with its past.
    fn forget(&mut self, camera: usize) {
        self.cameras[camera].newest.clear();
        self.cameras[camera].medians.clear();
        for camera in self.cameras.iter_mut().filter(|camera| !camera.is_left_out) {
            *camera = Watched::default();
        }
    }
}

/// The size of a change, in units of the least that counts.
fn size(change: &Pattern) -> f64 {
    (0..NUMBERS).map(|k| change[k].abs() / LEAST[k]).fold(0.0, f64::max)
}

/// The median of each number.
fn typical<'a>(patterns: impl Iterator<Item = &'a Pattern> + Clone) -> Pattern {
    std::array::from_fn(|k| {
        median(&mut patterns.clone().map(|pattern| pattern[k]).collect::<Vec<f64>>())
            .unwrap_or_default()
    })
}

/// The pattern of a frame, if it shows enough of the performer.
fn pattern(frame: &Detections, camera: &Camera, pose: &Pose, body: &Skeleton) -> Option<Pattern> {
    let limbs = limbs(pose, body);
    let Some(person) = performer(frame, camera, &limbs) else {
        let pixels = limbs.map(|limb| camera.project(&limb));
        let is_expected = pixels.iter().all(|pixel| pixel.is_some_and(|at| camera.contains(&at)));
        // Somebody who stands otherwise is somebody else, and the performer is hidden.
        let rays = limbs.map(|at| (camera.rotation * at + camera.translation).normalize());
        let is_there = |person| mend::turn(frame, person, camera, &rays).is_some();
        return (is_expected && frame.people.iter().any(is_there)).then_some(ELSEWHERE);
    };
    let points = LIMBS.iter().zip(&limbs).filter_map(|(&limb, at)| {
        let seen = pixel(person, frame, limb)?;
        let expected = camera.project(at)?;
        let focal = camera.focal.mean();
        Some([expected / focal, (seen - expected) / focal])
    });
    let points: Vec<[Vector2<f64>; 2]> = points.collect();
    let middle = |which: usize| {
        let axis = |k: usize| median(&mut points.iter().map(|p| p[which][k]).collect::<Vec<f64>>());
        Some(Vector2::new(axis(0)?, axis(1)?))
    };
    let (centre, shift) = (middle(0)?, middle(1)?);
    let height = points.iter().map(|p| (p[0] - centre).amax()).fold(0.0, f64::max);
    let near = points.iter().filter(|p| (p[1] - shift).norm() < 2.0 * OUTLIER * height);
    let (mut turn, mut scale, mut squares, mut count) = (0.0, 0.0, 0.0, 0);
    for [at, off] in near {
        let (arm, off) = (at - centre, off - shift);
        turn += arm.perp(&off);
        scale += arm.dot(&off);
        squares += arm.norm_squared();
        count += 1;
    }
    (count >= LEAST_LIMBS && squares > 0.0)
        .then(|| [shift.x, shift.y, turn / squares, scale / squares])
}
