//! DCT: segments with low-frequency joint trajectories \[Huang 2017\].
//!
//! cost = data term + prior of every frame + 1/2 smoothness |P - B c|^2, where P holds the
//! trajectories of all joints over a segment, B the first DCT basis vectors and c the coefficients
//! that fit P best. Each segment is solved on its own and starts from the per-frame solutions.
//! Differences: in the publication c is an unknown and the data term uses silhouettes. Here c is
//! the closed-form optimum for the current P.

use serde::{Deserialize, Serialize};

use super::muvs::{MuVsWeights, PerFrame};
use super::path::Term;
use super::terms::LowFrequency;
use super::{Delay, Method, Solved, Take};
use crate::core::body::fitted_points;
use crate::core::cost;
use crate::core::manifold::Decoder;

/// Weights of [`Dct`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DctWeights {
    /// Weight of the squared distance of each joint from its low-frequency trajectory, square
    /// pixels per square metre.
    pub smoothness: f64,
    /// Weight of |z|^2 in each frame, square pixels.
    pub prior: f64,
    /// Scale of the Geman-McClure loss, pixels.
    pub scale_px: f64,
    /// Frames per segment, as published.
    pub segment: usize,
    /// DCT basis vectors per segment, as published.
    pub components: usize,
    /// Maximum iterations per segment.
    pub iterations: usize,
}

impl Default for DctWeights {
    fn default() -> Self {
        Self {
            smoothness: 3e5,
            prior: 30.0,
            scale_px: 30.0,
            segment: 30,
            components: 10,
            iterations: 30,
        }
    }
}

/// Segments with low-frequency joint trajectories.
#[derive(Clone, Debug, Default)]
pub struct Dct {
    weights: DctWeights,
}

impl Dct {
    /// The method with the given weights.
    pub fn new(weights: DctWeights) -> Self {
        Self { weights }
    }
}

impl Method for Dct {
    fn name(&self) -> String {
        "DCT".to_owned()
    }

    fn delay(&self, _: f64) -> Delay {
        Delay::Frames(self.weights.segment)
    }

    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        let weights = &self.weights;
        let found = PerFrame::solve(take, decoder, &MuVsWeights::default())?;
        let cost =
            cost::Config { prior: weights.prior, scale_px: weights.scale_px, ..found.config.cost };
        let points = fitted_points(take.format);
        let scene = cost::Scene { decoder, rig: &take.rig, points: &points, config: &cost };
        let segment = weights.segment.max(1);
        let mut keyframes = Vec::with_capacity(found.keyframes.len());
        for (initial, observations) in
            found.keyframes.chunks(segment).zip(found.observations.chunks(segment))
        {
            // A shorter last segment keeps the same highest frequency.
            let components = (weights.components * initial.len()).div_ceil(segment);
            let low = LowFrequency::new(weights.smoothness, initial.len(), components);
            let terms: [Box<dyn Term>; 1] = [Box::new(low)];
            let start = (observations, initial);
            keyframes.extend(found.minimised(scene, start, &terms, [true; 2], weights.iterations));
        }
        Some(found.solved(decoder, &keyframes, segment))
    }
}
