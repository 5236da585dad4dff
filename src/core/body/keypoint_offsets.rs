//! Keypoint offsets: the difference between a keypoint of the detector and that of our body.
//!
//! Detectors have systematic errors: knees a little to the front, hips too high. An offset is a vector
//! that turns like the keypoint's place, the same in every view and at all times. Left and right offsets nearly mirror each
//! other, since detectors are trained on mirrored images: left = s + d, right = the mirror image of
//! s - d, with a strong prior on d.

use std::array::from_fn;

use nalgebra::Vector3;

use crate::core::detections::Keypoint::{self, LAnkle, LElbow, LKnee, LWrist};
use crate::core::detections::KeypointFormat;

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

/// Count of the coordinates that mirror each other: x, y and z of each keypoint.
pub const SYMMETRIC_OFFSETS: usize = 3 * POINTS.len();

/// Count of all coordinates: the symmetric ones, then half of the difference of left and right.
pub const OFFSETS: usize = 2 * SYMMETRIC_OFFSETS;

/// Metres per unit of an offset's coordinate.
const UNIT: f64 = 0.012;

/// Precision of the prior of the half differences between left and right, relative to the symmetric
/// offsets.
const EQUAL_SIDES: f64 = 128.0;

/// The offsets of all keypoints, in units of 12 mm; zero for the keypoints of our body. First x, y
/// and z of s for each keypoint, then those of d; see above.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeypointOffsets(pub [f64; OFFSETS]);

/// The prior of keypoint offsets.
#[derive(Clone, Debug, PartialEq)]
pub struct OffsetPrior {
    /// Means, in the units of [`KeypointOffsets`].
    pub means: [f64; OFFSETS],
    /// Relative precisions, no unit.
    pub precisions: [f64; OFFSETS],
}

impl OffsetPrior {
    /// The prior for detectors of a format: means where they were measured, else 0. Elbows, wrists, knees and ankles have higher precisions:
    /// detectors are most exact there, and a large offset would hide a wrong bone length.
    pub fn of(format: KeypointFormat) -> Self {
        let precise = |point| match (format, point) {
            (KeypointFormat::Halpe26, LElbow | LWrist) => 20.0,
            (_, LElbow | LWrist | LKnee | LAnkle) => 8.0,
            _ => 1.0,
        };
        let mean = |point, axis| match (format, point, axis) {
            // 27 mm below the knee joint were measured, on both sides of one performer. 0.7 of it is
            // the mean, since others may differ.
            (KeypointFormat::Halpe26, LKnee, 1) => -0.019 / UNIT,
            _ => 0.0,
        };
        let symmetric = |i: usize| i < SYMMETRIC_OFFSETS;
        let point = |i: usize| POINTS[i % SYMMETRIC_OFFSETS / 3];
        Self {
            means: from_fn(|i| if symmetric(i) { mean(point(i), i % 3) } else { 0.0 }),
            precisions: from_fn(|i| {
                precise(point(i)) * if symmetric(i) { 1.0 } else { EQUAL_SIDES }
            }),
        }
    }
}

impl KeypointOffsets {
    /// The offsets from their coordinates, metres.
    pub fn of_metres(metres: [f64; OFFSETS]) -> Self {
        Self(metres.map(|coordinate| coordinate / UNIT))
    }

    /// Root mean square of the symmetric coordinates, metres; 12 mm, the scale of the prior, if all are 0.
    pub fn root_mean_square(&self) -> f64 {
        let square: f64 = self.0[..SYMMETRIC_OFFSETS].iter().map(|offset| offset * offset).sum();
        let square = if square == 0.0 { 1.0 } else { square / SYMMETRIC_OFFSETS as f64 };
        UNIT * libm::sqrt(square)
    }

    /// The coordinates, metres.
    pub fn metres(&self) -> [f64; OFFSETS] {
        self.0.map(|coordinate| coordinate * UNIT)
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
    /// Sign of the half difference: 1 for left, 0 for middle, -1 for right.
    difference: f64,
}

impl Slot {
    /// `None` for keypoints that are not fitted.
    pub(super) fn of(keypoint: Keypoint) -> Option<Self> {
        let (left, side) = keypoint.of_left();
        let number = POINTS.iter().position(|&point| point == left)?;
        Some(Self { first: 3 * number, side, difference: keypoint.side() })
    }

    /// The offset, metres.
    pub(super) fn offset(self, offsets: &KeypointOffsets) -> Vector3<f64> {
        let [x, y, z] = [0, 1, 2].map(|axis| {
            let at = self.first + axis;
            (offsets.0[at] + self.difference * offsets.0[SYMMETRIC_OFFSETS + at]) * UNIT
        });
        Vector3::new(self.side * x, y, z)
    }

    /// Writes the derivative of [`Slot::offset`] by each coordinate of the offsets.
    pub(super) fn derivative(self, out: &mut [Vector3<f64>]) {
        for (first, sign) in [(self.first, 1.0), (SYMMETRIC_OFFSETS + self.first, self.difference)]
        {
            out[first].x = self.side * sign * UNIT;
            out[first + 1].y = sign * UNIT;
            out[first + 2].z = sign * UNIT;
        }
    }
}
