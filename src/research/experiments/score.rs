//! Scores a method on a sequence.

use nalgebra::Vector3;
use serde::Serialize;

use super::case::Sequence;
use crate::core::body::{JointDeviations, Posture};
use crate::core::time::{Nanos, Timestamp};
use crate::metrics::statistics::mean;
use crate::metrics::{self, LIMB_JOINTS, MarkerPositions, PoseErrorSums, limb_joints};
use crate::offline::{HeldOut, HoldOut};
use crate::research::methods::{Body, Motion, Solved};
use crate::research::synth;

/// Frames before and after a border in [`Trace::around_borders`].
pub const REACH: usize = 10;

/// The metrics of a method on a sequence. See [`crate::metrics`] for the formulas.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[allow(missing_docs)]
pub struct Score {
    /// Errors of the limb joints in the compared frames. Without a body these are distances of the
    /// detector's points from the joint centres, so they include the detector's systematic offsets.
    #[serde(flatten)]
    pub limbs: metrics::LimbErrors,
    /// The same without each joint's constant offset, see [`metrics::limb_errors_less_offset`].
    pub limb_less_offset_mm: Option<f64>,
    /// Mean lengths of the [`metrics::SEGMENTS`] less the true ones, millimetres.
    pub segments_mm: Option<[f64; metrics::SEGMENTS.len()]>,
    /// Mean over the cameras that no method sees of the median distance of the limb keypoints from
    /// the detector's places of them, without its random errors, pixels.
    pub held_out_px: Option<f64>,
    /// Errors of all joints; here and below `None` without a body and for a foreign true body.
    #[serde(flatten)]
    pub pose: Option<metrics::PoseErrors>,
    pub acceleration_error_m_s2: Option<f64>,
    /// `None` also if no foot stands.
    pub foot_skate: Option<metrics::FootSkate>,
    /// `None` without a body, and for a method without borders.
    pub velocity_jump: Option<metrics::VelocityJump>,
    /// `None` for a method that is not a tracker.
    pub not_followed: Option<metrics::NotFollowed>,
    /// Number of compared frames: those of all methods.
    pub compared_frames: usize,
    /// Share of the sequence's frames that the method has, percent.
    pub covered_percent: f64,
    /// Mean wall time per frame, milliseconds. The only metric that differs from run to run.
    pub ms_per_frame: f64,
}

/// The plot data of a method on a sequence.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trace {
    /// Seconds from the start and mean error, millimetres, of every compared frame: over all joints,
    /// or over the limb joints where only they are compared.
    pub error_mm: Vec<(f64, f64)>,
    /// Seconds from the start and height of each limb joint, metres.
    pub heights: Vec<(f64, Heights)>,
    /// Sum and count of the mean velocity jump by frames from the nearest border,
    /// from -[`REACH`] to [`REACH`].
    pub around_borders: [(f64, usize); 2 * REACH + 1],
}

/// Height of each limb joint, metres; `None` where it is not known.
pub type Heights = [Option<f32>; LIMB_JOINTS.len()];

/// For each frame of a sequence, the index of the motion's last entry for it.
pub(super) fn entries(sequence: &Sequence, motion: &Motion) -> Vec<Option<usize>> {
    let mut entries = vec![None; sequence.truth.len()];
    for (index, at) in motion.times().into_iter().enumerate() {
        if let Some(frame) = frame_of(sequence, at) {
            entries[frame] = Some(index);
        }
    }
    entries
}

/// The frame of a sequence within a tenth of a period of a time.
fn frame_of(sequence: &Sequence, at: Timestamp) -> Option<usize> {
    let (first, fps) = (sequence.truth.first()?.capture, sequence.take.fps);
    let frame = (at.seconds_since(first) * fps).round();
    let truth = sequence.truth.get(frame as usize).filter(|_| frame >= 0.0)?;
    let near = (truth.capture - at).abs() < Nanos::new((0.1e9 / fps) as i64);
    near.then_some(frame as usize)
}

/// Compares a motion with the truth in the given frames of a sequence, those of all methods. `None`
/// if the motion has none of them.
pub fn score(
    sequence: &Sequence,
    solved: &Solved,
    frames: &[usize],
    ms_per_frame: f64,
) -> Option<(Score, Trace)> {
    let fps = sequence.take.fps;
    let entries = entries(sequence, &solved.motion);
    let runs = Runs::new(sequence, solved, frames, &entries);
    let joints: Vec<MarkerPositions> = runs.bodies.iter().map(Body::limb_joints).collect();
    let true_joints: Vec<MarkerPositions> = runs.truths.iter().map(limb_joints).collect();
    let (estimates, truths) = (&runs.postures[..], &runs.truths[..]);
    // All joints of a foreign body are not comparable.
    let comparable = if sequence.body == synth::Body::Own { estimates } else { &[] };
    let covered = entries.iter().flatten().count();
    let score = Score {
        limbs: metrics::limb_errors(&joints, &true_joints, fps)?,
        limb_less_offset_mm: metrics::limb_errors_less_offset(&joints, truths),
        segments_mm: metrics::segment_errors(&joints, &true_joints),
        held_out_px: runs.held_out_px(sequence),
        pose: pose_errors(comparable, truths, &runs.deviations),
        acceleration_error_m_s2: metrics::acceleration_error(comparable, truths, fps),
        foot_skate: metrics::foot_skate(comparable, truths, fps),
        velocity_jump: metrics::velocity_jump(estimates, truths, &runs.borders, fps),
        not_followed: solved.not_followed.clone(),
        compared_frames: runs.frames.len(),
        covered_percent: 100.0 * covered as f64 / sequence.truth.len() as f64,
        ms_per_frame,
    };
    let trace = runs.trace(fps, comparable, &joints, &true_joints);
    Some((score, trace))
}

/// Seconds and height of the limb joints of the truth.
pub fn true_heights(sequence: &Sequence) -> Vec<(f64, Heights)> {
    let Some(first) = sequence.truth.first().map(|pose| pose.capture) else { return Vec::new() };
    let height = |pose: &crate::core::body::StampedPose| {
        let joints = limb_joints(&pose.pose.posture(&sequence.skeleton));
        (pose.capture.seconds_since(first), heights(&joints))
    };
    sequence.truth.iter().map(height).collect()
}

fn heights(joints: &MarkerPositions) -> Heights {
    joints.map(|joint| joint.map(|joint| joint.y as f32))
}

/// Estimate and truth of the same frames, in order.
struct Runs {
    /// Frames of the sequence.
    frames: Vec<usize>,
    bodies: Vec<Body>,
    /// Postures of the bodies; empty without a body.
    postures: Vec<Posture>,
    truths: Vec<Posture>,
    deviations: Vec<Option<JointDeviations>>,
    /// Indices of frames.
    borders: Vec<usize>,
}

impl Runs {
    fn new(
        sequence: &Sequence,
        solved: &Solved,
        frames: &[usize],
        entries: &[Option<usize>],
    ) -> Self {
        let found = frames.iter().filter_map(|&frame| {
            let index = (*entries.get(frame)?)?;
            let body = solved.motion.frame(index)?;
            let deviations = solved.deviations.get(index).copied().flatten();
            Some((frame, body, deviations, sequence.truth[frame].pose.posture(&sequence.skeleton)))
        });
        let found: Vec<_> = found.collect();
        let borders: Vec<usize> =
            solved.borders.iter().filter_map(|at| frame_of(sequence, *at)).collect();
        let is_border =
            |(_, (frame, ..)): &(usize, &(usize, Body, Option<JointDeviations>, Posture))| {
                borders.binary_search(frame).is_ok()
            };
        Self {
            borders: found.iter().enumerate().filter(is_border).map(|(index, _)| index).collect(),
            postures: found.iter().filter_map(|(_, body, ..)| body.posture().cloned()).collect(),
            frames: found.iter().map(|(frame, ..)| *frame).collect(),
            truths: found.iter().map(|(.., truth)| truth.clone()).collect(),
            deviations: found.iter().map(|(_, _, deviations, _)| *deviations).collect(),
            bodies: found.into_iter().map(|(_, body, ..)| body).collect(),
        }
    }

    fn held_out_px(&self, sequence: &Sequence) -> Option<f64> {
        let error = |(camera, seen): &(_, Vec<_>)| {
            let mut held_out = HeldOut::of_performer_alone(Clone::clone(camera));
            for (&frame, body) in self.frames.iter().zip(&self.bodies) {
                held_out.compare(&seen[frame], body);
            }
            held_out.finish()
        };
        let cameras: Vec<HoldOut> = sequence.held_out.iter().map(error).collect();
        HoldOut::of_all(&cameras)?.median_px
    }

    fn trace(
        &self,
        fps: f64,
        comparable: &[Posture],
        joints: &[MarkerPositions],
        true_joints: &[MarkerPositions],
    ) -> Trace {
        let mut trace = Trace::default();
        let truths = self.truths.iter().zip(true_joints);
        for (index, (&frame, (truth, true_joints))) in self.frames.iter().zip(truths).enumerate() {
            let errors: Vec<f64> = match comparable.get(index) {
                Some(posture) => distances(&posture.positions, &truth.positions).collect(),
                None => {
                    let pairs = joints[index].iter().zip(true_joints);
                    pairs.filter_map(|(a, b)| Some(((*a)? - (*b)?).norm())).collect()
                }
            };
            let at = frame as f64 / fps;
            trace.error_mm.extend(mean(&errors).map(|error| (at, 1e3 * error)));
            trace.heights.push((at, heights(&joints[index])));
        }
        let jumps: Vec<(usize, f64)> = metrics::velocity_jumps(&self.postures, fps).collect();
        for &border in &self.borders {
            for (slot, sum) in trace.around_borders.iter_mut().enumerate() {
                let frame = (border + slot).checked_sub(REACH + 1);
                if let Some((_, jump)) = frame.and_then(|index| jumps.get(index)) {
                    *sum = (sum.0 + jump, sum.1 + 1);
                }
            }
        }
        trace
    }
}

/// The errors of all joints; `None` without frames.
fn pose_errors(
    estimates: &[Posture],
    truths: &[Posture],
    deviations: &[Option<JointDeviations>],
) -> Option<metrics::PoseErrors> {
    let mut sums = PoseErrorSums::default();
    for ((estimate, truth), deviations) in estimates.iter().zip(truths).zip(deviations) {
        sums.add(estimate, truth, deviations.as_ref());
    }
    sums.errors()
}

fn distances<'a>(a: &'a [Vector3<f64>], b: &'a [Vector3<f64>]) -> impl Iterator<Item = f64> + 'a {
    a.iter().zip(b).map(|(a, b)| (a - b).norm())
}
