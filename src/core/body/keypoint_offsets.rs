//! Keypoint offsets: the difference between a keypoint of the detector and that of our body.
//!
//! Detectors have systematic errors: knees a little to the front, hips too high. An offset is a vector in
//! the joint's frame, the same in every view and at all times. Left and right offsets mirror each other,
//! since detectors are trained on mirrored images.

use nalgebra::Vector3;

use crate::core::detections::Keypoint;

/// Keypoints with an offset: the fitted ones of the left side and of the middle.
const POINTS: [Keypoint; 13] = [
    Keypoint::Nose,
    Keypoint::LEye,
    Keypoint::LEar,
    Keypoint::HeadTop,
    Keypoint::LShoulder,
    Keypoint::LElbow,
    Keypoint::LWrist,
    Keypoint::LHip,
    Keypoint::LKnee,
    Keypoint::LAnkle,
    Keypoint::LBigToe,
    Keypoint::LSmallToe,
    Keypoint::LHeel,
];

/// Count of all coordinates: x, y and z of each keypoint.
pub const OFFSETS: usize = 3 * POINTS.len();

/// Metres per unit of an offset's coordinate.
const UNIT: f64 = 0.012;

/// Precision of the prior at elbows, wrists, knees and ankles, relative to other keypoints.
const PRECISE: f64 = 8.0;

/// The offsets of all keypoints, in units of 12 mm; zero for the keypoints of our body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeypointOffsets(pub [f64; OFFSETS]);

impl KeypointOffsets {
    /// Relative precision (no unit) of the prior of each coordinate. It is higher at elbows, wrists,
    /// knees and ankles: detectors are most exact there, and a large offset would hide a wrong bone
    /// length.
    pub fn prior_precisions() -> [f64; OFFSETS] {
        use Keypoint::{LAnkle, LElbow, LKnee, LWrist};
        std::array::from_fn(|i| match POINTS[i / 3] {
            LElbow | LWrist | LKnee | LAnkle => PRECISE,
            _ => 1.0,
        })
    }
}

impl Default for KeypointOffsets {
    fn default() -> Self {
        Self([0.0; OFFSETS])
    }
}

/// Position of a keypoint's offset in the vector of all offsets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Slot {
    first: usize,
    /// 1 for left and middle, -1 for right: the sign of x.
    side: f64,
}

impl Slot {
    /// `None` for keypoints that are not fitted.
    pub(super) fn of(keypoint: Keypoint) -> Option<Self> {
        let (left, side) = keypoint.of_left();
        let number = POINTS.iter().position(|&point| point == left)?;
        Some(Self { first: 3 * number, side })
    }

    /// The offset in the joint's frame, metres.
    pub(super) fn offset(self, offsets: &KeypointOffsets) -> Vector3<f64> {
        let [x, y, z] = [0, 1, 2].map(|axis| offsets.0[self.first + axis] * UNIT);
        Vector3::new(self.side * x, y, z)
    }

    /// Writes the derivative of [`Slot::offset`] by each coordinate of the offsets.
    pub(super) fn derivative(self, out: &mut [Vector3<f64>]) {
        out[self.first].x = self.side * UNIT;
        out[self.first + 1].y = UNIT;
        out[self.first + 2].z = UNIT;
    }
}
