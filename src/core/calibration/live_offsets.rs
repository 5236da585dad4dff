//! Time offsets of live cameras: a slow state.
//!
//! Every two seconds the derivatives of the cost (see [`time_offsets`](super::time_offsets)) of that
//! section are added to those of the past, which fade. The camera whose offset changes the cost
//! most is corrected, little by little, so this follows slow clocks. It finds offsets of up to about
//! three frames; larger ones are left alone.

use super::normal::{Estimate, Normal, OffsetVerdict};
use super::time_offsets::TimeOffset;
use super::tracks::Tracks;
use super::views::{Scales, Views, loss_scale};
use crate::core::body::{Pose, Skeleton};
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::Nanos;

/// Weight of the past after each section: half of it after 46 s.
const FADE: f64 = 0.97;
/// Sections before the first correction.
const FIRST: usize = 8;
/// Frames in a step: costs are compared at lags this far apart.
const STEP: i64 = 3;
/// Largest correction per section, steps: 0.3 frames.
const LARGEST: f64 = 0.1;

/// The slow state of the time offsets.
#[derive(Clone, Debug)]
pub struct LiveOffsets {
    tracks: Tracks,
    normal: Normal,
    sections: usize,
    /// By camera, all corrections so far.
    corrections: Vec<Nanos>,
    is_shifted: Vec<bool>,
}

impl LiveOffsets {
    /// Nothing is known of that many cameras.
    pub fn new(cameras: usize) -> Self {
        Self {
            tracks: Tracks::new(cameras),
            normal: Normal::zeros(cameras),
            sections: 0,
            corrections: vec![Nanos::ZERO; cameras],
            is_shifted: vec![false; cameras],
        }
    }

    /// Adds the performer in a frame, see [`Tracks::add`].
    pub fn add(&mut self, frame: &Detections, rig: &Rig, pose: &Pose, body: &Skeleton) {
        if let Some(camera) = rig.cameras.get(frame.camera) {
            self.tracks.add(frame, camera, pose, body);
        }
    }

    /// After each section, corrects the time offset of the camera that is shifted most, by 0.3
    /// frames at most. Returns it if it was in sync before.
    pub fn correct(&mut self, rig: &mut Rig, frame_period: Nanos) -> Option<(usize, TimeOffset)> {
        let section = self.tracks.take_complete()?;
        let (cameras, step) = (rig.cameras.len(), frame_period * STEP);
        let views = Views::new(section.smoothed(&rig.cameras, step), &rig.cameras);
        let scales = views.pairs.iter().map(|pair| -> Scales {
            std::array::from_fn(|limb| loss_scale(&mut views.deviations(pair, limb, 0.0)))
        });
        let scales: Vec<Scales> = scales.collect();
        self.normal.fade(FADE);
        self.normal.merge(&views.linearise(&vec![0.0; cameras], &scales));
        self.sections += 1;
        if self.sections < FIRST {
            return None;
        }
        let alone = |i| Normal::estimate(|o| self.normal.at(o), vec![0.0; cameras], vec![i])[i];
        let found: Vec<Estimate> = (0..cameras).map(alone).collect();
        for (was_shifted, found) in self.is_shifted.iter_mut().zip(&found) {
            *was_shifted &= found.verdict != OffsetVerdict::InSync;
        }
        let slopes = self.normal.slopes().abs();
        let worst = (0..cameras).max_by(|&i, &j| slopes[i].total_cmp(&slopes[j]));
        let worst = worst.filter(|&i| found[i].verdict == OffsetVerdict::Shifted)?;

        let steps = found[worst].offset.clamp(-LARGEST, LARGEST);
        let change = Nanos::rounded(steps * step.ns() as f64);
        let offset = &mut rig.cameras[worst].time_offset;
        *offset = *offset + change;
        self.corrections[worst] = self.corrections[worst] + change;
        self.normal.shift(worst, steps);
        let was_shifted = std::mem::replace(&mut self.is_shifted[worst], true);
        (!was_shifted).then(|| (worst, TimeOffset::new(found[worst], step)))
    }

    /// By camera, all corrections so far.
    pub fn corrections(&self) -> &[Nanos] {
        &self.corrections
    }

    /// Begins with the corrections of an earlier run, if they are of as many cameras.
    pub fn resume(&mut self, corrections: &[Nanos]) {
        if corrections.len() == self.corrections.len() {
            self.corrections.copy_from_slice(corrections);
        }
    }
}
