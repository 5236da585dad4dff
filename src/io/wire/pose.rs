//! Converts `Pose` to and from [`StampedPose`].

use nalgebra::Vector3;

use super::check::{Field, field};
use super::{DecodeError, Pose, TrackingState as WireState};
use crate::core::body::{
    self, BODY_JOINTS, JOINTS, JointDeviations, Skeleton, StampedPose, TrackingState,
};
use crate::core::so3;
use crate::core::time::{Nanos, Timestamp};
use crate::io::timecode::House;

const fn at(name: &'static str) -> Field {
    field("Pose", name)
}

/// Data that a live node adds to a pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LiveStamp {
    /// Due time on the cameras' clock; `None` for a provisional pose.
    pub due: Option<Timestamp>,
    /// Declared latency, nanoseconds.
    pub latency: Nanos,
    /// Id of the node's run.
    pub run_id: u64,
}

impl Pose {
    /// The message of a pose, with joint centres from `skeleton`. Local rotations and joint
    /// centres are rounded to `f32`. Without `live`, the pose was solved offline.
    pub fn from_core(stamped: &StampedPose, skeleton: &Skeleton, live: Option<LiveStamp>) -> Self {
        let pose = &stamped.pose;
        let positions = pose.posture(skeleton).positions;
        Self {
            capture_time_ns: stamped.capture.ns(),
            due_time_ns: live.and_then(|live| live.due).map(Timestamp::ns),
            declared_latency_ns: live.map_or(0, |live| live.latency.ns().unsigned_abs()),
            state: wire_state(stamped.state).into(),
            root_position_m: pose.root_position.iter().copied().collect(),
            root_rotation: so3::xyzw_from_rotation(&pose.root_rotation).to_vec(),
            local_rotations: pose.local.iter().flat_map(quaternion_f32).collect(),
            joint_positions_m: positions.iter().flatten().map(|&m| m as f32).collect(),
            rig_version: stamped.rig_version,
            window: stamped.window,
            provisional: stamped.provisional,
            revision: stamped.revision,
            run_id: live.map_or(0, |live| live.run_id),
            timecode: String::new(),
            joint_deviations_m: stamped.deviations.iter().flatten().map(|&m| m as f32).collect(),
        }
    }

    /// The pose with the timecode of its capture time, if the house has one.
    pub fn labelled(self, house: Option<House>) -> Self {
        let label = house.map(|house| house.label(Timestamp::from_ns(self.capture_time_ns)));
        Self { timecode: label.unwrap_or_default(), ..self }
    }

    /// The pose.
    ///
    /// # Errors
    /// Wrong lengths, numbers that are not finite, quaternions of length zero, an unknown state.
    pub fn to_core(&self) -> Result<StampedPose, DecodeError> {
        let pose = body::Pose {
            root_rotation: at("root_rotation").rotation(&self.root_rotation)?,
            root_position: at("root_position_m").vector(&self.root_position_m)?,
            local: at("local_rotations").rotations::<BODY_JOINTS, _>(&self.local_rotations)?,
        };
        Ok(StampedPose {
            capture: Timestamp::from_ns(self.capture_time_ns),
            pose,
            state: self.tracking_state()?,
            window: self.window,
            rig_version: self.rig_version,
            provisional: self.provisional,
            revision: self.revision,
            deviations: self.joint_deviations()?,
        })
    }

    /// Joint centres in the world, metres.
    ///
    /// # Errors
    /// Wrong length, or numbers that are not finite.
    pub fn joint_positions(&self) -> Result<[Vector3<f64>; JOINTS], DecodeError> {
        at("joint_positions_m").vectors(&self.joint_positions_m)
    }

    /// The standard deviations of the joint centres, metres, if they are known.
    ///
    /// # Errors
    /// Wrong length, numbers that are negative or not finite.
    pub fn joint_deviations(&self) -> Result<Option<JointDeviations>, DecodeError> {
        let at = at("joint_deviations_m");
        if self.joint_deviations_m.is_empty() {
            return Ok(None);
        }
        let all: JointDeviations = at.numbers(&self.joint_deviations_m)?;
        match all.iter().all(|sd| *sd >= 0.0) {
            true => Ok(Some(all)),
            false => Err(at.invalid("a number is negative")),
        }
    }

    fn tracking_state(&self) -> Result<TrackingState, DecodeError> {
        let unknown = || at("state").invalid(format!("unknown state {}", self.state));
        core_state(self.state).ok_or_else(unknown)
    }
}

pub(super) fn core_state(state: i32) -> Option<TrackingState> {
    match WireState::try_from(state).ok()? {
        WireState::Tracking => Some(TrackingState::Tracking),
        WireState::Coasting => Some(TrackingState::Coasting),
        WireState::Lost => Some(TrackingState::Lost),
        WireState::Unspecified => None,
    }
}

pub(super) fn wire_state(state: TrackingState) -> WireState {
    match state {
        TrackingState::Tracking => WireState::Tracking,
        TrackingState::Coasting => WireState::Coasting,
        TrackingState::Lost => WireState::Lost,
    }
}

fn quaternion_f32(rotation: &nalgebra::Matrix3<f64>) -> [f32; 4] {
    so3::xyzw_from_rotation(rotation).map(|component| component as f32)
}
