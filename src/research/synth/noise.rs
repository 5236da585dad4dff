//! How a detector errs, as numbers, and the levels of the evaluation.

use serde::{Deserialize, Serialize};

/// How a detector errs. Rates are occurrences a second and camera; `_s` is the longest that one
/// lasts, in seconds. Sizes in the image are shares of the person's height in pixels, so errors grow
/// with the person. The default is [`Noise::studio`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Noise {
    /// Standard deviation of a limb's points along each axis, as a share of the person's height,
    /// where the detector is as sure as usual.
    pub jitter: f64,
    /// Share of the jitter's variance that is new in each frame; the rest changes slowly.
    pub new_share: f64,
    /// Time over which the slow jitter changes, seconds.
    pub correlation_s: f64,
    /// How the difficulty of a point changes over time: standard deviation of the logarithm of a
    /// factor on the jitter, for each point and camera.
    pub hardness: f64,
    /// Time over which the difficulty changes, seconds.
    pub hardness_s: f64,
    /// What a camera's detector takes a point to be shifts with the view: standard deviation along
    /// each axis, as a share of the height.
    pub wander: f64,
    /// Time over which that changes, seconds.
    pub wander_s: f64,
    /// Where a detector believes a point to be on the body: standard deviation along each axis of an
    /// offset in the frame of the point's joint, metres. The same in every view and for a whole
    /// recording; left and right mirror each other, as detectors are trained on mirrored images.
    pub bias_m: f64,
    /// Confidence of a point without jitter.
    pub confidence: f64,
    /// How much the confidence falls short of that for an error of one standard deviation at
    /// usual difficulty.
    pub doubt: f64,
    /// Probability that a point is missing at usual difficulty; it grows with the square of the
    /// difficulty.
    pub missing: f64,
    /// Probability that a point is grossly wrong, with a middling confidence.
    pub outliers: f64,
    /// A limb hidden from the camera: its points go missing, or are guessed.
    pub occlusions: f64,
    /// See `occlusions`; per limb.
    pub occlusion_s: f64,
    /// Share of the occlusions in which the limb is guessed, with middling confidence, and not
    /// missing.
    pub hallucinated: f64,
    /// Standard deviation along each axis of a guess at the end of a limb, as a share of the height.
    pub hallucination: f64,
    /// Left and right of the legs, or of the arms, swapped.
    pub swaps: f64,
    /// See `swaps`.
    pub swap_s: f64,
    /// A bystander at the edge of the floor is detected too.
    pub strangers: f64,
    /// See `strangers`.
    pub stranger_s: f64,
    /// The performer is reported as two people, trunk and legs.
    pub splits: f64,
    /// See `splits`.
    pub split_s: f64,
    /// Nobody is detected.
    pub blanks: f64,
    /// See `blanks`.
    pub blank_s: f64,
}

impl Default for Noise {
    fn default() -> Self {
        Self::studio()
    }
}

impl Noise {
    /// The levels by name, for settings and the command line.
    pub const LEVELS: [&'static str; 5] = ["none", "jitter", "clean", "studio", "sparse"];

    /// The level of that name.
    pub fn level(name: &str) -> Option<Self> {
        Some(match name {
            "none" => Self::none(),
            "jitter" => Self::jitter_only(),
            "clean" => Self::clean(),
            "studio" => Self::studio(),
            "sparse" => Self::sparse(),
            _ => return None,
        })
    }

    /// Exact projections with confidence 1; only what lies outside the image is missing.
    pub fn none() -> Self {
        Self {
            jitter: 0.0,
            new_share: 1.0 / 3.0,
            correlation_s: 0.12,
            hardness: 0.0,
            hardness_s: 0.5,
            wander: 0.0,
            wander_s: 1.0,
            bias_m: 0.0,
            confidence: 1.0,
            doubt: 0.0,
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
            blanks: 0.0,
            blank_s: 0.1,
        }
    }

    /// Jitter alone.
    pub fn jitter_only() -> Self {
        Self { jitter: 0.006, doubt: 0.10, ..Self::none() }
    }

    /// A good detector and a body that it knows: small jitter, a rare gap, nothing else.
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

    /// A studio with plain backgrounds and a detector of good quality.
    pub fn studio() -> Self {
        Self {
            jitter: 0.006,
            new_share: 0.22,
            correlation_s: 0.12,
            hardness: 0.45,
            hardness_s: 0.5,
            wander: 0.008,
            wander_s: 1.0,
            bias_m: 0.012,
            confidence: 0.75,
            doubt: 0.12,
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
            blanks: 0.02,
            blank_s: 0.1,
        }
    }

    /// Few cameras and a detector far from what it was trained on.
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
