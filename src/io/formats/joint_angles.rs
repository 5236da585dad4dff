//! Joint angles, with the names and definitions of OpenSim's Rajagopal models.
//!
//! All are 0 where the body stands upright and faces forward (x of OpenSim), and legs and arms are straight and hang down.
//! Rotations are about z (to the right), then x, then y (up). Positive are: flexion of hip, knee, elbow and arm,
//! dorsiflexion, extension of the back, adduction, and for both sides rotation inwards. Rotations that a joint of those
//! models does not have are left out: knees, elbows and ankles bend about one axis. The upper arm turns about its own axis
//! until the elbow's one axis brings the forearm where it is. The pelvis' place is that of our joint, not of the origin of
//! the models' pelvis. With a level arm, or a performer who lies on the side, two angles are not unique (Euler's singularity):
//! they may change fast, and jump by half a turn.
//!
//! Source: Rajagopal et al., Full-body musculoskeletal model for muscle-driven simulation of human gait, 2016; the
//! joints of `Rajagopal2016.osim`.

use std::f64::consts::PI;
use std::fmt::Write as _;
use std::path::Path;

use libm::{atan2, hypot};
use nalgebra::{Matrix3, Rotation3, Vector3};

use super::pose_table::{TimedPose, write_table};
use super::style::{RestPose, Style};
use super::{ExportError, Up};
use crate::core::body::{JOINTS, Joint, Pose, Skeleton};
use crate::core::so3;
use crate::io::new_file;

/// The turn of an upper arm is known where the forearm leaves its line by this part of its length.
const SURE_SIDE: f64 = 0.3;
/// Weight of the size of angles beside their distance from the last ones.
const SMALL: f64 = 1.5;
/// The same of the pelvis' tilt, list and rotation.
const SMALL_OF_PELVIS: [f64; 3] = [2.0, 2.0, 0.0];
/// Number of coordinates of a pose.
const COORDINATES: usize = 27;

/// Their names; the pelvis' place is in metres, all others are in degrees.
const NAMES: [&str; COORDINATES] = [
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
    "pelvis_tx",
    "pelvis_ty",
    "pelvis_tz",
    "hip_flexion_r",
    "hip_adduction_r",
    "hip_rotation_r",
    "knee_angle_r",
    "ankle_angle_r",
    "hip_flexion_l",
    "hip_adduction_l",
    "hip_rotation_l",
    "knee_angle_l",
    "ankle_angle_l",
    "lumbar_extension",
    "lumbar_bending",
    "lumbar_rotation",
    "arm_flex_r",
    "arm_add_r",
    "arm_rot_r",
    "elbow_flex_r",
    "arm_flex_l",
    "arm_add_l",
    "arm_rot_l",
    "elbow_flex_l",
];

/// The chains of joints whose angles are computed, from the parent on, and whether all three angles are used; in the
/// order of [`NAMES`]. Empty: the pelvis.
const CHAINS: [(&[Joint], bool); 12] = [
    (&[], true),
    (&[Joint::RHip], true),
    (&[Joint::RKnee], false),
    (&[Joint::RAnkle], false),
    (&[Joint::LHip], true),
    (&[Joint::LKnee], false),
    (&[Joint::LAnkle], false),
    (&[Joint::Spine1, Joint::Spine2, Joint::Spine3], true),
    (&[Joint::RCollar, Joint::RShoulder], true),
    (&[Joint::RElbow], false),
    (&[Joint::LCollar, Joint::LShoulder], true),
    (&[Joint::LElbow], false),
];

/// The bones that hang down where all angles are 0, each from its joint to the next.
const HANGING: [[Joint; 2]; 8] = [
    [Joint::LHip, Joint::LKnee],
    [Joint::LKnee, Joint::LAnkle],
    [Joint::RHip, Joint::RKnee],
    [Joint::RKnee, Joint::RAnkle],
    [Joint::LShoulder, Joint::LElbow],
    [Joint::LElbow, Joint::LWrist],
    [Joint::RShoulder, Joint::RElbow],
    [Joint::RElbow, Joint::RWrist],
];

/// Computes the angles of poses in order.
struct Angles {
    style: Style,
    /// By joint, the shortest turn from straight down to its bone in the rest pose.
    tilts: [Matrix3<f64>; JOINTS],
    /// The last angles, radians, so that the next ones go on without jumps of a turn.
    last: [[f64; 3]; CHAINS.len()],
    /// By side, the last turn of the upper arm about its axis, radians.
    last_turn: [f64; 2],
}

impl Angles {
    fn new(body: &Skeleton) -> Self {
        let rest = RestPose::N.pose().posture(body).positions;
        let mut tilts = [Matrix3::identity(); JOINTS];
        for [joint, next] in HANGING {
            let bone = rest[next.index()] - rest[joint.index()];
            if let Some(tilt) = Rotation3::rotation_between(&-Vector3::y(), &bone) {
                tilts[joint.index()] = tilt.into_inner();
            }
        }
        Self {
            style: Style::new(RestPose::N, Up::Y),
            tilts,
            last: Default::default(),
            last_turn: [0.0; 2],
        }
    }

    /// The coordinates of the next pose, in the order of [`NAMES`].
    fn of(&mut self, pose: &Pose) -> Vec<f64> {
        // x of OpenSim is our z, its z is our -x.
        let axes = Matrix3::new(0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0);
        let mut pose = self.style.pose(pose);
        for (joint, turn) in Joint::ALL.into_iter().skip(1).zip(&mut pose.local) {
            let outer = joint.parent().map_or(Matrix3::identity(), |at| self.tilts[at.index()]);
            *turn = outer.transpose() * *turn * self.tilts[joint.index()];
        }
        let arms = [(Joint::LShoulder, Joint::LElbow), (Joint::RShoulder, Joint::RElbow)];
        for ((shoulder, elbow), last) in arms.into_iter().zip(&mut self.last_turn) {
            let (shoulder, elbow) = (shoulder.index() - 1, elbow.index() - 1);
            let (turn, bent) = hinged(&(axes * pose.local[elbow] * axes.transpose()), last);
            pose.local[shoulder] *= axes.transpose() * turn * axes;
            pose.local[elbow] = axes.transpose() * bent * axes;
        }
        let mut all = Vec::with_capacity(COORDINATES);
        for ((joints, is_whole), last) in CHAINS.iter().zip(&mut self.last) {
            let turn = match joints {
                [] => pose.root_rotation,
                joints => joints.iter().map(|joint| pose.local[joint.index() - 1]).product(),
            };
            let turn = axes * turn * axes.transpose();
            // The performer may turn round and round.
            *last = if joints.is_empty() {
                // Tilt and list go on over whole turns, as in a roll forward.
                let mut both = so3::both_angles(&turn, [2, 0, 1], *last);
                both.sort_by(|a, b| so3::apart(a, last).total_cmp(&so3::apart(b, last)));
                both[1] = so3::nearest_turns(both[1], [0.0, 0.0, last[2]]);
                smallest(both, *last, SMALL_OF_PELVIS)
            } else {
                small_angles(&turn, *last)
            };
            let [z, x, y] = last.map(f64::to_degrees);
            let end = joints.last();
            // The models mirror the left side.
            let side = if end.is_some_and(|joint| joint.side() > 0.0) { -1.0 } else { 1.0 };
            let bends_back = matches!(end, Some(Joint::LKnee | Joint::RKnee));
            all.push(if bends_back { -z } else { z });
            if *is_whole {
                all.extend([side * x, side * y]);
            }
            if joints.is_empty() {
                all.extend((axes * pose.root_position).iter());
            }
        }
        all
    }
}

/// The angles of a joint about z, x and y, radians. A rotation has two solutions, to which whole turns can be added.
/// Where an arm is lifted aside, both are near, and the arm may come down with the one whose angles are all large. So
/// the angles are those nearest to `last`, unless others are much smaller.
fn small_angles(turn: &Matrix3<f64>, last: [f64; 3]) -> [f64; 3] {
    let near = so3::both_angles(turn, [2, 0, 1], last);
    let home = near.map(|angles| so3::nearest_turns(angles, [0.0; 3]));
    smallest(near.into_iter().chain(home), last, [SMALL; 3])
}

/// The angles nearest to `last`, unless others are much smaller; `small`: the weights of the sizes.
fn smallest(all: impl IntoIterator<Item = [f64; 3]>, last: [f64; 3], small: [f64; 3]) -> [f64; 3] {
    let cost = |angles: &[f64; 3]| {
        let size: f64 = angles.iter().zip(small).map(|(angle, small)| small * angle.abs()).sum();
        so3::apart(angles, &last) + size
    };
    all.into_iter().min_by(|a, b| cost(a).total_cmp(&cost(b))).unwrap_or(last)
}

/// An elbow that only bends, about z, and the turn of the upper arm about its axis, y, with which the forearm points
/// where it did. The straighter the arm, the less is known of the turn, and the less it turns.
fn hinged(elbow: &Matrix3<f64>, last: &mut f64) -> (Matrix3<f64>, Matrix3<f64>) {
    let forearm = -elbow.column(1);
    let side = hypot(forearm.x, forearm.z);
    let bent = atan2(side, -forearm.y);
    let turn = so3::nearest_turns([atan2(-forearm.z, forearm.x)], [*last])[0];
    // Bent a little the other way, after half a turn, the forearm points there too.
    let other = so3::nearest_turns([turn + PI], [*last])[0];
    let is_nearly_straight = forearm.y < 0.0 && side < SURE_SIDE;
    let is_other = is_nearly_straight && (other - *last).abs() < (turn - *last).abs();
    let (turn, bent) = if is_other { (other, -bent) } else { (turn, bent) };
    let turn = if is_nearly_straight { turn * side / SURE_SIDE } else { turn };
    *last = so3::nearest_turns([turn], [0.0])[0];
    (so3::about(1, turn), so3::about(2, bent))
}

/// Writes a .mot file of evenly spaced poses of a body from 0 s.
///
/// # Errors
/// The disk is full, the rate is not above 0, or a pose has a value that is not finite.
pub fn write_mot(
    path: &Path,
    fps: f64,
    body: &Skeleton,
    poses: impl IntoIterator<Item = Pose>,
) -> Result<(), ExportError> {
    ExportError::check_rate(path, fps)?;
    let (mut rows, mut frames, mut angles) = (String::new(), 0, Angles::new(body));
    for pose in poses {
        let numbers = angles.of(&pose);
        if !numbers.iter().all(|number| number.is_finite()) {
            return Err(ExportError::NotFinite { path: path.into(), frame: frames });
        }
        // Writing into a string cannot fail.
        let _ = write!(rows, "{:.6}", frames as f64 / fps);
        numbers.iter().for_each(|number| rows += &format!("\t{number:.6}"));
        rows.push('\n');
        frames += 1;
    }
    let (columns, names) = (COORDINATES + 1, NAMES.join("\t"));
    let text = format!(
        "Coordinates\nversion=1\nnRows={frames}\nnColumns={columns}\ninDegrees=yes\n\
         x of this ground is z of the other files, and its z is their -x.\nendheader\n\
         time\t{names}\n{rows}"
    );
    new_file::write(path, text.as_bytes()).map_err(ExportError::write(path))
}

/// Writes a line for each pose: `time_s`, `state`, then the coordinates: degrees, and metres for the pelvis' place.
///
/// # Errors
/// The disk is full, or a pose has a value that is not finite.
pub fn write_angles(
    path: &Path,
    body: &Skeleton,
    poses: impl IntoIterator<Item = TimedPose>,
) -> Result<(), ExportError> {
    let mut angles = Angles::new(body);
    let header = ["time_s", "state"].into_iter().chain(NAMES).map(str::to_owned).collect();
    let row = |(frame, TimedPose { time, state, pose, .. }): (usize, TimedPose)| {
        let begin = [format!("{time:.6}"), state.name().to_owned()];
        let numbers = angles.of(&pose);
        if !numbers.iter().all(|number| number.is_finite()) {
            return Err(ExportError::NotFinite { path: path.into(), frame });
        }
        Ok(begin.into_iter().chain(numbers.iter().map(|number| format!("{number:.6}"))).collect())
    };
    let rows: Vec<Vec<String>> =
        poses.into_iter().enumerate().map(row).collect::<Result<_, _>>()?;
    write_table(path, header, rows.into_iter())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::TrackingState;

    /// The named coordinates of a pose whose joints are turned about our axes, degrees.
    fn found(turns: &[(Joint, [f64; 3])], names: &[&str]) -> Vec<f64> {
        let mut pose = RestPose::N.pose();
        for (joint, degrees) in turns {
            let turn = so3::exp(&Vector3::from(degrees.map(f64::to_radians)));
            match joint.index().checked_sub(1) {
                Some(j) => pose.local[j] = turn * pose.local[j],
                None => pose.root_rotation = turn,
            }
        }
        let all = straight().of(&pose);
        let at = |name: &&str| all[NAMES.iter().position(|own| own == name).unwrap()];
        names.iter().map(at).map(|number| (number * 1e6).round() / 1e6).collect()
    }

    /// Of a body whose bones hang straight down in the rest pose.
    fn straight() -> Angles {
        Angles { tilts: [Matrix3::identity(); JOINTS], ..Angles::new(&Skeleton::default()) }
    }

    #[test]
    fn a_knee_and_an_elbow_are_bent_by_the_angle_of_their_bones() {
        let body = Skeleton::default();
        let all = |pose: &Pose| Angles::new(&body).of(pose);
        let at = |all: &[f64], name| all[NAMES.iter().position(|own| *own == name).unwrap()];
        let bent = |pose: &Pose, [from, joint, to]: [Joint; 3]| {
            let places = pose.posture(&body).positions;
            let [from, joint, to] = [from, joint, to].map(|one| places[one.index()]);
            (joint - from).angle(&(to - joint)).to_degrees()
        };
        let (leg, arm) = (
            [Joint::LHip, Joint::LKnee, Joint::LAnkle],
            [Joint::RShoulder, Joint::RElbow, Joint::RWrist],
        );
        let rest = RestPose::N.pose();
        // Our rest pose is not quite straight.
        assert!(bent(&rest, leg) > 3.0);
        assert!((at(&all(&rest), "knee_angle_l") - bent(&rest, leg)).abs() < 0.01);
        let mut pose = rest.clone();
        let turned = [(Joint::LHip, [-60.0, 5.0, 8.0]), (Joint::LKnee, [80.0, 0.0, 0.0])];
        let turned = turned.into_iter().chain([(Joint::RElbow, [-50.0, 0.0, 0.0])]);
        for (joint, degrees) in turned {
            let local = &mut pose.local[joint.index() - 1];
            *local = so3::exp(&Vector3::from(degrees.map(f64::to_radians))) * *local;
        }
        assert!((at(&all(&pose), "knee_angle_l") - bent(&pose, leg)).abs() < 0.05);
        assert!((at(&all(&pose), "elbow_flex_r") - bent(&pose, arm)).abs() < 0.05);
    }

    #[test]
    fn an_arm_that_hangs_again_has_small_angles_whatever_it_did() {
        let mut angles = straight();
        let arm = NAMES.iter().position(|name| *name == "arm_flex_l").unwrap();
        let mut at = |degrees: [f64; 2]| {
            let [aside, ahead] = degrees.map(f64::to_radians);
            let mut pose = RestPose::N.pose();
            // Lifted aside, and then moved to the front about the vertical.
            let local = &mut pose.local[Joint::LShoulder.index() - 1];
            *local = so3::about(1, -ahead) * so3::about(2, aside) * so3::about(1, ahead) * *local;
            angles.of(&pose)[arm..arm + 3].to_vec()
        };
        let steps =
            |from: f64, to: f64| (0..=20).map(move |k| from + f64::from(k) / 20.0 * (to - from));
        for top in [80.0, 89.0, 91.0, 100.0, 120.0, 160.0] {
            steps(0.0, top).for_each(|aside| drop(at([aside, 0.0])));
            steps(0.0, 100.0).for_each(|ahead| drop(at([top, ahead])));
            steps(top, 0.0).for_each(|aside| drop(at([aside, 100.0])));
            let hanging = at([0.0, 0.0]);
            assert!(hanging.iter().all(|angle| angle.abs() < 1.0), "{top}: {hanging:?}");
        }
    }

    /// Falls on the side, rolls over on the floor, and stands up.
    #[test]
    fn the_pelvis_is_upright_again_after_floor_work() {
        let steps =
            |from: f64, to: f64| (0..=20).map(move |k| from + f64::from(k) / 20.0 * (to - from));
        for (fallen, rolled) in [(85.0, 180.0), (95.0, 90.0), (95.0, 180.0), (80.0, -90.0)] {
            let body = Skeleton::default();
            let mut angles = Angles::new(&body);
            let mut at = |[side, roll]: [f64; 2]| {
                let [side, roll] = [side, roll].map(f64::to_radians);
                // Our z is OpenSim's x.
                let root_rotation = so3::about(1, roll) * so3::about(2, side);
                angles.of(&Pose { root_rotation, ..RestPose::N.pose() })[..3].to_vec()
            };
            steps(0.0, fallen).for_each(|side| drop(at([side, 0.0])));
            steps(0.0, rolled).for_each(|roll| drop(at([fallen, roll])));
            steps(fallen, 0.0).for_each(|side| drop(at([side, rolled])));
            let upright = at([0.0, rolled]);
            // But for whole turns.
            for (angle, wanted) in upright.iter().zip([0.0, 0.0, rolled]) {
                let turns = (angle - wanted) / 360.0;
                assert!((turns - turns.round()).abs() < 0.01, "{fallen}: {upright:?}");
            }
        }
        // A roll forward and a cartwheel go on without a jump.
        for axis in [0, 2] {
            let body = Skeleton::default();
            let mut angles = Angles::new(&body);
            let mut at = |degrees: f64| {
                let root_rotation = so3::about(axis, degrees.to_radians());
                angles.of(&Pose { root_rotation, ..RestPose::N.pose() })[..3].to_vec()
            };
            let all: Vec<Vec<f64>> = (0..180).map(|k| at(2.0 * f64::from(k))).collect();
            let is_step =
                |pair: &[Vec<f64>]| pair[0].iter().zip(&pair[1]).all(|(a, b)| (a - b).abs() < 5.0);
            assert!(all.windows(2).all(is_step), "{axis}");
        }
    }

    #[test]
    fn poses_that_are_not_finite_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("angles.csv");
        let at = |x: f64| {
            let pose = Pose { root_position: [x, 1.0, 0.0].into(), ..Pose::rest() };
            let (state, deviations) = (TrackingState::Tracking, None);
            TimedPose { time: 0.0, state, pose, deviations }
        };
        let body = Skeleton::default();
        write_angles(&path, &body, [at(0.0)]).unwrap();
        let found = write_angles(&path, &body, [at(0.0), at(f64::NAN)]);
        assert!(matches!(found, Err(ExportError::NotFinite { frame: 1, .. })), "{found:?}");
    }

    #[test]
    fn angles_have_the_signs_of_the_models() {
        assert!(found(&[], &NAMES).iter().all(|number| *number == 0.0));
        // Ours: x to the left, y up, z forward. A leg is raised forward by a turn about -x.
        let bent = [(Joint::LHip, [-30.0, 0.0, 0.0]), (Joint::LKnee, [50.0, 0.0, 0.0])];
        assert_eq!(
            found(&bent, &["hip_flexion_l", "knee_angle_l", "knee_angle_r"]),
            [30.0, 50.0, 0.0]
        );
        let inwards = [(Joint::LHip, [0.0, 0.0, -10.0]), (Joint::RHip, [0.0, 0.0, 10.0])];
        assert_eq!(found(&inwards, &["hip_adduction_l", "hip_adduction_r"]), [10.0, 10.0]);
        let inwards = [(Joint::LHip, [0.0, -10.0, 0.0]), (Joint::RHip, [0.0, 10.0, 0.0])];
        assert_eq!(found(&inwards, &["hip_rotation_l", "hip_rotation_r"]), [10.0, 10.0]);
        let back = [(Joint::Spine1, [-10.0, 0.0, 0.0]), (Joint::Spine3, [-10.0, 0.0, 0.0])];
        assert_eq!(found(&back, &["lumbar_extension"]), [20.0]);
        let raised = [(Joint::RShoulder, [-40.0, 0.0, 0.0]), (Joint::RElbow, [-90.0, 0.0, 0.0])];
        let raised = found(&raised, &["arm_flex_r", "arm_add_r", "arm_flex_l"]);
        assert_eq!(raised, [40.0, 0.0, 0.0]);
        // A forearm that points outwards turns the upper arm outwards.
        let aside = [(Joint::RElbow, [0.0, 0.0, -60.0])];
        let aside = found(&aside, &["elbow_flex_r", "arm_rot_r", "arm_flex_r"]);
        assert_eq!(aside, [60.0, -90.0, 0.0]);
        // A nearly straight elbow may bend back a little.
        let back = found(&[(Joint::LElbow, [0.0, 5.0, 0.0])], &["elbow_flex_l", "arm_rot_l"]);
        assert_eq!(back, [-5.0, 0.0]);
        assert_eq!(found(&[(Joint::Pelvis, [0.0, 20.0, 0.0])], &["pelvis_rotation"]), [20.0]);
        // In a T-pose the arms are led away from the body.
        let level = straight().of(&Pose::rest());
        let arm = NAMES.iter().position(|name| *name == "arm_add_r").unwrap();
        assert!((level[arm] + 90.0).abs() < 1e-6, "{}", level[arm]);
    }
}
