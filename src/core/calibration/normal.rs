//! Normal equations of time offsets, and what they say.

use nalgebra::{DMatrix, DVector};

use super::tracks::LIMBS;

/// Largest offset that is found, in steps.
pub(crate) const REACH: i64 = 6;
/// Most Newton steps, and when they end, in steps of time.
const NEWTON: usize = 12;
const CONVERGED: f64 = 2e-3;
/// Farther than this from the start, in steps, a minimum is one by chance.
const NEAR: f64 = 2.0;
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

/// Derivatives of the cost by the offsets, in steps.
#[derive(Clone, Debug)]
pub(super) struct Normal {
    /// Hessian and gradient of each limb.
    limbs: Vec<(DMatrix<f64>, DVector<f64>)>,
    /// Sum of the outer products of the blocks' gradients.
    spread: DMatrix<f64>,
}

/// An offset in steps.
#[derive(Clone, Copy, Debug)]
pub(super) struct Estimate {
    pub(super) offset: f64,
    pub(super) error: f64,
    pub(super) verdict: OffsetVerdict,
}

impl Normal {
    /// No information about that many cameras.
    pub(super) fn zeros(cameras: usize) -> Self {
        let zeros = DMatrix::zeros(cameras, cameras);
        let limb = (zeros.clone(), DVector::zeros(cameras));
        Self { limbs: vec![limb; LIMBS.len()], spread: zeros }
    }

    /// Adds a block of a limb.
    pub(super) fn add(&mut self, limb: usize, hessian: &DMatrix<f64>, gradient: &DVector<f64>) {
        let (h, g) = &mut self.limbs[limb];
        *h += hessian;
        *g += gradient;
        self.spread += gradient * gradient.transpose();
    }

    /// Adds other data.
    pub(super) fn merge(&mut self, other: &Self) {
        for ((hessian, gradient), (h, g)) in self.limbs.iter_mut().zip(&other.limbs) {
            *hessian += h;
            *gradient += g;
        }
        self.spread += &other.spread;
    }

    /// The derivatives at other offsets, if the cost is quadratic.
    pub(super) fn at(&self, offsets: &[f64]) -> Self {
        let mut moved = self.clone();
        offsets.iter().enumerate().for_each(|(camera, &steps)| moved.shift(camera, steps));
        moved
    }

    /// Lowers the weight of what was added so far.
    pub(super) fn fade(&mut self, factor: f64) {
        for (hessian, gradient) in &mut self.limbs {
            *hessian *= factor;
            *gradient *= factor;
        }
        self.spread *= factor * factor;
    }

    /// The offset of a camera has changed by that many steps.
    pub(super) fn shift(&mut self, camera: usize, steps: f64) {
        for (hessian, gradient) in &mut self.limbs {
            *gradient += hessian.column(camera) * steps;
        }
    }

    fn hessian(&self) -> DMatrix<f64> {
        self.limbs.iter().map(|(hessian, _)| hessian).sum()
    }

    /// The first derivative by each offset.
    pub(super) fn slopes(&self) -> DVector<f64> {
        self.limbs.iter().map(|(_, gradient)| gradient).sum()
    }

    /// The second derivative by each offset.
    pub(super) fn information(&self) -> DVector<f64> {
        self.hessian().diagonal()
    }

    /// The Newton step of the `free` cameras, and their standard errors.
    fn step(&self, free: &[usize]) -> (Vec<f64>, Vec<f64>) {
        let n = free.len();
        let part = |m: &DMatrix<f64>| DMatrix::from_fn(n, n, |i, j| m[(free[i], free[j])]);
        let mut hessian = part(&self.hessian());
        (0..n).for_each(|i| hessian[(i, i)] += NO_INFORMATION);
        let Some(factor) = hessian.clone().cholesky() else {
            // The camera with the least information is known least.
            let unknown = |i| REACH as f64 + 1.0 / hessian[(i, i)].max(1e-9);
            return (vec![0.0; n], (0..n).map(unknown).collect());
        };
        let mut of_limbs = DMatrix::zeros(n, n);
        let mut gradient = DVector::zeros(n);
        for (_, of_limb) in &self.limbs {
            let of_limb = DVector::from_fn(n, |i, _| of_limb[free[i]]);
            of_limbs += &of_limb * of_limb.transpose();
            gradient += of_limb;
        }
        let seen = self.limbs.iter().filter(|(_, gradient)| gradient.amax() > 0.0).count() as f64;
        let few = seen / (seen - 1.0).max(1.0);
        let variances = [of_limbs, part(&self.spread)].map(|spread| {
            let half = factor.solve(&spread);
            factor.solve(&half.transpose()).diagonal() * few
        });
        let mut errors = variances[0].zip_map(&variances[1], |a, b| a.max(b).max(0.0).sqrt());
        // Without data there is no spread either.
        for (i, error) in errors.iter_mut().enumerate() {
            if hessian[(i, i)] <= 2.0 * NO_INFORMATION {
                *error = error.max(REACH as f64);
            }
        }
        (factor.solve(&-gradient).data.into(), errors.data.into())
    }

    /// Newton steps over the offsets of the `free` cameras. Returns their standard errors.
    fn minimise(
        linearise: &mut impl FnMut(&[f64]) -> Self,
        offsets: &mut [f64],
        free: &[usize],
    ) -> Vec<f64> {
        let (mut iteration, start) = (0, offsets.to_vec());
        loop {
            let (step, errors) = linearise(offsets).step(free);
            let is_done = step.iter().all(|step| step.abs() < CONVERGED);
            if is_done || iteration == NEWTON {
                return errors;
            }
            for (&i, step) in free.iter().zip(&step) {
                let moved = offsets[i] + step.clamp(-1.0, 1.0);
                offsets[i] = moved.clamp(start[i] - NEAR, start[i] + NEAR);
            }
            iteration += 1;
        }
    }

    /// Estimates offsets from a start; those of cameras that are not `free` stay. Cameras without a
    /// significant offset are held at 0, the least significant one first.
    pub(super) fn estimate(
        mut linearise: impl FnMut(&[f64]) -> Self,
        mut offsets: Vec<f64>,
        mut free: Vec<usize>,
    ) -> Vec<Estimate> {
        let known = Estimate { offset: 0.0, error: 0.0, verdict: OffsetVerdict::InSync };
        let mut found = vec![known; offsets.len()];
        Self::minimise_into(&mut found, &mut linearise, &mut offsets, &free);
        // Near the minimum the cost is about quadratic.
        let (minimum, normal) = (offsets.clone(), linearise(&offsets));
        let mut quadratic = |offsets: &[f64]| {
            let moved: Vec<f64> = offsets.iter().zip(&minimum).map(|(o, m)| o - m).collect();
            normal.at(&moved)
        };
        loop {
            let significance = |i: usize| match found[i].verdict {
                OffsetVerdict::Unknown => -found[i].error,
                _ => found[i].offset.abs() / found[i].error,
            };
            let others = free.iter().filter(|&&i| found[i].verdict != OffsetVerdict::Shifted);
            let least = others.min_by(|&&i, &&j| significance(i).total_cmp(&significance(j)));
            let Some(&least) = least else { break };
            offsets[least] = 0.0;
            free.retain(|&i| i != least);
            Self::minimise_into(&mut found, &mut quadratic, &mut offsets, &free);
        }
        Self::minimise_into(&mut found, &mut linearise, &mut offsets, &free);
        found
    }

    /// Minimises over the `free` offsets and stores what is found.
    fn minimise_into(
        found: &mut [Estimate],
        linearise: &mut impl FnMut(&[f64]) -> Self,
        offsets: &mut [f64],
        free: &[usize],
    ) {
        if free.is_empty() {
            return;
        }
        let start = offsets.to_vec();
        let errors = Self::minimise(linearise, offsets, free);
        for (&i, error) in free.iter().zip(errors) {
            let is_near = (offsets[i] - start[i]).abs() < NEAR;
            let error = if is_near { error } else { error.max(REACH as f64) };
            found[i] = Estimate { offset: offsets[i], error, verdict: verdict(offsets[i], error) };
        }
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
