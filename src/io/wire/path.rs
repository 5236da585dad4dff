//! Poses from keyframes alone.

use super::StampedKeyframe;
use crate::core::body::{Pose, StampedPose};
use crate::core::manifold::Decoder;
use crate::core::time::Timestamp;

impl StampedKeyframe {
    /// Whether a path begins here, so that no keyframe before it is needed.
    pub fn begins(&self) -> bool {
        self.start == self.capture
    }

    /// The poses that this keyframe and the one `before` it stand for: those on the grid after
    /// `before`, up to this one. With k the decoder of the weights that the keyframe names,
    /// pose(t) = k(path((t - start) / (capture - start))). Where a path begins, the pose at that
    /// very time, and `before` is not asked for. `None`: `before` is not what the path comes from.
    pub fn poses(&self, before: Option<&Self>, decoder: &Decoder) -> Option<Vec<StampedPose>> {
        if self.begins() {
            return Some(vec![self.stamped(self.capture, decoder.pose(&self.keyframe))]);
        }
        let from = &before.filter(|before| before.capture == self.start)?.keyframe;
        let span = (self.capture - self.start).max(1) as f64;
        let at = |capture: Timestamp| {
            let s = (capture - self.start) as f64 / span;
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
        }
    }
}
