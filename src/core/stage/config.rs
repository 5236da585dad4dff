//! Settings of the stage.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::core::limits::{Limit, OutOfRange, check};
use crate::core::time::Nanos;

/// Most performers of a stage.
const MOST: u8 = 32;

/// Settings of the stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// How many people are performers at a time.
    pub performers: Performers,
    /// Several performers: names for those who enter, in this order. Others are p1, p2, ... by number.
    pub names: Vec<String>,
    /// Several performers: folder of known bodies, `NAME.mcap` each. People are recognised by them and have these
    /// names. Bodies of performers with a name are written to it. Empty: none.
    pub bodies: String,
    /// Several performers: only people with these names become performers, recognised by their bodies. Empty: everybody.
    pub only: Vec<String>,
    /// Corners of the part of the floor where people become performers: x and z in the world, metres. Everywhere
    /// if there are none.
    pub region: Vec<[f64; 2]>,
    /// A smaller person does not become a performer: least height in at least one image, pixels.
    pub min_height_px: f64,
    /// A performer who is not seen for so long has left, and somebody else may have the place; seconds.
    pub left_after_s: f64,
    /// Whether a live node of several performers also solves them. Otherwise it only publishes the
    /// detections of each, for other nodes.
    pub solve: bool,
}

impl Default for Config {
    fn default() -> Self {
        let (performers, names, bodies) = Default::default();
        let Choice { only, region, min_height_px, left_after_s } = Choice::default();
        let solve = true;
        Self { performers, names, bodies, only, region, min_height_px, left_after_s, solve }
    }
}

impl Config {
    /// Whether people are told from each other before they are tracked.
    pub fn several(&self) -> bool {
        self.performers.limit() > 1
    }

    /// Whether something is set that needs several performers. With one, it is the largest person.
    pub fn chooses(&self) -> bool {
        let is_named = !self.names.is_empty() || !self.bodies.is_empty();
        is_named || self.choice() != Choice::default()
    }

    /// Who may become a performer.
    pub fn choice(&self) -> Choice {
        let Self { only, region, min_height_px, left_after_s, .. } = self.clone();
        Choice { only, region, min_height_px, left_after_s }
    }

    /// Checks the ranges of all numbers.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        let corners = self.region.len();
        let is_shape = corners == 0 || corners >= 3;
        let far = self.region.iter().flatten().map(|at| at.abs()).max_by(f64::total_cmp);
        check([
            Limit::from_0("min_height_px", self.min_height_px),
            Limit("left_after_s", self.left_after_s, 1.0..=LONGEST_S, "1 to 1000000"),
            Limit(
                "region",
                far.unwrap_or_default(),
                0.0..=FARTHEST_M,
                "coordinates of at most 10000 m",
            ),
        ])?;
        let few = OutOfRange {
            key: "region".into(),
            value: corners as f64,
            allowed: "no corners, or 3 or more",
        };
        if is_shape { Ok(()) } else { Err(few) }
    }
}

/// Somebody has left after this time at the latest, seconds.
const LONGEST_S: f64 = 1e6;
/// Corners of a region are not farther from the origin, metres.
const FARTHEST_M: f64 = 1e4;

/// Who may become a performer, and when. The default: everybody.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    /// See [`Config::only`].
    pub only: Vec<String>,
    /// See [`Config::region`].
    pub region: Vec<[f64; 2]>,
    /// See [`Config::min_height_px`].
    pub min_height_px: f64,
    /// See [`Config::left_after_s`].
    pub left_after_s: f64,
}

impl Default for Choice {
    fn default() -> Self {
        Self { only: Vec::new(), region: Vec::new(), min_height_px: 0.0, left_after_s: 30.0 }
    }
}

impl Choice {
    pub(super) fn left_after(&self) -> Nanos {
        Nanos::rounded(self.left_after_s * 1e9)
    }

    /// Whether a person may become a performer. `place`: x and z in the world, metres; `None`: not known.
    /// `height_px`: the largest height in an image, pixels.
    pub(super) fn takes(&self, place: Option<[f64; 2]>, height_px: f64) -> bool {
        let is_there = self.region.is_empty() || place.is_some_and(|place| self.is_inside(place));
        is_there && height_px >= self.min_height_px
    }

    /// Whether a ray from there to +x crosses the border an odd number of times.
    fn is_inside(&self, [x, z]: [f64; 2]) -> bool {
        let from = self.region.iter().cycle().skip(self.region.len().saturating_sub(1));
        let sides = from.zip(&self.region);
        let crossed = sides.filter(|([x0, z0], [x1, z1])| {
            (*z0 > z) != (*z1 > z) && x < x0 + (z - z0) / (z1 - z0) * (x1 - x0)
        });
        crossed.count() % 2 == 1
    }
}

/// How many people are performers: a number from 1 to 32, or `auto` for all.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Number", into = "Number")]
pub enum Performers {
    /// At most so many.
    Number(u8),
    /// Everybody, up to 32.
    Auto,
}

/// As it is written.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Number {
    Of(u8),
    Word(String),
}

/// Not a number of performers.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("performers is {0:?}, but must be 1 to 32 or auto")]
pub struct PerformersError(String);

impl Performers {
    /// The most performers.
    pub fn limit(self) -> usize {
        match self {
            Self::Number(number) => number.into(),
            Self::Auto => MOST.into(),
        }
    }
}

impl Default for Performers {
    fn default() -> Self {
        Self::Number(1)
    }
}

impl FromStr for Performers {
    type Err = PerformersError;

    fn from_str(text: &str) -> Result<Self, PerformersError> {
        match text.parse() {
            Ok(number) if (1..=MOST).contains(&number) => Ok(Self::Number(number)),
            Err(_) if text == "auto" => Ok(Self::Auto),
            _ => Err(PerformersError(text.to_owned())),
        }
    }
}

impl fmt::Display for Performers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => number.fmt(f),
            Self::Auto => "auto".fmt(f),
        }
    }
}

impl TryFrom<Number> for Performers {
    type Error = PerformersError;

    fn try_from(number: Number) -> Result<Self, PerformersError> {
        match number {
            Number::Of(number) => number.to_string().parse(),
            Number::Word(word) => word.parse(),
        }
    }
}

impl From<Performers> for Number {
    fn from(performers: Performers) -> Self {
        match performers {
            Performers::Number(number) => Self::Of(number),
            Performers::Auto => Self::Word(performers.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_region_is_a_polygon_of_any_direction() {
        // An L: the corner at (2, 2) is outside.
        let mut region =
            vec![[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]];
        for _ in 0..2 {
            let min_height_px = 50.0;
            let choice = Choice { region: region.clone(), min_height_px, ..Choice::default() };
            let inside = |x, z| choice.takes(Some([x, z]), 60.0);
            assert!(inside(0.5, 0.5) && inside(2.5, 0.5) && inside(0.5, 2.5));
            assert!(
                !inside(2.0, 2.0) && !inside(-0.5, 0.5) && !inside(0.5, 3.5) && !inside(4.0, 0.5)
            );
            assert!(!choice.takes(Some([0.5, 0.5]), 40.0) && !choice.takes(None, 60.0));
            region.reverse();
        }
        assert!(Choice::default().takes(None, 0.0));
    }

    #[test]
    fn a_region_of_two_corners_is_refused() {
        let of = |region: Vec<[f64; 2]>| Config { region, ..Config::default() }.validate();
        assert!(of(vec![[0.0, 0.0], [1.0, 0.0]]).is_err() && of(vec![[f64::NAN, 0.0]; 3]).is_err());
        assert!(of(vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]).is_ok() && of(Vec::new()).is_ok());
    }
}
