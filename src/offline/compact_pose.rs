//! Poses of about 500 bytes each.

use nalgebra::{Matrix3, Vector3};

use crate::core::body::{BODY_JOINTS, JOINTS, JointDeviations, Pose, StampedPose, TrackingState};
use crate::core::so3;
use crate::core::time::Timestamp;

/// A pose with quaternions; those of the joints are rounded to `f32`.
#[derive(Clone, Debug)]
pub(crate) struct CompactPose {
    pub(crate) capture: Timestamp,
    pub(crate) state: TrackingState,
    root_rotation: [f64; 4],
    pub(crate) root_position: Vector3<f64>,
    local: [[f32; 4]; BODY_JOINTS],
    deviations: Option<[f32; JOINTS]>,
}

impl CompactPose {
    pub(crate) fn is_tracked(&self) -> bool {
        self.state == TrackingState::Tracking
    }

    /// The same pose at another time.
    #[cfg(feature = "cli")]
    pub(crate) fn at(&self, capture: Timestamp) -> Self {
        Self { capture, ..self.clone() }
    }

    /// The pose, if it was fitted to detections; else `None`.
    pub(crate) fn usable(&self) -> Option<Pose> {
        self.is_tracked().then(|| self.pose())
    }

    /// The pose with its time, without its window.
    pub(crate) fn stamped(&self) -> StampedPose {
        let stamped = StampedPose::new(self.capture, self.pose(), self.state);
        StampedPose { deviations: self.deviations(), ..stamped }
    }

    /// The standard deviations of the joint centres, where they are known.
    pub(crate) fn deviations(&self) -> Option<JointDeviations> {
        self.deviations.map(|all| all.map(f64::from))
    }

    /// The pose.
    pub(crate) fn pose(&self) -> Pose {
        let rotation = |xyzw| so3::rotation_from_xyzw(xyzw).unwrap_or_else(Matrix3::identity);
        Pose {
            root_rotation: rotation(self.root_rotation),
            root_position: self.root_position,
            local: self.local.map(|xyzw| rotation(xyzw.map(f64::from))),
        }
    }
}

impl From<&StampedPose> for CompactPose {
    fn from(stamped: &StampedPose) -> Self {
        let pose = &stamped.pose;
        Self {
            capture: stamped.capture,
            state: stamped.state,
            root_rotation: so3::xyzw_from_rotation(&pose.root_rotation),
            root_position: pose.root_position,
            local: pose
                .local
                .map(|r| so3::xyzw_from_rotation(&r).map(|component| component as f32)),
            deviations: stamped.deviations.map(|all| all.map(|metres| metres as f32)),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// The tracked rest pose at a time; `x` is the pelvis position, metres.
    pub(crate) fn tracked(ns: i64, x: f64) -> CompactPose {
        in_state(ns, x, TrackingState::Tracking)
    }

    /// The same with another state.
    pub(crate) fn in_state(ns: i64, x: f64, state: TrackingState) -> CompactPose {
        let mut pose = Pose::rest();
        pose.root_position.x = x;
        (&stamped(ns, pose, state)).into()
    }

    fn stamped(ns: i64, pose: Pose, state: TrackingState) -> StampedPose {
        let stamped = StampedPose::new(Timestamp::from_ns(ns), pose, state);
        StampedPose { deviations: Some([0.01; JOINTS]), ..stamped }
    }

    #[test]
    fn a_compact_pose_is_small_and_the_same_to_a_millionth() {
        let mut pose = Pose::rest();
        pose.local[3] = so3::exp(&Vector3::new(0.3, -1.1, 0.7));
        pose.root_rotation = so3::exp(&Vector3::new(-2.0, 0.1, 0.4));
        pose.root_position = Vector3::new(1.0, 2.0, 3.0);
        let stamped = stamped(7, pose, TrackingState::Lost);
        let compact = CompactPose::from(&stamped);
        assert!(std::mem::size_of::<CompactPose>() <= 512);
        assert!(!compact.is_tracked());
        let back = compact.pose();
        assert!((back.local[3] - stamped.pose.local[3]).amax() < 1e-6);
        assert!((back.root_rotation - stamped.pose.root_rotation).amax() < 1e-12);
        assert_eq!(back.root_position, stamped.pose.root_position);
        assert!((compact.deviations().unwrap()[5] - 0.01).abs() < 1e-9);
    }
}
