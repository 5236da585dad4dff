//! Keypoint formats and detections of a 2D detector.

use std::fmt;

use nalgebra::Point2;
use serde::{Deserialize, Serialize};

use crate::core::named;
use crate::core::time::{TIMES_NS, Timestamp};

named! {
    /// The order of a detector's keypoints.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    #[non_exhaustive]
    pub enum KeypointFormat {
        /// OpenPose BODY_25.
        Body25 = "body_25",
        /// OpenPose BODY_25B (experimental model: COCO order, upper neck and head top).
        Body25b = "body_25b",
        /// COCO, 17 points.
        Coco17 = "coco_17",
        /// HALPE, 26 points: COCO-17, head top, neck, hip, feet.
        Halpe26 = "halpe_26",
        /// COCO-WholeBody, 133 points; the body and the feet are used, face and hands are not.
        CocoWholebody133 = "coco_wholebody_133",
    }
}

/// An anatomical point, independent of its index in a format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[allow(missing_docs)]
pub enum Keypoint {
    Nose,
    LEye,
    REye,
    LEar,
    REar,
    HeadTop,
    /// Middle of the shoulders.
    Neck,
    /// Top of the neck, at the skull.
    UpperNeck,
    MidHip,
    LShoulder,
    RShoulder,
    LElbow,
    RElbow,
    LWrist,
    RWrist,
    LHip,
    RHip,
    LKnee,
    RKnee,
    LAnkle,
    RAnkle,
    LBigToe,
    RBigToe,
    LSmallToe,
    RSmallToe,
    LHeel,
    RHeel,
}

/// As `left big toe`.
impl fmt::Display for Keypoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut words = String::new();
        for c in format!("{self:?}").chars() {
            if c.is_uppercase() && !words.is_empty() {
                words.push(' ');
            }
            words.extend(c.to_lowercase());
        }
        match words.split_once(' ') {
            Some(("l", rest)) => write!(f, "left {rest}"),
            Some(("r", rest)) => write!(f, "right {rest}"),
            _ => f.write_str(&words),
        }
    }
}

impl Keypoint {
    /// 1 on the left, -1 on the right, 0 in the middle.
    pub fn side(self) -> f64 {
        match (self, self.of_left()) {
            (Nose | HeadTop | Neck | UpperNeck | MidHip, _) => 0.0,
            (_, (_, side)) => side,
        }
    }

    /// The left-side point that is this one or its mirror image, and the side: 1 for left and
    /// middle, -1 for right.
    pub fn of_left(self) -> (Self, f64) {
        let left = match self {
            REye => LEye,
            REar => LEar,
            RShoulder => LShoulder,
            RElbow => LElbow,
            RWrist => LWrist,
            RHip => LHip,
            RKnee => LKnee,
            RAnkle => LAnkle,
            RBigToe => LBigToe,
            RSmallToe => LSmallToe,
            RHeel => LHeel,
            _ => return (self, 1.0),
        };
        (left, -1.0)
    }
}

use Keypoint::*;

const BODY_25: [Keypoint; 25] = [
    Nose, Neck, RShoulder, RElbow, RWrist, LShoulder, LElbow, LWrist, MidHip, RHip, RKnee, RAnkle,
    LHip, LKnee, LAnkle, REye, LEye, REar, LEar, LBigToe, LSmallToe, LHeel, RBigToe, RSmallToe,
    RHeel,
];
const BODY_25B: [Keypoint; 25] = [
    Nose, LEye, REye, LEar, REar, LShoulder, RShoulder, LElbow, RElbow, LWrist, RWrist, LHip, RHip,
    LKnee, RKnee, LAnkle, RAnkle, UpperNeck, HeadTop, LBigToe, LSmallToe, LHeel, RBigToe,
    RSmallToe, RHeel,
];
const HALPE_26: [Keypoint; 26] = [
    Nose, LEye, REye, LEar, REar, LShoulder, RShoulder, LElbow, RElbow, LWrist, RWrist, LHip, RHip,
    LKnee, RKnee, LAnkle, RAnkle, HeadTop, Neck, MidHip, LBigToe, RBigToe, LSmallToe, RSmallToe,
    LHeel, RHeel,
];
/// COCO-17 (the first points) and the body and feet of COCO-WholeBody-133.
const COCO_FEET: [Keypoint; 23] = [
    Nose, LEye, REye, LEar, REar, LShoulder, RShoulder, LElbow, RElbow, LWrist, RWrist, LHip, RHip,
    LKnee, RKnee, LAnkle, RAnkle, LBigToe, LSmallToe, LHeel, RBigToe, RSmallToe, RHeel,
];

impl KeypointFormat {
    /// Number of points of a person in this format.
    #[allow(clippy::len_without_is_empty)] // A format always has points.
    pub const fn len(self) -> usize {
        match self {
            Self::CocoWholebody133 => 133,
            _ => self.keypoints().len(),
        }
    }

    /// The anatomical point of each index, in order. Points after the last one are not used.
    pub const fn keypoints(self) -> &'static [Keypoint] {
        match self {
            Self::Body25 => &BODY_25,
            Self::Body25b => &BODY_25B,
            Self::Coco17 => COCO_FEET.split_at(17).0,
            Self::Halpe26 => &HALPE_26,
            Self::CocoWholebody133 => &COCO_FEET,
        }
    }

    /// The index of an anatomical point in the format.
    pub fn index_of(self, keypoint: Keypoint) -> Option<usize> {
        self.keypoints().iter().position(|&k| k == keypoint)
    }
}

/// One detected point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detection {
    /// Pixels, OpenCV's pixel centres, as detected (distorted).
    pub pixel: Point2<f64>,
    /// In (0, 1]; larger detector scores count as 1.
    pub confidence: f64,
}

/// One detected person: a point for each index of the frame's format, `None` if not seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Person {
    /// The detector's own tracking id, if it has one.
    pub id: Option<i64>,
    /// `KeypointFormat::len` entries.
    pub points: Vec<Option<Detection>>,
}

/// The detections of one camera in one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Detections {
    /// Index of the camera in the rig.
    pub camera: usize,
    /// The camera's own frame counter.
    pub frame: u64,
    /// When the image was taken (middle of the exposure).
    pub capture: Timestamp,
    /// The order of the keypoints.
    pub format: KeypointFormat,
    /// In any order; empty if nobody was seen.
    pub people: Vec<Person>,
}

impl Detections {
    /// Why a frame cannot be used; `None` if it can.
    pub(crate) fn flaw(&self) -> Option<String> {
        let ns = self.capture.ns();
        if !TIMES_NS.contains(&ns) {
            let (least, most) = (TIMES_NS.start(), TIMES_NS.end());
            return Some(format!("its capture time {ns} ns is not from {least} to {most}"));
        }
        let (format, wanted) = (self.format.name(), self.format.len());
        let flaw = |person: &Person| {
            let count = person.points.len();
            if count != wanted {
                return Some(format!("a person has {count} points, {format} has {wanted}"));
            }
            let is_odd = |point: &Option<Detection>| {
                point.is_some_and(|Detection { pixel, confidence }| {
                    // In single precision, as messages have them.
                    let is_finite = |value: f64| (value as f32).is_finite();
                    !([pixel.x, pixel.y, confidence].into_iter().all(is_finite)
                        && confidence >= 0.0)
                })
            };
            let odd = person.points.iter().position(is_odd)?;
            Some(format!("point {odd} of a person is no finite pixel with a confidence"))
        };
        self.people.iter().find_map(flaw)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_round_trip_by_name_and_have_no_point_twice() {
        for format in KeypointFormat::ALL {
            assert_eq!(KeypointFormat::from_name(format.name()), Some(format));
            let mut points = format.keypoints().to_vec();
            points.sort();
            points.dedup();
            assert_eq!(points.len(), format.keypoints().len(), "{}", format.name());
        }
        assert_eq!(KeypointFormat::from_name("body_26"), None);
    }

    #[test]
    fn the_feet_of_wholebody_differ_in_order_from_halpe() {
        assert_eq!(KeypointFormat::CocoWholebody133.index_of(LHeel), Some(19));
        assert_eq!(KeypointFormat::Halpe26.index_of(LHeel), Some(24));
        assert_eq!(KeypointFormat::Coco17.index_of(LHeel), None);
    }
}
