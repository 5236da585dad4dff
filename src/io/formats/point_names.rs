//! The names that programs give to points of the body.

use crate::core::detections::Keypoint;
use Keypoint as K;

/// The point that a name means, such as `left_shoulder`, `LShoulder`, `lshoulder` or `shoulder.L`.
pub(crate) fn keypoint_of(name: &str) -> Option<Keypoint> {
    let words = words(name);
    let is_side = |word: &String| matches!(word.as_str(), "l" | "left" | "r" | "right");
    let side = words.iter().find(|word| is_side(word)).and_then(|word| word.chars().next());
    let plain: String = words.iter().filter(|word| !is_side(word)).map(String::as_str).collect();
    // As one word: LShoulder, rknee.
    let joined = |side: char| Some((side, plain.strip_prefix(side)?));
    let (side, rest) = match (side, joined('l').or(joined('r'))) {
        (None, Some((side, rest))) if sided(rest, side).is_some() => (Some(side), rest),
        (side, _) => (side, plain.as_str()),
    };
    match (side, rest) {
        (Some(side), rest) => sided(rest, side),
        (None, "nose") => Some(K::Nose),
        (None, "head" | "headtop" | "tophead" | "topofhead") => Some(K::HeadTop),
        (None, "neck") => Some(K::Neck),
        (None, "upperneck") => Some(K::UpperNeck),
        (None, "hip" | "chip" | "midhip" | "hips" | "pelvis" | "root") => Some(K::MidHip),
        _ => None,
    }
}

/// The words of a name in small letters. A capital after a small letter begins one.
fn words(name: &str) -> Vec<String> {
    let mut words = Vec::<String>::new();
    let mut before = None;
    for c in name.chars() {
        if !c.is_alphanumeric() {
            before = None;
            continue;
        }
        if before.is_none_or(|before: char| c.is_uppercase() && !before.is_uppercase()) {
            words.push(String::new());
        }
        if let Some(word) = words.last_mut() {
            word.extend(c.to_lowercase());
        }
        before = Some(c);
    }
    words
}

/// A point of the left (`l`) or the right (`r`) side.
fn sided(name: &str, side: char) -> Option<Keypoint> {
    let [left, right] = match name {
        "eye" => [K::LEye, K::REye],
        "ear" => [K::LEar, K::REar],
        "shoulder" | "sho" => [K::LShoulder, K::RShoulder],
        "elbow" | "elb" => [K::LElbow, K::RElbow],
        "wrist" | "wri" => [K::LWrist, K::RWrist],
        "hip" => [K::LHip, K::RHip],
        "knee" => [K::LKnee, K::RKnee],
        "ankle" | "ank" => [K::LAnkle, K::RAnkle],
        "bigtoe" | "footindex" => [K::LBigToe, K::RBigToe],
        "smalltoe" => [K::LSmallToe, K::RSmallToe],
        "heel" => [K::LHeel, K::RHeel],
        _ => return None,
    };
    Some(if side == 'l' { left } else { right })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::detections::KeypointFormat;

    #[test]
    fn names_of_many_kinds_are_understood() {
        for format in KeypointFormat::ALL {
            for &point in format.keypoints() {
                assert_eq!(keypoint_of(&format!("{point:?}")), Some(point));
                assert_eq!(keypoint_of(&point.to_string()), Some(point));
            }
        }
        for (name, point) in [
            ("left_shoulder", K::LShoulder),
            ("shoulder.R", K::RShoulder),
            ("LEFT_HIP", K::LHip),
            ("rknee", K::RKnee),
            ("right-foot-index", K::RBigToe),
            ("Head", K::HeadTop),
            ("CHip", K::MidHip),
            ("RAnk", K::RAnkle),
            ("earRight", K::REar),
        ] {
            assert_eq!(keypoint_of(name), Some(point), "{name}");
        }
        for name in ["", "left", "tail", "shoulder", "leftnose", "left ear inner", "hipster", "L"] {
            assert_eq!(keypoint_of(name), None, "{name}");
        }
    }
}
