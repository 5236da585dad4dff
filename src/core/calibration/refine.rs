//! Small corrections of cameras from the performer's limbs.
//!
//! A robust bundle adjustment of the triangulated limbs. The residual of a view is
//! r = F (n - s pi(q)), pixels, with F the mean focal length, n the observed normalised point,
//! pi(q) = (x, y) / z, q = exp(w) (R (X - c) - k), and the unknowns of a camera: its rotation w and
//! shift k in its own frame, and s - 1 the change of its focal length. Points are eliminated (Schur
//! complement). A stiff prior holds the cameras; where a correction is larger than it expects, a weaker one.
//!
//! As few cameras as possible are corrected: one after the other is set free, the one that lowers
//! the cost most first, as long as its correction is significant. The others hold the world in
//! place. Standard errors are those of data in clusters, see [`time_offsets`](super::time_offsets);
//! a cluster is a limb, because a detector misplaces a limb alike in all frames.

use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix3, SMatrix, SVector, Vector2, Vector3};
use serde::Serialize;

use super::tracks::{LIMBS, Tracks, at};
use crate::core::camera::Camera;
use crate::core::points::median;
use crate::core::so3;
use crate::core::time::Nanos;

/// Time between two compared frames.
const STEP: Nanos = Nanos::from_ms(100);
/// Unknowns of a camera: rotation (radians), shift (metres), relative focal length.
const UNKNOWNS: usize = 7;
/// Standard deviations of the prior: 1 degree, 2 cm, 2 %.
const PRIOR: [f64; 3] = [0.017453292519943295, 0.02, 0.02];
/// A significant correction that is larger gets a prior of its own size. Both are estimated so many times.
const RELAXATIONS: usize = 4;
/// Corrections below these are not significant: 0.1 degrees, 5 mm, 0.3 %.
const LEAST: [f64; 3] = [0.0017453292519943296, 0.005, 0.003];
/// Nor are those below this many standard errors.
const SIGNIFICANT: f64 = 3.0;
/// A correction must lower the disagreement of its camera to the first part. The disagreements of the other cameras may rise
/// by the second part of that, in sum. Otherwise the correction fits the detector, not the camera.
const BETTER: f64 = 0.9;
const MOST_RISE: f64 = 1.0 / 3.0;
/// A limb counts like this many independent points, however often it is seen.
const POINTS_PER_LIMB: f64 = 10.0;
/// Scale of the Geman-McClure loss in standard deviations.
pub(super) const LOSS_SCALE: f64 = 3.0;
/// Gauss-Newton steps of a set of cameras, and of a point.
const STEPS: usize = 8;
const POINT_STEPS: usize = 4;
/// The median length of a two-dimensional normal vector, in standard deviations.
const MEDIAN_LENGTH: f64 = 1.1774;

/// A camera's correction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Correction {
    /// Whether the correction is significant; else all is 0.
    pub significant: bool,
    /// Angle of the rotation, its standard error, radians.
    pub rotation: [f64; 2],
    /// Distance of the shift, its standard error, metres.
    pub position: [f64; 2],
    /// Relative change of the focal length, its standard error.
    pub focal: [f64; 2],
    /// Median distance of the camera's limbs from those triangulated by the other cameras, pixels,
    /// before and after. `None` with fewer than two other cameras.
    pub disagreement_px: [Option<f64>; 2],
}

/// Corrects cameras whose limbs disagree with those of the others. Returns the cameras, corrected
/// where that is significant, and their corrections. With fewer than three cameras it is not known
/// which one is wrong, and nothing is corrected.
pub fn refine(tracks: &Tracks, cameras: &[Camera]) -> (Vec<Camera>, Vec<Correction>) {
    let mut problem = Problem::new(tracks, cameras);
    let before = problem.disagreements();
    let mut errors = vec![[0.0; 3]; cameras.len()];
    let mut free = Vec::new();
    while cameras.len() > 2 {
        let Some((camera, found)) = problem.next(&free) else { break };
        free.push(camera);
        for (&camera, error) in free.iter().zip(found) {
            errors[camera] = error;
        }
    }
    for (&camera, error) in free.iter().zip(problem.relax(&free)) {
        errors[camera] = error;
    }
    let after = problem.disagreements();
    let corrections = (0..cameras.len()).map(|i| {
        let change = problem.change(i);
        let [rotation, position, focal] = parts(&change);
        let [of_rotation, of_position, of_focal] = errors[i];
        Correction {
            significant: free.contains(&i),
            rotation: [rotation, of_rotation],
            position: [position, of_position],
            focal: [focal, of_focal],
            disagreement_px: [before[i], after[i]],
        }
    });
    let corrections = corrections.collect();
    (problem.cameras, corrections)
}

type Change = SVector<f64, UNKNOWNS>;

/// Sizes of rotation, shift and change of focal length.
fn parts(change: &Change) -> [f64; 3] {
    [change.fixed_rows::<3>(0).norm(), change.fixed_rows::<3>(3).norm(), change[6]]
}

/// A limb at one time.
struct Point {
    limb: usize,
    /// Camera, normalised point.
    views: Vec<(usize, Vector2<f64>)>,
}

struct Problem<'a> {
    original: &'a [Camera],
    cameras: Vec<Camera>,
    points: Vec<Point>,
    /// Standard deviation of each camera's points, pixels.
    sigma: Vec<f64>,
    /// Standard deviations of each camera's prior, as [`PRIOR`].
    prior: Vec<[f64; 3]>,
}

/// Normal equations of all cameras, without prior.
struct Normal {
    hessian: DMatrix<f64>,
    /// Of each limb.
    gradients: Vec<DVector<f64>>,
}

impl<'a> Problem<'a> {
    fn new(tracks: &Tracks, original: &'a [Camera]) -> Self {
        let mut points = Vec::new();
        for tracks in tracks.smoothed(original, STEP) {
            let steps = tracks.iter().map(Vec::len).max().unwrap_or(0);
            for (step, limb) in (0..steps).flat_map(|k| (0..LIMBS.len()).map(move |limb| (k, limb)))
            {
                let view = |(i, track)| Some((i, at(track, limb, step as f64)?));
                let views: Vec<_> = tracks.iter().enumerate().filter_map(view).collect();
                if views.len() > 1 {
                    points.push(Point { limb, views });
                }
            }
        }
        let sigma = vec![1.0; original.len()];
        let (cameras, prior) = (original.to_vec(), vec![PRIOR; original.len()]);
        let mut problem = Self { original, cameras, points, sigma, prior };
        (0..2).for_each(|_| problem.measure_sigma());
        problem
    }

    /// The change of a camera so far.
    fn change(&self, i: usize) -> Change {
        let (from, to) = (&self.original[i], &self.cameras[i]);
        let turn = so3::log(&(to.rotation * from.rotation.transpose()));
        let shift = from.rotation * (to.centre_in_world() - from.centre_in_world());
        let focal = to.focal.x / from.focal.x - 1.0;
        Change::from_iterator(turn.iter().chain(&shift).copied().chain([focal]))
    }

    fn apply(&mut self, i: usize, step: &Change) {
        let camera = &mut self.cameras[i];
        let shift = camera.rotation.tr_mul(&step.fixed_rows::<3>(3));
        let centre = camera.centre_in_world() + shift;
        camera.rotation = so3::exp(&step.fixed_rows::<3>(0).into()) * camera.rotation;
        camera.translation = -(camera.rotation * centre);
        camera.focal *= 1.0 + step[6];
    }

    /// The residual of a view, pixels, and its derivatives by the point in the camera's frame and by
    /// a factor of the focal length. `None` behind the camera.
    fn residual(
        &self,
        (i, observed): &(usize, Vector2<f64>),
        point: &Vector3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>, Vector2<f64>)> {
        let (camera, original) = (&self.cameras[*i], &self.original[*i]);
        let q = camera.rotation * point + camera.translation;
        let (scale, focal) = (camera.focal.x / original.focal.x, original.focal.mean());
        let (error, by_q) = residual(&q, observed, focal, scale)?;
        Some((error, by_q, q.xy() / q.z * (-focal * scale)))
    }

    /// Weight of a residual: 1 / sigma^2, less for large ones.
    fn weight(&self, camera: usize, residual: &Vector2<f64>) -> f64 {
        let variance = self.sigma[camera] * self.sigma[camera];
        let large = residual.norm_squared() / (variance * LOSS_SCALE * LOSS_SCALE);
        1.0 / (variance * (1.0 + large) * (1.0 + large))
    }

    /// The point nearest to the rays of the views, refined on the weighted residuals.
    fn triangulate(&self, views: &[(usize, Vector2<f64>)]) -> Option<Vector3<f64>> {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (i, observed) in views {
            let (camera, original) = (&self.cameras[*i], &self.original[*i]);
            let seen = observed * (original.focal.x / camera.focal.x);
            let ray = camera.rotation.tr_mul(&Vector3::new(seen.x, seen.y, 1.0)).normalize();
            let across = (Matrix3::identity() - ray * ray.transpose()) / self.sigma[*i].powi(2);
            normal += across;
            right += across * camera.centre_in_world();
        }
        let mut point = normal.cholesky()?.solve(&right);
        for _ in 0..POINT_STEPS {
            let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
            for view in views {
                let (residual, by_q, _) = self.residual(view, &point)?;
                let by_point = by_q * self.cameras[view.0].rotation;
                let weight = self.weight(view.0, &residual);
                normal += by_point.tr_mul(&by_point) * weight;
                right -= by_point.tr_mul(&residual) * weight;
            }
            point += normal.cholesky()?.solve(&right);
        }
        Some(point)
    }

    /// Measures each camera's standard deviation from its residuals.
    fn measure_sigma(&mut self) {
        let mut lengths = vec![Vec::new(); self.cameras.len()];
        for Point { views, .. } in &self.points {
            let Some(point) = self.triangulate(views) else { continue };
            for view in views {
                let residual = self.residual(view, &point);
                lengths[view.0].extend(residual.map(|(r, ..)| r.norm()));
            }
        }
        for (sigma, lengths) in self.sigma.iter_mut().zip(&mut lengths) {
            *sigma = median(lengths).map_or(1.0, sigma_of);
        }
    }

    /// For each camera, the median distance of its points from those of the other cameras, pixels.
    fn disagreements(&self) -> Vec<Option<f64>> {
        let of_camera = |camera: usize| {
            let distance = |Point { views, .. }: &Point| {
                let view = views.iter().find(|view| view.0 == camera)?;
                let others: Vec<_> = views.iter().filter(|v| v.0 != camera).copied().collect();
                let point = self.triangulate(&others).filter(|_| others.len() > 1)?;
                self.residual(view, &point).map(|(residual, ..)| residual.norm())
            };
            median(&mut self.points.iter().filter_map(distance).collect::<Vec<f64>>())
        };
        (0..self.cameras.len()).map(of_camera).collect()
    }

    fn linearise(&self) -> Normal {
        let n = UNKNOWNS * self.cameras.len();
        let (mut hessian, zeros) = (DMatrix::zeros(n, n), DVector::zeros(n));
        let mut gradients = vec![zeros; LIMBS.len()];
        for Point { limb, views } in &self.points {
            let Some(point) = self.triangulate(views) else { continue };
            let mut terms = Vec::new();
            let mut by_points = Matrix3::zeros();
            for view in views {
                let Some((residual, by_q, by_focal)) = self.residual(view, &point) else {
                    continue;
                };
                let Camera { rotation, translation, .. } = &self.cameras[view.0];
                let by_camera = by_camera(&(rotation * point + translation), &by_q, &by_focal);
                let by_point = by_q * rotation;
                let weight = self.weight(view.0, &residual);
                by_points += by_point.tr_mul(&by_point) * weight;
                terms.push((view.0 * UNKNOWNS, weight, residual, by_camera, by_point));
            }
            let Some(inverse) = by_points.try_inverse() else { continue };
            for (a, weight, residual, by_camera, by_point) in &terms {
                let gradient = by_camera.tr_mul(residual) * *weight;
                let mut own = gradients[*limb].fixed_rows_mut::<UNKNOWNS>(*a);
                own += gradient;
                let mut own = hessian.fixed_view_mut::<UNKNOWNS, UNKNOWNS>(*a, *a);
                own += by_camera.tr_mul(by_camera) * *weight;
                let cross = by_camera.tr_mul(by_point) * *weight * inverse;
                for (b, weight, _, by_camera, by_point) in &terms {
                    let mut block = hessian.fixed_view_mut::<UNKNOWNS, UNKNOWNS>(*a, *b);
                    block -= cross * (by_point.tr_mul(by_camera) * *weight);
                }
            }
        }
        let share = POINTS_PER_LIMB * LIMBS.len() as f64 / self.points.len().max(1) as f64;
        hessian *= share;
        gradients.iter_mut().for_each(|gradient| *gradient *= share);
        Normal { hessian, gradients }
    }

    /// The step of some cameras, the fall of the cost that it promises, and the covariance.
    fn step(&self, normal: &Normal, free: &[usize]) -> Option<(DVector<f64>, f64, DMatrix<f64>)> {
        let index: Vec<usize> =
            free.iter().flat_map(|&i| (0..UNKNOWNS).map(move |k| i * UNKNOWNS + k)).collect();
        let n = index.len();
        let mut hessian = DMatrix::from_fn(n, n, |i, j| normal.hessian[(index[i], index[j])]);
        let mut gradient = DVector::zeros(n);
        let mut spread = DMatrix::zeros(n, n);
        for of_limb in &normal.gradients {
            let of_limb = DVector::from_fn(n, |i, _| of_limb[index[i]]);
            spread += &of_limb * of_limb.transpose();
            gradient += of_limb;
        }
        let changes: Vec<Change> = free.iter().map(|&i| self.change(i)).collect();
        for i in 0..n {
            let k = i % UNKNOWNS;
            let information = self.prior[free[i / UNKNOWNS]][k / 3].powi(-2);
            hessian[(i, i)] += information;
            gradient[i] += information * changes[i / UNKNOWNS][k];
        }
        let factor = hessian.cholesky()?;
        let step = -factor.solve(&gradient);
        let gain = -0.5 * step.dot(&gradient);
        let half = factor.solve(&spread);
        Some((step, gain, factor.solve(&half.transpose())))
    }

    /// Gauss-Newton steps of some cameras. Returns their standard errors.
    fn adjust(&mut self, free: &[usize]) -> Option<Vec<[f64; 3]>> {
        let mut errors = None;
        for _ in 0..STEPS {
            let (step, _, covariance) = self.step(&self.linearise(), free)?;
            for (index, &i) in free.iter().enumerate() {
                self.apply(i, &step.fixed_rows::<UNKNOWNS>(index * UNKNOWNS).into());
            }
            self.measure_sigma();
            errors = Some((0..free.len()).map(|index| of_parts(&covariance, index)).collect());
        }
        errors
    }

    /// Corrects cameras again that were turned or moved farther than the prior expects. Returns their standard errors; none if
    /// there are no such cameras.
    fn relax(&mut self, free: &[usize]) -> Vec<[f64; 3]> {
        let mut errors = Vec::new();
        for _ in 0..RELAXATIONS {
            let sizes: Vec<[f64; 3]> = free.iter().map(|&i| parts(&self.change(i))).collect();
            if sizes.iter().all(|size| size[0] < PRIOR[0] && size[1] < PRIOR[1]) {
                break;
            }
            for (&i, size) in free.iter().zip(sizes) {
                let [turn, shift, focal] = PRIOR;
                self.prior[i] = [turn.max(size[0]), shift.max(size[1]), focal];
            }
            errors = self.adjust(free).unwrap_or_default();
        }
        errors
    }

    /// Sets one more camera free and corrects it, if that is significant: its index, and the standard
    /// errors of all free cameras. Otherwise nothing changes.
    fn next(&mut self, free: &[usize]) -> Option<(usize, Vec<[f64; 3]>)> {
        let (normal, before) = (self.linearise(), self.disagreements());
        let candidates = (0..self.cameras.len()).filter(|i| !free.contains(i));
        let gains =
            candidates.filter_map(|i| Some((self.step(&normal, &[free, &[i]].concat())?.1, i)));
        let camera = gains.max_by(|a, b| a.0.total_cmp(&b.0))?.1;
        let all = [free, &[camera]].concat();
        let start = (self.cameras.clone(), self.sigma.clone());
        let errors = self.adjust(&all).unwrap_or_default();
        let is_significant = errors.len() == all.len()
            && all.iter().zip(&errors).all(|(&i, errors)| {
                let sizes = parts(&self.change(i));
                (0..3).any(|k| sizes[k].abs() > (SIGNIFICANT * errors[k]).max(LEAST[k]))
            });
        let after = self.disagreements();
        let rise = |i: usize| Some((after[i]? - before[i]?).max(0.0));
        let rises: f64 = (0..after.len()).filter(|&i| i != camera).filter_map(rise).sum();
        let is_better = after[camera].zip(before[camera]).is_some_and(|(after, before)| {
            after < BETTER * before && rises < MOST_RISE * (before - after)
        });
        if is_significant && is_better {
            return Some((camera, errors));
        }
        (self.cameras, self.sigma) = start;
        None
    }
}

/// The residual, pixels, of a point `q` in the camera's frame, metres, that is seen at a normalised point,
/// and its derivatives by `q`. `focal` is the mean focal length, pixels, which has changed by the factor
/// `scale`. `None` if the depth is below 0.1 m.
pub(super) fn residual(
    q: &Vector3<f64>,
    observed: &Vector2<f64>,
    focal: f64,
    scale: f64,
) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
    if q.z < 0.1 {
        return None;
    }
    let seen = q.xy() / q.z;
    let by_q = Matrix2x3::new(1.0, 0.0, -seen.x, 0.0, 1.0, -seen.y) * (-focal * scale / q.z);
    Some(((observed - seen * scale) * focal, by_q))
}

/// The standard deviation of residuals with that median length, pixels; 0.5 at least.
pub(super) fn sigma_of(median_length: f64) -> f64 {
    (median_length / MEDIAN_LENGTH).max(0.5)
}

/// The derivative of a residual by a camera's unknowns, from those by q and by a factor of the focal
/// length.
fn by_camera(
    q: &Vector3<f64>,
    by_q: &Matrix2x3<f64>,
    by_focal: &Vector2<f64>,
) -> SMatrix<f64, 2, UNKNOWNS> {
    let mut by_camera = SMatrix::<f64, 2, UNKNOWNS>::zeros();
    by_camera.fixed_columns_mut::<3>(0).copy_from(&(by_q * -q.cross_matrix()));
    by_camera.fixed_columns_mut::<3>(3).copy_from(&-by_q);
    by_camera.set_column(6, by_focal);
    by_camera
}

/// Standard errors of rotation, shift and focal length of the camera at that place.
fn of_parts(covariance: &DMatrix<f64>, place: usize) -> [f64; 3] {
    let few = LIMBS.len() as f64 / (LIMBS.len() - 1) as f64;
    let sum = |from: usize, to: usize| {
        let variances = (from..to).map(|k| covariance.diagonal()[place * UNKNOWNS + k]);
        (few * variances.sum::<f64>().max(0.0)).sqrt()
    };
    [sum(0, 3), sum(3, 6), sum(6, 7)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::camera::Lens;

    #[test]
    fn derivatives_match_central_differences() {
        let matrix = Matrix3::new(900.0, 0.0, 400.0, 0.0, 900.0, 300.0, 0.0, 0.0, 1.0);
        let (turn, shift) = (so3::exp(&Vector3::new(0.2, -0.4, 0.1)), Vector3::new(0.3, 0.1, 4.0));
        let camera = Camera::new("a", [800, 600], &matrix, Lens::IDEAL, turn, shift).unwrap();
        let original = [camera];
        let (view, point) = ((0, Vector2::new(0.1, -0.2)), Vector3::new(0.3, 0.9, -0.5));
        let at = |change: &Change| {
            let (cameras, points, sigma) = (original.to_vec(), Vec::new(), vec![1.0]);
            let prior = vec![PRIOR];
            let mut problem = Problem { original: &original, cameras, points, sigma, prior };
            problem.apply(0, change);
            let (residual, by_q, by_focal) = problem.residual(&view, &point).unwrap();
            (residual, by_camera(&(turn * point + shift), &by_q, &by_focal))
        };
        let analytic = at(&Change::zeros()).1;
        for k in 0..UNKNOWNS {
            let mut step = Change::zeros();
            step[k] = 1e-5;
            let numeric = (at(&step).0 - at(&-step).0) / 2e-5;
            assert!((analytic.column(k) - numeric).amax() < 1e-4, "{k}: {analytic} {numeric}");
        }
    }
}
