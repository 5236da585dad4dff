//! Augmentation across subjects: a clip's motion about another clip's mean pose.
//!
//! R' = B exp(g log(A^T R)), with the mean rotation A of a joint in the motion's own clip, its mean
//! rotation B in another clip, and a gain g near 1. People differ more in posture and amplitude
//! than in how they move. All poses of a sample use the same A, B and g, so a pose between two
//! poses stays between them.

use nalgebra::{Matrix3, Vector3};

use super::corpus::{Clip, POSE, PoseVector, pose_vector};
use super::rotation::from_six;
use crate::core::body::BODY_JOINTS;
use crate::core::so3;

/// A clip's mean local rotations.
pub type MeanPose = [Matrix3<f64>; BODY_JOINTS];

/// Mean local rotations: Gram-Schmidt of the mean of the first two columns.
pub fn mean_pose(clip: &Clip) -> MeanPose {
    let mut sum = [0.0; POSE];
    for pose in &clip.poses {
        sum.iter_mut().zip(pose).for_each(|(sum, value)| *sum += value);
    }
    std::array::from_fn(|joint| from_six(&sum[6 * joint..6 * joint + 6]).rotation.map(f64::from))
}

/// Moves a pose from the mean pose `from` to `to`, with its deviation from the mean scaled by
/// `gain`.
pub fn restyled(pose: &PoseVector, from: &MeanPose, to: &MeanPose, gain: f64) -> PoseVector {
    pose_vector(&std::array::from_fn(|joint| {
        let column = |at: usize| Vector3::from_fn(|row, _| f64::from(pose[6 * joint + at + row]));
        let (a, b) = (column(0), column(3));
        let local = Matrix3::from_columns(&[a, b, a.cross(&b)]);
        to[joint] * so3::exp(&(so3::log(&(from[joint].transpose() * local)) * gain))
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::Skeleton;

    fn clip(about: &Vector3<f64>, swing: f64) -> Clip {
        let turn = |angle: f64| so3::exp(about) * so3::exp(&(Vector3::x() * angle));
        let angles = [-swing, 0.0, swing];
        let poses = angles.map(|angle| pose_vector(&[turn(angle); BODY_JOINTS])).to_vec();
        Clip {
            name: "01_01".into(),
            subject: "01".into(),
            poses,
            roots: Vec::new(),
            skeleton: Skeleton::default(),
        }
    }

    #[test]
    fn motion_moves_to_the_other_mean_and_grows_with_the_gain() {
        let small = clip(&Vector3::new(0.1, 0.5, -0.2), 0.2);
        let large = clip(&Vector3::new(-0.3, 0.1, 0.4), 0.3);
        let (from, to) = (mean_pose(&small), mean_pose(&large));
        for (pose, expected) in small.poses.iter().zip(&large.poses) {
            let moved = restyled(pose, &from, &to, 1.5);
            assert!(moved.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5));
            let same = restyled(pose, &from, &from, 1.0);
            assert!(same.iter().zip(pose).all(|(a, b)| (a - b).abs() < 1e-5));
        }
    }
}
