//! Time offsets of live cameras: a slow state.
//!
//! Every two seconds the derivatives of the cost (see [`time_offsets`](super::time_offsets)) of that
//! section are added to those of the past, which fade. The camera whose offset changes the cost
//! most is corrected, little by little, so this follows slow clocks. It finds offsets of up to about
//! three frames. Once, after the first sections, offsets of up to 18 frames are searched and corrected at once.

use super::epipolar::Pair;
use super::normal::{Estimate, Normal, OffsetVerdict};
use super::time_offsets::{Searched, refined, search};
use super::tracks::{Track, Tracks};
use super::views::{Scales, Views, loss_scale};
use crate::core::body::{Pose, Skeleton};
use crate::core::camera::{Camera, Rig};
use crate::core::detections::Detections;
use crate::core::time::Nanos;

/// Weight of the past after each section: half of it after 46 s.
const FADE: f64 = 0.97;
/// Sections before the first correction, and after the last one.
const FIRST: usize = 8;
/// Frames in a step: costs are compared at lags this far apart.
const STEP: i64 = 3;
/// Largest standard error of an offset that is corrected at once, steps.
const CERTAIN: f64 = 0.06;
/// Largest correction per section, steps: 0.3 frames.
const LARGEST: f64 = 0.1;

/// What is new about the clock of a camera, which is an index in the rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum News {
    /// It is off, and is corrected step by step.
    Shifted(usize),
    /// It was off, and has this correction at once.
    AtOnce(usize, Nanos),
    /// It is in sync again, with all corrections so far.
    InSync(usize, Nanos),
}

/// The slow state of the time offsets.
#[derive(Clone, Debug)]
pub struct LiveOffsets {
    tracks: Tracks,
    normal: Normal,
    sections: usize,
    /// `None` after the first sections.
    first: Option<First>,
    /// By camera, all corrections so far.
    corrections: Vec<Nanos>,
    /// Of cameras that are being corrected, the number of sections since the last step.
    since_step: Vec<Option<usize>>,
}

impl LiveOffsets {
    /// Nothing is known of that many cameras.
    pub fn new(cameras: usize) -> Self {
        Self {
            tracks: Tracks::new(cameras),
            normal: Normal::zeros(cameras),
            sections: 0,
            first: Some(First::default()),
            corrections: vec![Nanos::ZERO; cameras],
            since_step: vec![None; cameras],
        }
    }

    /// The capture clock has jumped: times of before are forgotten.
    pub fn clock_jumped(&mut self) {
        self.tracks = Tracks::new(self.corrections.len());
    }

    /// Adds the performer in a frame, see [`Tracks::add`].
    pub fn add(&mut self, frame: &Detections, rig: &Rig, pose: &Pose, body: &Skeleton) {
        if let Some(camera) = rig.cameras.get(frame.camera) {
            self.tracks.add(frame, camera, pose, body);
        }
    }

    /// After each section, corrects the time offset of the camera that is shifted most, by 0.3
    /// frames at most; after the first ones, those of all cameras at once. Returns what is new.
    pub fn correct(&mut self, rig: &mut Rig, frame_period: Nanos) -> Vec<News> {
        let Some(section) = self.tracks.take_complete() else { return Vec::new() };
        let (cameras, step) = (rig.cameras.len(), frame_period * STEP);
        let views = Views::new(section.smoothed(&rig.cameras, step), &rig.cameras);
        let none = vec![0.0; cameras];
        self.normal.fade(FADE);
        self.normal.merge(&views.linearise(&none, &scales(&views, &none)));
        if let Some(first) = &mut self.first {
            first.add(views);
        }
        self.sections += 1;
        if self.sections < FIRST {
            return Vec::new();
        }
        let alone = |i| Normal::estimate(|o| self.normal.at(o), none.clone(), vec![i])[i];
        let found: Vec<Estimate> = (0..cameras).map(alone).collect();
        let mut news = Vec::new();
        if let Some(first) = self.first.take() {
            let is_shifted = |found: &Estimate| found.verdict == OffsetVerdict::Shifted;
            for (camera, steps) in first.certain_offsets(&rig.cameras, found.iter().any(is_shifted))
            {
                let by = Nanos::rounded(steps * step.ns() as f64);
                rig.shift_time(camera, by);
                self.set(camera, self.corrections[camera] + by);
                news.push(News::AtOnce(camera, self.corrections[camera]));
            }
            if !news.is_empty() {
                return news;
            }
        }
        for (camera, since) in self.since_step.iter_mut().enumerate() {
            *since = since.map(|sections| sections + 1);
            if *since >= Some(FIRST) && found[camera].verdict == OffsetVerdict::InSync {
                *since = None;
                news.push(News::InSync(camera, self.corrections[camera]));
            }
        }
        let slopes = self.normal.slopes().abs();
        let worst = (0..cameras).max_by(|&i, &j| slopes[i].total_cmp(&slopes[j]));
        let worst = worst.filter(|&i| found[i].verdict == OffsetVerdict::Shifted);
        let Some(worst) = worst else { return news };
        let steps = found[worst].offset.clamp(-LARGEST, LARGEST);
        let change = Nanos::rounded(steps * step.ns() as f64);
        rig.shift_time(worst, change);
        self.corrections[worst] = self.corrections[worst] + change;
        self.normal.shift(worst, steps);
        if self.since_step[worst].replace(0).is_none() {
            news.push(News::Shifted(worst));
        }
        news
    }

    /// By camera, all corrections so far.
    pub fn corrections(&self) -> &[Nanos] {
        &self.corrections
    }

    /// Corrects a camera by so much from here on, in place of its correction so far. What motion has told is of other
    /// times, and forgotten.
    pub fn set(&mut self, camera: usize, correction: Nanos) {
        let (corrections, first) =
            (self.corrections.clone(), self.first.is_some().then(First::default));
        *self = Self { corrections, first, ..Self::new(self.since_step.len()) };
        self.corrections[camera] = correction;
    }

    /// Another calibration holds: the search of the first sections, if they are not over, begins anew.
    pub fn search_anew(&mut self) {
        if self.first.is_some() {
            (self.first, self.sections) = (Some(First::default()), 0);
        }
    }

    /// Begins with the corrections of an earlier run, if they are of as many cameras.
    pub fn resume(&mut self, corrections: &[Nanos]) {
        if corrections.len() == self.corrections.len() {
            self.corrections.copy_from_slice(corrections);
        }
    }
}

/// The first sections, in which offsets of many frames are searched.
#[derive(Clone, Debug, Default)]
struct First {
    sections: Vec<Vec<Track>>,
    /// The sums of the costs, by pair.
    searched: Vec<Searched>,
}

impl First {
    fn add(&mut self, views: Views) {
        let searched: Vec<Searched> =
            views.pairs.iter().map(|pair| Searched::of(&views, pair)).collect();
        self.searched.iter_mut().zip(&searched).for_each(|(sum, one)| sum.merge(one));
        if self.searched.is_empty() {
            self.searched = searched;
        }
        self.sections.extend(views.into_sections());
    }

    /// The cameras with a certain offset, and that in steps. If the search finds none, there may be small
    /// ones if `may_be_near`.
    fn certain_offsets(self, cameras: &[Camera], may_be_near: bool) -> Vec<(usize, f64)> {
        let offsets = search(&self.searched, cameras.len(), &[]);
        if !may_be_near && offsets.iter().all(|offset| *offset == 0.0) {
            return Vec::new();
        }
        let views = Views::new(self.sections, cameras);
        let found = refined(&views, &scales(&views, &offsets), offsets, 0);
        // Without motion, an offset by chance looks certain now and then, but not those of the others.
        let are_known = found.iter().filter(|one| one.verdict != OffsetVerdict::Unknown).count();
        let is_certain = |(_, one): &(usize, Estimate)| {
            let is_shifted = one.verdict == OffsetVerdict::Shifted && one.error < CERTAIN;
            is_shifted && 2 * are_known > cameras.len()
        };
        found
            .into_iter()
            .enumerate()
            .filter(is_certain)
            .map(|(i, found)| (i, found.offset))
            .collect()
    }
}

/// The scales of the loss of each pair at some offsets, in steps.
fn scales(views: &Views, offsets: &[f64]) -> Vec<Scales> {
    let of_pair = |pair: &Pair| -> Scales {
        let lag = offsets[pair.a] - offsets[pair.b];
        std::array::from_fn(|limb| loss_scale(&mut views.deviations(pair, limb, lag)))
    };
    views.pairs.iter().map(of_pair).collect()
}
