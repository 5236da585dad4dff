//! How far the joint centres of a solved window may be from the true ones.
//!
//! The curvature of the cost gives standard deviations for errors that are independent from frame to frame.
//! A detector's errors are not: they change slowly, and a part of them is constant. So the deviations from
//! the curvature are multiplied by a factor, and a constant error is added. Its size follows from the size
//! of the keypoint offsets. The factors were chosen at the noise levels of the evaluation, see
//! docs/results/solver.md.

use super::Solver;
use super::known::Known;
use crate::core::body::{BodyPoint, JOINTS, JointDeviations};
use crate::core::cost::{FreeBody, PathKeyframe, PathProblem, Scene};
use crate::core::tracker::job::Job;

/// Factor of the deviations from the curvature.
const RANDOM: f64 = 1.75;
/// Constant error of a joint centre, relative to the root mean square of the keypoint offsets.
const CONSTANT: f64 = 0.65;
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
        Some(std::array::from_fn(|joint| {
            let unseen = if seen[joint] { 0.0 } else { UNSEEN_M * UNSEEN_M };
            libm::sqrt(RANDOM * RANDOM * noise * variances[joint] + rest + unseen)
        }))
    }
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
    use super::*;
    use crate::core::body::{Joint, fitted_points};
    use crate::core::detections::KeypointFormat;

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
