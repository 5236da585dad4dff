//! Estimates the new pose of a moved camera from the performer, whom the other cameras track.
//!
//! First guess: in each frame, a rotation aligns the body's limbs with each detected person. For the performer
//! it is about the rotation of the move; for anybody else it changes from frame to frame. The rotation on which
//! most frames agree starts a fit of the camera's pose to the limbs. The solved body has less noise than
//! triangulated points: the error is half. Detector, body and lens bias each fitted camera by about a degree.
//! So the pose before the move is fitted too; the difference of both fits is the move.

use std::sync::Arc;

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::refine::{self, Correction, LOSS_SCALE, sigma_of};
use super::tracks::{LIMBS, Limbs, performer, pixel};
use crate::core::camera::Camera;
use crate::core::detections::{Detections, Keypoint, Person};
use crate::core::points::median;
use crate::core::so3;
use crate::core::time::Timestamp;

/// Frames of the moved camera that are compared for the first guess.
const GUESSES: usize = 100;
/// Limbs of a person that a guess needs.
const LEAST_LIMBS: usize = 8;
/// A person may be the performer if the RMS distance to the rotated limbs is below this part of the extent.
const ALIKE: f64 = 0.15;
/// Rotations that differ less than this agree, radians.
const AGREE: f64 = 0.035;
/// Frames of a camera that are used.
const FRAMES: usize = 1000;
const STEPS: usize = 20;
/// The time is split into this many parts; the camera must see the performer in at least [`LEAST_PARTS`].
const PARTS: usize = 8;
const LEAST_PARTS: usize = 6;
/// Largest standard errors of the rotation and the position: 0.2 degrees, 1.5 cm.
const MOST_ERROR: [f64; 2] = [0.003_490_658_503_988_659, 0.015];
/// The median residual may be this many times that before: with less effort the body is less exact.
const AS_GOOD: f64 = 3.0;

/// What was seen in some time.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Frames of all cameras, in order of capture time.
    pub frames: Vec<Arc<Detections>>,
    /// The performer's limbs, in order of capture time.
    pub limbs: Vec<(Timestamp, Limbs)>,
}

impl Seen {
    /// Adds what was seen later.
    pub fn append(&mut self, later: &Self) {
        self.frames.extend_from_slice(&later.frames);
        self.limbs.extend_from_slice(&later.limbs);
    }

    /// The first and the last time of which the limbs are known.
    pub fn span(&self) -> Option<[Timestamp; 2]> {
        Some([self.limbs.first()?.0, self.limbs.last()?.0])
    }

    /// The limbs at a time between two.
    fn limbs(&self, at: Timestamp) -> Option<Limbs> {
        let after = self.limbs.partition_point(|(time, _)| *time < at);
        let (to, end) = self.limbs.get(after)?;
        if *to == at {
            return Some(*end);
        }
        let (from, begin) = self.limbs.get(after.checked_sub(1)?)?;
        let share = at.fraction(*from, *to);
        Some(std::array::from_fn(|k| begin[k].lerp(&end[k], share)))
    }
}

/// Estimates the new pose of the camera `moved` from what was seen before and after the move; `original` is
/// its calibration. Returns the camera and the correction. `None` if the performer was seen too little, no
/// rotation has a majority, the standard errors are too large, or the median residual is 3 times that before.
pub fn mend(
    [before, after]: [&Seen; 2],
    original: &Camera,
    moved: usize,
) -> Option<(Camera, Correction)> {
    let as_seen = views(before, original, moved);
    let (usual, of_usual) = fit(original.clone(), &as_seen)?;
    let mut guess = original.clone();
    guess.rotation = guess_turn(after, original, moved)? * original.rotation;
    guess.translation = -(guess.rotation * original.centre_in_world());
    let views = views(after, &guess, moved);
    let (now, of_now) = fit(guess, &views)?;

    // The camera's own pattern turns and shifts it by as much as before.
    let mut camera = original.clone();
    let turn = original.rotation * usual.rotation.transpose();
    camera.rotation = turn * now.rotation;
    camera.translation = turn * (now.translation - usual.translation) + original.translation;

    let error = |k: usize| libm::hypot(of_usual[k], of_now[k]);
    let by = Correction {
        significant: true,
        rotation: [so3::angle_between(&camera.rotation, &original.rotation), error(0)],
        position: [(camera.centre_in_world() - original.centre_in_world()).norm(), error(1)],
        focal: [0.0; 2],
        disagreement_px: [distance(original, &views), distance(&now, &views)],
    };
    let is_known = error(0) < MOST_ERROR[0] && error(1) < MOST_ERROR[1];
    let is_good = by.disagreement_px[1]? < AS_GOOD * distance(&usual, &as_seen)?;
    (is_known && is_good).then_some((camera, by))
}

/// A limb of the body and where a camera sees it.
struct View {
    /// Part of the time.
    part: usize,
    /// In the world, metres.
    at: Vector3<f64>,
    /// Normalised, distortion removed.
    seen: Vector2<f64>,
}

/// What a camera, by index, sees of the performer.
fn views(seen: &Seen, camera: &Camera, index: usize) -> Vec<View> {
    let frames = frames(seen, index, FRAMES);
    let of_frame = |(number, frame): (usize, &Arc<Detections>)| {
        let limbs = seen.limbs(frame.capture)?;
        let person = performer(frame, camera, &limbs)?;
        let view = |(limb, at): (&Keypoint, &Vector3<f64>)| {
            let seen = camera.undistort(&pixel(person, frame, *limb)?)?;
            Some(View { part: number * PARTS / frames.len(), at: *at, seen })
        };
        Some(LIMBS.iter().zip(&limbs).filter_map(view).collect::<Vec<_>>())
    };
    frames.iter().copied().enumerate().filter_map(of_frame).flatten().collect()
}

/// At most that many frames of a camera, spread over the time.
fn frames(seen: &Seen, camera: usize, most: usize) -> Vec<&Arc<Detections>> {
    let frames: Vec<_> = seen.frames.iter().filter(|frame| frame.camera == camera).collect();
    let every = frames.len().div_ceil(most).max(1);
    frames.into_iter().step_by(every).collect()
}

/// The reprojection error, pixels, and its Jacobian with respect to rotation and translation of the camera, in
/// the camera frame. `None` if the depth is below 0.1 m.
fn residual(camera: &Camera, view: &View) -> Option<(Vector2<f64>, SMatrix<f64, 2, 6>)> {
    let q = camera.rotation * view.at + camera.translation;
    let (error, by_q) = refine::residual(&q, &view.seen, camera.focal.mean(), 1.0)?;
    let mut by = SMatrix::<f64, 2, 6>::zeros();
    by.fixed_columns_mut::<3>(0).copy_from(&(by_q * -q.cross_matrix()));
    by.fixed_columns_mut::<3>(3).copy_from(&by_q);
    Some((error, by))
}

/// The median distance of a camera's points from the body, pixels.
fn distance(camera: &Camera, views: &[View]) -> Option<f64> {
    let lengths = views.iter().filter_map(|view| Some(residual(camera, view)?.0.norm()));
    median(&mut lengths.collect::<Vec<f64>>())
}

/// Robust Gauss-Newton on a camera's pose. Returns cluster-robust standard errors of rotation (radians) and
/// position (metres); a cluster is a part of the time.
fn fit(mut camera: Camera, views: &[View]) -> Option<(Camera, [f64; 2])> {
    let mut errors = [f64::INFINITY; 2];
    for _ in 0..STEPS {
        let scale = LOSS_SCALE * sigma_of(distance(&camera, views)?);
        let mut hessians = [SMatrix::<f64, 6, 6>::zeros(); PARTS];
        let mut gradients = [SVector::<f64, 6>::zeros(); PARTS];
        for view in views {
            let Some((residual, by)) = residual(&camera, view) else { continue };
            let large = residual.norm_squared() / (scale * scale);
            let weight = 1.0 / ((1.0 + large) * (1.0 + large));
            hessians[view.part] += by.tr_mul(&by) * weight;
            gradients[view.part] += by.tr_mul(&residual) * weight;
        }
        let inverse = hessians.iter().sum::<SMatrix<f64, 6, 6>>().cholesky()?.inverse();
        let step = -(inverse * gradients.iter().sum::<SVector<f64, 6>>());
        let spread: SMatrix<f64, 6, 6> = gradients.iter().map(|of| of * of.transpose()).sum();
        let parts = hessians.iter().filter(|hessian| hessian[(0, 0)] > 0.0).count();
        if parts < LEAST_PARTS {
            return None;
        }
        let few = parts as f64 / (parts - 1) as f64;
        let covariance = inverse * spread * inverse * few;
        let error = |from| covariance.diagonal().fixed_rows::<3>(from).sum().max(0.0).sqrt();
        errors = [error(0), error(3)];
        let turn = so3::exp(&step.fixed_rows::<3>(0).into());
        camera.rotation = turn * camera.rotation;
        camera.translation = turn * camera.translation + step.fixed_rows::<3>(3);
    }
    Some((camera, errors))
}

/// The rotation on which most frames of the moved camera agree.
fn guess_turn(seen: &Seen, camera: &Camera, moved: usize) -> Option<Matrix3<f64>> {
    // Of each frame, one for each person who is alike.
    let turns = frames(seen, moved, GUESSES).into_iter().filter_map(|frame| {
        let limbs = seen.limbs(frame.capture)?;
        let limbs = limbs.map(|at| (camera.rotation * at + camera.translation).normalize());
        let turns = frame.people.iter().filter_map(|person| turn(frame, person, camera, &limbs));
        Some(turns.collect()).filter(|turns: &Vec<_>| !turns.is_empty())
    });
    let turns: Vec<Vec<Matrix3<f64>>> = turns.collect();
    let agreeing = |turn: &Matrix3<f64>| {
        let agrees = |other: &Matrix3<f64>| so3::angle_between(turn, other) < AGREE;
        turns.iter().filter(|frame| frame.iter().any(agrees)).count()
    };
    let most = turns.iter().flatten().max_by_key(|turn| agreeing(turn))?;
    (2 * agreeing(most) > turns.len()).then_some(*most)
}

/// The rotation that turns the directions of the performer's limbs to those of a person, if they are
/// alike.
pub(super) fn turn(
    frame: &Detections,
    person: &Person,
    camera: &Camera,
    limbs: &Limbs,
) -> Option<Matrix3<f64>> {
    let pairs = LIMBS.iter().zip(limbs).filter_map(|(&limb, expected)| {
        let at = camera.undistort(&pixel(person, frame, limb)?)?;
        Some((*expected, Vector3::new(at.x, at.y, 1.0).normalize()))
    });
    let pairs: Vec<_> = pairs.collect();
    if pairs.len() < LEAST_LIMBS {
        return None;
    }
    let mut turn = Matrix3::identity();
    for _ in 0..STEPS {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (expected, seen) in &pairs {
            let at = turn * expected;
            normal += Matrix3::identity() - at * at.transpose();
            right += at.cross(seen);
        }
        turn = so3::exp(&normal.cholesky()?.solve(&right)) * turn;
    }
    let extent =
        |(a, _): &(Vector3<f64>, _)| pairs.iter().map(|(b, _)| (a - b).norm()).fold(0.0, f64::max);
    let extent = pairs.iter().map(extent).fold(0.0, f64::max);
    let squares: f64 = pairs.iter().map(|(a, b)| (turn * a - b).norm_squared()).sum();
    (squares < (ALIKE * extent).powi(2) * pairs.len() as f64).then_some(turn)
}
