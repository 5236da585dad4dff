//! Test sequences of given motions: a stretch within the cameras' reach, on a body of its own.

use nalgebra::Vector3;

use super::detector::position;
use super::motion::about_y;
use super::protocol::SequenceChoice;
use crate::core::body::{FASTEST, JOINTS, Joint, Pose, SHAPE_COEFFICIENTS, Shape, Skeleton};
use crate::core::detections::Keypoint;
use crate::core::random::Draws;

/// Sets these draws apart from others of the same seed.
const STREAM: u64 = 0x7365_7175_656e_6365;
/// Which number is for what.
mod topic {
    pub(super) const SHAPE: u64 = 0;
    pub(super) const HEADING: u64 = 1;
}

/// A pelvis does not accelerate more than this in the mean, m/s^2: what falls has a quarter of it, who
/// runs half.
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

/// A stretch of a motion on a body.
#[derive(Clone, Debug)]
pub struct Sequence {
    /// The body.
    pub skeleton: Skeleton,
    /// Poses at the motion's own frame rate, around the origin.
    pub poses: Vec<Pose>,
    /// Frame of the motion that the first pose is.
    pub first: usize,
    /// Frames at the wanted frame rate, for [`Recording`](super::Recording) with
    /// [`through`](super::through)`(poses, source_fps)` as its motion.
    pub frames: u64,
}

/// A test sequence from poses at `source_fps` (y up, metres, on the mean body).
///
/// The body's shape is drawn: ten normal coefficients, clipped. The pelvis moves as far as the body's
/// legs are long, and the lower foot stands on the floor (the lowest tenth of the soles' lower
/// ends lies below y = 0, on the mean body and on this one). Of the motion the stretch of at most
/// `choice.seconds` is taken that stays within `choice.radius_m` of its own middle: that nearest to
/// the middle of the motion, or where there is none, the longest shorter one. Its middle is moved to
/// the origin, and the whole turned by a drawn angle. No stretch goes over a leap, where a joint is faster
/// than 15 m/s, and in none the pelvis accelerates by more than 40 m/s^2 in the mean: such a capture is
/// broken. The same seed gives the same sequence.
///
/// `None` where no stretch of `choice.least_seconds` is left.
pub fn sequence(
    poses: &[Pose],
    source_fps: f64,
    choice: &SequenceChoice,
    seed: u64,
) -> Option<Sequence> {
    let draws = Draws { seed, stream: STREAM };
    let skeleton = Skeleton::new(shape(&draws, choice));
    let mean = Skeleton::default();
    let scale = standing_height(&skeleton) / standing_height(&mean);
    let mut scaled: Vec<Pose> = poses.to_vec();
    let floor = floor(&scaled, &mean)?;
    for pose in &mut scaled {
        pose.root_position.y -= floor;
        pose.root_position *= scale;
    }
    let leaps = leaps(&scaled, &skeleton, source_fps);
    let (first, count, middle) = stretch(&scaled, &leaps, source_fps, choice)?;
    let mut poses = scaled.split_off(first);
    poses.truncate(count);

    let lift = self::floor(&poses, &skeleton)?;
    let turn = about_y(std::f64::consts::TAU * draws.uniform(topic::HEADING, 0));
    for pose in &mut poses {
        pose.root_position = turn * (pose.root_position - middle - Vector3::y() * lift);
        pose.root_rotation = turn * pose.root_rotation;
    }
    let frames = ((count - 1) as f64 / source_fps * choice.fps + 1e-6).floor() as u64 + 1;
    Some(Sequence { skeleton, poses, first, frames })
}

fn shape(draws: &Draws, choice: &SequenceChoice) -> Shape {
    let mut values = [0.0; SHAPE_COEFFICIENTS];
    for (pair, values) in values.chunks_mut(2).enumerate() {
        for (value, normal) in values.iter_mut().zip(draws.normals(topic::SHAPE, pair as u64)) {
            *value = (choice.shape_spread * normal).clamp(-choice.shape_limit, choice.shape_limit);
        }
    }
    Shape(values)
}

/// Of the pelvis above the ankles in the rest pose, metres.
fn standing_height(skeleton: &Skeleton) -> f64 {
    -[Joint::LHip, Joint::LKnee, Joint::LAnkle].iter().map(|&j| skeleton.offset(j).y).sum::<f64>()
}

/// Height of the floor: the lowest tenth of the soles' lowest points lies below it.
fn floor(poses: &[Pose], skeleton: &Skeleton) -> Option<f64> {
    let mut lowest: Vec<f64> = (poses.iter())
        .map(|pose| {
            let posture = pose.posture(skeleton);
            SOLE.map(|k| position(k, skeleton, &posture).y).into_iter().fold(f64::MAX, f64::min)
        })
        .collect();
    lowest.sort_by(f64::total_cmp);
    lowest.get(lowest.len() / 10).copied()
}

/// First pose, number of poses, and the middle of the path on the floor.
fn stretch(
    poses: &[Pose],
    leaps: &[bool],
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
            if leaps[first + 1..first + count].contains(&true) {
                return None;
            }
            let stretch = &poses[first..first + count];
            let middle = middle_within(stretch, choice.radius_m)?;
            let possible = mean_acceleration(stretch, fps) <= MOST_ACCELERATION;
            possible.then_some((first, count, middle))
        });
        if found.is_some() {
            return found;
        }
        count = count.checked_sub(step)?;
    }
    None
}

/// Whether a joint is faster than people are from the pose before to this one.
fn leaps(poses: &[Pose], skeleton: &Skeleton, fps: f64) -> Vec<bool> {
    let positions: Vec<_> = poses.iter().map(|pose| pose.posture(skeleton).positions).collect();
    let is_leap = |pair: &[[Vector3<f64>; JOINTS]]| {
        pair[0].iter().zip(&pair[1]).any(|(a, b)| (b - a).norm() * fps > FASTEST)
    };
    std::iter::once(false).chain(positions.windows(2).map(is_leap)).collect()
}

/// Of the pelvis, m/s^2.
fn mean_acceleration(poses: &[Pose], fps: f64) -> f64 {
    let bend = |three: &[Pose]| {
        let [a, b, c] = [0, 1, 2].map(|at| three[at].root_position);
        (c - 2.0 * b + a).norm() * fps * fps
    };
    poses.windows(3).map(bend).sum::<f64>() / poses.len().saturating_sub(2).max(1) as f64
}

/// The middle of the box around the path of the pelvis on the floor, if the path stays within the
/// radius of it.
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
    fn no_stretch_goes_over_a_leap() {
        let at = |x: f64| {
            let mut pose = Pose::rest();
            pose.root_position = Vector3::new(x, 0.9, 0.0);
            pose
        };
        let mut poses: Vec<Pose> = (0..200).map(|frame| at(0.005 * f64::from(frame))).collect();
        let choice = SequenceChoice { least_seconds: 1.0, ..SequenceChoice::default() };
        assert_eq!(sequence(&poses, 60.0, &choice, 1).unwrap().first, 0);
        poses[0] = at(-0.5);
        let cut = sequence(&poses, 60.0, &choice, 1).unwrap();
        assert!(cut.first >= 1 && cut.poses.len() > 180, "{} {}", cut.first, cut.poses.len());
        poses[100] = at(9.0);
        let cut = sequence(&poses, 60.0, &choice, 1).unwrap();
        assert!(cut.first > 100 || cut.first + cut.poses.len() <= 100, "{}", cut.first);
    }
    #[test]
    fn a_pelvis_that_shakes_as_nobody_can_is_left_out() {
        let choice = SequenceChoice { least_seconds: 1.0, ..SequenceChoice::default() };
        // Up and down three times a second: 36 and 90 m/s^2 at most, 23 and 57 in the mean.
        let shaken = |height: f64| {
            let at = |frame: u32| {
                let mut pose = Pose::rest();
                let phase = 6.0 * std::f64::consts::PI * f64::from(frame) / 60.0;
                pose.root_position = Vector3::y() * (0.9 + height * phase.sin());
                pose
            };
            let poses: Vec<Pose> = (0..200).map(at).collect();
            sequence(&poses, 60.0, &choice, 1)
        };
        assert!(shaken(0.1).is_some());
        assert!(shaken(0.25).is_none());
    }
}
