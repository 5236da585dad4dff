//! How well the joint centres are determined.

use super::frame_cost::Path;
use super::path::PathProblem;
use super::reprojection::Reprojection;
use super::unknowns::KEYFRAME;
use super::workspace::Workspace;
use crate::core::body::{JOINTS, Joint};

impl PathProblem<'_> {
    /// The variance of each joint centre at the first keyframe of the path, mean of the three axes: J C J^T,
    /// with J the centres' derivatives and C the covariance of the keyframe's unknowns, row-major. The body
    /// is fixed.
    pub fn joint_variances(self, covariance: &[f32]) -> Option<[f64; JOINTS]> {
        let Self { scene, unknowns, loss, work, .. } = self;
        let reprojection = Reprojection { rig: scene.rig, loss };
        let Workspace { batches: [batch, _], offsets, .. } = &mut *work;
        let path = Path { scene, unknowns: &unknowns, reprojection, offsets };
        let tangents = path.tangents_at(0, batch)?;
        let variance = |row: &[f32]| -> f32 {
            let by_row = covariance.chunks_exact(KEYFRAME).zip(row);
            by_row.map(|(c, j)| j * c.iter().zip(row).map(|(c, k)| c * k).sum::<f32>()).sum()
        };
        let of_joint = |joint: Joint| {
            let rows = tangents.position(joint).chunks_exact(KEYFRAME);
            rows.map(|row| f64::from(variance(row))).sum::<f64>() / 3.0
        };
        Some(Joint::ALL.map(of_joint))
    }
}
