//! The configuration file: every module's `Config` in one tree.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::track;

/// All settings. `config/default.toml` holds the defaults with a comment each.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Of the tracking machine and of what it solves.
    pub track: track::Config,
}

/// The defaults as a file with comments.
pub const DEFAULT_TOML: &str = include_str!("../config/default.toml");

/// Why a configuration file cannot be used.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration {}: {source}; check the path", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// No TOML, an unknown key, or a value of another kind.
    #[error("{}, line {line}: {reason}; config/default.toml lists every key", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// From 1.
        line: usize,
        /// What is wrong, with the key.
        reason: String,
    },
    /// A number that makes no sense.
    #[error("{}: {key} is {value}, but must be {allowed}", path.display())]
    OutOfRange {
        /// The file.
        path: PathBuf,
        /// Full name of the key.
        key: &'static str,
        /// What the file says.
        value: f64,
        /// What it may say.
        allowed: &'static str,
    },
}

impl Config {
    /// Reads a file; keys that it does not have keep their defaults.
    ///
    /// # Errors
    /// A file that cannot be read, unknown keys, values of another kind or out of range.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigError::Unreadable { path: path.into(), source })?;
        Self::parse(&text, path)
    }

    /// Reads the text of a file; `path` is named in errors.
    ///
    /// # Errors
    /// As [`Config::load`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text).map_err(|error| {
            let line = error.span().map_or(1, |span| line_at(text, span.start));
            let reason = error.message().replace('\n', " ");
            ConfigError::Malformed { path: path.into(), line, reason }
        })?;
        match config.out_of_range() {
            Some((key, value, allowed)) => {
                Err(ConfigError::OutOfRange { path: path.into(), key, value, allowed })
            }
            None => Ok(config),
        }
    }

    /// The settings as TOML, without comments.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).unwrap_or_default()
    }

    /// The first number out of range: its key, its value and what is allowed.
    fn out_of_range(&self) -> Option<(&'static str, f64, &'static str)> {
        let track = &self.track;
        let at_least_one = [
            ("track.window_frames", track.window_frames),
            ("track.shape_windows", track.shape_windows),
            ("track.iterations", track.iterations),
            ("track.acquisition_iterations", track.acquisition_iterations),
        ];
        let positive = [
            ("track.cost.scale_px", track.cost.scale_px),
            ("track.gate.agree", track.gate.agree),
            ("track.gate.follow", track.gate.follow),
            ("track.gate.lost_residual", track.gate.lost_residual),
            ("track.gate.lost_latent", track.gate.lost_latent),
        ];
        let not_negative = [
            ("track.frame_rate_hz", track.frame_rate_hz),
            ("track.cost.prior", track.cost.prior),
            ("track.cost.shape_prior", track.cost.shape_prior),
            ("track.min_confidence", track.min_confidence),
            ("track.gate.lost_observations", track.gate.lost_observations),
        ];
        let counts = at_least_one.into_iter().filter(|(_, value)| *value < 1);
        let counts = counts.map(|(key, value)| (key, value as f64, "at least 1"));
        let positive = positive.into_iter().filter(|(_, v)| !(v.is_finite() && *v > 0.0));
        let positive = positive.map(|(key, value)| (key, value, "a number above 0"));
        let not_negative = not_negative.into_iter().filter(|(_, v)| !(v.is_finite() && *v >= 0.0));
        let not_negative = not_negative.map(|(key, value)| (key, value, "0 or a number above"));
        counts.chain(positive).chain(not_negative).next()
    }
}

/// The number of the line, from 1, that holds a byte.
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
        config.track.window_frames = 7;
        config.track.cost.prior = 12.5;
        assert_eq!(parse(&config.to_toml()), Ok(config));
    }

    #[test]
    fn errors_name_file_line_and_key() {
        let unknown = parse("[track]\nwindow_frames = 10\nwindow_size = 3\n").unwrap_err();
        assert!(
            unknown.contains("my.toml, line 3") && unknown.contains("window_size"),
            "{unknown}"
        );
        let kind = parse("[track]\nwindow_frames = \"ten\"\n").unwrap_err();
        assert!(kind.contains("line 2"), "{kind}");
        let zero = parse("[track]\nwindow_frames = 0\n").unwrap_err();
        assert!(zero.contains("track.window_frames is 0"), "{zero}");
        let negative = parse("[track.cost]\nscale_px = -1.0\n").unwrap_err();
        assert!(negative.contains("track.cost.scale_px is -1"), "{negative}");
        assert!(!kind.contains('\n') && !unknown.contains('\n'));
    }
}
