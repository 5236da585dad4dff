//! The floor under a performer, from the solved feet.

use std::collections::BTreeMap;

use crate::core::body::{Attachment, Posture, Skeleton};
use crate::core::detections::Keypoint;

/// The points of a foot whose lowest one is on the floor.
const SOLE: [[Keypoint; 3]; 2] = [
    [Keypoint::LHeel, Keypoint::LBigToe, Keypoint::LSmallToe],
    [Keypoint::RHeel, Keypoint::RBigToe, Keypoint::RSmallToe],
];
/// A foot stands if its lowest point moves less than this up or down, m/s.
const STANDING_SPEED: f64 = 0.1;
/// A floor needs this many frames with a standing foot.
const LEAST: usize = 20;

/// Finds the height of the floor, in memory that does not grow with the number of frames.
#[derive(Clone, Debug, Default)]
pub struct Floor {
    /// The lowest point of each foot in the last frame of the run, metres.
    before: Option<[f64; 2]>,
    /// Number of frames with a standing foot, by height in millimetres.
    heights: BTreeMap<i64, usize>,
}

impl Floor {
    /// The next frame does not follow the one before.
    pub fn gap(&mut self) {
        self.before = None;
    }

    /// Adds the next frame; frames follow each other at `fps`.
    pub fn add(&mut self, posture: &Posture, body: &Skeleton, fps: f64) {
        let height = |point| Attachment::of(point).position(posture, body).y;
        let lowest = SOLE.map(|sole| sole.map(height).into_iter().fold(f64::INFINITY, f64::min));
        for (now, before) in lowest.into_iter().zip(self.before.into_iter().flatten()) {
            if (now - before).abs() * fps < STANDING_SPEED {
                *self.heights.entry((1e3 * now).round() as i64).or_default() += 1;
            }
        }
        self.before = Some(lowest);
    }

    /// The median height of standing feet above y = 0, metres; `None` if they hardly stand.
    pub fn height(&self) -> Option<f64> {
        let all: usize = self.heights.values().sum();
        let mut below = 0;
        let middle = self.heights.iter().find(|(_, frames)| {
            below += **frames;
            2 * below >= all
        });
        middle.filter(|_| all >= LEAST).map(|(&mm, _)| 1e-3 * mm as f64)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::core::body::Pose;

    /// The floor under a body in the rest pose, with the pelvis at these heights, metres.
    fn floor(heights: impl Iterator<Item = f64>) -> Option<f64> {
        let (body, mut floor) = (Skeleton::default(), Floor::default());
        for y in heights {
            let pose = Pose { root_position: Vector3::new(0.0, y, 0.0), ..Pose::rest() };
            floor.add(&pose.posture(&body), &body, 50.0);
        }
        floor.height()
    }

    #[test]
    fn the_floor_is_where_feet_stand_most() {
        let (standing, on_a_step) = ((0..100).map(|_| 1.0), (0..30).map(|_| 1.3));
        let jump = (0..50).map(|k| 1.0 + 0.02 * f64::from(k.min(50 - k)));
        let found = floor(standing.chain(jump).chain(on_a_step)).unwrap();
        let higher = floor((0..100).map(|_| 1.5)).unwrap();
        assert!((higher - found - 0.5).abs() < 2e-3, "{found} {higher}");
    }

    #[test]
    fn feet_that_never_stand_show_no_floor() {
        assert_eq!(floor((0..100).map(|k| 1.0 + 0.02 * f64::from(k))), None);
    }
}
