//! Time offsets of cameras from motion.
//!
//! Two views of a moving limb satisfy their epipolar constraint only if they are of the same time.
//! For each pair of cameras, limb and block of half a second, the cost of a lag l is
//! sum rho(d_k(l) - m), where d_k is the epipolar distance in pixels of one view at step k - l/2 and
//! the other at k + l/2, m its robust mean, and rho the Geman-McClure loss. The mean takes up the
//! errors of calibration and detector, which look like an offset of whoever moves in one direction.
//! The offsets minimise the sum over pairs of the costs at l = offset_a - offset_b.
//!
//! A search over whole steps gives the start; Newton steps refine it. First and second derivative
//! of the costs are differences over one step: where nothing moves, the second one vanishes, however
//! much the points jitter. Standard errors are those of clustered data: with H the sum of the second
//! and s_c the first derivatives of cluster c, the covariance is H^-1 (sum s_c s_c^T) H^-1. Clusters
//! are limbs, since a detector errs alike in each step of a walk, or limbs in a block, whichever
//! gives more.

use super::epipolar::Pair;
use super::normal::{Estimate, Normal, OffsetVerdict, REACH};
use super::tracks::{LIMBS, Tracks};
use super::views::{Scales, Views, loss_scale};
use crate::core::camera::Camera;
use crate::core::time::Nanos;

/// Noise alone lowers the costs of a camera's pairs by less than this part at any lag.
const LEAST_FALL: f64 = 0.05;

/// What must be added to a camera's capture times to agree with those of most cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeOffset {
    /// The estimate; `None` if it is unknown.
    pub offset: Option<Nanos>,
    /// Its standard error; at most six steps.
    pub error: Nanos,
    /// Whether to use it.
    pub verdict: OffsetVerdict,
}

impl TimeOffset {
    pub(super) fn new(found: Estimate, step: Nanos) -> Self {
        let Estimate { offset, error, verdict } = found;
        let time = |steps: f64| Nanos::rounded(steps * step.ns() as f64);
        let offset = (verdict != OffsetVerdict::Unknown).then(|| time(offset));
        Self { offset, error: time(error.min(REACH as f64)), verdict }
    }

    /// The same after a significant offset that was applied before.
    #[must_use]
    pub(crate) fn after(self, before: Nanos) -> Self {
        Self { offset: Some(before + self.applied()), verdict: OffsetVerdict::Shifted, ..self }
    }

    /// The offset to use: none unless it is significant.
    pub fn applied(&self) -> Nanos {
        let shifted = self.offset.filter(|_| self.verdict == OffsetVerdict::Shifted);
        shifted.unwrap_or(Nanos::ZERO)
    }
}

/// The step for [`time_offsets`]: the shortest whole number of frame periods of at least 8 ms. In less time, people hardly
/// move.
pub(crate) fn offset_step(period: Nanos) -> Nanos {
    const LEAST: Nanos = Nanos::from_ms(8);
    period * ((LEAST.ns() - 1) / period.ns().max(1) + 1)
}

/// The time offsets of cameras, from tracks of their views. Offsets of up to six `step`s are found. The offsets of the first
/// cameras may be `known`.
pub fn time_offsets(
    tracks: &Tracks,
    cameras: &[Camera],
    step: Nanos,
    known: &[Nanos],
) -> Vec<TimeOffset> {
    let views = Views::new(tracks.smoothed(cameras, step), cameras);
    let searched: Vec<Searched> =
        views.pairs.iter().map(|pair| Searched::of(&views, pair)).collect();
    let scales: Vec<Scales> = searched.iter().map(|searched| searched.scales).collect();
    let known: Vec<f64> = known.iter().map(|k| k.ns() as f64 / step.ns().max(1) as f64).collect();
    let offsets = search(&searched, cameras.len(), &known);
    let found = refined(&views, &scales, offsets, known.len());
    found.into_iter().map(|found| TimeOffset::new(found, step)).collect()
}

/// The estimates that follow from whole offsets, of which the first ones are known.
pub(super) fn refined(
    views: &Views,
    scales: &[Scales],
    mut offsets: Vec<f64>,
    known: usize,
) -> Vec<Estimate> {
    let linearise = |offsets: &[f64]| views.linearise(offsets, scales);
    let mut free: Vec<usize> = (known..offsets.len()).collect();
    let mut reference = None;
    if known == 0 {
        centre(&mut offsets);
        let information = linearise(&offsets).information();
        // The reference has the median offset, and the other offsets are relative to it.
        let usual = (0..offsets.len()).filter(|&i| offsets[i] == 0.0);
        reference = usual.max_by(|&i, &j| information[i].total_cmp(&information[j]));
        free.retain(|&i| Some(i) != reference);
    }
    let mut found = Normal::estimate(linearise, offsets, free);
    if let Some(reference) = reference {
        let unknown = |(i, found): (usize, &Estimate)| {
            i == reference || found.verdict == OffsetVerdict::Unknown
        };
        if found.iter().enumerate().all(unknown) {
            // Nothing is known of any camera.
            found[reference] =
                Estimate { offset: 0.0, error: f64::INFINITY, verdict: OffsetVerdict::Unknown };
        }
    }
    found
}

/// The costs of a pair at whole lags.
#[derive(Clone, Debug)]
pub(super) struct Searched {
    pair: Pair,
    /// Sum over the limbs of the mean absolute deviation in scales, times the number of points, at
    /// lags from -2 REACH to 2 REACH.
    costs: Vec<f64>,
    /// Of the lag with the least deviation.
    scales: Scales,
}

impl Searched {
    pub(super) fn of(views: &Views, pair: &Pair) -> Self {
        let lags = || -2 * REACH..=2 * REACH;
        let mut found = Self {
            pair: pair.clone(),
            costs: vec![0.0; lags().count()],
            scales: Default::default(),
        };
        for limb in 0..LIMBS.len() {
            let mut all: Vec<Vec<f64>> =
                lags().map(|lag| views.deviations(pair, limb, lag as f64)).collect();
            let mean = |values: &Vec<f64>| values.iter().sum::<f64>() / values.len() as f64;
            let means: Vec<f64> = all.iter().map(mean).collect();
            let known = || means.iter().copied().filter(|mean| mean.is_finite());
            let most = known().fold(0.0, f64::max);
            let best = (0..means.len()).filter(|&i| means[i].is_finite());
            let Some(best) = best.min_by(|&i, &j| means[i].total_cmp(&means[j])) else { continue };
            let scale = loss_scale(&mut all[best]);
            found.scales[limb] = scale;
            if scale > 0.0 {
                let weight = all[2 * REACH as usize].len() as f64 / scale;
                let means = means.iter().map(|mean| if mean.is_finite() { *mean } else { most });
                found.costs.iter_mut().zip(means).for_each(|(cost, mean)| *cost += weight * mean);
            }
        }
        found
    }

    /// Adds the costs of the same pair in other sections.
    pub(super) fn merge(&mut self, other: &Self) {
        self.costs.iter_mut().zip(&other.costs).for_each(|(cost, other)| *cost += other);
    }
}

/// Whole offsets: one camera after the other takes the offset that lowers the costs of its pairs most,
/// as long as they fall by a part that is no accident. The first offsets are known.
pub(super) fn search(pairs: &[Searched], cameras: usize, known: &[f64]) -> Vec<f64> {
    let mut offsets: Vec<f64> = vec![0.0; cameras];
    offsets[..known.len()].copy_from_slice(known);
    let cost = |camera: usize, offsets: &[f64]| -> f64 {
        let of_pair = |Searched { pair, costs, .. }: &Searched| {
            let lag = (offsets[pair.a] - offsets[pair.b]).round() as i64;
            costs[(lag + 2 * REACH).clamp(0, 4 * REACH) as usize]
        };
        let own = pairs.iter().filter(|s| s.pair.a == camera || s.pair.b == camera);
        own.map(of_pair).sum()
    };
    for _ in 0..4 * cameras {
        let (mut most, mut best) = (0.0, None);
        for camera in known.len()..cameras {
            let now = cost(camera, &offsets);
            for offset in -REACH..=REACH {
                let mut moved = offsets.clone();
                moved[camera] = offset as f64;
                let fall = now - cost(camera, &moved);
                if fall > LEAST_FALL * now && fall > most {
                    (most, best) = (fall, Some(moved));
                }
            }
        }
        let Some(moved) = best else { break };
        offsets = moved;
    }
    offsets
}

/// Moves offsets so that their median (the lower one) is 0.
fn centre(offsets: &mut [f64]) {
    let mut sorted = offsets.to_vec();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.get(sorted.len().saturating_sub(1) / 2).copied().unwrap_or(0.0);
    offsets.iter_mut().for_each(|offset| *offset -= middle);
}
