//! Errors of the twelve limb joints, which every result has, with or without a body.

use nalgebra::Vector3;
use serde::Serialize;

use super::markers::MarkerPositions;
use super::statistics::mean;
use crate::core::body::{Joint, Posture, Skeleton};

/// The limb joints, in the order of [`COMPARED`](super::COMPARED).
pub const LIMB_JOINTS: [Joint; 12] = [
    Joint::LShoulder,
    Joint::RShoulder,
    Joint::LElbow,
    Joint::RElbow,
    Joint::LWrist,
    Joint::RWrist,
    Joint::LHip,
    Joint::RHip,
    Joint::LKnee,
    Joint::RKnee,
    Joint::LAnkle,
    Joint::RAnkle,
];

/// Upper ends of the bins of the joints' true speed but the last, m/s.
pub const SPEEDS_M_S: [f64; 2] = [0.5, 2.0];

/// Errors over frames and limb joints. With e = |P - P*| of one joint in one frame:
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LimbErrors {
    /// Mean of e, millimetres.
    pub limb_mm: f64,
    /// Mean of e by true speed |P*(t+1) - P*(t-1)| fps / 2, millimetres: see [`SPEEDS_M_S`].
    pub limb_by_speed_mm: [Option<f64>; SPEEDS_M_S.len() + 1],
    /// Mean of |P'' - P*''|, P'' = (P(t+1) - 2 P(t) + P(t-1)) fps^2, m/s^2.
    pub limb_acceleration_error_m_s2: Option<f64>,
}

/// Segments of the limbs, each of the left and of the right, as pairs of [`LIMB_JOINTS`].
pub const SEGMENTS: [(&str, [[usize; 2]; 2]); 4] = [
    ("thigh", [[6, 8], [7, 9]]),
    ("shank", [[8, 10], [9, 11]]),
    ("upper arm", [[0, 2], [1, 3]]),
    ("forearm", [[2, 4], [3, 5]]),
];

/// Centres of the limb joints, world, metres.
pub fn limb_joints(posture: &Posture) -> MarkerPositions {
    LIMB_JOINTS.map(|joint| Some(posture.positions[joint.index()]))
}

/// Compares runs of the same times, without gaps, at `fps`. `None` without a joint that is in both.
pub fn limb_errors(
    estimate: &[MarkerPositions],
    truth: &[MarkerPositions],
    fps: f64,
) -> Option<LimbErrors> {
    let (mut all, mut accelerations) = (Vec::new(), Vec::new());
    let mut by_speed: [Vec<f64>; SPEEDS_M_S.len() + 1] = Default::default();
    for joint in 0..LIMB_JOINTS.len() {
        let at = |run: &[MarkerPositions], t: usize| run.get(t).and_then(|points| points[joint]);
        for t in 0..estimate.len().min(truth.len()) {
            let Some(error) = at(estimate, t).zip(at(truth, t)).map(|(p, q)| 1e3 * (p - q).norm())
            else {
                continue;
            };
            all.push(error);
            let around = |run| Some([at(run, t.checked_sub(1)?)?, at(run, t)?, at(run, t + 1)?]);
            let Some([a, b, c]) = around(truth) else { continue };
            let speed = (c - a).norm() * 0.5 * fps;
            by_speed[SPEEDS_M_S.iter().filter(|end| speed >= **end).count()].push(error);
            if let Some([p, q, r]) = around(estimate) {
                let difference = (r - 2.0 * q + p) - (c - 2.0 * b + a);
                accelerations.push(difference.norm() * fps * fps);
            }
        }
    }
    Some(LimbErrors {
        limb_mm: mean(&all)?,
        limb_by_speed_mm: by_speed.map(|errors| mean(&errors)),
        limb_acceleration_error_m_s2: mean(&accelerations),
    })
}

/// Mean of |d - mean of d| over frames and limb joints, millimetres: d = R*^T (P - P*) of one joint, in
/// the frame of the true joint. The place of a joint's centre is partly a definition, so this excludes the
/// constant part of the difference. `None` without a joint.
pub fn limb_errors_less_offset(estimate: &[MarkerPositions], truth: &[Posture]) -> Option<f64> {
    let mut all = Vec::new();
    for (index, joint) in LIMB_JOINTS.iter().map(|joint| joint.index()).enumerate() {
        let frames = estimate.iter().zip(truth);
        let apart = frames.filter_map(|(points, truth)| {
            Some(truth.rotations[joint].transpose() * (points[index]? - truth.positions[joint]))
        });
        let apart: Vec<Vector3<f64>> = apart.collect();
        let mean = apart.iter().sum::<Vector3<f64>>() / apart.len().max(1) as f64;
        all.extend(apart.iter().map(|d| 1e3 * (d - mean).norm()));
    }
    mean(&all)
}

/// Lengths of the [`SEGMENTS`] of a body, mean of both sides, metres.
pub fn segment_lengths(body: &Skeleton) -> [f64; SEGMENTS.len()] {
    // Each ends in a joint whose parent it begins in.
    SEGMENTS.map(|(_, sides)| {
        sides.map(|[_, end]| body.offset(LIMB_JOINTS[end]).norm()).iter().sum::<f64>() / 2.0
    })
}

/// Mean length of each of the [`SEGMENTS`] over frames and sides, less the true one, millimetres.
/// `None` if one is never seen.
pub fn segment_errors(
    estimate: &[MarkerPositions],
    truth: &[MarkerPositions],
) -> Option<[f64; SEGMENTS.len()]> {
    let mut errors = [0.0; SEGMENTS.len()];
    for (error, (_, sides)) in errors.iter_mut().zip(SEGMENTS) {
        let length =
            |points: &MarkerPositions, [a, b]: [usize; 2]| Some((points[a]? - points[b]?).norm());
        let longer = sides.iter().flat_map(|&side| {
            let frames = estimate.iter().zip(truth);
            frames.filter_map(move |(points, truth)| {
                Some(length(points, side)? - length(truth, side)?)
            })
        });
        *error = 1e3 * mean(&longer.collect::<Vec<f64>>())?;
    }
    Some(errors)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::Pose;
    use crate::core::so3;

    #[test]
    fn what_a_joint_has_in_its_own_frame_is_no_error_and_the_length_of_a_segment_is() {
        let postures: Vec<Posture> = (0..4)
            .map(|frame| {
                let mut pose = Pose::rest();
                pose.root_rotation = so3::exp(&(Vector3::y() * f64::from(frame)));
                pose.posture(&Skeleton::default())
            })
            .collect();
        let truth: Vec<MarkerPositions> = postures.iter().map(limb_joints).collect();
        // Both knees are 10 mm to the front of the body, at rest and turned.
        let mut seen = truth.clone();
        for (points, posture) in seen.iter_mut().zip(&postures) {
            for (index, joint) in [(8, Joint::LKnee), (9, Joint::RKnee)] {
                let front = posture.rotations[joint.index()] * Vector3::z() * 0.01;
                points[index] = points[index].map(|point| point + front);
            }
        }
        assert!(limb_errors_less_offset(&seen, &postures).unwrap() < 1e-9);
        // One of them also goes to and fro by 6 mm.
        for (frame, points) in seen.iter_mut().enumerate() {
            let away = if frame % 2 == 0 { 0.006 } else { -0.006 };
            points[8] = points[8].map(|point| point + Vector3::y() * away);
        }
        let less_offset = limb_errors_less_offset(&seen, &postures).unwrap();
        assert!((less_offset - 0.5).abs() < 1e-9, "{less_offset}");
        // Shanks that are 1 % longer.
        let mut seen = truth.clone();
        for points in &mut seen {
            for (knee, ankle) in [(8, 10), (9, 11)] {
                let (knee, ankle_was) = (points[knee].unwrap(), points[ankle].unwrap());
                points[ankle] = Some(knee + (ankle_was - knee) * 1.01);
            }
        }
        let [thigh, shank, ..] = segment_errors(&seen, &truth).unwrap();
        let true_shank = 1e3 * Skeleton::default().offset(Joint::LAnkle).norm();
        assert!((shank - 0.01 * true_shank).abs() < 1e-9 && thigh == 0.0, "{thigh} {shank}");
    }

    #[test]
    fn errors_are_of_the_joints_that_are_known_and_by_speed() {
        // One joint at 1 m/s, 10 mm off; another still, 20 mm off; a third is not in the estimate.
        let run = |off: [Option<f64>; 3]| -> Vec<MarkerPositions> {
            let at = |t: usize| {
                let mut points: MarkerPositions = [None; 12];
                points[0] = off[0].map(|off| Vector3::new(0.02 * t as f64, off, 0.0));
                points[5] = off[1].map(|off| Vector3::new(1.0, off, 0.0));
                points[9] = off[2].map(|off| Vector3::new(2.0, off, 0.0));
                points
            };
            (0..5).map(at).collect()
        };
        let truth = run([Some(0.0); 3]);
        let errors = limb_errors(&run([Some(0.01), Some(0.02), None]), &truth, 50.0).unwrap();
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} is not {b}");
        close(errors.limb_mm, 15.0);
        close(errors.limb_by_speed_mm[0].unwrap(), 20.0);
        close(errors.limb_by_speed_mm[1].unwrap(), 10.0);
        assert_eq!(errors.limb_by_speed_mm[2], None);
        close(errors.limb_acceleration_error_m_s2.unwrap(), 0.0);
        assert_eq!(limb_errors(&run([None; 3]), &truth, 50.0), None);
    }
}
