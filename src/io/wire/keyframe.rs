//! Converts `Keyframe` messages to and from [`StampedKeyframe`].

use super::check::{Field, field};
use super::{DecodeError, Keyframe};
use crate::core::body::{SYMMETRIC_SHAPE, Shape};
use crate::core::manifold::{self, CORRECTION, Correction, Interpolation, LATENT, StampedKeyframe};
use crate::core::so3;
use crate::core::time::{Grid, Timestamp};

const fn at(name: &'static str) -> Field {
    field("Keyframe", name)
}

/// Most poses in one window.
const MOST_POSES: f64 = 1e5;

impl Keyframe {
    /// The message of a keyframe in full precision; for a
    /// [quantised](manifold::Keyframe::quantised) keyframe it is exact to the bit. `weights` is the
    /// fingerprint of the decoder's weights, hexadecimal. The run id is 0, as for offline
    /// keyframes.
    pub fn from_core(stamped: &StampedKeyframe, weights: &str) -> Self {
        let keyframe = &stamped.keyframe;
        Self {
            capture_time_ns: stamped.capture.ns(),
            window: stamped.window,
            z: keyframe.z.to_vec(),
            root_rotation: so3::quantised_xyzw(&keyframe.root_rotation).to_vec(),
            root_position_m: keyframe.root_position.iter().copied().collect(),
            correction: wire_correction(&keyframe.correction),
            shape: stamped.shape.0.to_vec(),
            start_time_ns: stamped.start.ns(),
            interpolation: stamped.interpolation.name().to_owned(),
            weights: weights.to_owned(),
            grid_origin_ns: stamped.grid.origin.ns(),
            grid_period_ns: stamped.grid.period_ns,
            state: super::pose::wire_state(stamped.state).into(),
            rig_version: stamped.rig_version,
            run_id: 0,
        }
    }

    /// The keyframe, without the fingerprint of the weights.
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
                correction: self.core_correction()?,
            },
            shape: Shape(at("shape").padded(&self.shape, SYMMETRIC_SHAPE)?),
            start: self.start()?,
            interpolation: Interpolation::from_name(&self.interpolation).ok_or_else(|| {
                let name = &self.interpolation;
                at("interpolation").invalid(format!("{name:?} is not slerp or lerp"))
            })?,
            grid: self.grid()?,
            state: super::pose::core_state(self.state)
                .ok_or_else(|| at("state").invalid(format!("unknown state {}", self.state)))?,
            rig_version: self.rig_version,
        })
    }

    /// Zero if there is none.
    fn core_correction(&self) -> Result<Correction, DecodeError> {
        match self.correction.is_empty() {
            true => Ok(Correction::default()),
            false => Ok(Correction(at("correction").numbers::<CORRECTION, _>(&self.correction)?)),
        }
    }

    fn start(&self) -> Result<Timestamp, DecodeError> {
        match self.start_time_ns <= self.capture_time_ns {
            true => Ok(Timestamp::from_ns(self.start_time_ns)),
            false => Err(at("start_time_ns").invalid("is after capture_time_ns")),
        }
    }

    /// The grid; refuses a window with more poses than can be decoded.
    fn grid(&self) -> Result<Grid, DecodeError> {
        let period_ns = self.grid_period_ns;
        let span = self.capture_time_ns.saturating_sub(self.start_time_ns) as f64;
        if !(1e5..=1e18).contains(&period_ns) || span / period_ns > MOST_POSES {
            let reason = format!("is {period_ns}, which does not fit a window of {span} ns");
            return Err(at("grid_period_ns").invalid(reason));
        }
        Ok(Grid { origin: Timestamp::from_ns(self.grid_origin_ns), period_ns })
    }
}

/// Empty for none, as in recordings from before there were corrections.
fn wire_correction(correction: &Correction) -> Vec<f32> {
    match *correction == Correction::default() {
        true => Vec::new(),
        false => correction.0.iter().map(|&c| c as f32).collect(),
    }
}
