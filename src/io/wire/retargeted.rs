//! Checks `RetargetedPose`, whose skeleton is not ours.

use super::check::{Field, field};
use super::{DecodeError, RetargetedPose, TrackingState};
use crate::core::so3;

const fn at(name: &'static str) -> Field {
    field("RetargetedPose", name)
}

impl RetargetedPose {
    /// Checks a message from outside.
    ///
    /// # Errors
    /// Wrong lengths, numbers that are not finite, quaternions of length zero, an unknown state,
    /// hips that are not a joint.
    pub fn validated(self) -> Result<Self, DecodeError> {
        let joints = self.joint_names.len();
        match TrackingState::try_from(self.state) {
            Ok(state) if state != TrackingState::Unspecified => {}
            _ => return Err(at("state").invalid(format!("unknown state {}", self.state))),
        }
        if self.hips as usize >= joints {
            let reason = format!("{} is not one of the {joints} joints", self.hips);
            return Err(at("hips").invalid(reason));
        }
        at("hips_position_m").vector(&self.hips_position_m)?;
        at("local_rotations").length(self.local_rotations.len(), 4 * joints)?;
        at("local_rotations").finite(&self.local_rotations)?;
        for (index, xyzw) in self.local_rotations.as_chunks().0.iter().enumerate() {
            if so3::rotation_from_xyzw(xyzw.map(f64::from)).is_none() {
                let reason = format!("quaternion {index} has length zero");
                return Err(at("local_rotations").invalid(reason));
            }
        }
        Ok(self)
    }
}
