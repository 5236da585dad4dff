//! What the triangulated performer says of the whole recording: scale, up axis, sides, keypoint order.

use nalgebra::Vector3;

use super::consensus::Points;
use super::footage::POINTS;
use super::hypotheses::Finding;
use crate::core::detections::Keypoint;
use crate::core::points::median;
use Keypoint::{
    LAnkle, LBigToe, LElbow, LHeel, LHip, LKnee, LShoulder, LWrist, RAnkle, RBigToe, RElbow, RHeel,
    RHip, RKnee, RShoulder, RWrist,
};

/// Trunk, thigh and shank together, as a part of the height \[Winter 2009\].
const TRUNK_AND_LEG: f64 = 0.779;
/// Heights of performers, metres.
const HEIGHTS_M: std::ops::RangeInclusive<f64> = 1.2..=2.3;
/// The trunk points along an axis if its direction has this component on it.
const ALONG: f64 = 0.85;
/// Units that a calibration may be in, metres.
const UNITS: [(f64, &str); 6] = [
    (1.0, "metres"),
    (0.001, "millimetres"),
    (0.01, "centimetres"),
    (0.0254, "inches"),
    (0.3048, "feet"),
    (1000.0, "kilometres"),
];
/// Mean height of adults, metres.
const USUAL_M: f64 = 1.72;
/// Largest |ln(height / mean)| of an adult: 1.45 to 2.04 m.
const ADULTS: f64 = 0.17;

/// The knees are bent if they are further than this from the middle of hip and ankle: the sum of both, as a part of
/// the trunk's length.
const BENT: f64 = 0.2;

fn at(points: &Points, point: Keypoint) -> Option<Vector3<f64>> {
    points[POINTS.iter().position(|other| *other == point)?]
}

fn middle(points: &Points, a: Keypoint, b: Keypoint) -> Option<Vector3<f64>> {
    Some((at(points, a)? + at(points, b)?) / 2.0)
}

/// From the middle of the hips to that of the shoulders.
fn trunk(points: &Points) -> Option<Vector3<f64>> {
    Some(middle(points, LShoulder, RShoulder)? - middle(points, LHip, RHip)?)
}

fn medians(frames: &[Points], value: impl Fn(&Points) -> Option<f64>) -> Option<f64> {
    median(&mut frames.iter().filter_map(value).collect::<Vec<f64>>())
}

fn length(frames: &[Points], a: Keypoint, b: Keypoint) -> Option<f64> {
    medians(frames, |points| Some((at(points, a)? - at(points, b)?).norm()))
}

/// How far a height, metres, is from the mean of adults: |ln(height / mean)|.
pub(super) fn oddness(height: f64) -> f64 {
    libm::log(height / USUAL_M).abs()
}

/// The performer's height by the median lengths of trunk, thigh and shank, metres.
pub(super) fn height_m(frames: &[Points]) -> Option<f64> {
    let trunk = medians(frames, |points| Some(trunk(points)?.norm()))?;
    let leg = [(LHip, LKnee), (RHip, RKnee), (LKnee, LAnkle), (RKnee, RAnkle)];
    let leg = leg.map(|(a, b)| length(frames, a, b));
    let leg: f64 = leg.into_iter().sum::<Option<f64>>()? / 2.0;
    Some((trunk + leg) / TRUNK_AND_LEG)
}

/// What is wrong with a performer that so many cameras see.
pub(super) fn findings(frames: &[Points], cameras: usize) -> Vec<Finding> {
    let height = height_m(frames);
    // Two opposite cameras hardly tell where the feet point.
    let sides = if cameras > 2 { sides(frames) } else { None };
    let all = [height.and_then(scale), up(frames).and_then(upright), sides];
    all.into_iter().flatten().collect()
}

fn scale(height: f64) -> Option<Finding> {
    if HEIGHTS_M.contains(&height) {
        return None;
    }
    let (is, factor) = match unit(height) {
        Some((metres, unit)) if metres != 1.0 => {
            (format!("the calibration is in {unit}"), 1.0 / metres)
        }
        _ => {
            let factor = height / USUAL_M;
            (format!("the calibration has {factor:.2} times the right scale"), factor)
        }
    };
    let what = format!("the performer is {height:.2} m high: {is}");
    let fix = format!("divide all translations by {factor:.4}; metres are needed");
    Some(Finding::new("scale", what, fix))
}

/// The unit, metres, in which a performer of such a height is an adult.
pub(super) fn unit(height: f64) -> Option<(f64, &'static str)> {
    let off = |metres: f64| oddness(height * metres);
    let nearest = UNITS.into_iter().min_by(|a, b| off(a.0).total_cmp(&off(b.0)));
    nearest.filter(|(metres, _)| off(*metres) < ADULTS)
}

/// The direction from hips to shoulders: medians of unit vectors, so the more it changes the shorter.
pub(super) fn up(frames: &[Points]) -> Option<[f64; 3]> {
    let along = |axis: usize| medians(frames, |p| Some(trunk(p)?.try_normalize(1e-9)?[axis]));
    Some([along(0)?, along(1)?, along(2)?])
}

/// The trunk points along another axis than y.
fn upright(up: [f64; 3]) -> Option<Finding> {
    let axis = (0..3).find(|axis| up[*axis].abs() > ALONG)?;
    if axis == 1 && up[axis] > 0.0 {
        return None;
    }
    let along = format!("{}{}", if up[axis] < 0.0 { "-" } else { "" }, ["x", "y", "z"][axis]);
    let fix = format!(
        "if the performer stands upright and no --up was given: give --up {along} to check and solve; else give another --up"
    );
    let what = format!("the performer is not upright: {along} points from hips to shoulders");
    Some(Finding::new("up_axis", what, fix))
}

/// The feet, or else the bent knees, point backwards if left and right are exchanged.
fn sides(frames: &[Points]) -> Option<Finding> {
    let forwards = |of: &dyn Fn(&Points) -> Option<Vector3<f64>>| {
        medians(frames, |points| {
            let left = at(points, LHip)? - at(points, RHip)?;
            let forwards = left.cross(&trunk(points)?).try_normalize(1e-9)?;
            Some(forwards.dot(&of(points)?.try_normalize(1e-9)?))
        })
    };
    let feet = |points: &Points| {
        let foot = |heel, ankle, toe| {
            let heel = at(points, heel).or_else(|| at(points, ankle))?;
            Some(at(points, toe)? - heel)
        };
        Some(foot(LHeel, LAnkle, LBigToe)? + foot(RHeel, RAnkle, RBigToe)?)
    };
    let knees = |points: &Points| {
        let knee = |hip, knee, ankle| Some(at(points, knee)? - middle(points, hip, ankle)?);
        let bent = knee(LHip, LKnee, LAnkle)? + knee(RHip, RKnee, RAnkle)?;
        Some(bent).filter(|bent| bent.norm() > BENT * trunk(points).unwrap_or_default().norm())
    };
    let feet = forwards(&feet).map(|part| ("feet point", part));
    // If the legs are straight, only some frames with large errors look bent.
    let bent = frames.iter().filter(|points| knees(points).is_some()).count();
    let bends = || Some(("knees bend", forwards(&knees).filter(|_| 5 * bent > frames.len())?));
    let (who, part) = feet.or_else(bends)?;
    (part < -0.3).then(|| {
        let what = format!("the {who} backwards: left and right are exchanged in all cameras");
        let fix = "check the keypoint order, and whether all images or the world are mirrored";
        Finding::new("sides_exchanged", what, fix)
    })
}

/// Limbs, and their lengths as a part of the height \[Winter 2009\].
const LIMBS: [(Keypoint, Keypoint, f64); 10] = [
    (LHip, LKnee, 0.245),
    (RHip, RKnee, 0.245),
    (LKnee, LAnkle, 0.246),
    (RKnee, RAnkle, 0.246),
    (LShoulder, LElbow, 0.186),
    (RShoulder, RElbow, 0.186),
    (LElbow, LWrist, 0.146),
    (RElbow, RWrist, 0.146),
    (LShoulder, LHip, 0.288),
    (RShoulder, RHip, 0.288),
];

/// Fewer limbs say nothing.
const LEAST_LIMBS: usize = 6;

/// How strange the limbs are, no unit: the median change of their lengths over time as a part of the lengths, plus the RMS
/// of the logarithms of their proportions against usual ones. Large if the keypoints are in another order than declared.
pub(super) fn strangeness(frames: &[Points]) -> Option<f64> {
    let of_limb = |(a, b, part): (Keypoint, Keypoint, f64)| {
        let usual = length(frames, a, b)?.max(1e-12);
        let off = |p: &Points| Some(((at(p, a)? - at(p, b)?).norm() - usual).abs());
        Some((medians(frames, off)? / usual, libm::log(usual / part)))
    };
    let (mut changes, heights): (Vec<f64>, Vec<f64>) =
        LIMBS.into_iter().filter_map(of_limb).unzip();
    if changes.len() < LEAST_LIMBS {
        return None;
    }
    let mean = heights.iter().sum::<f64>() / heights.len() as f64;
    let squares = heights.iter().map(|height| (height - mean) * (height - mean)).sum::<f64>();
    Some(median(&mut changes)? + libm::sqrt(squares / heights.len() as f64))
}
