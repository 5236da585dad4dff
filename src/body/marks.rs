//! Where a detector marks points, against where our body has them.
//!
//! Each detector has a habit of its own: knees a little to the front, hips too high. A mark is an
//! offset of a point in its joint's frame, the same in every view and all the time; those of left
//! and right mirror each other, since detectors are trained on mirrored images.

use nalgebra::Vector3;

use crate::detect::Keypoint;

/// Points that have a mark: those of the left side and of the middle.
const POINTS: usize = 13;

/// Numbers of all marks.
pub const MARKS: usize = 3 * POINTS;

/// Metres of a coordinate of 1.
const UNIT: f64 = 0.012;

/// Marks of all points, in units of 12 mm; all zero is where our body has them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Marks(pub [f64; MARKS]);

impl Default for Marks {
    fn default() -> Self {
        Self([0.0; MARKS])
    }
}

/// Which mark a point has.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Slot {
    first: usize,
    /// 1 for left and middle, -1 for right: the sign of x.
    side: f64,
}

impl Slot {
    /// `None` for points that are not fitted.
    pub(super) fn of(keypoint: Keypoint) -> Option<Self> {
        use Keypoint as K;
        let (number, side) = match keypoint {
            K::Nose => (0, 1.0),
            K::LEye => (1, 1.0),
            K::REye => (1, -1.0),
            K::LEar => (2, 1.0),
            K::REar => (2, -1.0),
            K::HeadTop => (3, 1.0),
            K::LShoulder => (4, 1.0),
            K::RShoulder => (4, -1.0),
            K::LElbow => (5, 1.0),
            K::RElbow => (5, -1.0),
            K::LWrist => (6, 1.0),
            K::RWrist => (6, -1.0),
            K::LHip => (7, 1.0),
            K::RHip => (7, -1.0),
            K::LKnee => (8, 1.0),
            K::RKnee => (8, -1.0),
            K::LAnkle => (9, 1.0),
            K::RAnkle => (9, -1.0),
            K::LBigToe => (10, 1.0),
            K::RBigToe => (10, -1.0),
            K::LSmallToe => (11, 1.0),
            K::RSmallToe => (11, -1.0),
            K::LHeel => (12, 1.0),
            K::RHeel => (12, -1.0),
            K::Neck | K::UpperNeck | K::MidHip => return None,
        };
        Some(Self { first: 3 * number, side })
    }

    /// The offset in the joint's frame, metres.
    pub(super) fn offset(self, marks: &Marks) -> Vector3<f64> {
        let [x, y, z] = [0, 1, 2].map(|axis| marks.0[self.first + axis] * UNIT);
        Vector3::new(self.side * x, y, z)
    }

    /// Writes the derivative of [`Slot::offset`] by each number of the marks.
    pub(super) fn derivative(self, out: &mut [Vector3<f64>]) {
        out[self.first].x = self.side * UNIT;
        out[self.first + 1].y = UNIT;
        out[self.first + 2].z = UNIT;
    }
}
