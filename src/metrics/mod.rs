//! Metrics and references.
//!
//! e = |P - P*| is the distance of a joint from the true one, over frames and the 22 joints:
//!
//! | metric | formula | unit |
//! |---|---|---|
//! | MPJPE | mean of e | mm |
//! | limb joints | mean of e over shoulders, elbows, wrists, hips, knees and ankles; see [`LimbErrors`] | mm |
//! | limbs less offset | the same without the constant part in each joint's frame, see [`limb_errors_less_offset`] | mm |
//! | bones | mean over thigh, shank, upper arm and forearm of \|length less the true one\|, see [`segment_errors`] | mm |
//! | root-relative MPJPE | mean of e after aligning the pelvis with the true one | mm |
//! | RMSE | sqrt(mean of e^2) | mm |
//! | MAE | mean angle between local rotations of joints 1 to 21 and the true ones | deg |
//! | PCK@3, PCK@7 | share of joints with e <= 3 cm, 7 cm | % |
//! | acceleration error | mean of \|P'' - P*''\|, P'' = (P(t+1) - 2 P(t) + P(t-1)) fps^2 | m/s^2 |
//! | jump at borders | [`VelocityJump`]: mean \|v(t+) - v(t-)\| at window borders, less that of the true motion there | m/s |
//! | foot skate | [`foot_skate`]: mean horizontal speed of ankles and feet whose true speed and height mean contact | mm/s |
//! | floor | [`Floor`]: median height of standing feet | m |
//! | seen and not followed | [`NotFollowed`]: share of points on which the views agree and from which the body is more than 10 cm away | % |
//! | several performers | [`PerformerScores`]: MOTA, identity switches, recall, precision, PCP | %, count |
//! | coverage | [`Coverage`]: share of the coordinates' errors within one and two of their standard deviations | % |
//! | drift | [`slope_interval`] of the frames' mean e over time | mm/min |
//!
//! Means over several recordings have the intervals of [`mean_interval`].

mod camera_state;
mod coverage;
mod detector_statistics;
mod distribution;
mod feet;
mod floor;
mod followed;
mod limbs;
mod markers;
mod motion;
mod performers;
mod pose_errors;
pub mod statistics;
mod trend;

pub(crate) use camera_state::{CameraState, set_residuals};
pub use coverage::{Coverage, CoverageSums};
pub use detector_statistics::{
    ConfidenceBin, DetectorStatistics, DetectorTracks, PointTrack, Seen,
};
pub use distribution::Distribution;
pub use feet::{FootSkate, FootSkateSums, foot_skate};
pub use floor::Floor;
pub use followed::{Episode, FollowedSums, NotFollowed};
pub use limbs::{
    LIMB_JOINTS, LimbErrors, SEGMENTS, SPEEDS_M_S, limb_errors, limb_errors_less_offset,
    limb_joints, segment_errors, segment_lengths,
};
pub use markers::{COMPARED, MarkerDistance, MarkerDistances, MarkerPositions};
pub use motion::{VelocityJump, velocity_jump, velocity_jumps};
pub use performers::{JointPositions, PerformerScore, PerformerScores, PerformerSums};
pub use pose_errors::{
    MeanAcceleration, PoseErrorSums, PoseErrors, acceleration_error, mean_acceleration, pose_errors,
};
pub use trend::{Interval, mean_interval, slope_interval};

/// For the tests: made-up motions.
#[cfg(test)]
mod made_up {
    use nalgebra::Vector3;

    use crate::core::body::{Pose, Posture, Skeleton};

    pub(super) const FPS: f64 = 50.0;

    /// The rest pose with the pelvis at these positions along x, metres.
    pub(super) fn run(x: &[f64]) -> Vec<Posture> {
        let at = |&x: &f64| {
            let mut pose = Pose::rest();
            pose.root_position = Vector3::new(x, 0.0, 0.0);
            pose.posture(&Skeleton::default())
        };
        x.iter().map(at).collect()
    }

    pub(super) fn close(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-9, "{a} is not {b}");
    }
}
