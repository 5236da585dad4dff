//! Keyframes: a value, a value with its time, and the keyframe that a tracker publishes.

use nalgebra::{Matrix3, Vector3};

use super::{Correction, Decoder, Interpolation, Latent};
use crate::core::body::{Pose, Shape, StampedPose, TrackingState};
use crate::core::so3;
use crate::core::time::{Grid, Timestamp};

/// A latent code and the pelvis: the unknowns of a window.
#[derive(Clone, Debug, PartialEq)]
pub struct Keyframe {
    /// Latent code.
    pub z: Latent,
    /// `world_from_pelvis`.
    pub root_rotation: Matrix3<f64>,
    /// The pelvis in the world, metres.
    pub root_position: Vector3<f64>,
    /// Rotations of joints beside the manifold.
    pub correction: Correction,
}

impl Keyframe {
    /// The nearest keyframe that a message holds exactly, so that every receiver decodes the same
    /// poses; see [`so3::quantised`].
    pub fn quantised(self) -> Self {
        let root_rotation = so3::quantised(&self.root_rotation);
        Self { root_rotation, correction: self.correction.quantised(), ..self }
    }
}

/// A keyframe and its capture time.
#[derive(Clone, Debug, PartialEq)]
pub struct TimedKeyframe {
    /// The capture time.
    pub capture: Timestamp,
    /// The value.
    pub keyframe: Keyframe,
}

impl TimedKeyframe {
    /// `keyframe` at `capture`.
    pub fn new(capture: Timestamp, keyframe: Keyframe) -> Self {
        Self { capture, keyframe }
    }
}

/// The keyframes of both in order of time; each time is there once.
pub(in crate::core) fn in_order(
    some: &[TimedKeyframe],
    others: &[TimedKeyframe],
) -> Vec<TimedKeyframe> {
    let mut all = [some, others].concat();
    all.sort_by_key(|at| at.capture);
    all.dedup_by_key(|at| at.capture);
    all
}

/// A final keyframe, with all data to decode the poses between it and the keyframe before.
#[derive(Clone, Debug, PartialEq)]
pub struct StampedKeyframe {
    /// Its capture time.
    pub capture: Timestamp,
    /// The capture time of the keyframe before; equal to `capture` at the start of a path.
    pub start: Timestamp,
    /// Number of its window, from 0.
    pub window: u64,
    /// Its value.
    pub keyframe: Keyframe,
    /// The body shape of its solve.
    pub shape: Shape,
    /// The interpolation of the latent code from the keyframe before.
    pub interpolation: Interpolation,
    /// The times of poses.
    pub grid: Grid,
    /// The quality of the poses since `start`.
    pub state: TrackingState,
    /// Version of the rig of its solve.
    pub rig_version: u64,
}

impl StampedKeyframe {
    /// Whether a path begins here; the keyframe before is then not needed.
    pub fn begins(&self) -> bool {
        self.start == self.capture
    }

    /// The poses on the grid after the keyframe `before`, up to this one: pose(t) = decoder(path(s))
    /// with s = (t - start) / (capture - start); the pose at `capture` is that of this keyframe. At the start of a
    /// path, the one pose at `capture`; `before` is not used.
    ///
    /// `decoder` must have the weights of the solve. `None` if `before` is not the keyframe at
    /// `start`.
    pub fn poses(&self, before: Option<&Self>, decoder: &Decoder) -> Option<Vec<StampedPose>> {
        if self.begins() {
            return Some(vec![self.stamped(self.capture, decoder.pose(&self.keyframe))]);
        }
        let from = &before.filter(|before| before.capture == self.start)?.keyframe;
        let at = |capture: Timestamp| {
            if capture == self.capture {
                return self.stamped(capture, decoder.pose(&self.keyframe));
            }
            let s = capture.fraction(self.start, self.capture);
            let keyframe = self.interpolation.keyframe(from, &self.keyframe, s);
            self.stamped(capture, decoder.pose(&keyframe))
        };
        Some(self.grid.between(self.start, self.capture).map(at).collect())
    }

    fn stamped(&self, capture: Timestamp, pose: Pose) -> StampedPose {
        StampedPose {
            capture,
            pose,
            state: self.state,
            window: self.window,
            rig_version: self.rig_version,
            provisional: false,
            revision: 0,
            deviations: None,
        }
    }
}
