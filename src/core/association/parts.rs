//! The parts of a body that go to a performer one by one, and arrays by keypoint.

use nalgebra::{Vector2, Vector3};

use crate::core::body::{Attachment, Pose, Skeleton};
use crate::core::detections::{Detections, Keypoint, Person};

use Keypoint as K;

/// Number of keypoints: the length of arrays by keypoint.
pub const KEYPOINTS: usize = K::RHeel as usize + 1;
/// Points of a body by `Keypoint as usize`, world, metres.
pub type Points = [Option<Vector3<f64>>; KEYPOINTS];
/// Points in an image by `Keypoint as usize`, pixels.
pub type Pixels = [Option<Vector2<f64>>; KEYPOINTS];

/// A part of the body. A detector may give parts of one person to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Head and shoulders.
    Upper,
    /// Both hips.
    Hips,
    /// Elbow and wrist.
    LeftArm,
    /// Elbow and wrist.
    RightArm,
    /// Knee, ankle, foot.
    LeftLeg,
    /// Knee, ankle, foot.
    RightLeg,
}

impl Part {
    /// All parts, in the order of `Part as usize`.
    pub const ALL: [Self; 6] =
        [Self::Upper, Self::Hips, Self::LeftArm, Self::RightArm, Self::LeftLeg, Self::RightLeg];

    /// The part that a keypoint is on.
    pub fn of(keypoint: Keypoint) -> Self {
        match keypoint {
            K::LHip | K::RHip | K::MidHip => Self::Hips,
            K::LElbow | K::LWrist => Self::LeftArm,
            K::RElbow | K::RWrist => Self::RightArm,
            K::LKnee | K::LAnkle | K::LBigToe | K::LSmallToe | K::LHeel => Self::LeftLeg,
            K::RKnee | K::RAnkle | K::RBigToe | K::RSmallToe | K::RHeel => Self::RightLeg,
            _ => Self::Upper,
        }
    }

    /// The keypoints that are compared: those that the body is fitted to.
    pub(super) const fn compared(self) -> &'static [Keypoint] {
        match self {
            Self::Upper => &[
                K::Nose,
                K::LEye,
                K::REye,
                K::LEar,
                K::REar,
                K::HeadTop,
                K::LShoulder,
                K::RShoulder,
            ],
            Self::Hips => &[K::LHip, K::RHip],
            Self::LeftArm => &[K::LElbow, K::LWrist],
            Self::RightArm => &[K::RElbow, K::RWrist],
            Self::LeftLeg => &[K::LKnee, K::LAnkle, K::LBigToe, K::LSmallToe, K::LHeel],
            Self::RightLeg => &[K::RKnee, K::RAnkle, K::RBigToe, K::RSmallToe, K::RHeel],
        }
    }

    /// The same part of the other side.
    pub(super) fn twin(self) -> Self {
        match self {
            Self::LeftArm => Self::RightArm,
            Self::RightArm => Self::LeftArm,
            Self::LeftLeg => Self::RightLeg,
            Self::RightLeg => Self::LeftLeg,
            other => other,
        }
    }

    /// Weight in the decision whose a detection is: the trunk decides.
    pub(super) fn weight(self) -> f64 {
        match self {
            Self::Upper => 3.0,
            Self::Hips => 2.0,
            _ => 1.0,
        }
    }
}

/// The keypoints of a body in a pose; those that are not fitted are `None`.
pub fn points_of(pose: &Pose, skeleton: &Skeleton) -> Points {
    let posture = pose.posture(skeleton);
    let mut points = [None; KEYPOINTS];
    for &keypoint in Part::ALL.into_iter().flat_map(Part::compared) {
        points[keypoint as usize] = Some(Attachment::of(keypoint).position(&posture, skeleton));
    }
    points
}

/// The fitted points of a detected person with at least this confidence.
pub fn pixels_of(frame: &Detections, person: &Person, min_confidence: f64) -> Pixels {
    let mut pixels = [None; KEYPOINTS];
    for (keypoint, seen) in frame.format.keypoints().iter().zip(&person.points) {
        let is_compared = Part::of(*keypoint).compared().contains(keypoint);
        let seen = seen.filter(|seen| is_compared && seen.confidence >= min_confidence);
        pixels[*keypoint as usize] = seen.map(|seen| seen.pixel.coords);
    }
    pixels
}

/// A box in the image, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Bounds {
    pub(super) low: Vector2<f64>,
    pub(super) high: Vector2<f64>,
}

impl Bounds {
    /// `None` without points.
    pub(super) fn of(pixels: &Pixels) -> Option<Self> {
        let mut points = pixels.iter().flatten();
        let first = *points.next()?;
        let start = Self { low: first, high: first };
        Some(
            points.fold(start, |all, point| Self {
                low: all.low.inf(point),
                high: all.high.sup(point),
            }),
        )
    }

    /// The longer side.
    pub(super) fn extent(&self) -> f64 {
        (self.high - self.low).max()
    }

    /// Whether the boxes come within `margin` of each other.
    pub(super) fn is_near(&self, other: &Self, margin: f64) -> bool {
        let gap = (other.low - self.high).sup(&(self.low - other.high));
        gap.max() <= margin
    }

    pub(super) fn middle(&self) -> Vector2<f64> {
        (self.low + self.high) / 2.0
    }

    pub(super) fn contains(&self, point: &Vector2<f64>) -> bool {
        self.is_near(&Self { low: *point, high: *point }, 0.0)
    }
}
