//! Cuts test sequences from motions: a section within the cameras' view, on a random body.

use nalgebra::Vector3;

use super::body::{Body, Places};
use super::motion::about_y;
use super::protocol::SequenceChoice;
use super::skinned::Skinned;
use crate::core::body::{
    FASTEST, JOINTS, Joint, Pose, SHAPE_COEFFICIENTS, SYMMETRIC_SHAPE, Shape, Skeleton,
};
use crate::core::detections::Keypoint;
use crate::core::random::Draws;

/// Separates these draws from others with the same seed.
const STREAM: u64 = 0x7365_7175_656e_6365;
/// Keys of the random draws.
mod topic {
    pub(super) const SHAPE: u64 = 0;
    pub(super) const HEADING: u64 = 1;
    pub(super) const SKINNED: u64 = 2;
}

/// Largest plausible mean acceleration of the pelvis, m/s^2: 4 times free fall, twice that of a
/// runner.
const MOST_ACCELERATION: f64 = 40.0;

/// Points that touch the floor.
const SOLE: [Keypoint; 6] = [
    Keypoint::LBigToe,
    Keypoint::RBigToe,
    Keypoint::LSmallToe,
    Keypoint::RSmallToe,
    Keypoint::LHeel,
    Keypoint::RHeel,
];

/// A section of a motion on a body.
#[derive(Clone, Debug)]
pub struct Sequence {
    /// The body.
    pub skeleton: Skeleton,
    /// Where detectors see its keypoints.
    pub places: Places,
    /// Poses at the motion's own frame rate, around the origin.
    pub poses: Vec<Pose>,
    /// Index of the first pose in the motion.
    pub first: usize,
    /// Number of frames at `choice.fps`, for [`Recording`](super::Recording) with
    /// [`through`](super::through)`(poses, source_fps)` as its motion.
    pub frames: u64,
}

/// A test sequence from poses at `source_fps` (y up, metres, on the mean body).
///
/// - Body, by its kind: ten random shape coefficients, normal and clipped; the motion's own skeleton,
///   `foreign`; or one of the bodies with a skin, at random. The motion of the pelvis is scaled by the
///   length of the legs. The lower foot stands on the floor: the lowest tenth of the soles' lower ends
///   is below y = 0, on the mean body and on this one.
/// - Section: at most `choice.seconds` long, within `choice.radius_m` of its own middle, nearest to
///   the middle of the motion; if there is none, the longest shorter one. It contains no jump (a
///   joint faster than 15 m/s), and the pelvis accelerates by at most 40 m/s^2 in the mean: beyond
///   that the capture is broken.
/// - Placement: the middle of the section is the origin, with a random heading.
///
/// The same seed gives the same sequence. `None` if no section of `choice.least_seconds` is left, or if
/// a foreign body is asked for and there is none.
pub fn sequence(
    poses: &[Pose],
    source_fps: f64,
    choice: &SequenceChoice,
    seed: u64,
    foreign: Option<&Skeleton>,
) -> Option<Sequence> {
    let draws = Draws { seed, stream: STREAM };
    let mean = Skeleton::default();
    let (skeleton, places) = match choice.body {
        Body::Own => (Skeleton::new(shape(&draws, choice)), Places::Own),
        Body::Foreign => (foreign?.clone(), Places::Foreign),
        Body::Skinned => {
            let all = Skinned::all();
            let body = all.get((all.len() as f64 * draws.uniform(topic::SKINNED, 0)) as usize)?;
            (body.skeleton.clone(), Places::Skinned(body))
        }
    };
    let scale = match choice.body {
        Body::Own => standing_height(&skeleton) / standing_height(&mean),
        Body::Foreign | Body::Skinned => leg(&skeleton) / leg(&mean),
    };
    let mut scaled: Vec<Pose> = poses.to_vec();
    let floor = floor(&scaled, &mean, Places::Own)?;
    for pose in &mut scaled {
        pose.root_position.y -= floor;
        pose.root_position *= scale;
    }
    let jumps = jumps(&scaled, &skeleton, source_fps);
    let (first, count, middle) = section(&scaled, &jumps, source_fps, choice)?;
    let mut poses = scaled.split_off(first);
    poses.truncate(count);

    let lift = self::floor(&poses, &skeleton, places)?;
    let turn = about_y(std::f64::consts::TAU * draws.uniform(topic::HEADING, 0));
    for pose in &mut poses {
        pose.root_position = turn * (pose.root_position - middle - Vector3::y() * lift);
        pose.root_rotation = turn * pose.root_rotation;
    }
    let frames = ((count - 1) as f64 / source_fps * choice.fps + 1e-6).floor() as u64 + 1;
    Some(Sequence { skeleton, places, poses, first, frames })
}

fn shape(draws: &Draws, choice: &SequenceChoice) -> Shape {
    let mut values = [0.0; SHAPE_COEFFICIENTS];
    for (pair, values) in values[..SYMMETRIC_SHAPE].chunks_mut(2).enumerate() {
        for (value, normal) in values.iter_mut().zip(draws.normals(topic::SHAPE, pair as u64)) {
            *value = (choice.shape_spread * normal).clamp(-choice.shape_limit, choice.shape_limit);
        }
    }
    Shape(values)
}

/// Height of the pelvis above the ankles in the rest pose, metres.
fn standing_height(skeleton: &Skeleton) -> f64 {
    -[Joint::LHip, Joint::LKnee, Joint::LAnkle].iter().map(|&j| skeleton.offset(j).y).sum::<f64>()
}

/// Length of a leg, metres: thigh and shank, by which clips are scaled.
fn leg(skeleton: &Skeleton) -> f64 {
    skeleton.offset(Joint::LKnee).norm() + skeleton.offset(Joint::LAnkle).norm()
}

/// Height of the floor: the lowest tenth of the soles' lowest points is below it.
fn floor(poses: &[Pose], skeleton: &Skeleton, places: Places) -> Option<f64> {
    let mut lowest: Vec<f64> = (poses.iter())
        .map(|pose| {
            let posture = pose.posture(skeleton);
            SOLE.map(|k| places.of(k, skeleton, &posture).0.y).into_iter().fold(f64::MAX, f64::min)
        })
        .collect();
    lowest.sort_by(f64::total_cmp);
    lowest.get(lowest.len() / 10).copied()
}

/// First pose and number of poses of the section, and the middle of its path on the floor.
fn section(
    poses: &[Pose],
    jumps: &[bool],
    fps: f64,
    choice: &SequenceChoice,
) -> Option<(usize, usize, Vector3<f64>)> {
    let frames = |seconds: f64| (seconds * fps).round() as usize;
    let step = frames(0.1).max(1);
    let least = frames(choice.least_seconds).max(2);
    let mut count = frames(choice.seconds).min(poses.len());
    while count >= least {
        let centre = (poses.len() - count) / 2;
        let mut starts: Vec<usize> = (0..=poses.len() - count).step_by(step).collect();
        starts.sort_by_key(|start| start.abs_diff(centre));
        let found = starts.into_iter().find_map(|first| {
            if jumps[first + 1..first + count].contains(&true) {
                return None;
            }
            let section = &poses[first..first + count];
            let middle = middle_within(section, choice.radius_m)?;
            let possible = mean_acceleration(section, fps) <= MOST_ACCELERATION;
            possible.then_some((first, count, middle))
        });
        if found.is_some() {
            return found;
        }
        count = count.checked_sub(step)?;
    }
    None
}

/// For each pose: whether a joint moves faster than people can, from the pose before to this one.
fn jumps(poses: &[Pose], skeleton: &Skeleton, fps: f64) -> Vec<bool> {
    let positions: Vec<_> = poses.iter().map(|pose| pose.posture(skeleton).positions).collect();
    let is_jump = |pair: &[[Vector3<f64>; JOINTS]]| {
        pair[0].iter().zip(&pair[1]).any(|(a, b)| (b - a).norm() * fps > FASTEST)
    };
    std::iter::once(false).chain(positions.windows(2).map(is_jump)).collect()
}

/// Mean acceleration of the pelvis, m/s^2.
fn mean_acceleration(poses: &[Pose], fps: f64) -> f64 {
    let bend = |three: &[Pose]| {
        let [a, b, c] = [0, 1, 2].map(|at| three[at].root_position);
        (c - 2.0 * b + a).norm() * fps * fps
    };
    poses.windows(3).map(bend).sum::<f64>() / poses.len().saturating_sub(2).max(1) as f64
}

/// The middle of the bounding box of the pelvis path on the floor, if the path stays within
/// `radius` of it.
fn middle_within(poses: &[Pose], radius: f64) -> Option<Vector3<f64>> {
    let on_floor = |pose: &Pose| Vector3::new(pose.root_position.x, 0.0, pose.root_position.z);
    let bounds = poses.iter().map(|p| (on_floor(p), on_floor(p)));
    let (low, high) = bounds.reduce(|a, b| (a.0.inf(&b.0), a.1.sup(&b.1)))?;
    let middle = (low + high) / 2.0;
    poses.iter().all(|p| (on_floor(p) - middle).norm() <= radius).then_some(middle)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_section_contains_a_jump() {
        let at = |x: f64| {
            let mut pose = Pose::rest();
            pose.root_position = Vector3::new(x, 0.9, 0.0);
            pose
        };
        let mut poses: Vec<Pose> = (0..200).map(|frame| at(0.005 * f64::from(frame))).collect();
        let choice = SequenceChoice { least_seconds: 1.0, ..SequenceChoice::default() };
        assert_eq!(sequence(&poses, 60.0, &choice, 1, None).unwrap().first, 0);
        poses[0] = at(-0.5);
        let cut = sequence(&poses, 60.0, &choice, 1, None).unwrap();
        assert!(cut.first >= 1 && cut.poses.len() > 180, "{} {}", cut.first, cut.poses.len());
        poses[100] = at(9.0);
        let cut = sequence(&poses, 60.0, &choice, 1, None).unwrap();
        assert!(cut.first > 100 || cut.first + cut.poses.len() <= 100, "{}", cut.first);
    }

    #[test]
    fn a_section_with_implausible_acceleration_is_skipped() {
        let choice = SequenceChoice { least_seconds: 1.0, ..SequenceChoice::default() };
        // Three oscillations a second: at most 36 and 90 m/s^2, 23 and 57 in the mean.
        let shaken = |height: f64| {
            let at = |frame: u32| {
                let mut pose = Pose::rest();
                let phase = 6.0 * std::f64::consts::PI * f64::from(frame) / 60.0;
                pose.root_position = Vector3::y() * (0.9 + height * phase.sin());
                pose
            };
            let poses: Vec<Pose> = (0..200).map(at).collect();
            sequence(&poses, 60.0, &choice, 1, None)
        };
        assert!(shaken(0.1).is_some());
        assert!(shaken(0.25).is_none());
    }
}
