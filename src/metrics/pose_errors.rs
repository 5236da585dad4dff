//! Errors of solved poses against the truth, with the metrics of \[Albanis 2023, sec. 4\].

use std::borrow::Borrow;

use nalgebra::{Matrix3, Vector3};
use serde::Serialize;

use super::coverage::{Coverage, CoverageSums};
use crate::core::body::{JOINTS, Joint, JointDeviations, Posture};
use crate::core::so3;
use crate::core::time::{Nanos, Timestamp};

/// Largest errors of a joint that counts as correct (PCK), metres.
const PCK: [f64; 2] = [0.03, 0.07];

/// Errors over frames and the 22 joints. With e = |P - P*| of one joint in one frame:
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PoseErrors {
    /// Number of compared frames.
    pub frames: usize,
    /// Mean of e, millimetres (MPJPE, absolute).
    pub mpjpe_mm: f64,
    /// Mean of e after aligning the pelvis with the true one, millimetres; the pelvis counts as 0.
    pub mpjpe_root_relative_mm: f64,
    /// sqrt(mean of e^2), millimetres.
    pub rmse_mm: f64,
    /// Mean angle between local rotations (`parent_from_joint`) over joints 1 to 21, degrees.
    pub mae_deg: f64,
    /// Mean angle between root rotations, degrees.
    pub root_deg: f64,
    /// Share of joints with e <= 3 cm, percent.
    pub pck3_percent: f64,
    /// Share of joints with e <= 7 cm, percent.
    pub pck7_percent: f64,
    /// Of the estimate's standard deviations, over the coordinates of P; `None` if it has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coverage: Option<Coverage>,
    /// Mean of e for each joint, millimetres; not serialised.
    #[serde(skip)]
    pub per_joint_mm: [f64; JOINTS],
}

/// Errors of pairs (estimate, truth) of the same times. `None` without pairs.
pub fn pose_errors<P: Borrow<Posture>>(
    pairs: impl IntoIterator<Item = (P, P)>,
) -> Option<PoseErrors> {
    let mut sums = PoseErrorSums::default();
    for (estimate, truth) in pairs {
        sums.add(estimate.borrow(), truth.borrow(), None);
    }
    sums.errors()
}

/// Sums [`PoseErrors`] over frames.
#[derive(Clone, Debug, Default)]
pub struct PoseErrorSums {
    frames: usize,
    per_joint: [f64; JOINTS],
    relative: f64,
    squared: f64,
    angle: f64,
    root_angle: f64,
    within: [usize; 2],
    coverage: CoverageSums,
}

impl PoseErrorSums {
    /// Adds a frame, with the standard deviations of the estimate if they are known.
    pub fn add(
        &mut self,
        estimate: &Posture,
        truth: &Posture,
        deviations: Option<&JointDeviations>,
    ) {
        self.frames += 1;
        let shift = truth.positions[0] - estimate.positions[0];
        for (j, sum) in self.per_joint.iter_mut().enumerate() {
            let difference = estimate.positions[j] - truth.positions[j];
            let distance = difference.norm();
            *sum += distance;
            self.squared += distance * distance;
            if let Some(deviations) = deviations {
                self.coverage.add(&difference, deviations[j]);
            }
            self.relative += (difference + shift).norm();
            for (count, limit) in self.within.iter_mut().zip(PCK) {
                *count += usize::from(distance <= limit);
            }
        }
        self.root_angle += so3::angle_between(&estimate.rotations[0], &truth.rotations[0]);
        self.angle += Joint::ALL
            .into_iter()
            .filter_map(|joint| Some((joint, joint.parent()?)))
            .map(|(joint, parent)| {
                so3::angle_between(&local(estimate, joint, parent), &local(truth, joint, parent))
            })
            .sum::<f64>();
    }

    /// The errors over all frames so far; `None` without frames.
    pub fn errors(&self) -> Option<PoseErrors> {
        let frames = self.frames as f64;
        let all = frames * JOINTS as f64;
        (self.frames > 0).then(|| PoseErrors {
            frames: self.frames,
            mpjpe_mm: 1e3 * self.per_joint.iter().sum::<f64>() / all,
            mpjpe_root_relative_mm: 1e3 * self.relative / all,
            rmse_mm: 1e3 * (self.squared / all).sqrt(),
            mae_deg: (self.angle / (all - frames)).to_degrees(),
            root_deg: (self.root_angle / frames).to_degrees(),
            pck3_percent: 100.0 * self.within[0] as f64 / all,
            pck7_percent: 100.0 * self.within[1] as f64 / all,
            coverage: self.coverage.finish(),
            per_joint_mm: self.per_joint.map(|sum| 1e3 * sum / frames),
        })
    }
}

fn local(posture: &Posture, joint: Joint, parent: Joint) -> Matrix3<f64> {
    posture.rotations[parent.index()].transpose() * posture.rotations[joint.index()]
}

/// Mean size of the joints' acceleration, m/s^2, over joints and inner frames of a run
/// without gaps at `fps`: |P(t+1) - 2 P(t) + P(t-1)| fps^2. `None` for fewer than three frames.
pub fn mean_acceleration(postures: &[Posture], fps: f64) -> Option<f64> {
    mean_of_triples(postures.windows(3).map(|triple| acceleration(triple, fps)))
}

/// [`mean_acceleration`] of a stream of postures: mean over its runs without gaps, weighted by
/// their length.
#[derive(Clone, Debug)]
pub struct MeanAcceleration {
    fps: f64,
    /// The last postures of the run, at most three.
    run: Vec<Posture>,
    last: Option<Timestamp>,
    sum: f64,
    count: f64,
}

impl MeanAcceleration {
    /// For postures at `fps` frames a second.
    pub fn new(fps: f64) -> Self {
        Self { fps, run: Vec::with_capacity(3), last: None, sum: 0.0, count: 0.0 }
    }

    /// Adds the next posture in order of time; `None` if the frame has no usable posture. A step of
    /// more than 1.5 frame periods is a gap.
    pub fn add(&mut self, capture: Timestamp, posture: Option<Posture>) {
        let longest = Nanos::new((1.5e9 / self.fps) as i64);
        let gap = self.last.is_some_and(|last| capture - last >= longest);
        if gap || posture.is_none() {
            self.run.clear();
        }
        self.last = Some(capture);
        let Some(posture) = posture else { return };
        if self.run.len() == 3 {
            self.run.remove(0);
        }
        self.run.push(posture);
        if let Some(mean) = mean_acceleration(&self.run, self.fps) {
            self.sum += mean;
            self.count += 1.0;
        }
    }

    /// The mean so far, m/s^2; `None` without three consecutive frames.
    pub fn mean(&self) -> Option<f64> {
        (self.count > 0.0).then(|| self.sum / self.count)
    }
}

/// Mean size of the difference between estimated and true acceleration of the joints, m/s^2.
/// Both runs have the same times and no gaps. `None` for fewer than three frames.
pub fn acceleration_error(estimate: &[Posture], truth: &[Posture], fps: f64) -> Option<f64> {
    let triples = estimate.windows(3).zip(truth.windows(3));
    mean_of_triples(triples.map(|(estimate, truth)| {
        let (a, b) = (acceleration(estimate, fps), acceleration(truth, fps));
        std::array::from_fn(|j| a[j] - b[j])
    }))
}

fn mean_of_triples(triples: impl Iterator<Item = [Vector3<f64>; JOINTS]>) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0usize);
    for vectors in triples {
        sum += vectors.iter().map(Vector3::norm).sum::<f64>();
        count += JOINTS;
    }
    (count > 0).then(|| sum / count as f64)
}

fn acceleration(triple: &[Posture], fps: f64) -> [Vector3<f64>; JOINTS] {
    std::array::from_fn(|j| {
        let at = |i: usize| triple[i].positions[j];
        (at(2) - at(1) * 2.0 + at(0)) * (fps * fps)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Pose, Skeleton};

    fn posture(pose: &Pose) -> Posture {
        pose.posture(&Skeleton::default())
    }

    fn close(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-6, "{a} is not {b}");
    }

    #[test]
    fn a_shifted_body_is_wrong_absolutely_and_right_relatively() {
        let (rest, mut moved) = (posture(&Pose::rest()), Pose::rest());
        moved.root_position = Vector3::new(0.03, 0.0, 0.04);
        let moved = posture(&moved);
        let errors = pose_errors([(&moved, &rest), (&rest, &rest)]).unwrap();
        assert_eq!(errors.frames, 2);
        close(errors.mpjpe_mm, 25.0);
        close(errors.rmse_mm, 50.0 / 2f64.sqrt());
        close(errors.mpjpe_root_relative_mm, 0.0);
        close(errors.pck3_percent, 50.0);
        close(errors.pck7_percent, 100.0);
        close(errors.per_joint_mm[7], 25.0);
        close(errors.mae_deg + errors.root_deg, 0.0);
    }

    #[test]
    fn a_bent_elbow_moves_the_wrist_and_counts_once() {
        let (rest, mut bent) = (posture(&Pose::rest()), Pose::rest());
        bent.local[Joint::LElbow.index() - 1] = so3::exp(&Vector3::new(0.0, 0.42, 0.0));
        let bent = posture(&bent);
        let errors = pose_errors([(&bent, &rest)]).unwrap();
        close(errors.mae_deg, 0.42f64.to_degrees() / 21.0);
        let forearm = Skeleton::default().offset(Joint::LWrist).norm();
        let chord = 2e3 * forearm * 0.21f64.sin();
        close(errors.per_joint_mm[Joint::LWrist.index()], chord);
        close(errors.mpjpe_mm, chord / 22.0);
        close(errors.rmse_mm, chord / 22f64.sqrt());
        close(errors.pck7_percent, 100.0 * 21.0 / 22.0);
    }

    #[test]
    fn free_fall_accelerates_by_g() {
        let fall = |frame: i32| {
            let t = f64::from(frame) / 50.0;
            let mut pose = Pose::rest();
            pose.root_position = Vector3::new(t, -4.905 * t * t, 0.0);
            posture(&pose)
        };
        let falling: Vec<Posture> = (0..5).map(fall).collect();
        let still = vec![posture(&Pose::rest()); 5];
        close(mean_acceleration(&falling, 50.0).unwrap(), 9.81);
        close(acceleration_error(&falling, &falling, 50.0).unwrap(), 0.0);
        close(acceleration_error(&falling, &still, 50.0).unwrap(), 9.81);
        assert_eq!(mean_acceleration(&falling[..2], 50.0), None);
        assert!(pose_errors::<&Posture>([]).is_none());
    }
}
