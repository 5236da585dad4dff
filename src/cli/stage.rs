//! Who is solved: arguments of `run` and `solve`.

use std::path::PathBuf;

use clap::Args;

use super::bus::check_name;
use super::failure::{Exit, Failure};
use super::terminal::complain;
use crate::core::stage::{Config, Performers};

/// Which people are solved.
#[derive(Debug, Args)]
pub(super) struct StageArguments {
    /// How many people are solved at a time: 1 to 32, or auto for all; default: that of the settings, 1.
    #[arg(long, value_name = "N")]
    performers: Option<Performers>,
    /// With several performers, names for those who enter, in this order; others are p1, p2, ...
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    names: Vec<String>,
    /// With several performers, folder of known bodies, NAME.mcap each. People are recognised by them and have
    /// these names. The body of a performer with a name is written to it, unless it is there.
    #[arg(long, value_name = "DIR")]
    bodies: Option<PathBuf>,
    /// Only people with these names become performers. They are recognised by --bodies.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    only: Vec<String>,
}

impl StageArguments {
    /// Replaces the settings that are given.
    pub(super) fn apply(&self, config: &mut Config) -> Result<(), Failure> {
        self.names.iter().try_for_each(|name| check_name("--names", name))?;
        config.performers = self.performers.unwrap_or(config.performers);
        let is_given = !self.names.is_empty() || self.bodies.is_some() || !self.only.is_empty();
        if is_given && !config.several() {
            let fix = "--names, --bodies and --only are for several people: add --performers auto";
            return Err(Failure::new(Exit::Usage, fix));
        }
        if self.performers.is_some() && !config.several() && config.chooses() {
            let what = "--performers 1: [stage] names, bodies, only, region, min_height_px and \
                        left_after_s have no effect";
            complain("warning", what);
            let Config { performers, solve, .. } = *config;
            *config = Config { performers, solve, ..Config::default() };
        }
        if !self.names.is_empty() {
            config.names.clone_from(&self.names);
        }
        if let Some(bodies) = &self.bodies {
            let text = bodies.to_str().ok_or_else(|| {
                let what = format!("--bodies {}: the name must be UTF-8", bodies.display());
                Failure::new(Exit::Usage, what)
            })?;
            text.clone_into(&mut config.bodies);
        }
        if !self.only.is_empty() {
            config.only.clone_from(&self.only);
        }
        Ok(())
    }
}
