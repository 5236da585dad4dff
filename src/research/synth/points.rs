//! Properties of keypoints for the noise model: limb, mirrored point, difficulty.

use crate::core::detections::Keypoint;

/// A pair of limbs.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Region {
    Arm,
    Leg,
}

/// The limb that a point is on: region, and 0 for left or 1 for right. `None` if on no limb.
pub(super) fn limb_of(keypoint: Keypoint) -> Option<(Region, usize)> {
    use Keypoint as K;
    Some(match keypoint {
        K::LElbow | K::LWrist => (Region::Arm, 0),
        K::RElbow | K::RWrist => (Region::Arm, 1),
        K::LKnee | K::LAnkle | K::LBigToe | K::LSmallToe | K::LHeel => (Region::Leg, 0),
        K::RKnee | K::RAnkle | K::RBigToe | K::RSmallToe | K::RHeel => (Region::Leg, 1),
        _ => return None,
    })
}

/// The same point on the other side; points that are on no limb stay.
pub(super) fn mirrored(keypoint: Keypoint) -> Keypoint {
    use Keypoint as K;
    const PAIRS: [(Keypoint, Keypoint); 7] = [
        (K::LElbow, K::RElbow),
        (K::LWrist, K::RWrist),
        (K::LKnee, K::RKnee),
        (K::LAnkle, K::RAnkle),
        (K::LBigToe, K::RBigToe),
        (K::LSmallToe, K::RSmallToe),
        (K::LHeel, K::RHeel),
    ];
    PAIRS
        .into_iter()
        .find_map(|(l, r)| match keypoint {
            k if k == l => Some(r),
            k if k == r => Some(l),
            _ => None,
        })
        .unwrap_or(keypoint)
}

/// Jitter of a point relative to a limb's points.
pub(super) fn difficulty(keypoint: Keypoint) -> f64 {
    use Keypoint as K;
    match keypoint {
        K::Nose | K::LEye | K::REye | K::LEar | K::REar => 0.6,
        K::HeadTop | K::Neck | K::UpperNeck => 0.9,
        K::LHip | K::RHip | K::MidHip => 1.5,
        K::LShoulder | K::RShoulder => 0.9,
        _ => 1.0,
    }
}

/// Position of a point along its limb: 1 at the end.
pub(super) fn along(keypoint: Keypoint) -> f64 {
    use Keypoint as K;
    match keypoint {
        K::LElbow | K::RElbow | K::LKnee | K::RKnee => 0.5,
        _ => 1.0,
    }
}
