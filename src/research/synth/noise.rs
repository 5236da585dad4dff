//! The detector's noise model and the noise levels of the evaluation.

use serde::{Deserialize, Serialize};

/// Parameters of the noise model. Event rates are per second and camera; `_s` is the longest
/// duration, seconds. Image sizes are relative to the person's height in pixels, so errors scale
/// with the person. The default is [`Noise::studio`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Noise {
    /// Standard deviation of a limb's points along each axis at usual difficulty, relative to the
    /// person's height.
    pub jitter: f64,
    /// Share of the jitter's variance that is new in each frame; the rest changes slowly.
    pub new_share: f64,
    /// Time over which the slow jitter changes, seconds.
    pub correlation_s: f64,
    /// Variation of a point's difficulty over time: standard deviation of the logarithm of a factor
    /// on the jitter, per point and camera.
    pub hardness: f64,
    /// Time over which the difficulty changes, seconds.
    pub hardness_s: f64,
    /// Slow shift of a point with the view: standard deviation along each axis, relative to the
    /// height.
    pub wander: f64,
    /// Time over which this shift changes, seconds.
    pub wander_s: f64,
    /// Differences of the views: standard deviation of the logarithm of a camera's factor on the slow
    /// shifts.
    pub view_spread: f64,
    /// Systematic offset of a point on the body: standard deviation along each axis in the frame of
    /// the point's joint, metres. The offset is the same in every view for a whole recording; left
    /// and right mirror each other, because detectors are trained on mirrored images, as far as
    /// [`Body`](super::Body) says.
    pub bias_m: f64,
    /// Confidence of a point without jitter.
    pub confidence: f64,
    /// Loss of confidence for an error of one standard deviation at usual difficulty.
    pub doubt: f64,
    /// Whether all points of a person in a frame have the mean of their confidences.
    pub one_confidence: bool,
    /// Probability that a point is missing at usual difficulty; grows with the square of the
    /// difficulty.
    pub missing: f64,
    /// Probability of a gross error, with medium confidence.
    pub outliers: f64,
    /// Rate at which a limb is occluded; its points are missing or guessed.
    pub occlusions: f64,
    /// Longest occlusion of a limb, seconds.
    pub occlusion_s: f64,
    /// Share of the occlusions in which the limb is guessed, with medium confidence.
    pub hallucinated: f64,
    /// Standard deviation along each axis of a guess at the end of a limb, relative to the height.
    pub hallucination: f64,
    /// Rate at which left and right of the legs, or of the arms, are swapped.
    pub swaps: f64,
    /// Longest swap, seconds.
    pub swap_s: f64,
    /// Rate at which a bystander at the edge of the floor is detected too.
    pub strangers: f64,
    /// Longest detection of the bystander, seconds.
    pub stranger_s: f64,
    /// Rate at which the performer is reported as two people, trunk and legs.
    pub splits: f64,
    /// Longest split, seconds.
    pub split_s: f64,
    /// Rate at which two people who overlap in the image are mixed: each has a limb of the other, or the
    /// nearer one is seen twice.
    pub mixed: f64,
    /// Longest mixture, seconds.
    pub mixed_s: f64,
    /// Rate at which nobody is detected.
    pub blanks: f64,
    /// Longest time without a detection, seconds.
    pub blank_s: f64,
    /// Time from the first row of an image to its last, seconds: a rolling shutter. Half of it is before the
    /// capture time. 0: all rows at once.
    pub readout_s: f64,
}

impl Default for Noise {
    fn default() -> Self {
        Self::studio()
    }
}

impl Noise {
    /// Exact projections with confidence 1; only points outside the image are missing.
    pub fn none() -> Self {
        Self {
            jitter: 0.0,
            new_share: 1.0 / 3.0,
            correlation_s: 0.12,
            hardness: 0.0,
            hardness_s: 0.5,
            wander: 0.0,
            wander_s: 1.0,
            view_spread: 0.0,
            bias_m: 0.0,
            confidence: 1.0,
            doubt: 0.0,
            one_confidence: false,
            missing: 0.0,
            outliers: 0.0,
            occlusions: 0.0,
            occlusion_s: 0.8,
            hallucinated: 0.5,
            hallucination: 0.0,
            swaps: 0.0,
            swap_s: 0.25,
            strangers: 0.0,
            stranger_s: 1.5,
            splits: 0.0,
            split_s: 0.2,
            mixed: 0.0,
            mixed_s: 0.3,
            blanks: 0.0,
            blank_s: 0.1,
            readout_s: 0.0,
        }
    }

    /// The same with errors of another size; gaps, swaps and gross errors stay as frequent.
    pub fn times(&self, factor: f64) -> Self {
        Self {
            jitter: factor * self.jitter,
            wander: factor * self.wander,
            bias_m: factor * self.bias_m,
            hallucination: factor * self.hallucination,
            ..self.clone()
        }
    }

    /// The same with jitter in place of the slow shifts, of the same variance together. A share of it is
    /// new in each frame.
    pub fn with_new_share(&self, new_share: f64) -> Self {
        Self { jitter: self.jitter.hypot(self.wander), wander: 0.0, new_share, ..self.clone() }
    }

    /// Only jitter.
    pub fn jitter_only() -> Self {
        Self { jitter: 0.006, doubt: 0.10, ..Self::none() }
    }

    /// A good detector: small jitter and offsets, rare gaps, nothing else.
    pub fn clean() -> Self {
        Self {
            jitter: 0.003,
            hardness: 0.2,
            bias_m: 0.003,
            doubt: 0.05,
            missing: 0.002,
            ..Self::none()
        }
    }

    /// A good detector in a studio with plain backgrounds.
    pub fn studio() -> Self {
        Self {
            jitter: 0.006,
            new_share: 0.22,
            correlation_s: 0.12,
            hardness: 0.45,
            hardness_s: 0.5,
            wander: 0.008,
            wander_s: 1.0,
            view_spread: 0.0,
            bias_m: 0.012,
            confidence: 0.75,
            doubt: 0.12,
            one_confidence: false,
            missing: 0.015,
            outliers: 0.003,
            occlusions: 0.15,
            occlusion_s: 0.8,
            hallucinated: 0.7,
            hallucination: 0.04,
            swaps: 0.03,
            swap_s: 0.25,
            strangers: 0.06,
            stranger_s: 1.5,
            splits: 0.02,
            split_s: 0.2,
            mixed: 0.1,
            mixed_s: 0.3,
            blanks: 0.02,
            blank_s: 0.1,
            readout_s: 0.0,
        }
    }

    /// The detector of the two takes of mohamdev/pykinematics in `docs/results/solver.md`, without
    /// their errors of views: one confidence for all points, guesses instead of missing points.
    pub fn uniform() -> Self {
        Self {
            jitter: 0.0022,
            new_share: 0.5,
            wander: 0.003,
            confidence: 0.9,
            doubt: 0.02,
            one_confidence: true,
            occlusions: 0.2,
            hallucinated: 1.0,
            hallucination: 0.06,
            missing: 0.0,
            outliers: 0.0,
            swaps: 0.0,
            strangers: 0.0,
            splits: 0.0,
            blanks: 0.0,
            ..Self::studio()
        }
    }

    /// The detector of those takes: [`Noise::uniform`] with errors that differ from view to view and
    /// hardly change.
    pub fn systematic() -> Self {
        Self { wander: 0.0055, wander_s: 8.0, view_spread: 0.4, ..Self::uniform() }
    }

    /// Few cameras, and a detector far from its training data.
    pub fn sparse() -> Self {
        Self {
            jitter: 0.0195,
            hardness: 0.6,
            wander: 0.022,
            bias_m: 0.033,
            confidence: 0.70,
            doubt: 0.10,
            missing: 0.04,
            outliers: 0.01,
            occlusions: 0.25,
            occlusion_s: 1.2,
            hallucination: 0.069,
            swaps: 0.06,
            swap_s: 0.5,
            ..Self::studio()
        }
    }
}
