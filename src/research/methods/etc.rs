//! ETC: all frames at once, with a penalty on joint velocity \[Arnab 2019\].
//!
//! cost = data term + prior of every frame + 1/2 smoothness sum of |P_j(t + 1) - P_j(t)|^2 over
//! joints and frames, starting from the per-frame solutions. Differences: the publication starts from
//! the poses of a regressor. It uses one camera, so it also keeps the joints near a network's 3D joints and the camera's scale constant.
//! Several views need neither.

use serde::{Deserialize, Serialize};

use super::muvs::{MuVsWeights, PerFrame};
use super::path::Term;
use super::terms::JointSteps;
use super::{Delay, Method, Solved, Take};
use crate::core::body::fitted_points;
use crate::core::cost;
use crate::core::manifold::Decoder;

/// Weights of [`Etc`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EtcWeights {
    /// Weight of the squared displacement of each joint from frame to frame, square pixels per
    /// square metre.
    pub smoothness: f64,
    /// Weight of |z|^2 in each frame, square pixels.
    pub prior: f64,
    /// Scale of the Geman-McClure loss, pixels.
    pub scale_px: f64,
    /// Maximum iterations over all frames.
    pub iterations: usize,
}

impl Default for EtcWeights {
    fn default() -> Self {
        Self { smoothness: 9e4, prior: 30.0, scale_px: 30.0, iterations: 30 }
    }
}

/// All frames at once, with a penalty on joint velocity.
#[derive(Clone, Debug, Default)]
pub struct Etc {
    weights: EtcWeights,
}

impl Etc {
    /// The method with the given weights.
    pub fn new(weights: EtcWeights) -> Self {
        Self { weights }
    }
}

impl Method for Etc {
    fn name(&self) -> String {
        "ETC".to_owned()
    }

    fn delay(&self, _: f64) -> Delay {
        Delay::Recording
    }

    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        let weights = &self.weights;
        let found = PerFrame::solve(take, decoder, &MuVsWeights::default())?;
        let cost =
            cost::Config { prior: weights.prior, scale_px: weights.scale_px, ..found.config.cost };
        let points = fitted_points(take.format);
        let scene = cost::Scene { decoder, rig: &take.rig, points: &points, config: &cost };
        let terms: [Box<dyn Term>; 1] = [Box::new(JointSteps { weight: weights.smoothness })];
        let start = (&found.observations[..], &found.keyframes[..]);
        let keyframes = found.minimised(scene, start, &terms, [true; 2], weights.iterations);
        Some(Solved { borders: Vec::new(), ..found.solved(decoder, &keyframes, 1) })
    }
}
