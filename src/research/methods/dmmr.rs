//! DMMR: segments with one latent code per frame and smoothness between neighbours, in four stages
//! \[Huang 2021\].
//!
//! cost = data term + prior of every frame + 1/2 latent |z(t + 1) - z(t)|^2 +
//! 1/2 rotation |log(R(t + 1) R(t)^T)|^2 + 1/2 position |p(t + 1) - p(t)|^2.
//!
//! Each segment is solved on its own and starts from the per-frame solutions. The stages solve for:
//! 1. rotation and position of the root, with a loss of a larger scale,
//! 2. codes, with the same loss,
//! 3. all unknowns, with the same loss,
//! 4. all unknowns, with the final loss.
//!
//! Differences: the publication also solves for cameras and several people, in segments of 64 frames
//! and with a penalty on joint velocities. Its codes come from a
//! motion prior that is trained to be smooth; here they are codes of single poses. Its stages go
//! from root and cameras to all unknowns, each with its own weights; here all stages share the
//! weights and differ in the free unknowns and in the loss.

use serde::{Deserialize, Serialize};

use super::muvs::{MuVsWeights, PerFrame};
use super::path::Term;
use super::terms::KeyframeSteps;
use super::{Delay, Method, Solved, Take};
use crate::core::body::fitted_points;
use crate::core::cost;
use crate::core::manifold::Decoder;

/// Weights of [`Dmmr`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DmmrWeights {
    /// Weight of the squared change of the code from frame to frame, square pixels.
    pub latent: f64,
    /// Weight of the squared root rotation from frame to frame, square pixels per square radian.
    pub rotation: f64,
    /// Weight of the squared root translation from frame to frame, square pixels per square metre.
    pub position: f64,
    /// Weight of |z|^2 in each frame, square pixels.
    pub prior: f64,
    /// Scale of the Geman-McClure loss of the last stage, pixels.
    pub scale_px: f64,
    /// Factor on that scale in the earlier stages.
    pub loose_scale: f64,
    /// Frames per segment.
    pub segment: usize,
    /// Maximum iterations of each stage.
    pub iterations: [usize; 4],
}

impl Default for DmmrWeights {
    fn default() -> Self {
        Self {
            latent: 300.0,
            rotation: 3e4,
            position: 3e5,
            prior: 30.0,
            scale_px: 30.0,
            loose_scale: 3.0,
            segment: 30,
            iterations: [5, 5, 10, 30],
        }
    }
}

/// Segments with one code per frame and smoothness between neighbours, in four stages.
#[derive(Clone, Debug, Default)]
pub struct Dmmr {
    weights: DmmrWeights,
}

impl Dmmr {
    /// The method with the given weights.
    pub fn new(weights: DmmrWeights) -> Self {
        Self { weights }
    }

    /// The free unknowns of each stage (codes, roots) and the scale of its loss, pixels.
    fn stages(&self) -> [([bool; 2], f64); 4] {
        let (tight, loose) =
            (self.weights.scale_px, self.weights.scale_px * self.weights.loose_scale);
        [
            ([false, true], loose),
            ([true, false], loose),
            ([true, true], loose),
            ([true, true], tight),
        ]
    }
}

impl Method for Dmmr {
    fn name(&self) -> String {
        "DMMR".to_owned()
    }

    fn delay(&self, _: f64) -> Delay {
        Delay::Frames(self.weights.segment)
    }

    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        let weights = &self.weights;
        let found = PerFrame::solve(take, decoder, &MuVsWeights::default())?;
        let points = fitted_points(take.format);
        let steps = KeyframeSteps {
            latent: weights.latent,
            rotation: weights.rotation,
            position: weights.position,
        };
        let terms: [Box<dyn Term>; 1] = [Box::new(steps)];
        let segment = weights.segment.max(1);
        let mut keyframes = Vec::with_capacity(found.keyframes.len());
        for (initial, observations) in
            found.keyframes.chunks(segment).zip(found.observations.chunks(segment))
        {
            let mut now = initial.to_vec();
            for ((free, scale_px), iterations) in self.stages().into_iter().zip(weights.iterations)
            {
                let config = cost::Config { prior: weights.prior, scale_px, ..found.config.cost };
                let scene =
                    cost::Scene { decoder, rig: &take.rig, points: &points, config: &config };
                now = found.minimised(scene, (observations, &now), &terms, free, iterations);
            }
            keyframes.extend(now);
        }
        Some(found.solved(decoder, &keyframes, segment))
    }
}
