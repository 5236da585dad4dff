//! Scores a method on a sequence.

use serde::Serialize;

use super::case::Sequence;
use crate::core::body::{JOINTS, Joint, Posture};
use crate::core::time::{Nanos, Timestamp};
use crate::metrics;
use crate::research::methods::Solved;

/// Frames before and after a border in [`Trace::around_borders`].
pub const REACH: usize = 10;

/// The metrics of a method on a sequence. See [`crate::metrics`] for the formulas.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[allow(missing_docs)]
pub struct Score {
    /// Errors of the compared frames.
    #[serde(flatten)]
    pub pose: metrics::PoseErrors,
    /// Share of the sequence's frames that have a pose, percent.
    pub covered_percent: f64,
    pub acceleration_error_m_s2: f64,
    /// `None` for a method without borders.
    pub velocity_jump: Option<metrics::VelocityJump>,
    /// `None` if no foot stands.
    pub foot_skate: Option<metrics::FootSkate>,
    /// Mean wall time per frame, milliseconds. The only metric that differs from run to run.
    pub ms_per_frame: f64,
}

/// The plot data of a method on a sequence.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trace {
    /// Seconds from the start and mean joint error, millimetres, of every compared frame.
    pub error_mm: Vec<(f64, f64)>,
    /// Seconds from the start and height of each joint, metres.
    pub heights: Vec<(f64, [f32; JOINTS])>,
    /// Sum and count of the mean velocity jump by frames from the nearest border,
    /// from -[`REACH`] to [`REACH`].
    pub around_borders: [(f64, usize); 2 * REACH + 1],
}

/// Compares poses with the truth of the same frames; `None` for fewer than three.
pub fn score(sequence: &Sequence, solved: &Solved, ms_per_frame: f64) -> Option<(Score, Trace)> {
    let fps = sequence.take.fps;
    let runs = Runs::new(sequence, solved)?;
    let Runs { estimates, truths, borders, .. } = &runs;
    let errors = metrics::pose_errors(estimates.iter().zip(truths))?;
    let score = Score {
        covered_percent: 100.0 * errors.frames as f64 / sequence.truth.len() as f64,
        pose: errors,
        acceleration_error_m_s2: metrics::acceleration_error(estimates, truths, fps)?,
        velocity_jump: metrics::velocity_jump(estimates, borders, fps),
        foot_skate: metrics::foot_skate(estimates, truths, fps),
        ms_per_frame,
    };
    let trace = runs.trace(fps);
    Some((score, trace))
}

/// Seconds and height of every joint of the truth.
pub fn true_heights(sequence: &Sequence) -> Vec<(f64, [f32; JOINTS])> {
    let Some(first) = sequence.truth.first().map(|pose| pose.capture) else { return Vec::new() };
    let height = |pose: &crate::core::body::StampedPose| {
        (pose.capture.seconds_since(first), heights(&pose.pose.posture(&sequence.skeleton)))
    };
    sequence.truth.iter().map(height).collect()
}

fn heights(posture: &Posture) -> [f32; JOINTS] {
    Joint::ALL.map(|joint| posture.positions[joint.index()].y as f32)
}

/// Estimate and truth of the same frames, in order.
struct Runs {
    seconds: Vec<f64>,
    estimates: Vec<Posture>,
    truths: Vec<Posture>,
    /// Indices of frames.
    borders: Vec<usize>,
}

impl Runs {
    fn new(sequence: &Sequence, solved: &Solved) -> Option<Self> {
        let first = sequence.truth.first()?.capture;
        let fps = sequence.take.fps;
        let frame_of = |at: Timestamp| -> Option<usize> {
            let frame = (at.seconds_since(first) * fps).round();
            let truth = sequence.truth.get(frame as usize).filter(|_| frame >= 0.0)?;
            let near = (truth.capture - at).abs() < Nanos::new((0.1e9 / fps) as i64);
            near.then_some(frame as usize)
        };
        // The last pose of a frame is used.
        let mut by_frame = vec![None; sequence.truth.len()];
        for (at, pose) in &solved.poses {
            if let Some(frame) = frame_of(*at) {
                by_frame[frame] = Some(pose);
            }
        }
        let mut runs = Self { seconds: vec![], estimates: vec![], truths: vec![], borders: vec![] };
        let borders: Vec<usize> = solved.borders.iter().copied().filter_map(frame_of).collect();
        for (frame, (pose, truth)) in by_frame.iter().zip(&sequence.truth).enumerate() {
            let Some(pose) = pose else { continue };
            if borders.binary_search(&frame).is_ok() {
                runs.borders.push(runs.estimates.len());
            }
            runs.seconds.push(truth.capture.seconds_since(first));
            runs.estimates.push(pose.posture(&solved.skeleton));
            runs.truths.push(truth.pose.posture(&sequence.skeleton));
        }
        Some(runs)
    }

    fn trace(&self, fps: f64) -> Trace {
        let mut trace = Trace::default();
        for ((&at, estimate), truth) in self.seconds.iter().zip(&self.estimates).zip(&self.truths) {
            let pairs = estimate.positions.iter().zip(&truth.positions);
            let error = pairs.map(|(a, b)| (a - b).norm()).sum::<f64>() / JOINTS as f64;
            trace.error_mm.push((at, 1e3 * error));
            trace.heights.push((at, heights(estimate)));
        }
        let jumps: Vec<(usize, f64)> = metrics::velocity_jumps(&self.estimates, fps).collect();
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
