//! How far the joint centres of a solved window may be from the true ones.
//!
//! The curvature of the cost gives standard deviations for errors that are independent from frame to frame.
//! A detector's errors are not: they change slowly, and a part of them is constant. So the deviations from
//! the curvature are multiplied by a factor, and a constant error is added. Its size follows from the size
//! of the keypoint offsets. A wrong calibration shifts all points of a camera together. The residuals show
//! these shifts. The factors were chosen at the noise levels of the evaluation and on real takes, see
//! docs/results/solver.md.

use std::collections::BTreeSet;

use nalgebra::{Matrix3, Vector3};

use super::Solver;
use super::known::Known;
use crate::core::body::{BodyPoint, JOINTS, JointDeviations};
use crate::core::camera::Rig;
use crate::core::cost::{FreeBody, PathKeyframe, PathProblem, Scene};
use crate::core::tracker::job::Job;
use crate::core::tracker::noise::Residual;

/// Factor of the deviations from the curvature.
const RANDOM: f64 = 1.85;
/// Constant error of a joint centre, relative to the root mean square of the keypoint offsets.
const CONSTANT: f64 = 0.58;
/// Factor of the deviations from shifts of cameras. The residuals show only a part of a shift: the body turns and bends
/// with it.
const SHIFTED: f64 = 1.4;
/// Information that the size of the body gives about its distance, as a part of that of all images. Cameras that face each
/// other give none.
const BY_SIZE: f64 = 0.01;
/// The error of our model, metres.
const MODEL_M: f64 = 0.002;
/// The error of a joint centre that only the manifold tells, metres: no keypoint of the format is at the joint or beyond it.
const UNSEEN_M: f64 = 0.022;

impl Solver {
    /// The standard deviations of the joint centres at the end of a window's final part. The window must be
    /// the last problem of the optimiser.
    pub(super) fn deviations(
        &mut self,
        job: &Job,
        points: &[BodyPoint],
        solved: Known,
        residuals: &[Residual],
    ) -> Option<JointDeviations> {
        let last = solved.ahead.iter().position(|at| at.capture >= job.publish)?;
        let covariance = self.optimiser.inverse_block(last)?;
        let cost = self.cost(job);
        let scene = Scene { decoder: &self.decoder, rig: &job.rig, points, config: &cost };
        let path = vec![PathKeyframe::free(solved.ahead[last].clone(), 1.0)];
        let (body, work) = (FreeBody::Fixed, &mut self.work);
        let problem = PathProblem::new(scene, path, solved.skeleton, body, &[], work);
        let variances = problem.joint_variances(&covariance)?;
        let noise = job.noise.variance_px(self.config.reference_residual_px);
        let constant = CONSTANT * solved.skeleton.keypoint_offsets().root_mean_square();
        let rest = constant * constant + MODEL_M * MODEL_M;
        let seen = seen(points);
        let pose = self.decoder.pose(&solved.ahead[last].keyframe);
        let centres = pose.posture(solved.skeleton).positions;
        let cameras: BTreeSet<usize> = residuals.iter().map(|residual| residual.camera).collect();
        let shift = SHIFTED * SHIFTED * job.noise.shift_variance_px();
        Some(std::array::from_fn(|joint| {
            let unseen = if seen[joint] { 0.0 } else { UNSEEN_M * UNSEEN_M };
            let random = RANDOM * RANDOM * noise * variances[joint];
            let shifted = shift * variance_of_shifts(&job.rig, &cameras, &centres[joint]);
            libm::sqrt(random + shifted + rest + unseen)
        }))
    }
}

/// The variance of a joint centre along an axis, square metres for one square pixel: the images of these cameras are
/// shifted, independently and with that variance along each axis.
fn variance_of_shifts(rig: &Rig, cameras: &BTreeSet<usize>, joint: &Vector3<f64>) -> f64 {
    let projected =
        cameras.iter().filter_map(|&camera| rig.cameras[camera].project_with_jacobian(joint));
    let seen: Matrix3<f64> = projected.map(|(_, by_joint)| by_joint.transpose() * by_joint).sum();
    let by_size = Matrix3::identity() * (BY_SIZE * seen.trace());
    (seen + by_size).try_inverse().map_or(0.0, |covariance| covariance.trace() / 3.0)
}

/// Whether points are at a joint or beyond it.
fn seen(points: &[BodyPoint]) -> [bool; JOINTS] {
    let mut seen = [false; JOINTS];
    for point in points {
        let joints = std::iter::successors(Some(point.attachment.joint), |joint| joint.parent());
        joints.for_each(|joint| seen[joint.index()] = true);
    }
    seen
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;
    use crate::core::body::{Joint, fitted_points};
    use crate::core::camera::{Camera, Lens};

    use crate::core::detections::KeypointFormat;
    use crate::core::so3;

    /// The variance of the origin if shifts have a variance of a square pixel, with cameras 4 m away in these directions,
    /// quarters of a turn, with 1,000 pixels focal length.
    fn variance_of_the_origin(quarters: &[f64]) -> f64 {
        let matrix = Matrix3::new(1000.0, 0.0, 640.0, 0.0, 1000.0, 360.0, 0.0, 0.0, 1.0);
        let camera = |(i, quarter): (usize, &f64)| {
            let turn = so3::exp(&Vector3::new(0.0, quarter * FRAC_PI_2, 0.0));
            let away = Vector3::new(0.0, 0.0, 4.0);
            Camera::new(i.to_string(), [1280, 720], &matrix, Lens::IDEAL, turn, away).unwrap()
        };
        let cameras: Vec<Camera> = quarters.iter().enumerate().map(camera).collect();
        let rig = Rig::new(1, cameras).unwrap();
        let cameras = (0..quarters.len()).collect();
        variance_of_shifts(&rig, &cameras, &Vector3::zeros())
    }

    #[test]
    fn shifts_move_a_joint_centre_as_far_as_the_cameras_let_it() {
        // A metre is 250 pixels. Four cameras see the height, two of them each horizontal axis.
        let metre = 250.0_f64 * 250.0;
        let four = variance_of_the_origin(&[0.0, 1.0, 2.0, 3.0]);
        let expected = (1.0 / 4.0 + 1.0 / 2.0 + 1.0 / 2.0) / (3.0 * metre);
        assert!((four / expected - 1.0).abs() < 0.05, "{four} {expected}");
        // Two that face each other see no distance: the size alone gives it.
        let facing = variance_of_the_origin(&[0.0, 2.0]);
        let expected = (1.0 / 2.0 + 1.0 / 2.0 + 1.0 / (4.0 * BY_SIZE)) / (3.0 * metre);
        assert!((facing / expected - 1.0).abs() < 0.05, "{facing} {expected}");
    }

    #[test]
    fn without_points_at_the_feet_they_are_not_seen() {
        let unseen = |format| {
            let seen = seen(&fitted_points(format));
            Joint::ALL.into_iter().filter(|joint| !seen[joint.index()]).collect::<Vec<_>>()
        };
        assert_eq!(unseen(KeypointFormat::Body25), []);
        assert_eq!(unseen(KeypointFormat::Coco17), [Joint::LFoot, Joint::RFoot]);
    }
}
