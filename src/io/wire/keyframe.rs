//! `Keyframe` to and from [`manifold::Keyframe`], with the shape and the window it belongs to.

use super::check::{Field, field};
use super::{DecodeError, Keyframe};
use crate::core::body::{SHAPE_COEFFICIENTS, Shape, TrackingState};
use crate::core::manifold::{self, Interpolation, LATENT};
use crate::core::so3;
use crate::core::time::{Grid, Timestamp};

const fn at(name: &'static str) -> Field {
    field("Keyframe", name)
}

/// Poses of one window, at most.
const MOST_POSES: f64 = 1e5;

/// A keyframe at the end of a window: all that is needed to go on from there, and with the one
/// before it to decode the poses between.
#[derive(Clone, Debug, PartialEq)]
pub struct StampedKeyframe {
    /// The end of the window.
    pub capture: Timestamp,
    /// The keyframe that the path comes from; its own time where a path begins.
    pub start: Timestamp,
    /// Number of the window, from 0.
    pub window: u64,
    /// Latent code and root.
    pub keyframe: manifold::Keyframe,
    /// The shape that it was solved with.
    pub shape: Shape,
    /// How the latent code runs from the keyframe before.
    pub interpolation: Interpolation,
    /// Fingerprint of the decoder's weights, hexadecimal.
    pub weights: String,
    /// The times of poses.
    pub grid: Grid,
    /// How far the poses since `start` can be trusted.
    pub state: TrackingState,
    /// Version of the rig that it was solved with.
    pub rig_version: u64,
}

impl Keyframe {
    /// The keyframe, in full precision, with the run id of keyframes solved offline, 0; of a [settled](manifold::Keyframe::quantised) one, bit for
    /// bit.
    pub fn from_core(stamped: &StampedKeyframe) -> Self {
        let keyframe = &stamped.keyframe;
        Self {
            capture_time_ns: stamped.capture.ns(),
            window: stamped.window,
            z: keyframe.z.to_vec(),
            root_rotation: so3::quantised_xyzw(&keyframe.root_rotation).to_vec(),
            root_position_m: keyframe.root_position.iter().copied().collect(),
            shape: stamped.shape.0.to_vec(),
            start_time_ns: stamped.start.ns(),
            interpolation: stamped.interpolation.name().to_owned(),
            weights: stamped.weights.clone(),
            grid_origin_ns: stamped.grid.origin.ns(),
            grid_period_ns: stamped.grid.period_ns,
            state: super::pose::wire_state(stamped.state).into(),
            rig_version: stamped.rig_version,
            run_id: 0,
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
            start: self.start()?,
            interpolation: Interpolation::named(&self.interpolation).ok_or_else(|| {
                let name = &self.interpolation;
                at("interpolation").invalid(format!("{name:?} is not slerp or lerp"))
            })?,
            weights: self.weights.clone(),
            grid: self.grid()?,
            state: super::pose::core_state(self.state)
                .ok_or_else(|| at("state").invalid(format!("unknown state {}", self.state)))?,
            rig_version: self.rig_version,
        })
    }

    fn start(&self) -> Result<Timestamp, DecodeError> {
        match self.start_time_ns <= self.capture_time_ns {
            true => Ok(Timestamp::from_ns(self.start_time_ns)),
            false => Err(at("start_time_ns").invalid("is after capture_time_ns")),
        }
    }

    /// The grid; a window with more poses than anybody can decode is refused.
    fn grid(&self) -> Result<Grid, DecodeError> {
        let period_ns = self.grid_period_ns;
        let span = self.capture_time_ns.saturating_sub(self.start_time_ns) as f64;
        if !(1e5..=1e18).contains(&period_ns) || span / period_ns > MOST_POSES {
            let reason = format!("is {period_ns}, which is no period of a window of {span} ns");
            return Err(at("grid_period_ns").invalid(reason));
        }
        Ok(Grid { origin: Timestamp::from_ns(self.grid_origin_ns), period_ns })
    }
}
