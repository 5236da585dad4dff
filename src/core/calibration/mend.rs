//! The pose of a camera that was moved, from the performer whom the other cameras track.
//!
//! In each frame of the camera, the rotation that turns the body's limbs to those of a person is that of
//! the move, about; a person who is somebody else gives another one each time. From the rotation on which
//! most frames agree, the pose of the camera is fitted to the limbs. The body as the other cameras solve it
//! is less noisy than points that they triangulate: it gives half the error.

use std::sync::Arc;

use nalgebra::{Matrix2x3, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::refine::{Correction, LOSS_SCALE, MEDIAN_LENGTH};
use super::tracks::{LIMBS, performer, pixel};
use crate::core::body::{Attachment, Pose, Skeleton};
use crate::core::camera::{Camera, Rig};
use crate::core::detections::{Detections, Keypoint, Person};
use crate::core::points::median;
use crate::core::so3;
use crate::core::time::Timestamp;

/// Frames of the moved camera that are compared for the first guess.
const GUESSES: usize = 100;
/// Limbs of a person that a guess needs.
const LEAST_LIMBS: usize = 8;
/// A person may be the performer if the limbs are this near to the turned ones, as a part of the body's
/// extent.
const ALIKE: f64 = 0.15;
/// Rotations that differ less than this agree, radians.
const AGREE: f64 = 0.035;
/// Frames of a camera that are used.
const FRAMES: usize = 1000;
const STEPS: usize = 20;
/// Largest standard errors of the rotation and the position: 0.1 degrees, 1 cm.
const MOST_ERROR: [f64; 2] = [0.0017453292519943296, 0.01];
/// The camera's points may be this many times as far from the body as those of the others.
const AS_GOOD: f64 = 1.5;

/// What was seen since a camera was moved.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Frames of all cameras, in order of capture time.
    pub frames: Vec<Arc<Detections>>,
    /// The performer's poses, in order of capture time.
    pub poses: Vec<(Timestamp, Pose)>,
    /// The performer's body.
    pub body: Arc<Skeleton>,
}

impl Seen {
    /// The times of the first and of the last pose.
    pub fn span(&self) -> Option<[Timestamp; 2]> {
        Some([self.poses.first()?.0, self.poses.last()?.0])
    }

    /// The pose at a time between two poses.
    fn pose(&self, at: Timestamp) -> Option<Pose> {
        let after = self.poses.partition_point(|(time, _)| *time < at);
        let (to, end) = self.poses.get(after)?;
        if *to == at {
            return Some(end.clone());
        }
        let (from, begin) = self.poses.get(after.checked_sub(1)?)?;
        Some(begin.interpolate(end, at.fraction(*from, *to)))
    }
}

/// The camera `moved` of `rig` where it is now, and the way there. `None` if that is not known well
/// enough: the performer was seen too little, or the camera's points do not fit the body as well as those
/// of the others do.
pub fn mend(seen: &Seen, rig: &Rig, moved: usize) -> Option<(Camera, Correction)> {
    let original = rig.cameras.get(moved)?;
    let mut guess = original.clone();
    guess.rotation = guess_turn(seen, original, moved)? * original.rotation;
    guess.translation = -(guess.rotation * original.centre_in_world());
    let views = views(seen, &guess, moved);
    let (camera, [of_rotation, of_position]) = fit(guess, &views)?;

    let others = rig.cameras.iter().enumerate().filter(|(index, _)| *index != moved);
    let of_other = |(index, camera)| distance(camera, &self::views(seen, camera, index));
    let mut others: Vec<f64> = others.filter_map(of_other).collect();
    let [before, after] = [original, &camera].map(|camera| distance(camera, &views));
    let is_known = of_rotation < MOST_ERROR[0] && of_position < MOST_ERROR[1];
    let by = Correction {
        significant: true,
        rotation: [so3::angle_between(&camera.rotation, &original.rotation), of_rotation],
        position: [(camera.centre_in_world() - original.centre_in_world()).norm(), of_position],
        focal: [0.0; 2],
        disagreement_px: [before, after],
    };
    (is_known && after? < AS_GOOD * median(&mut others)?).then_some((camera, by))
}

/// A limb of the body and where a camera sees it.
struct View {
    limb: usize,
    /// In the world, metres.
    at: Vector3<f64>,
    /// Normalised, distortion removed.
    seen: Vector2<f64>,
}

/// What a camera, by index, sees of the performer.
fn views(seen: &Seen, camera: &Camera, index: usize) -> Vec<View> {
    let of_frame = |frame: &Arc<Detections>| {
        let pose = seen.pose(frame.capture)?;
        let person = performer(frame, camera, &pose, &seen.body)?;
        let posture = pose.posture(&seen.body);
        let view = |(limb, point): (usize, &Keypoint)| {
            let at = Attachment::of(*point).position(&posture, &seen.body);
            Some(View { limb, at, seen: camera.undistort(&pixel(person, frame, *point)?)? })
        };
        Some(LIMBS.iter().enumerate().filter_map(view).collect::<Vec<_>>())
    };
    frames(seen, index, FRAMES).into_iter().filter_map(of_frame).flatten().collect()
}

/// At most that many frames of a camera, spread over the time.
fn frames(seen: &Seen, camera: usize, most: usize) -> Vec<&Arc<Detections>> {
    let frames: Vec<_> = seen.frames.iter().filter(|frame| frame.camera == camera).collect();
    let every = frames.len().div_ceil(most).max(1);
    frames.into_iter().step_by(every).collect()
}

/// The residual of a view, pixels, and its derivatives by a rotation of the camera and by a shift of the
/// world, both in the camera's frame. `None` behind the camera.
fn residual(camera: &Camera, view: &View) -> Option<(Vector2<f64>, SMatrix<f64, 2, 6>)> {
    let q = camera.rotation * view.at + camera.translation;
    if q.z < 0.1 {
        return None;
    }
    let (seen, focal) = (q.xy() / q.z, camera.focal.mean());
    let by_q = Matrix2x3::new(1.0, 0.0, -seen.x, 0.0, 1.0, -seen.y) * (-focal / q.z);
    let mut by = SMatrix::<f64, 2, 6>::zeros();
    by.fixed_columns_mut::<3>(0).copy_from(&(by_q * -so3::hat(&q)));
    by.fixed_columns_mut::<3>(3).copy_from(&by_q);
    Some(((view.seen - seen) * focal, by))
}

/// The median distance of a camera's points from the body, pixels.
fn distance(camera: &Camera, views: &[View]) -> Option<f64> {
    let lengths = views.iter().filter_map(|view| Some(residual(camera, view)?.0.norm()));
    median(&mut lengths.collect::<Vec<f64>>())
}

/// Robust Gauss-Newton steps from a camera's pose, and the standard errors of its rotation (radians) and
/// position (metres). A limb is a cluster, because a detector misplaces a limb alike in all frames.
fn fit(mut camera: Camera, views: &[View]) -> Option<(Camera, [f64; 2])> {
    let mut covariance = SMatrix::<f64, 6, 6>::zeros();
    for _ in 0..STEPS {
        let scale = LOSS_SCALE * (distance(&camera, views)? / MEDIAN_LENGTH).max(0.5);
        let mut hessian = SMatrix::<f64, 6, 6>::zeros();
        let mut of_limbs = [SVector::<f64, 6>::zeros(); LIMBS.len()];
        for view in views {
            let Some((residual, by)) = residual(&camera, view) else { continue };
            let large = residual.norm_squared() / (scale * scale);
            let weight = 1.0 / ((1.0 + large) * (1.0 + large));
            hessian += by.tr_mul(&by) * weight;
            of_limbs[view.limb] += by.tr_mul(&residual) * weight;
        }
        let inverse = hessian.cholesky()?.inverse();
        let step = -(inverse * of_limbs.iter().sum::<SVector<f64, 6>>());
        let spread: SMatrix<f64, 6, 6> = of_limbs.iter().map(|of| of * of.transpose()).sum();
        covariance = inverse * spread * inverse;
        let turn = so3::exp(&step.fixed_rows::<3>(0).into());
        camera.rotation = turn * camera.rotation;
        camera.translation = turn * camera.translation + step.fixed_rows::<3>(3);
    }
    let few = LIMBS.len() as f64 / (LIMBS.len() - 1) as f64;
    let error = |from| (few * covariance.diagonal().fixed_rows::<3>(from).sum().max(0.0)).sqrt();
    Some((camera, [error(0), error(3)]))
}

/// The rotation on which most frames of the moved camera agree.
fn guess_turn(seen: &Seen, camera: &Camera, moved: usize) -> Option<Matrix3<f64>> {
    let turns = frames(seen, moved, GUESSES).into_iter().flat_map(|frame| {
        let posture = seen.pose(frame.capture).map(|pose| pose.posture(&seen.body));
        let limbs = posture.map(|posture| {
            LIMBS.map(|limb| {
                let at = Attachment::of(limb).position(&posture, &seen.body);
                (camera.rotation * at + camera.translation).normalize()
            })
        });
        frame.people.iter().filter_map(move |person| turn(frame, person, camera, limbs.as_ref()?))
    });
    let turns: Vec<Matrix3<f64>> = turns.collect();
    let agreeing = |turn: &Matrix3<f64>| {
        turns.iter().filter(|other| so3::angle_between(turn, other) < AGREE).count()
    };
    let most = turns.iter().max_by_key(|turn| agreeing(turn))?;
    (2 * agreeing(most) > turns.len()).then_some(*most)
}

/// The rotation that turns the directions of the performer's limbs to those of a person, if they are
/// alike.
fn turn(
    frame: &Detections,
    person: &Person,
    camera: &Camera,
    limbs: &[Vector3<f64>; LIMBS.len()],
) -> Option<Matrix3<f64>> {
    let pairs = LIMBS.iter().zip(limbs).filter_map(|(&limb, expected)| {
        let at = camera.undistort(&pixel(person, frame, limb)?)?;
        Some((*expected, Vector3::new(at.x, at.y, 1.0).normalize()))
    });
    let pairs: Vec<_> = pairs.collect();
    if pairs.len() < LEAST_LIMBS {
        return None;
    }
    let mut correlation = Matrix3::zeros();
    for (expected, seen) in &pairs {
        correlation += seen * expected.transpose();
    }
    let svd = correlation.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    let sign = (u * v).determinant().signum();
    let turn = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v;
    let extent =
        |(a, _): &(Vector3<f64>, _)| pairs.iter().map(|(b, _)| (a - b).norm()).fold(0.0, f64::max);
    let extent = pairs.iter().map(extent).fold(0.0, f64::max);
    let squares: f64 = pairs.iter().map(|(a, b)| (turn * a - b).norm_squared()).sum();
    (squares < (ALIKE * extent).powi(2) * pairs.len() as f64).then_some(turn)
}
