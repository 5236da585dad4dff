//! `Keyframe` to and from [`manifold::Keyframe`], with the shape and the window it belongs to.

use super::check::{Field, field};
use super::{DecodeError, Keyframe};
use crate::body::{SHAPE_COEFFICIENTS, Shape};
use crate::manifold::{self, LATENT};
use crate::so3;
use crate::time::Timestamp;

const fn at(name: &'static str) -> Field {
    field("Keyframe", name)
}

/// A keyframe at the end of a window: all that is needed to go on from there.
#[derive(Clone, Debug, PartialEq)]
pub struct StampedKeyframe {
    /// The end of the window.
    pub capture: Timestamp,
    /// Number of the window, from 0.
    pub window: u64,
    /// Latent code and root.
    pub keyframe: manifold::Keyframe,
    /// The shape that it was solved with.
    pub shape: Shape,
}

impl Keyframe {
    /// The keyframe, in full precision.
    pub fn from_core(stamped: &StampedKeyframe) -> Self {
        let keyframe = &stamped.keyframe;
        Self {
            capture_time_ns: stamped.capture.ns(),
            window: stamped.window,
            z: keyframe.z.to_vec(),
            root_rotation: so3::xyzw_from_rotation(&keyframe.root_rotation).to_vec(),
            root_position_m: keyframe.root_position.iter().copied().collect(),
            shape: stamped.shape.0.to_vec(),
            ..Self::default()
        }
    }

    /// The keyframe.
    ///
    /// # Errors
    /// Wrong lengths, numbers that are not finite, a quaternion of length zero.
    pub fn to_core(&self) -> Result<StampedKeyframe, DecodeError> {
        Ok(StampedKeyframe {
            capture: Timestamp::from_ns(self.capture_time_ns),
            window: self.window,
            keyframe: manifold::Keyframe {
                z: at("z").numbers::<LATENT, _>(&self.z)?,
                root_rotation: at("root_rotation").rotation(&self.root_rotation)?,
                root_position: at("root_position_m").vector(&self.root_position_m)?,
            },
            shape: Shape(at("shape").numbers::<SHAPE_COEFFICIENTS, _>(&self.shape)?),
        })
    }
}
