//! Settings of the stage.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Most performers of a stage.
const MOST: u8 = 32;

/// Settings of the stage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// How many people are performers.
    pub performers: Performers,
    /// Whether a live node of several performers also solves them. Otherwise it only publishes the
    /// detections of each, for other nodes.
    pub solve: bool,
}

impl Default for Config {
    fn default() -> Self {
        Self { performers: Performers::default(), solve: true }
    }
}

impl Config {
    /// Whether people are told from each other before they are tracked.
    pub fn several(&self) -> bool {
        self.performers.limit() > 1
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
