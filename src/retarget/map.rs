//! The user's settings for a target: a TOML file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::RetargetError;
use crate::core::body::Joint;

/// Which axis of the file's world points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Up {
    /// +y, facing +z.
    Y,
    /// +z, facing -y.
    Z,
}

/// A map file:
///
/// ```toml
/// scale = 1.05       # movement over the floor, target over ours; default: ratio of the leg lengths
/// unit = "cm"        # m, dm, cm, mm, inch, foot, or a number of metres; default: guessed
/// up = "z"           # up axis of the file's world, y or z; default: from the zero pose
/// [joints]
/// left_knee = "LeftLeg"
/// head = ""          # the target has no such joint
/// ```
///
/// Keys of `[joints]` are our joints, `l_knee` or `left_knee`. Joints without an entry are guessed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Map {
    /// Path of the file, for errors.
    pub path: PathBuf,
    /// Scale of the movement, target over ours.
    pub scale: Option<f64>,
    /// Metres per unit of the file.
    pub unit: Option<f64>,
    /// Up axis of the file's world.
    pub up: Option<Up>,
    /// Our joint and the target's; `None`: the target has no such joint.
    pub joints: Vec<(Joint, Option<String>)>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    scale: Option<f64>,
    unit: Option<Unit>,
    up: Option<Up>,
    #[serde(default)]
    joints: BTreeMap<String, String>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Unit {
    Metres(f64),
    Name(String),
}

/// Units by name, in metres.
pub(super) const UNITS: [(&str, f64); 6] =
    [("m", 1.0), ("dm", 0.1), ("cm", 0.01), ("mm", 0.001), ("inch", 0.0254), ("foot", 0.3048)];

impl Map {
    /// Reads a file.
    ///
    /// # Errors
    /// The file cannot be read; errors of [`Map::parse`].
    pub fn read(path: &Path) -> Result<Self, RetargetError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| RetargetError::Read { path: path.into(), source })?;
        Self::parse(&text, path)
    }

    /// Parses the text of a file; errors name `path`.
    ///
    /// # Errors
    /// Invalid TOML, unknown keys, values out of range, unknown joints.
    pub fn parse(text: &str, path: &Path) -> Result<Self, RetargetError> {
        let file: File = toml::from_str(text).map_err(|error| {
            let before = error.span().map_or("", |span| text.get(..span.start).unwrap_or(text));
            let line = 1 + before.matches('\n').count();
            let reason = error.message().replace('\n', " ");
            RetargetError::Map { path: path.into(), line, reason }
        })?;
        if let Some(scale) = file.scale.filter(|&scale| !is_positive(scale)) {
            return Err(wrong(path, "scale", scale.to_string(), "a number above 0"));
        }
        let joints = file.joints.into_iter().map(|(key, value)| match ours(&key) {
            Some(joint) => Ok((joint, Some(value).filter(|value| !value.is_empty()))),
            None => Err(RetargetError::OurJoint { path: path.into(), key, ours: our_names() }),
        });
        Ok(Self {
            joints: joints.collect::<Result<_, _>>()?,
            unit: file.unit.map(|unit| metres(unit, path)).transpose()?,
            path: path.into(),
            scale: file.scale,
            up: file.up,
        })
    }
}

fn is_positive(value: f64) -> bool {
    value.is_finite() && value > 0.0
}

fn metres(unit: Unit, path: &Path) -> Result<f64, RetargetError> {
    let (metres, said) = match unit {
        Unit::Metres(metres) => (Some(metres).filter(|m| is_positive(*m)), metres.to_string()),
        Unit::Name(name) => {
            let known = UNITS.iter().find(|(known, _)| *known == name);
            (known.map(|(_, metres)| *metres), format!("{name:?}"))
        }
    };
    let allowed = "m, dm, cm, mm, inch, foot, or a number of metres above 0";
    metres.ok_or_else(|| wrong(path, "unit", said, allowed))
}

fn wrong(path: &Path, key: &str, value: String, allowed: &'static str) -> RetargetError {
    RetargetError::Value { path: path.into(), key: key.into(), value, allowed }
}

/// Our joint for a key such as `l_knee` or `left_knee`.
fn ours(key: &str) -> Option<Joint> {
    let short = match (key.strip_prefix("left_"), key.strip_prefix("right_")) {
        (Some(rest), _) => format!("l_{rest}"),
        (_, Some(rest)) => format!("r_{rest}"),
        _ => key.to_owned(),
    };
    Joint::from_name(&short)
}

fn our_names() -> String {
    Joint::ALL.map(Joint::name).join(", ")
}
