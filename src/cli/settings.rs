//! Settings of a file, changed by arguments.

use std::path::Path;

use super::failure::{Exit, Failure};
use crate::config::{Config, ConfigError};

/// The settings of a file, or the defaults, after a change by arguments. What is `unfit` then is an error.
pub(super) fn changed(
    path: Option<&Path>,
    unfit: fn(&Config) -> Option<&'static str>,
    change: impl FnOnce(&mut Config) -> Result<(), Failure>,
) -> Result<Config, Failure> {
    let mut config = path.map(Config::load_apart).transpose()?.unwrap_or_default();
    let before = unfit(&config);
    change(&mut config)?;
    match (unfit(&config), path) {
        (None, _) => Ok(config),
        (Some(reason), Some(path)) if before == Some(reason) => {
            Err(ConfigError::Together { path: path.into(), reason }.into())
        }
        (Some(reason), _) => Err(Failure::new(Exit::Usage, reason)),
    }
}
