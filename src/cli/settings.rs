//! Settings of a file, changed by arguments.

use std::path::Path;

use super::failure::{Exit, Failure};
use crate::config::{Config, ConfigError};

/// The settings of a file, or the defaults, after a change by arguments.
///
/// # Errors
/// The file cannot be used, the change fails, or there is a `conflict` after it.
pub(super) fn changed(
    path: Option<&Path>,
    conflict: fn(&Config) -> Option<&'static str>,
    change: impl FnOnce(&mut Config) -> Result<(), Failure>,
) -> Result<Config, Failure> {
    let mut config = path.map(Config::load_partial).transpose()?.unwrap_or_default();
    let before = conflict(&config);
    change(&mut config)?;
    match (conflict(&config), path) {
        (None, _) => Ok(config),
        // The file alone has it.
        (Some(reason), Some(path)) if before == Some(reason) => {
            Err(ConfigError::Together { path: path.into(), reason }.into())
        }
        (Some(reason), _) => Err(Failure::new(Exit::Usage, reason)),
    }
}
