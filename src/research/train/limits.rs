//! A penalty that keeps decoded joint rotations within the range of the corpus.
//!
//! Codes are drawn near the origin and decoded. A joint with the six components v and the
//! Mahalanobis distance m = sqrt((v - mean)^T (C + floor I)^-1 (v - mean)) from the corpus costs
//! max(0, m - [`RADIUS`]). Reason: the encoder's codes fill only a part of the latent space, and
//! the reconstruction loss does not constrain the decoder elsewhere. The solver reaches such codes,
//! for example with a twist that no detection shows.

use nalgebra::{Matrix6, Vector6};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::corpus::{Clip, POSE, mirrored};
use super::mlp::fill_normal;
use crate::core::body::BODY_JOINTS;
use crate::core::manifold::LATENT;

/// Mahalanobis distance up to which a joint costs nothing; 99 % of the corpus is within.
const RADIUS: f32 = 3.5;
/// Variance added to each of the six components, so that a stiff joint may move by about 0.1 rad.
const FLOOR: f64 = 0.01;
/// Codes are N(0, I) times a factor drawn between 0 and this.
const REACH: f32 = 1.2;

/// Mean and inverse covariance of each joint's six components over the corpus and its mirror image.
#[derive(Clone, Debug)]
pub struct Limits {
    joints: Vec<(Vector6<f32>, Matrix6<f32>)>,
}

impl Limits {
    /// Computes the statistics of `clips`.
    pub fn new(clips: &[Clip]) -> Self {
        Self { joints: (0..BODY_JOINTS).map(|joint| statistics(clips, joint)).collect() }
    }

    /// Mean cost over the joints of the decoded `pose` (126 values). Adds `weight` times its
    /// derivative to `by_pose` (126 values).
    pub fn cost(&self, weight: f32, pose: &[f32], by_pose: &mut [f32]) -> f32 {
        let mut cost = 0.0;
        let joints = pose.chunks_exact(6).zip(by_pose.chunks_exact_mut(6)).zip(&self.joints);
        for ((six, by_six), (mean, inverse)) in joints {
            let away = Vector6::from_column_slice(six) - mean;
            let scaled = inverse * away;
            let distance = away.dot(&scaled).max(0.0).sqrt();
            if distance > RADIUS {
                cost += distance - RADIUS;
                let slope = scaled * (weight / (BODY_JOINTS as f32 * distance));
                by_six.iter_mut().zip(slope.iter()).for_each(|(by, slope)| *by += slope);
            }
        }
        cost / BODY_JOINTS as f32
    }
}

fn statistics(clips: &[Clip], joint: usize) -> (Vector6<f32>, Matrix6<f32>) {
    let (mut count, mut sum, mut squares) = (0.0, Vector6::zeros(), Matrix6::zeros());
    for pose in clips.iter().flat_map(|clip| &clip.poses) {
        for pose in [*pose, mirrored(pose)] {
            let six = Vector6::from_fn(|i, _| f64::from(pose[6 * joint + i]));
            count += 1.0;
            sum += six;
            squares += six * six.transpose();
        }
    }
    let mean = sum / f64::max(count, 1.0);
    let covariance = squares / f64::max(count, 1.0) - mean * mean.transpose();
    let floored = covariance + Matrix6::identity() * FLOOR;
    let inverse = floored.try_inverse().unwrap_or_else(Matrix6::identity);
    (mean.cast(), inverse.cast())
}

/// Draws codes near the origin.
pub fn draw_codes(codes: &mut [f32], rng: &mut ChaCha8Rng) {
    fill_normal(codes, rng);
    for code in codes.chunks_exact_mut(LATENT) {
        let scale = REACH * rng.random::<f32>();
        code.iter_mut().for_each(|value| *value *= scale);
    }
}

const _: () = assert!(POSE == 6 * BODY_JOINTS);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::Skeleton;

    fn corpus() -> Vec<Clip> {
        let pose = |i: usize| std::array::from_fn(|k| 0.3 * ((i * 7 + k * k) as f32).sin());
        vec![Clip {
            name: "a".to_owned(),
            subject: "a".to_owned(),
            poses: (0..500).map(pose).collect(),
            roots: Vec::new(),
            skeleton: Skeleton::default(),
        }]
    }

    #[test]
    fn the_corpus_costs_little_and_far_poses_cost_more() {
        let clips = corpus();
        let limits = Limits::new(&clips);
        let mut none = [0.0; POSE];
        assert!(limits.cost(1.0, &clips[0].poses[3], &mut none) < 0.05);
        assert!(limits.cost(1.0, &[5.0; POSE], &mut none) > 1.0);
    }

    #[test]
    fn the_derivative_agrees_with_central_differences() {
        let limits = Limits::new(&corpus());
        let pose: Vec<f32> = (0..POSE).map(|k| 2.0 * (k as f32).cos()).collect();
        let mut analytic = vec![0.0; POSE];
        limits.cost(2.0, &pose, &mut analytic);
        for k in (0..POSE).step_by(5) {
            let at = |step: f32| {
                let mut moved = pose.clone();
                moved[k] += step;
                f64::from(limits.cost(1.0, &moved, &mut [0.0; POSE]))
            };
            let numeric = 2.0 * (at(1e-2) - at(-1e-2)) / 2e-2;
            assert!((f64::from(analytic[k]) - numeric).abs() < 2e-2, "{k}");
        }
    }
}
