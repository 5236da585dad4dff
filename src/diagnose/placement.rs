//! Faults of a camera with numbers: turned, moved, another focal length or size of the image. The
//! numbers are a robust fit to the points of the others.

use nalgebra::{DMatrix, DVector, Matrix2, Vector2, Vector3};

use super::consensus::Match;
use super::hypotheses::{Finding, Hypothesis};
use super::reading::Reading;
use crate::core::points::median;
use crate::core::so3;

const STEPS: usize = 15;
/// Change of a parameter for the derivative by differences.
const CHANGE: f64 = 1e-6;

/// A free parameter of a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Free {
    /// About an axis of the camera, radians.
    Turn(usize),
    /// Along an axis of the camera, metres.
    Move(usize),
    /// Logarithm of a factor.
    Focal,
    /// Along an axis of the image, image widths.
    Centre(usize),
    /// Logarithm of a factor on the pixels.
    Scale,
    ScaleX,
    ScaleY,
    /// Logarithm of a factor on the translation.
    Unit,
}

use Free::{Centre, Focal, Move, Scale, ScaleX, ScaleY, Turn, Unit};

const TURN: [Free; 3] = [Turn(0), Turn(1), Turn(2)];
const MOVE: [Free; 3] = [Move(0), Move(1), Move(2)];
const PLACE: [Free; 6] = [Turn(0), Turn(1), Turn(2), Move(0), Move(1), Move(2)];
const PLACE_AND_FOCAL: [Free; 7] = [Turn(0), Turn(1), Turn(2), Move(0), Move(1), Move(2), Focal];

/// Parameters that are fitted together, their weight as in [`Hypothesis`], and factors to start from.
type Model = (&'static [Free], f64, &'static [f64]);
const MODELS: [Model; 10] = [
    (&[Scale], 1.1, &[0.3, 0.5, 0.75, 1.33, 2.0, 3.0]),
    (&[Focal], 1.1, &[0.5, 0.8, 1.25, 2.0]),
    (&[Unit], 1.1, &[0.5, 2.0]),
    (&[ScaleX, ScaleY], 1.35, &[0.5, 1.0, 2.0]),
    (&[ScaleX], 1.1, &[0.6, 1.7]),
    (&[ScaleY], 1.1, &[0.6, 1.7]),
    (&[Centre(0), Centre(1)], 1.45, &[1.0]),
    (&TURN, 1.2, &[1.0]),
    (&MOVE, 1.3, &[1.0]),
    (&PLACE, 1.5, &[1.0]),
];
/// If the fit turns and moves a camera by more than this (degrees, centimetres), its images are probably those of another
/// camera.
const CARRIED: (f64, f64) = (45.0, 100.0);
const LAST: Model = (&PLACE_AND_FOCAL, 1.6, &[1.0]);

/// A reading with other parameters. `pixel` maps its pixels.
fn apply(reading: &Reading, free: &[Free], values: &[f64]) -> (Reading, Vector2<f64>) {
    let mut reading = reading.clone();
    let (mut turn, mut moved, mut pixel) =
        (Vector3::zeros(), Vector3::zeros(), Vector2::repeat(1.0));
    for (free, value) in free.iter().zip(values) {
        let camera = &mut reading.camera;
        match *free {
            Turn(axis) => turn[axis] = *value,
            Move(axis) => moved[axis] = *value,
            Focal => camera.focal *= libm::exp(*value),
            Centre(axis) => camera.centre[axis] += value * f64::from(camera.width),
            Scale => pixel *= libm::exp(*value),
            ScaleX => pixel.x *= libm::exp(*value),
            ScaleY => pixel.y *= libm::exp(*value),
            Unit => camera.translation *= libm::exp(*value),
        }
    }
    let turn = so3::exp(&turn);
    let camera = &mut reading.camera;
    camera.rotation = turn * camera.rotation;
    camera.translation = turn * camera.translation + moved;
    let scale = Matrix2::from_diagonal(&pixel);
    (reading.turn, reading.shift) = (scale * reading.turn, scale * reading.shift);
    (reading, pixel)
}

/// The fits of all models to the points that a camera should see.
pub(super) fn placements(reading: &Reading, matches: &[Match]) -> Vec<Hypothesis> {
    let mut all = Vec::new();
    for (free, weight, starts) in MODELS.into_iter().chain([LAST]) {
        for start in starts {
            let start = vec![libm::log(*start); free.len()];
            let Some(values) = fit(reading, free, start, matches) else { continue };
            let fitted = apply(reading, free, &values).0;
            let (finding, favour) = describe(reading, &fitted, free, &values);
            all.push(Hypothesis { finding, reading: fitted, weight: weight * favour });
        }
    }
    all
}

/// Robust Gauss-Newton steps; Cauchy weights at the median error.
fn fit(
    reading: &Reading,
    free: &[Free],
    mut values: Vec<f64>,
    matches: &[Match],
) -> Option<Vec<f64>> {
    let n = free.len();
    let residuals = |values: &[f64]| -> Vec<Option<Vector2<f64>>> {
        let (reading, scale) = apply(reading, free, values);
        let one = |(point, pixel): &Match| {
            Some(reading.camera.project(point)? - pixel.component_mul(&scale))
        };
        matches.iter().map(one).collect()
    };
    for _ in 0..STEPS {
        let now = residuals(&values);
        let mut sizes: Vec<f64> = now.iter().flatten().map(|r| r.norm()).collect();
        if 2 * sizes.len() < matches.len() {
            return None;
        }
        let size = median(&mut sizes)?.max(0.5);
        let changed: Vec<_> = (0..n)
            .map(|k| {
                let mut values = values.clone();
                values[k] += CHANGE;
                residuals(&values)
            })
            .collect();
        let (mut normal, mut right) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
        for (i, residual) in now.iter().enumerate() {
            let Some(residual) = residual else { continue };
            let columns: Option<Vec<Vector2<f64>>> =
                changed.iter().map(|all| Some((all[i]? - residual) / CHANGE)).collect();
            let Some(columns) = columns else { continue };
            let weight = 1.0 / (1.0 + residual.norm_squared() / (size * size));
            for a in 0..n {
                right[a] -= weight * columns[a].dot(residual);
                for b in 0..n {
                    normal[(a, b)] += weight * columns[a].dot(&columns[b]);
                }
            }
        }
        for a in 0..n {
            normal[(a, a)] += 1e-6 * normal[(a, a)] + 1e-9;
        }
        let step = normal.cholesky()?.solve(&right);
        let longest = step.amax();
        let shorten = (0.5 / longest.max(0.5)).min(1.0);
        values.iter_mut().zip(step.iter()).for_each(|(value, step)| *value += shorten * step);
        if longest < 1e-7 {
            break;
        }
    }
    values.iter().all(|value| value.is_finite()).then_some(values)
}

/// The fault in words, and how well it is believed beside the others: below 1 if the calibration
/// itself speaks for it.
fn describe(before: &Reading, after: &Reading, free: &[Free], values: &[f64]) -> (Finding, f64) {
    let (old, new) = (&before.camera, &after.camera);
    let factor = |value: f64| libm::exp(value);
    let again = "calibrate it again (`calibrate` corrects small errors)";
    match free {
        [Scale] => {
            let [w, h] = [old.width, old.height].map(|size| f64::from(size) / factor(values[0]));
            let what = format!("its keypoints are of an image of {w:.0} x {h:.0}");
            let size = format!("{} x {}", old.width, old.height);
            let fix =
                format!("multiply them by {:.3}; the calibration is for {size}", factor(values[0]));
            (Finding::new("image_scaled", what, fix), 1.0)
        }
        [ScaleX, ..] | [ScaleY] => {
            let [x, y] = match free {
                [ScaleX] => [factor(values[0]), 1.0],
                [ScaleY] => [1.0, factor(values[0])],
                _ => [factor(values[0]), factor(values[1])],
            };
            let [w, h] = [f64::from(old.width) / x, f64::from(old.height) / y];
            let what = format!("its keypoints are of an image stretched to {w:.0} x {h:.0}");
            let fix = format!("multiply x by {x:.3} and y by {y:.3}");
            (Finding::new("image_stretched", what, fix), 1.0)
        }
        [Focal] => {
            let times = 1.0 / factor(values[0]);
            let what = format!("its focal length is {times:.2} times the right one");
            let fix = format!("divide it by {times:.3}, or calibrate it again (zoomed?)");
            (Finding::new("focal_length", what, fix), 1.0)
        }
        [Unit] => {
            let times = 1.0 / factor(values[0]);
            let what = format!("its translation is {times:.2} times that in the others' unit");
            (Finding::new("translation_unit", what, format!("divide it by {times:.4}")), 1.0)
        }
        [Centre(_), ..] => {
            let off = (new.centre - old.centre).norm();
            let what = format!("its principal point is {off:.0} px off");
            let fix = format!("({:.0}, {:.0}) fits", new.centre.x, new.centre.y);
            // A turn looks alike; a principal point far from the middle of the image decides.
            let middle = Vector2::new(f64::from(old.width), f64::from(old.height)) / 2.0;
            let nearer = (new.centre - middle).norm() < 0.5 * (old.centre - middle).norm();
            let favour = if nearer && off > 0.04 * f64::from(old.width) { 0.75 } else { 1.0 };
            (Finding::new("principal_point", what, fix), favour)
        }
        _ => {
            let degrees = so3::angle_between(&old.rotation, &new.rotation).to_degrees();
            let cm = 100.0 * (old.centre_in_world() - new.centre_in_world()).norm();
            let mut parts = Vec::new();
            if free.contains(&Turn(0)) {
                parts.push(format!("turned by {degrees:.1} degrees"));
            }
            if free.contains(&Move(0)) {
                parts.push(format!("moved by {cm:.0} cm"));
            }
            if free.contains(&Focal) {
                parts.push(format!("zoomed by {:+.0} %", 100.0 * (factor(values[6]) - 1.0)));
            }
            let cause = match free.len() {
                3 if free.contains(&Turn(0)) => "turned",
                3 => "moved",
                _ => "turned_and_moved",
            };
            let what = format!("it was {} since its calibration", parts.join(" and "));
            let is_far = degrees > CARRIED.0 && cm > CARRIED.1;
            (Finding::new(cause, what, again), if is_far { 2.0 } else { 1.0 })
        }
    }
}

/// Usual factors on the size of the image and on the focal length, without a fit.
pub(super) fn factors(reading: &Reading) -> Vec<Hypothesis> {
    let sizes = [0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.75, 4.0 / 3.0, 1.5, 2.0, 3.0, 4.0];
    let sizes = sizes.map(|factor| (&[Scale][..], factor));
    let all = sizes.into_iter().chain([0.5, 2.0].map(|factor| (&[Focal][..], factor)));
    let hypothesis = |(free, factor): (&[Free], f64)| {
        let values = [libm::log(factor)];
        let fitted = apply(reading, free, &values).0;
        let finding = describe(reading, &fitted, free, &values).0;
        Hypothesis { finding, reading: fitted, weight: 1.0 }
    };
    all.map(hypothesis).collect()
}
