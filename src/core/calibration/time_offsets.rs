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

use nalgebra::{DMatrix, DVector};

use super::epipolar::Pair;
use super::tracks::{LIMBS, Track, Tracks, at, median};
use crate::core::camera::Camera;
use crate::core::time::Nanos;

/// Largest offset that is searched for, in steps.
const REACH: i64 = 6;
/// Blocks in a section.
const BLOCKS: usize = 4;
/// Scale of the loss, in robust standard deviations of the distances.
const LOSS_SCALE: f64 = 3.0;
/// Most Newton steps, and when they end, in steps of time.
const NEWTON: usize = 12;
const CONVERGED: f64 = 2e-3;
/// An offset is significant from this many standard errors and this many steps on.
const SIGNIFICANT: [f64; 2] = [3.0, 0.1];
/// Largest standard errors, steps, with which a camera counts as shifted or in sync.
const KNOWN: [f64; 2] = [0.5, 0.25];
/// Second derivative that stands for no information: a standard error of many steps.
const NO_INFORMATION: f64 = 1e-3;

/// The verdict on a camera's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OffsetVerdict {
    /// No significant offset.
    InSync,
    /// A significant offset.
    Shifted,
    /// Too little motion was seen to tell.
    Unknown,
}

/// What must be added to a camera's capture times to agree with those of most cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeOffset {
    /// The estimate.
    pub offset: Nanos,
    /// Its standard error.
    pub error: Nanos,
    /// Whether to use it.
    pub verdict: OffsetVerdict,
}

impl TimeOffset {
    /// The offset to use: none unless it is significant.
    pub fn applied(&self) -> Nanos {
        if self.verdict == OffsetVerdict::Shifted { self.offset } else { Nanos::ZERO }
    }
}

/// The time offsets of cameras, from tracks of their views. `step` is the nominal frame period;
/// offsets up to six of them are found. Those of the first cameras may be `known`.
pub fn time_offsets(
    tracks: &Tracks,
    cameras: &[Camera],
    step: Nanos,
    known: &[Nanos],
) -> Vec<TimeOffset> {
    let sections = tracks.smoothed(cameras, step);
    let pairs = (0..cameras.len()).flat_map(|b| (0..b).map(move |a| (a, b)));
    let pairs = pairs.filter_map(|(a, b)| Pair::of(cameras, a, b));
    let mut views = Views { sections, pairs: Vec::new(), cameras: cameras.len() };
    views.pairs = pairs.filter_map(|pair| views.searched(pair)).collect();
    let known: Vec<f64> = known.iter().map(|k| k.ns() as f64 / step.ns().max(1) as f64).collect();
    let start = views.search(&known);
    views.refine(start, &known).into_iter().map(|found| found.over(step)).collect()
}

/// A pair with its costs at whole lags.
struct Searched {
    pair: Pair,
    /// Mean absolute distance from the median at lags from -2 REACH to 2 REACH, times its weight.
    costs: Vec<f64>,
    /// Scale of the loss, pixels.
    scale: f64,
}

struct Views {
    /// By section and camera.
    sections: Vec<Vec<Track>>,
    pairs: Vec<Searched>,
    cameras: usize,
}

/// An offset in steps.
#[derive(Clone, Copy)]
struct Estimate {
    offset: f64,
    error: f64,
    verdict: OffsetVerdict,
}

impl Estimate {
    fn over(self, step: Nanos) -> TimeOffset {
        let time = |steps: f64| Nanos::rounded(steps * step.ns() as f64);
        TimeOffset {
            offset: time(self.offset),
            error: time(self.error.min(1e3)),
            verdict: self.verdict,
        }
    }
}

/// Cost, gradient and curvature at some offsets.
struct Normal {
    hessian: DMatrix<f64>,
    gradient: DVector<f64>,
    /// Sums of the outer products of the gradients of limbs, and of limbs in a block.
    spreads: [DMatrix<f64>; 2],
    limbs: usize,
}

impl Views {
    /// The epipolar distances of a limb in a block at several lags, for the steps that have all.
    fn distances<const N: usize>(
        &self,
        pair: &Pair,
        [section, block, limb]: [usize; 3],
        lags: [f64; N],
    ) -> Vec<[f64; N]> {
        let (a, b) = (&self.sections[section][pair.a], &self.sections[section][pair.b]);
        let steps = a.len() / BLOCKS;
        let distance = |k: usize, lag: f64| {
            let [before, after] = [-0.5, 0.5].map(|half| k as f64 + half * lag);
            Some(pair.distance(&at(a, limb, before)?, &at(b, limb, after)?))
        };
        let mut found = Vec::new();
        for k in block * steps..(block + 1) * steps {
            let all = lags.map(|lag| distance(k, lag));
            if all.iter().all(Option::is_some) {
                found.push(all.map(Option::unwrap_or_default));
            }
        }
        if 2 * found.len() < steps { Vec::new() } else { found }
    }

    /// All blocks: section, block, limb.
    fn blocks(&self, limb: usize) -> impl Iterator<Item = [usize; 3]> + use<> {
        let sections = 0..self.sections.len();
        sections.flat_map(move |section| (0..BLOCKS).map(move |block| [section, block, limb]))
    }

    /// The costs of a pair at whole lags. `None` if its views have nothing in common.
    fn searched(&self, pair: Pair) -> Option<Searched> {
        let mut of_lags: Vec<(f64, f64)> = Vec::new();
        let mut least: Option<Vec<f64>> = None;
        for lag in -2 * REACH..=2 * REACH {
            let mut deviations = Vec::new();
            for block in (0..LIMBS.len()).flat_map(|limb| self.blocks(limb)) {
                let mut distances: Vec<f64> =
                    self.distances(&pair, block, [lag as f64]).into_iter().flatten().collect();
                let Some(middle) = median(&mut distances) else { continue };
                deviations.extend(distances.iter().map(|d| (d - middle).abs()));
            }
            let mean = deviations.iter().sum::<f64>() / deviations.len().max(1) as f64;
            if of_lags.iter().all(|(best, _)| mean < *best) && !deviations.is_empty() {
                least = Some(deviations.clone());
            }
            of_lags.push((
                if deviations.is_empty() { f64::INFINITY } else { mean },
                deviations.len() as f64,
            ));
        }
        let scale = LOSS_SCALE * 1.4826 * median(&mut least?)?;
        let count = of_lags[2 * REACH as usize].1;
        let most =
            of_lags.iter().map(|(mean, _)| *mean).filter(|m| m.is_finite()).fold(0.0, f64::max);
        let cost = |mean: f64| if mean.is_finite() { mean } else { most };
        let costs = of_lags.iter().map(|(mean, _)| cost(*mean) * count / scale).collect();
        (scale > 0.0).then_some(Searched { pair, costs, scale })
    }

    /// Whole offsets: one camera after the other takes the offset that lowers the sum of the costs
    /// most.
    fn search(&self, known: &[f64]) -> Vec<i64> {
        let mut offsets = vec![0; self.cameras];
        offsets.iter_mut().zip(known).for_each(|(offset, known)| *offset = known.round() as i64);
        let cost = |offsets: &[i64]| -> f64 {
            let of_pair = |searched: &Searched| {
                let lag = offsets[searched.pair.a] - offsets[searched.pair.b];
                let index = (lag + 2 * REACH).clamp(0, 4 * REACH);
                searched.costs[index as usize]
            };
            self.pairs.iter().map(of_pair).sum()
        };
        for _ in 0..4 * self.cameras {
            let mut best = (cost(&offsets) * (1.0 - 1e-9), None);
            for camera in known.len()..self.cameras {
                for offset in -REACH..=REACH {
                    let mut moved = offsets.clone();
                    moved[camera] = offset;
                    let cost = cost(&moved);
                    if cost < best.0 {
                        best = (cost, Some(moved));
                    }
                }
            }
            let Some(moved) = best.1 else { break };
            offsets = moved;
        }
        offsets
    }

    /// Cost and derivatives at some offsets, in steps.
    fn linearise(&self, offsets: &[f64]) -> Normal {
        let n = self.cameras;
        let zeros = DMatrix::zeros(n, n);
        let (hessian, spreads) = (zeros.clone(), [zeros.clone(), zeros]);
        let mut normal = Normal { hessian, gradient: DVector::zeros(n), spreads, limbs: 0 };
        for limb in 0..LIMBS.len() {
            let mut of_limb = DVector::zeros(n);
            for block in self.blocks(limb) {
                let of_block = self.slopes(offsets, block, &mut normal.hessian);
                normal.spreads[1] += &of_block * of_block.transpose();
                of_limb += of_block;
            }
            normal.limbs += usize::from(of_limb.amax() > 0.0);
            normal.spreads[0] += &of_limb * of_limb.transpose();
            normal.gradient += of_limb;
        }
        normal
    }

    /// The gradient of a block's cost; adds its Hessian.
    fn slopes(
        &self,
        offsets: &[f64],
        block: [usize; 3],
        hessian: &mut DMatrix<f64>,
    ) -> DVector<f64> {
        let mut slopes = DVector::zeros(self.cameras);
        for Searched { pair, scale, .. } in &self.pairs {
            let lag = offsets[pair.a] - offsets[pair.b];
            let distances = self.distances(pair, block, [lag - 1.0, lag, lag + 1.0]);
            if distances.is_empty() {
                continue;
            }
            let [before, at, after] = [0, 1, 2].map(|i| cost(&distances, i, *scale));
            let (slope, curvature) = (0.5 * (after - before), after - 2.0 * at + before);
            for (i, sign) in [(pair.a, 1.0), (pair.b, -1.0)] {
                slopes[i] += sign * slope;
                hessian[(i, pair.a)] += sign * curvature;
                hessian[(i, pair.b)] -= sign * curvature;
            }
        }
        slopes
    }

    /// Refines whole offsets. Cameras without a significant offset are held at 0, the least
    /// significant one first.
    fn refine(&self, start: Vec<i64>, known: &[f64]) -> Vec<Estimate> {
        let mut offsets: Vec<f64> = start.iter().map(|&offset| offset as f64).collect();
        let mut free: Vec<usize> = (known.len()..self.cameras).collect();
        offsets[..known.len()].copy_from_slice(known);
        if known.is_empty() {
            let reference = self.reference(&mut offsets);
            free.retain(|&i| Some(i) != reference);
        }
        let known = Estimate { offset: 0.0, error: 0.0, verdict: OffsetVerdict::InSync };
        let mut found = vec![known; self.cameras];
        while !free.is_empty() {
            let errors = self.minimise(&mut offsets, &free);
            for (&i, &error) in free.iter().zip(&errors) {
                let verdict = verdict(offsets[i], error);
                found[i] = Estimate { offset: offsets[i], error, verdict };
            }
            let significance = |i: usize| match found[i].verdict {
                OffsetVerdict::Unknown => -1.0 / found[i].error,
                _ => found[i].offset.abs() / found[i].error,
            };
            let least =
                free.iter().copied().filter(|&i| found[i].verdict != OffsetVerdict::Shifted);
            let least = least.min_by(|&i, &j| significance(i).total_cmp(&significance(j)));
            let Some(least) = least else { break };
            offsets[least] = 0.0;
            free.retain(|&i| i != least);
        }
        found
    }

    /// Moves the offsets so that their median is 0. Returns the camera near 0 that is known best.
    fn reference(&self, offsets: &mut [f64]) -> Option<usize> {
        let middle = {
            let mut sorted = offsets.to_vec();
            sorted.sort_by(f64::total_cmp);
            *sorted.get(sorted.len().checked_sub(1)? / 2)?
        };
        offsets.iter_mut().for_each(|offset| *offset -= middle);
        let information = self.linearise(offsets).hessian.diagonal();
        let near = (0..offsets.len()).filter(|&i| offsets[i].abs() < 1.5);
        near.max_by(|&i, &j| information[i].total_cmp(&information[j]))
    }

    /// Newton steps over the offsets of the `free` cameras. Returns their standard errors.
    fn minimise(&self, offsets: &mut [f64], free: &[usize]) -> Vec<f64> {
        let n = free.len();
        let unknown = vec![f64::INFINITY; n];
        for iteration in 0..=NEWTON {
            let normal = self.linearise(offsets);
            let part = |m: &DMatrix<f64>| DMatrix::from_fn(n, n, |i, j| m[(free[i], free[j])]);
            let mut hessian = part(&normal.hessian);
            for i in 0..n {
                hessian[(i, i)] += NO_INFORMATION;
            }
            let Some(factor) = hessian.cholesky() else { return unknown };
            let gradient = DVector::from_fn(n, |i, _| normal.gradient[free[i]]);
            let step = factor.solve(&gradient);
            if step.amax() < CONVERGED || iteration == NEWTON {
                let limbs = normal.limbs as f64;
                let few = limbs / (limbs - 1.0).max(1.0);
                let variances = normal.spreads.map(|spread| {
                    let half = factor.solve(&part(&spread));
                    factor.solve(&half.transpose()).diagonal() * few
                });
                return variances[0].zip_map(&variances[1], |a, b| a.max(b).sqrt()).data.into();
            }
            let most = REACH as f64 + 1.0;
            for (&i, step) in free.iter().zip(&step) {
                offsets[i] = (offsets[i] - step.clamp(-1.0, 1.0)).clamp(-most, most);
            }
        }
        unknown
    }
}

fn verdict(offset: f64, error: f64) -> OffsetVerdict {
    let [errors, steps] = SIGNIFICANT;
    let [shifted, in_sync] = KNOWN;
    match () {
        () if error < shifted && offset.abs() > (errors * error).max(steps) => {
            OffsetVerdict::Shifted
        }
        () if error < in_sync => OffsetVerdict::InSync,
        () => OffsetVerdict::Unknown,
    }
}

/// The sum of rho(d - m) over the distances with index `i`, as multiples of the squared scale; m
/// minimises it.
fn cost<const N: usize>(distances: &[[f64; N]], i: usize, scale: f64) -> f64 {
    let values = || distances.iter().map(|all| all[i]);
    let mut middle = median(&mut values().collect::<Vec<f64>>()).unwrap_or_default();
    let weight = |r: f64| 1.0 / (1.0 + r * r).powi(2);
    for _ in 0..3 {
        let (sum, weights) = values().fold((0.0, 0.0), |(sum, weights), d| {
            let w = weight((d - middle) / scale);
            (sum + w * d, weights + w)
        });
        middle = sum / weights;
    }
    values().map(|d| ((d - middle) / scale).powi(2)).map(|r| 0.5 * r / (1.0 + r)).sum()
}
