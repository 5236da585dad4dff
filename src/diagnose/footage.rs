//! What the cameras saw: frames of each camera, thinned out over a long recording.

use nalgebra::Vector2;

use crate::core::camera::Camera;
use crate::core::detections::{Detections, Keypoint, KeypointFormat, Person};
use crate::core::points::{CONFIDENT, extent, median};
use crate::core::time::{Nanos, Timestamp};

/// The points that are compared, those of [`FITTED`] first.
pub(super) const POINTS: [Keypoint; 17] = [
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
    Keypoint::Nose,
    Keypoint::LBigToe,
    Keypoint::RBigToe,
    Keypoint::LHeel,
    Keypoint::RHeel,
];
/// Cameras are judged by this many points; the rest tells where the performer faces.
pub(super) const FITTED: usize = 13;
/// A person with fewer points is not used.
pub(super) const LEAST_POINTS: usize = 6;
/// The body's points come first in every format.
const BODY_POINTS: usize = 26;
/// Frames are kept in sections of this length, every section of a camera with at most that many, every
/// second one of a camera with more, and so on. Sections are counted from zero time, so that cameras
/// with the same clock keep the same ones. The first ones are always kept: there, clocks may differ by seconds.
const SECTION: Nanos = Nanos::from_ms(4000);
const MOST_SECTIONS: i64 = 12;
const FIRST_SECTIONS: i64 = 6;
/// A frame is stray if it is so far ahead of the frames before and after it.
const STRAY: Nanos = Nanos::from_ms(1000);
/// Frames between two compared ones.
pub(super) const APART: usize = 15;
/// Frames before and after a frame that tell how much the performer moves.
const REACH: usize = 8;

/// One person: pixels by index in the format.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Seen(Vec<Option<Vector2<f32>>>);

impl Seen {
    fn of(person: &Person) -> Option<Self> {
        let confident = |point: &Option<_>| {
            let point: &crate::core::detections::Detection = point.as_ref()?;
            (point.confidence > CONFIDENT).then(|| point.pixel.coords.cast())
        };
        let points: Vec<_> = person.points.iter().take(BODY_POINTS).map(confident).collect();
        (points.iter().flatten().count() >= LEAST_POINTS).then_some(Self(points))
    }

    pub(super) fn at(&self, index: usize) -> Option<Vector2<f64>> {
        Some((*self.0.get(index)?)?.cast())
    }

    /// The longer side of the bounding box, pixels.
    pub(super) fn extent(&self) -> f64 {
        extent(self.0.iter().flatten().map(|pixel| pixel.cast()))
    }

    /// Median distance of the points that both have, pixels.
    pub(super) fn distance(&self, other: &Self) -> Option<f64> {
        let both = self.0.iter().zip(&other.0);
        let mut all: Vec<f64> =
            both.filter_map(|(a, b)| Some(f64::from(((*a)? - (*b)?).norm()))).collect();
        median(&mut all).filter(|_| all.len() >= LEAST_POINTS)
    }
}

/// A frame of a camera.
#[derive(Clone, Debug)]
pub(super) struct Frame {
    pub(super) capture: Timestamp,
    pub(super) format: KeypointFormat,
    /// The largest first.
    pub(super) people: Vec<Seen>,
}

/// The frames of a camera.
#[derive(Clone, Debug, Default)]
pub(super) struct Track {
    /// In order of capture time.
    pub(super) frames: Vec<Frame>,
    /// Number of all frames, of those that came out of order, and of those with the time of the one before.
    pub(super) count: usize,
    pub(super) disordered: usize,
    pub(super) doubled: usize,
    /// Number of all points, of those that are confident, and of those with a confidence above 1.
    pub(super) points: usize,
    pub(super) confident: usize,
    pub(super) percent: usize,
    /// First and last capture time.
    pub(super) span: Option<[Timestamp; 2]>,
    /// Every so many sections are kept.
    stride: i64,
    /// A frame far ahead of the one before. The next frame shows whether it is stray.
    held: Option<Box<Detections>>,
}

fn section(capture: Timestamp) -> i64 {
    capture.ns().div_euclid(SECTION.ns())
}

impl Track {
    fn forget_frames(&mut self) {
        (self.span, self.frames) = (None, Vec::new());
    }

    /// The median time between two frames.
    pub(super) fn period(&self) -> Option<Nanos> {
        let gaps = self.frames.windows(2).map(|pair| (pair[1].capture - pair[0].capture).ns());
        let mut gaps: Vec<f64> = gaps.map(|ns| ns as f64).collect();
        median(&mut gaps).map(|ns| Nanos::rounded(ns.max(1.0)))
    }

    /// The frame nearest to a capture time, at most `reach` away.
    pub(super) fn nearest(&self, time: Timestamp, reach: Nanos) -> Option<&Frame> {
        let after = self.frames.partition_point(|frame| frame.capture < time);
        let away = |frame: &&Frame| (frame.capture - time).ns().abs();
        let around =
            self.frames.get(after.saturating_sub(1)..(after + 1).min(self.frames.len()))?;
        around.iter().min_by_key(away).filter(|frame| away(frame) <= reach.ns())
    }
}

/// The detections of each camera of a rig: all of 48 seconds, and parts of a longer recording.
#[derive(Clone, Debug)]
pub struct Footage {
    pub(super) tracks: Vec<Track>,
    most_people: usize,
    /// Whether no camera's clock runs faster or slower than those of the others.
    pub(super) have_right_rates: bool,
}

impl Footage {
    /// No frames yet, of that many cameras. Of the people of a frame, so many are kept: the largest.
    pub fn new(cameras: usize, most_people: usize) -> Self {
        let tracks = vec![Track { stride: 1, ..Track::default() }; cameras];
        Self { tracks, most_people, have_right_rates: false }
    }

    /// Forgets all but the first cameras.
    pub(super) fn keep_first(&mut self, cameras: usize) {
        self.tracks.truncate(cameras);
    }

    /// The same with the cameras of which that is true from other footage.
    pub(super) fn with(&self, other: &Self, is_other: impl Fn(usize) -> bool) -> Self {
        let both = self.tracks.iter().zip(&other.tracks).enumerate();
        let track = |(camera, (own, other))| if is_other(camera) { other } else { own };
        Self { tracks: both.map(track).cloned().collect(), ..*self }
    }

    /// Adds a frame, with the capture time of its camera. Cameras that are not in the rig, and frames
    /// that are not after the camera's last one, are not kept.
    pub fn add(&mut self, frame: &Detections) {
        let Some(track) = self.tracks.get_mut(frame.camera) else { return };
        track.count += 1;
        if let Some([first, last]) = track.span {
            let step = frame.capture - last;
            if step == Nanos::ZERO {
                track.doubled += 1;
                return;
            }
            if step < Nanos::ZERO {
                track.disordered += 1;
                // A first frame may be stray, too.
                if first != last || -step <= STRAY {
                    return;
                }
                track.forget_frames();
            } else if step > STRAY && track.held.is_none() {
                track.held = Some(Box::new(frame.clone()));
                return;
            }
        }
        match track.held.take() {
            Some(held) if held.capture < frame.capture => {
                if track.span.is_some_and(|[first, last]| first == last) {
                    track.forget_frames();
                }
                self.push(&held);
            }
            Some(_) => track.disordered += 1,
            None => {}
        }
        self.push(frame);
    }

    fn push(&mut self, frame: &Detections) {
        let track = &mut self.tracks[frame.camera];
        let first = track.span.map_or(frame.capture, |[first, _]| first);
        track.span = Some([first, frame.capture]);
        let points = || frame.people.iter().flat_map(|person| person.points.iter().flatten());
        track.points += points().count();
        track.confident += points().filter(|point| point.confidence > CONFIDENT).count();
        let is_kept = |capture, stride| {
            let own = section(capture);
            own - section(first) < FIRST_SECTIONS || own.rem_euclid(stride) == 0
        };
        while section(frame.capture) - section(first) >= MOST_SECTIONS * track.stride {
            track.stride *= 2;
            track.frames.retain(|frame| is_kept(frame.capture, track.stride));
        }
        if !is_kept(frame.capture, track.stride) {
            return;
        }
        let mut people: Vec<Seen> = frame.people.iter().filter_map(Seen::of).collect();
        people.sort_by(|a, b| b.extent().total_cmp(&a.extent()));
        people.truncate(self.most_people);
        track.frames.push(Frame { capture: frame.capture, format: frame.format, people });
    }

    /// How much somebody moves who is alone in the frames: the distances over [`APART`] frames, as parts
    /// of the person's size, summed up.
    pub(super) fn movement(&self) -> f64 {
        let of_track = |track: &Track| -> f64 {
            let pairs = track.frames.iter().zip(track.frames.iter().skip(APART));
            let moved = pairs.filter_map(|(a, b)| {
                let ([a], [b]) = (&a.people[..], &b.people[..]) else { return None };
                Some(a.distance(b)? / a.extent().max(1.0))
            });
            moved.sum()
        };
        self.tracks.iter().map(of_track).sum()
    }

    /// Counts points of a camera whose confidence was above 1 in the message.
    pub fn add_percent(&mut self, camera: usize, points: usize) {
        if let Some(track) = self.tracks.get_mut(camera) {
            track.percent += points;
        }
    }

    /// First and last time of each camera, on the clock of the rig.
    pub(super) fn spans(&self, cameras: &[Camera]) -> Vec<Option<[Timestamp; 2]>> {
        let both = self.tracks.iter().zip(cameras);
        both.map(|(track, camera)| Some(track.span?.map(|time| time + camera.time_offset)))
            .collect()
    }

    /// The first time of all cameras.
    pub(super) fn start(&self, cameras: &[Camera]) -> Option<Timestamp> {
        self.spans(cameras).into_iter().flatten().map(|[first, _]| first).min()
    }

    /// `count` times of one camera, on the clock of the rig: a third evenly spread, the others where
    /// the performer moves most, which shows errors of time. A long recording has as many more at its
    /// start. Of the cameras that have time in common with the most others, the one with the most
    /// frames is taken: another one may have a clock of its own.
    pub(super) fn instants(&self, count: usize, cameras: &[Camera]) -> Vec<Timestamp> {
        let spans = self.spans(cameras);
        let common = |own: [Timestamp; 2]| {
            spans.iter().flatten().filter(|other| overlap(own, **other)).count()
        };
        let frames = |track: &Track| track.count - track.disordered - track.doubled;
        let all = self.tracks.iter().zip(cameras).zip(&spans);
        let all = all.filter_map(|(both, span)| Some((both, common((*span)?))));
        let Some(((longest, camera), _)) =
            all.max_by_key(|((track, _), common)| (*common, frames(track)))
        else {
            return Vec::new();
        };
        let frames = &longest.frames;
        let is_even = |i: &usize| section(frames[*i].capture).rem_euclid(longest.stride) == 0;
        let (spread, first): (Vec<usize>, Vec<usize>) = (0..frames.len()).partition(is_even);
        let all = (3 * count).min(spread.len());
        let index = |i: usize| spread[(2 * i + 1) * spread.len() / (2 * all)];
        let motion = |i: usize| -> f64 {
            let [before, after] = [i.saturating_sub(REACH), (i + REACH).min(frames.len() - 1)];
            let Some(person) = frames[before].people.first() else { return 0.0 };
            let others = frames[after].people.iter().filter_map(|other| person.distance(other));
            others.reduce(f64::min).unwrap_or(0.0)
        };
        let (even, rest): (Vec<usize>, Vec<usize>) =
            (0..all).partition(|i| i % 9 == 0 || all <= count);
        let mut moving: Vec<(f64, usize)> =
            rest.into_iter().map(|i| (motion(index(i)), i)).collect();
        moving.sort_by(|a, b| b.0.total_cmp(&a.0));
        moving.truncate(count.saturating_sub(even.len()));
        let chosen = even.into_iter().chain(moving.into_iter().map(|(_, i)| i)).map(index);
        let of_first = first.iter().copied().step_by(first.len().div_ceil(count).max(1));
        let mut chosen: Vec<usize> = chosen.chain(of_first).collect();
        chosen.sort_unstable();
        chosen.into_iter().map(|i| frames[i].capture + camera.time_offset).collect()
    }

    /// The median time between two frames of a camera that has frames.
    pub(super) fn period(&self) -> Nanos {
        let mut all: Vec<f64> =
            self.tracks.iter().filter_map(Track::period).map(|period| period.ns() as f64).collect();
        Nanos::rounded(median(&mut all).unwrap_or(1e7))
    }
}

/// Whether two spans of time have a moment in common.
pub(super) fn overlap(a: [Timestamp; 2], b: [Timestamp; 2]) -> bool {
    a[0] <= b[1] && b[0] <= a[1]
}
