//! Epipolar distances of smoothed tracks, and their costs at a lag.

use nalgebra::{DMatrix, DVector};

use super::epipolar::Pair;
use super::normal::Normal;
use super::tracks::{LIMBS, Track, at};
use crate::core::camera::Camera;
use crate::core::points::median;

/// Blocks in a section.
const BLOCKS: usize = 4;
/// Scale of the loss, in robust standard deviations of the distances.
const LOSS_SCALE: f64 = 3.0;
/// Standard deviation of a normal distribution, in medians of the absolute deviation.
const SIGMA: f64 = 1.4826;

/// Scale of the loss of each limb, pixels.
pub(super) type Scales = [f64; LIMBS.len()];

/// Smoothed tracks, and the pairs of cameras to compare.
pub(super) struct Views {
    /// By section and camera.
    sections: Vec<Vec<Track>>,
    pub(super) pairs: Vec<Pair>,
    cameras: usize,
}

impl Views {
    pub(super) fn new(sections: Vec<Vec<Track>>, cameras: &[Camera]) -> Self {
        let pairs = (0..cameras.len()).flat_map(|b| (0..b).map(move |a| (a, b)));
        let pairs = pairs.filter_map(|(a, b)| Pair::of(cameras, a, b)).collect();
        Self { sections, pairs, cameras: cameras.len() }
    }

    pub(super) fn into_sections(self) -> Vec<Vec<Track>> {
        self.sections
    }

    /// The epipolar distances of a limb in a block at several lags, for every `stride`th step, if it
    /// has all.
    fn distances<const N: usize>(
        &self,
        pair: &Pair,
        [section, block, limb]: [usize; 3],
        lags: [f64; N],
        stride: usize,
    ) -> Vec<[f64; N]> {
        let (a, b) = (&self.sections[section][pair.a], &self.sections[section][pair.b]);
        let steps = a.len() / BLOCKS;
        let distance = |k: usize, lag: f64| {
            let [before, after] = [-0.5, 0.5].map(|half| k as f64 + half * lag);
            Some(pair.distance(&at(a, limb, before)?, &at(b, limb, after)?))
        };
        let mut found = Vec::new();
        for k in (block * steps..(block + 1) * steps).step_by(stride) {
            let all = lags.map(|lag| distance(k, lag));
            if all.iter().all(Option::is_some) {
                found.push(all.map(Option::unwrap_or_default));
            }
        }
        if 2 * stride * found.len() < steps { Vec::new() } else { found }
    }

    /// All blocks of a limb: section, block, limb.
    fn blocks(&self, limb: usize) -> impl Iterator<Item = [usize; 3]> + use<> {
        let sections = 0..self.sections.len();
        sections.flat_map(move |section| (0..BLOCKS).map(move |block| [section, block, limb]))
    }

    /// The distances of a pair's limb at a lag from the median of their block, without sign, for every
    /// second step.
    pub(super) fn deviations(&self, pair: &Pair, limb: usize, lag: f64) -> Vec<f64> {
        let mut all = Vec::new();
        for block in self.blocks(limb) {
            let mut distances: Vec<f64> =
                self.distances(pair, block, [lag], 2).into_iter().flatten().collect();
            let Some(middle) = median(&mut distances) else { continue };
            all.extend(distances.iter().map(|distance| (distance - middle).abs()));
        }
        all
    }

    /// The derivatives at some offsets, in steps, with the scales of the loss of each pair.
    pub(super) fn linearise(&self, offsets: &[f64], scales: &[Scales]) -> Normal {
        let mut normal = Normal::zeros(self.cameras);
        for limb in 0..LIMBS.len() {
            for block in self.blocks(limb) {
                self.add_block(block, offsets, scales, &mut normal);
            }
        }
        normal
    }

    fn add_block(
        &self,
        block: [usize; 3],
        offsets: &[f64],
        scales: &[Scales],
        normal: &mut Normal,
    ) {
        let mut hessian = DMatrix::zeros(self.cameras, self.cameras);
        let mut gradient = DVector::zeros(self.cameras);
        for (pair, scales) in self.pairs.iter().zip(scales) {
            let scale = scales[block[2]];
            let lag = offsets[pair.a] - offsets[pair.b];
            let distances = self.distances(pair, block, [lag - 1.0, lag, lag + 1.0], 2);
            if distances.is_empty() || scale <= 0.0 {
                continue;
            }
            let [before, at, after] = [0, 1, 2].map(|i| cost(&distances, i, scale));
            let (slope, curvature) = (0.5 * (after - before), after - 2.0 * at + before);
            for (i, sign) in [(pair.a, 1.0), (pair.b, -1.0)] {
                gradient[i] += sign * slope;
                hessian[(i, pair.a)] += sign * curvature;
                hessian[(i, pair.b)] -= sign * curvature;
            }
        }
        normal.add(block[2], &hessian, &gradient);
    }
}

/// The scale of the loss from deviations; 0 without any.
pub(super) fn loss_scale(deviations: &mut [f64]) -> f64 {
    LOSS_SCALE * SIGMA * median(deviations).unwrap_or(0.0)
}

/// The sum of rho(d - m) over the distances with index `i`, as multiples of the squared scale; m
/// minimises it.
fn cost<const N: usize>(distances: &[[f64; N]], i: usize, scale: f64) -> f64 {
    let values = || distances.iter().map(|all| all[i]);
    let mut middle = median(&mut values().collect::<Vec<f64>>()).unwrap_or_default();
    for _ in 0..3 {
        let (sum, weights) = values().fold((0.0, 0.0), |(sum, weights), d| {
            let r = (d - middle) / scale;
            let weight = 1.0 / ((1.0 + r * r) * (1.0 + r * r));
            (sum + weight * d, weights + weight)
        });
        middle = sum / weights;
    }
    values().map(|d| ((d - middle) / scale).powi(2)).map(|r| 0.5 * r / (1.0 + r)).sum()
}
