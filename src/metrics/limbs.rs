//! Errors of the twelve limb joints, which every result has, with or without a body.

use serde::Serialize;

use super::markers::MarkerPositions;
use super::statistics::mean;
use crate::core::body::{Joint, Posture};

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

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

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
