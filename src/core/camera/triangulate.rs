//! A point from its pixels in several cameras.

use nalgebra::{Matrix3, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::Rig;

/// Up to this many views every pair is tried; with more, [`SAMPLED_PAIRS`] random ones.
const EXHAUSTIVE_VIEWS: usize = 12;
/// Pairs drawn when there are many views: with half of the views wrong, 1 - 0.75^66 of the
/// draws hold a good pair.
const SAMPLED_PAIRS: usize = 66;
/// Rays that meet at less than this angle (1 degree, radians) fix no depth.
const MIN_PARALLAX: f64 = 0.017453292519943295;
/// Gauss-Newton steps after the linear solution; it converges in two or three.
const REFINEMENTS: usize = 5;
/// The refinement ends with a step that is shorter than this, metres: the next one would be far shorter still.
const CLOSE_M: f64 = 1e-6;
/// The same in [`triangulate_near`], metres. The point only tells people apart, and is corrected in each frame set.
const NEAR_CLOSE_M: f64 = 1e-4;

/// What one camera saw: its index in the rig, the pixel, and the confidence in (0, 1].
pub type View = (usize, Vector2<f64>, f64);

/// A triangulated point and what supports it.
#[derive(Clone, Debug, PartialEq)]
pub struct Triangulated {
    /// World, metres.
    pub point: Vector3<f64>,
    /// Indices into the views given, ascending; at least two.
    pub inliers: Vec<usize>,
    /// Median distance of the inliers' pixels to the point's projection.
    pub residual_px: f64,
}

/// A view with its distortion removed.
struct Ray {
    normalised: Vector2<f64>,
    direction_in_world: Vector3<f64>,
}

/// The point that fits the views best: linear least squares on normalised coordinates, then
/// Gauss-Newton on sum confidence |pixel - projection|^2.
///
/// `None` with fewer than two usable views, when all rays are within a degree of parallel, and
/// when the point is behind one of the cameras. A camera index out of the rig is not usable.
pub fn triangulate(rig: &Rig, views: &[View]) -> Option<Vector3<f64>> {
    let rays = rays(rig, views);
    let usable: Vec<usize> = (0..views.len()).filter(|&i| rays[i].is_some()).collect();
    solve(rig, views, &rays, &usable)
}

/// What is left of some views: their point (world, metres), their indices among the views given, ascending, and
/// the distance of the worst one's pixel from the point's projection, pixels; infinite behind that camera.
pub type Left = (Vector3<f64>, Vec<usize>, f64);

/// As [`triangulate`], but drops the worst view while it is more than `threshold_px` off and more than `least`
/// views are left. `None` where [`triangulate`] finds no point.
pub fn triangulate_dropping(
    rig: &Rig,
    views: &[View],
    threshold_px: f64,
    least: usize,
) -> Option<Left> {
    let (mut left, mut indices) = (views.to_vec(), (0..views.len()).collect::<Vec<_>>());
    loop {
        let point = triangulate(rig, &left)?;
        let errors = left.iter().map(|view| error_px(rig, view, &point).unwrap_or(f64::INFINITY));
        let (worst, error) = errors.enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
        if error <= threshold_px || left.len() <= least {
            return Some((point, indices, error));
        }
        left.remove(worst);
        indices.remove(worst);
    }
}

/// As [`triangulate`], but only from views that agree to within `threshold_px`.
///
/// The point of all views, if they agree. Otherwise candidates come from pairs of views (all pairs up
/// to 12 views, else seeded draws), are scored by sum confidence min(error^2, threshold^2), and the best
/// is refined on its inliers. `None` when no two views agree. The same arguments give the same result.
pub fn triangulate_robust(
    rig: &Rig,
    views: &[View],
    threshold_px: f64,
    seed: u64,
) -> Option<Triangulated> {
    let rays = rays(rig, views);
    let usable: Vec<usize> = (0..views.len()).filter(|&i| rays[i].is_some()).collect();
    if let Some(all) = of_all(rig, views, &rays, &usable, threshold_px) {
        return Some(all);
    }
    let score = |point: &Vector3<f64>| -> f64 {
        let cost = |&i: &usize| {
            let error = error_px(rig, &views[i], point).map_or(threshold_px, |e| e);
            views[i].2 * error.min(threshold_px).powi(2)
        };
        usable.iter().map(cost).sum()
    };
    let best = pairs(&usable, seed)
        .into_iter()
        .filter_map(|pair| {
            let point = linear(rig, views, &rays, &pair)
                .filter(|p| well_posed(rig, views, &rays, &pair, p))?;
            Some((score(&point), point))
        })
        .min_by(|a, b| a.0.total_cmp(&b.0))?
        .1;
    refine_on_inliers(rig, views, &rays, &usable, best, threshold_px)
}

/// As [`triangulate_robust`], for a point that is expected near `start` (world, metres). Gauss-Newton
/// starts there. If all views agree with its result, no linear solution is needed.
pub fn triangulate_near(
    rig: &Rig,
    views: &[View],
    threshold_px: f64,
    seed: u64,
    start: Vector3<f64>,
) -> Option<Triangulated> {
    let all: Vec<usize> = (0..views.len()).collect();
    let is_usable =
        |(camera, _, confidence): &View| *camera < rig.cameras.len() && *confidence > 0.0;
    if views.len() >= 2 && views.iter().all(is_usable) {
        let point = gauss_newton(rig, views, &all, start, NEAR_CLOSE_M);
        let ray =
            |i: usize| (point - rig.cameras[views[i].0].centre_in_world()).try_normalize(1e-6);
        let first = ray(0);
        let parallax = |i: usize| first.zip(ray(i)).map_or(0.0, |(a, b)| a.cross(&b).norm());
        // Without a step, the expected point would count as a measured one.
        if point != start
            && (1..views.len()).any(|i| parallax(i) > libm::sin(MIN_PARALLAX))
            && let Some(found) = agreed(rig, views, &all, point, threshold_px)
        {
            return Some(found);
        }
    }
    triangulate_robust(rig, views, threshold_px, seed)
}

/// The point of all usable views, if each agrees with it to within the threshold.
fn of_all(
    rig: &Rig,
    views: &[View],
    rays: &[Option<Ray>],
    usable: &[usize],
    threshold_px: f64,
) -> Option<Triangulated> {
    agreed(rig, views, usable, solve(rig, views, rays, usable)?, threshold_px)
}

/// The point with its views, if each agrees with it to within the threshold.
fn agreed(
    rig: &Rig,
    views: &[View],
    usable: &[usize],
    point: Vector3<f64>,
    threshold_px: f64,
) -> Option<Triangulated> {
    let error = |&i: &usize| error_px(rig, &views[i], &point).filter(|e| *e <= threshold_px);
    let mut errors: Vec<f64> = usable.iter().map(error).collect::<Option<_>>()?;
    Some(Triangulated { point, inliers: usable.to_vec(), residual_px: median(&mut errors) })
}

/// The median, of an even number the mean of the two in the middle.
fn median(errors: &mut [f64]) -> f64 {
    errors.sort_by(f64::total_cmp);
    let middle = errors.len() / 2;
    match errors.len() % 2 {
        0 => 0.5 * (errors[middle - 1] + errors[middle]),
        _ => errors[middle],
    }
}

fn refine_on_inliers(
    rig: &Rig,
    views: &[View],
    rays: &[Option<Ray>],
    usable: &[usize],
    mut point: Vector3<f64>,
    threshold_px: f64,
) -> Option<Triangulated> {
    let agreeing = |point: &Vector3<f64>| -> Vec<usize> {
        let agrees =
            |i: &usize| error_px(rig, &views[*i], point).is_some_and(|e| e <= threshold_px);
        usable.iter().copied().filter(agrees).collect()
    };
    let mut inliers = agreeing(&point);
    for _ in 0..3 {
        point = solve(rig, views, rays, &inliers)?;
        let now = agreeing(&point);
        if now == inliers {
            break;
        }
        inliers = now;
    }
    if inliers.len() < 2 {
        return None;
    }
    let mut errors: Vec<f64> =
        inliers.iter().filter_map(|&i| error_px(rig, &views[i], &point)).collect();
    Some(Triangulated { point, inliers, residual_px: median(&mut errors) })
}

fn rays(rig: &Rig, views: &[View]) -> Vec<Option<Ray>> {
    let ray = |(camera, pixel, confidence): &View| {
        let camera = rig.cameras.get(*camera).filter(|_| *confidence > 0.0)?;
        let normalised = camera.undistort(pixel)?;
        let direction = camera.rotation.tr_mul(&Vector3::new(normalised.x, normalised.y, 1.0));
        Some(Ray { normalised, direction_in_world: direction.normalize() })
    };
    views.iter().map(ray).collect()
}

fn pairs(usable: &[usize], seed: u64) -> Vec<[usize; 2]> {
    let n = usable.len();
    if n <= EXHAUSTIVE_VIEWS {
        return (0..n).flat_map(|i| (0..i).map(move |j| [usable[j], usable[i]])).collect();
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut draw = || {
        let first = rng.random_range(0..n);
        let second = (first + rng.random_range(1..n)) % n;
        [usable[first], usable[second]]
    };
    (0..SAMPLED_PAIRS).map(|_| draw()).collect()
}

/// Linear, checked, refined on the chosen views.
fn solve(
    rig: &Rig,
    views: &[View],
    rays: &[Option<Ray>],
    chosen: &[usize],
) -> Option<Vector3<f64>> {
    let start =
        linear(rig, views, rays, chosen).filter(|p| well_posed(rig, views, rays, chosen, p))?;
    let point = gauss_newton(rig, views, chosen, start, CLOSE_M);
    well_posed(rig, views, rays, chosen, &point).then_some(point)
}

/// Direct linear transform, inhomogeneous: each view gives two rows
/// (x r3 - r1) . X = t1 - x t3 and (y r3 - r2) . X = t2 - y t3, weighted by the confidence.
/// Normal equations, 3x3. `None` if they are singular.
fn linear(
    rig: &Rig,
    views: &[View],
    rays: &[Option<Ray>],
    chosen: &[usize],
) -> Option<Vector3<f64>> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for &i in chosen {
        let (camera, _, confidence) = views[i];
        let (camera, ray) = (&rig.cameras[camera], rays[i].as_ref()?);
        for axis in 0..2 {
            let row = camera.rotation.row(2) * ray.normalised[axis] - camera.rotation.row(axis);
            let value = camera.translation[axis] - ray.normalised[axis] * camera.translation.z;
            let row = row.transpose();
            normal += row * row.transpose() * confidence;
            right += row * (value * confidence);
        }
    }
    Some(normal.cholesky()?.solve(&right)).filter(|p| p.iter().all(|v| v.is_finite()))
}

/// At least two views, the point in front of each, and two rays that meet at an angle.
fn well_posed(
    rig: &Rig,
    views: &[View],
    rays: &[Option<Ray>],
    chosen: &[usize],
    point: &Vector3<f64>,
) -> bool {
    let in_front = |&i: &usize| rig.cameras[views[i].0].depth(point) > 0.0;
    let parallax = |&i: &usize, &j: &usize| match (&rays[i], &rays[j]) {
        (Some(a), Some(b)) => a.direction_in_world.cross(&b.direction_in_world).norm(),
        _ => 0.0,
    };
    chosen.iter().all(in_front)
        && chosen
            .iter()
            .enumerate()
            .any(|(at, i)| chosen[..at].iter().any(|j| parallax(i, j) > libm::sin(MIN_PARALLAX)))
}

/// Steps on sum confidence |pixel - projection|^2, kept only while they bring it down, until one is
/// shorter than `close`, metres.
fn gauss_newton(
    rig: &Rig,
    views: &[View],
    chosen: &[usize],
    start: Vector3<f64>,
    close: f64,
) -> Vector3<f64> {
    let mut point = start;
    let mut best = f64::INFINITY;
    let mut candidate = start;
    for _ in 0..=REFINEMENTS {
        let Some((cost, step)) = normal_step(rig, views, chosen, &candidate) else { break };
        if cost >= best {
            break;
        }
        (point, best) = (candidate, cost);
        candidate += step;
        if step.norm() < close {
            return candidate;
        }
    }
    point
}

/// The cost at a point and the Gauss-Newton step from it; `None` where a view does not see it.
fn normal_step(
    rig: &Rig,
    views: &[View],
    chosen: &[usize],
    point: &Vector3<f64>,
) -> Option<(f64, Vector3<f64>)> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    let mut cost = 0.0;
    for &i in chosen {
        let (camera, pixel, confidence) = &views[i];
        let (projected, jacobian) = rig.cameras[*camera].project_with_jacobian(point)?;
        let residual = pixel - projected;
        cost += confidence * residual.norm_squared();
        normal += jacobian.tr_mul(&jacobian) * *confidence;
        right += jacobian.tr_mul(&residual) * *confidence;
    }
    Some((cost, normal.cholesky()?.solve(&right)))
}

fn error_px(rig: &Rig, (camera, pixel, _): &View, point: &Vector3<f64>) -> Option<f64> {
    rig.cameras.get(*camera)?.project(point).map(|projected| (projected - pixel).norm())
}
