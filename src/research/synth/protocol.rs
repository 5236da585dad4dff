//! The numbers of the evaluation: motions, bodies, rigs, and how the detectors err.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::noise::Noise;

/// How test sequences are made of motions; see [`sequence`](super::sequence).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SequenceChoice {
    /// Frames a second of the cameras.
    pub fps: f64,
    /// Longest sequence, seconds.
    pub seconds: f64,
    /// Motions that give less than this are left out, seconds.
    pub least_seconds: f64,
    /// How far the pelvis goes from the middle of the floor, metres.
    pub radius_m: f64,
    /// Standard deviation of the shape's coefficients.
    pub shape_spread: f64,
    /// The coefficients are clipped to this size.
    pub shape_limit: f64,
}

impl Default for SequenceChoice {
    fn default() -> Self {
        Self {
            fps: 50.0,
            seconds: 8.0,
            least_seconds: 1.5,
            radius_m: 1.6,
            shape_spread: 0.8,
            shape_limit: 2.0,
        }
    }
}

/// The protocol of the evaluation. `config/eval.toml` holds it with comments.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Protocol {
    /// Subjects whose motions are used: those the weights that ship have not seen.
    pub subjects: Vec<String>,
    /// Names of rigs, see [`rig_named`](super::rig_named).
    pub rigs: Vec<String>,
    /// Keypoint format of the detectors.
    pub format: String,
    /// Each seed is a pass over all motions; the seed of a sequence also depends on its place.
    pub seeds: Vec<u64>,
    /// How sequences are made.
    pub sequence: SequenceChoice,
    /// How the detectors err, by level.
    pub levels: BTreeMap<String, Noise>,
}

impl Default for Protocol {
    fn default() -> Self {
        let levels =
            [("clean", Noise::clean()), ("studio", Noise::studio()), ("sparse", Noise::sparse())];
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
    /// The seed of the `index`-th sequence in the pass of `seed`: for [`sequence`](super::sequence)
    /// and for the detectors.
    pub fn seed_of(seed: u64, index: usize) -> u64 {
        seed.wrapping_mul(1_000_003).wrapping_add(index as u64)
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
