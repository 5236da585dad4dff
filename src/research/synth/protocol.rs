//! Settings of the evaluation: motions, bodies, rigs and noise levels.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::body::Body;
use super::noise::Noise;
use crate::core::fnv::fnv1a;

/// How test sequences are cut from motions; see [`sequence`](super::sequence).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SequenceChoice {
    /// The kind of the performer's body.
    pub body: Body,
    /// Frame rate of the cameras, Hz.
    pub fps: f64,
    /// Longest sequence, seconds.
    pub seconds: f64,
    /// Shortest sequence, seconds; motions that give less are skipped.
    pub least_seconds: f64,
    /// Largest distance of the pelvis from the middle of the floor, metres.
    pub radius_m: f64,
    /// Standard deviation of the shape coefficients.
    pub shape_spread: f64,
    /// Largest magnitude of the coefficients; they are clipped to it.
    pub shape_limit: f64,
}

impl Default for SequenceChoice {
    fn default() -> Self {
        Self {
            body: Body::Own,
            fps: 50.0,
            seconds: 8.0,
            least_seconds: 1.5,
            radius_m: 1.6,
            shape_spread: 0.8,
            shape_limit: 2.0,
        }
    }
}

/// The protocol of the evaluation; `config/eval.toml` explains each setting.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Protocol {
    /// Subjects whose motions are used; by default those held out from the embedded weights.
    pub subjects: Vec<String>,
    /// Names of rigs; see [`rig_named`](super::rig_named).
    pub rigs: Vec<String>,
    /// Keypoint format of the detectors.
    pub format: String,
    /// One pass over all motions per seed; a sequence's seed also depends on its name.
    pub seeds: Vec<u64>,
    /// How sequences are made.
    pub sequence: SequenceChoice,
    /// Noise of the detectors, by level.
    pub levels: BTreeMap<String, Noise>,
}

impl Default for Protocol {
    fn default() -> Self {
        let levels = [
            ("clean", Noise::clean()),
            ("studio", Noise::studio()),
            ("sparse", Noise::sparse()),
            ("uniform", Noise::uniform()),
            ("systematic", Noise::systematic()),
        ];
        let owned = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
        Self {
            subjects: owned(&["07", "10"]),
            rigs: owned(&["h36m", "h36m-s11", "3dhp", "ring4"]),
            format: "body_25".to_owned(),
            seeds: vec![1],
            sequence: SequenceChoice::default(),
            levels: levels.map(|(name, noise)| (name.to_owned(), noise)).into(),
        }
    }
}

impl Protocol {
    /// The seed of the motion `name` in the pass of `seed`, for [`sequence`](super::sequence) and
    /// the detectors. It does not depend on the other motions.
    pub fn seed_of(seed: u64, name: &str) -> u64 {
        seed.wrapping_mul(1_000_003) ^ fnv1a(name.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_commented_file_holds_every_default() {
        let text = include_str!("../../../config/eval.toml");
        assert_eq!(toml::from_str(text), Ok(Protocol::default()));
    }
}
