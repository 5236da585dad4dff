//! The configuration file: every module's `Config` in one tree.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::core::limits::OutOfRange;
use crate::core::manifold::Decoder;
use crate::core::stage::{self, Known, PerformerId};
use crate::core::tracker;
use crate::io::bus;
use crate::io::recording::{RecordError, known_people};
use crate::io::timecode::{House, TimecodeError};
use crate::io::wire::{NameError, valid_name};
use crate::live;

/// All settings; `config/default.toml` explains each.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The stage.
    pub stage: stage::Config,
    /// The tracker.
    pub tracker: tracker::Config,
    /// The live node.
    pub node: live::Config,
    /// How the live node and the tools exchange messages.
    pub bus: bus::Config,
    /// The timecode of the house.
    pub timecode: TimecodeConfig,
}

/// The timecode of the house. Without a rate there is none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TimecodeConfig {
    /// Its rate, such as `25` or `29.97df`; empty: no timecode.
    pub rate: String,
    /// A timecode and its capture time, such as `01:00:00:00 at 1795252800.25`.
    pub offset: String,
}

impl TimecodeConfig {
    /// The timecode, if there is one.
    ///
    /// # Errors
    /// An unknown rate, or no such offset.
    pub fn house(&self) -> Result<Option<House>, TimecodeError> {
        match self.rate.as_str() {
            "" if self.offset.is_empty() => Ok(None),
            rate => House::new(rate, &self.offset).map(Some),
        }
    }
}

/// The defaults, with comments.
pub const DEFAULT_TOML: &str = include_str!("../config/default.toml");

/// Why a configuration file cannot be used. Its text says what is wrong, with units.
#[derive(Debug, Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum ConfigError {
    #[error("cannot read the configuration {}: {source}; check the path", path.display())]
    Unreadable { path: PathBuf, source: std::io::Error },
    /// Lines count from 1.
    #[error("{}, line {line}: {reason}; config/default.toml lists every key", path.display())]
    Malformed { path: PathBuf, line: usize, reason: String },
    /// A number out of range.
    #[error("{}: {error}", path.display())]
    OutOfRange { path: PathBuf, error: OutOfRange },
    /// A timecode that cannot be used.
    #[error("{}: [timecode] {source}", path.display())]
    Timecode { path: PathBuf, source: TimecodeError },
    /// Settings that do not fit each other.
    #[error("{}: {reason}", path.display())]
    Together { path: PathBuf, reason: &'static str },
    /// An invalid name of a stage or an actor.
    #[error("{}: {key}: {source}", path.display())]
    Name { path: PathBuf, key: &'static str, source: NameError },
}

impl Config {
    /// Reads a file; missing keys keep their defaults.
    ///
    /// # Errors
    /// An unreadable file, unknown keys, values of the wrong type or out of range, settings that do not fit each other.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::load_partial(path)?.without_conflict(path)
    }

    /// Reads a file that arguments may complete: there may be a [`Config::conflict`].
    ///
    /// # Errors
    /// As [`Config::load`], but for the conflict.
    pub fn load_partial(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigError::Unreadable { path: path.into(), source })?;
        Self::parse_partial(&text, path)
    }

    /// Reads the text of a file; `path` is named in errors.
    ///
    /// # Errors
    /// As [`Config::load`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        Self::parse_partial(text, path)?.without_conflict(path)
    }

    fn without_conflict(self, path: &Path) -> Result<Self, ConfigError> {
        match self.conflict() {
            Some(reason) => Err(ConfigError::Together { path: path.into(), reason }),
            None => Ok(self),
        }
    }

    pub(crate) fn parse_partial(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text).map_err(|error| {
            let line = error.span().map_or(1, |span| line_at(text, span.start));
            let reason = error.message().replace('\n', " ");
            ConfigError::Malformed { path: path.into(), line, reason }
        })?;
        let names = config.stage.names.iter().map(|name| ("stage.names", name));
        let node = [("node.stage", &config.node.stage), ("node.actor", &config.node.actor)];
        for (key, name) in node.into_iter().chain(names) {
            valid_name(name).map_err(|source| ConfigError::Name {
                path: path.into(),
                key,
                source,
            })?;
        }
        let house = config.timecode.house();
        house.map_err(|source| ConfigError::Timecode { path: path.into(), source })?;
        let unfit = |error| ConfigError::OutOfRange { path: path.into(), error };
        config.validate().map_err(unfit)?;
        Ok(config)
    }

    /// Checks the ranges of all numbers. The settings of a file are checked when it is read.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        let in_table = |table| move |error: OutOfRange| error.in_table(table);
        self.stage.validate().map_err(in_table("stage"))?;
        self.tracker.validate().map_err(in_table("tracker"))?;
        self.node.validate().map_err(in_table("node"))
    }

    /// Settings that do not fit each other, and what would fit.
    pub fn conflict(&self) -> Option<&'static str> {
        let Self { stage, node, .. } = self;
        let reason = match stage.several() {
            false if node.solver => {
                "[node] solver solves several performers; set [stage] performers = \"auto\""
            }
            true if node.solver && (!stage.solve || stage.chooses()) => {
                "[node] solver solves the performers of another node: [stage] solve = false, names, bodies, only, region, \
                 min_height_px and left_after_s are for that one"
            }
            true if node.solver && !node.rig.is_empty() => {
                "[node] solver takes the calibration from the front; remove [node] rig here, and set it at the front"
            }
            true if node.solver && node.latency_ms == 0.0 => {
                "[node] solver needs the same latency on all nodes, since performers change the node; set [node] latency_ms, \
                 such as 300"
            }
            true if !node.body.is_empty() => {
                "[node] body is of one performer; leave it out, or set [stage] performers = 1"
            }
            false if !stage.solve => {
                "[stage] solve = false needs several performers; set [stage] performers"
            }
            _ => return self.conflict_of_people(),
        };
        Some(reason)
    }

    /// Settings of the people who are solved that do not fit each other, and what would fit.
    pub fn conflict_of_people(&self) -> Option<&'static str> {
        let stage::Config { names, bodies, only, .. } = &self.stage;
        if self.stage.chooses() && !self.stage.several() {
            return Some(
                "[stage] names, bodies, only, region, min_height_px and left_after_s are for several people; set \
                 [stage] performers = \"auto\"",
            );
        }
        let mut others = BTreeSet::from([&self.node.actor]);
        if !names.iter().all(|name| others.insert(name) && !PerformerId::is_name(name)) {
            return Some(
                "[stage] names must differ from each other, from [node] actor, and from p1, p2, ...",
            );
        }
        let is_anybody = !only.is_empty() && bodies.is_empty();
        is_anybody
            .then_some("[stage] only needs [stage] bodies, by which these people are recognised")
    }

    /// The settings of a new node's core, without a known body.
    ///
    /// # Errors
    /// As [`TimecodeConfig::house`].
    pub fn core_settings(&self, decoder: &Decoder) -> Result<live::Settings, TimecodeError> {
        Ok(live::Settings {
            tracker: self.tracker,
            stage: self.stage.clone(),
            node: self.node.clone(),
            toml: self.to_toml(),
            weights: format!("{:016x}", decoder.fingerprint()),
            body: None,
            carried: live::Carried::default(),
            timecode: self.timecode.house()?,
        })
    }

    /// The people whose bodies are known: those of `[stage] bodies`.
    ///
    /// # Errors
    /// As [`known_people`], which must know everybody of `[stage] only`.
    pub fn known_people(&self) -> Result<Vec<Known>, RecordError> {
        match self.bodies_folder() {
            Some(folder) => known_people(folder, &self.node.actor, &self.stage.only),
            None => Ok(Vec::new()),
        }
    }

    /// The folder of known bodies, if there is one.
    pub fn bodies_folder(&self) -> Option<&Path> {
        Some(self.stage.bodies.as_str()).filter(|folder| !folder.is_empty()).map(Path::new)
    }

    /// The settings as TOML, without comments.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).unwrap_or_default()
    }
}

/// The line, from 1, that contains a byte.
fn line_at(text: &str, byte: usize) -> usize {
    1 + text.bytes().take(byte).filter(|&b| b == b'\n').count()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Config, String> {
        Config::parse(text, Path::new("my.toml")).map_err(|error| error.to_string())
    }

    #[test]
    fn the_commented_file_holds_every_default() {
        assert_eq!(parse(DEFAULT_TOML), Ok(Config::default()));
        let keys = |text: &str| -> Vec<String> {
            let mut table = String::new();
            let mut keys = Vec::new();
            for line in text.lines().map(str::trim) {
                if let Some(name) = line.strip_prefix('[') {
                    table = name.trim_end_matches(']').to_owned();
                } else if let Some((key, _)) = line.split_once('=')
                    && !line.starts_with('#')
                {
                    keys.push(format!("{table}.{}", key.trim()));
                }
            }
            keys.sort();
            keys
        };
        assert_eq!(keys(DEFAULT_TOML), keys(&Config::default().to_toml()));
    }

    #[test]
    fn every_key_of_the_file_has_a_comment_above_it() {
        let lines: Vec<&str> = DEFAULT_TOML.lines().collect();
        for pair in lines.windows(2) {
            if pair[1].contains(" = ") && !pair[1].starts_with('#') {
                assert!(pair[0].starts_with('#'), "{:?} has no comment", pair[1]);
            }
        }
    }

    #[test]
    fn a_round_trip_keeps_everything() {
        let mut config = Config::default();
        config.tracker.window_frames = 7;
        config.tracker.cost.prior = 12.5;
        assert_eq!(parse(&config.to_toml()), Ok(config));
    }

    #[test]
    fn errors_name_file_line_and_key() {
        let unknown = parse("[tracker]\nwindow_frames = 10\nwindow_size = 3\n").unwrap_err();
        assert!(
            unknown.contains("my.toml, line 3") && unknown.contains("window_size"),
            "{unknown}"
        );
        let kind = parse("[tracker]\nwindow_frames = \"ten\"\n").unwrap_err();
        assert!(kind.contains("line 2"), "{kind}");
        let zero = parse("[tracker]\nwindow_frames = 0\n").unwrap_err();
        assert!(zero.contains("tracker.window_frames is 0"), "{zero}");
        let negative = parse("[tracker.cost]\nscale_px = -1.0\n").unwrap_err();
        assert!(negative.contains("tracker.cost.scale_px is -1"), "{negative}");
        assert!(!kind.contains('\n') && !unknown.contains('\n'));
    }

    #[test]
    fn settings_that_do_not_fit_each_other_are_refused() {
        for (text, part) in [
            ("[node]\nsolver = true\n", "several performers"),
            ("[stage]\nperformers = 2\n[node]\nsolver = true\n", "latency_ms"),
            ("[stage]\nperformers = 2\nsolve = false\n[node]\nsolver = true\n", "another node"),
            (
                "[stage]\nperformers = 2\n[node]\nsolver = true\nlatency_ms = 300.0\nrig = \"a.toml\"\n",
                "the calibration from the front; remove [node] rig",
            ),
            ("[stage]\nperformers = \"auto\"\n[node]\nbody = \"a.mcap\"\n", "of one performer"),
            ("[stage]\nsolve = false\n", "needs several performers"),
            ("[stage]\nmin_height_px = 100\n", "are for several people"),
            ("[stage]\nnames = [\"a\"]\n", "are for several people"),
            ("[stage]\nperformers = 2\nnames = [\"a\", \"a\"]\n", "names must differ"),
            ("[stage]\nperformers = 2\nnames = [\"p4\"]\n", "names must differ"),
            ("[stage]\nperformers = 2\nonly = [\"a\"]\n", "needs [stage] bodies"),
            (
                "[stage]\nregion = [[0, 0], [1, 0]]\n",
                "stage.region is 2, but must be no corners, or 3 or more",
            ),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.starts_with("my.toml: ") && error.contains(part), "{error}");
        }
    }

    #[test]
    fn names_that_no_topic_can_hold_are_refused() {
        for key in ["stage", "actor"] {
            let error = parse(&format!("[node]\n{key} = \"my stage/1\"\n")).unwrap_err();
            assert!(
                error.contains(&format!("node.{key}: ")) && error.contains("my stage/1"),
                "{error}"
            );
        }
    }

    #[test]
    fn published_frames_fit_the_window_and_its_keyframes() {
        for text in ["publish_frames = 11", "keyframe_frames = 2", "window_frames = 4"] {
            let error = parse(&format!("[tracker]\n{text}\n")).unwrap_err();
            assert!(error.contains("tracker.publish_frames is "), "{error}");
            assert!(error.ends_with("a multiple of keyframe_frames, at most window_frames"));
        }
        let paper = Config { tracker: tracker::Config::paper(), ..Config::default() };
        assert_eq!(parse(&paper.to_toml()), Ok(paper));
    }

    #[test]
    fn the_papers_file_holds_the_papers_settings() {
        let paper = Config { tracker: tracker::Config::paper(), ..Config::default() };
        let text = include_str!("../config/paper.toml");
        assert_eq!(parse(text), Ok(paper));
        let keys = |text: &str| text.lines().filter(|line| line.contains(" = ")).count();
        assert_eq!(keys(text), keys(DEFAULT_TOML));
    }

    #[test]
    fn numbers_out_of_range_are_named_with_what_is_allowed() {
        let refused = |table: &str, key: &str, value: &str, allowed: &str| {
            let error = parse(&format!("[{table}]\n{key} = {value}\n")).unwrap_err();
            assert!(error.contains(&format!("{table}.{key} is ")), "{error}");
            assert!(error.ends_with(&format!("but must be {allowed}")), "{error}");
        };
        for value in ["0.5", "1001.0", "-60.0", "inf", "nan"] {
            refused("tracker", "frame_rate_hz", value, "0 (estimated) or 1 to 1000");
        }
        refused("tracker", "window_frames", "1001", "1 to 1000");
        refused("tracker", "keyframe_frames", "0", "1 to 1000");
        refused("tracker", "publish_frames", "0", "1 to 1000");
        refused("tracker", "deadline_frames", "1001", "0 to 1000");
        refused("tracker", "shape_windows", "0", "1 to 100");
        refused("tracker", "shape_windows", "101", "1 to 100");
        refused("tracker", "iterations", "0", "1 to 1000");
        refused("tracker", "iterations", "1000000", "1 to 1000");
        refused("tracker", "acquisition_iterations", "0", "1 to 1000");
        refused("tracker", "provisional_iterations", "1001", "0 to 1000");
        refused("tracker", "body_windows", "1001", "0 to 1000");
        refused("tracker", "coast_windows", "1001", "0 to 1000");
        refused("tracker", "grace_windows", "0", "1 to 1000");
        refused("tracker", "min_confidence", "1.5", "0 to 1");
        refused("tracker.cost", "scale_px", "0.0", "a number above 0");
        refused("tracker.cost", "prior", "-1.0", "0 or more");
        refused("tracker.cost", "prior_dof", "nan", "0 or more");
        refused("tracker.cost", "shape_prior", "inf", "0 or more");
        refused("tracker.cost", "offset_prior", "-1.0", "0 or more");
        refused("tracker.cost.stiffness", "rotation", "-0.1", "0 or more");
        refused("tracker.gate", "follow", "nan", "a number above 0");
        refused("node", "queue", "15", "16 to 1000000");
        refused("node", "latency_ms", "-1.0", "0 (estimated) or 6 to 60000");
        refused("node", "latency_ms", "5.0", "0 (estimated) or 6 to 60000");
        refused("node", "output_rate_hz", "0.5", "0 (rate of the cameras) or 1 to 1000");
        refused("tracker.gate", "lost_observations", "-1.0", "0 or more");
        for rate in ["0.0", "1.0", "59.94", "1000.0"] {
            parse(&format!("[tracker]\nframe_rate_hz = {rate}\n")).unwrap();
        }
        parse("[tracker.cost]\nprior = 0.0\nshape_prior = 0.0\n").unwrap();
    }
}
