//! What a solve is told, and who watches it.

use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;

use crate::core::body::{Skeleton, StampedPose};
use crate::core::manifold::{Decoder, WeightsError};
use crate::core::stage::{Choice, Known, Performers};
use crate::core::tracker;
use crate::io::formats::Trajectories;
use crate::io::recording::Companion;
use crate::io::timecode::House;

/// Makes a companion of a file.
pub type NewCompanion = fn() -> Box<dyn Companion>;

/// Options of a solve. The defaults use all cameras, the embedded weights and the settings of
/// `config/default.toml`, and write nothing.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Settings of the tracker.
    pub config: tracker::Config,
    /// Weights of the manifold; the embedded ones if `None`.
    pub decoder: Option<Decoder>,
    /// Use only the cameras with these names; all if empty.
    pub cameras: Vec<String>,
    /// Hold these cameras out of the solve and measure the error in them.
    pub hold_out: Vec<String>,
    /// Measure the distance from these marker positions (y up, frames as in the recording); each
    /// performer's from the nearest.
    pub references: Vec<Trajectories>,
    /// How many performers [`solve_group`](super::solve_group) solves.
    pub performers: Performers,
    /// Who may become a performer, if there are several.
    pub choice: Choice,
    /// Names for them, in the order of entering; others are p1, p2, ... by number.
    pub names: Vec<String>,
    /// People whose bodies are known: they are recognised, if there are several performers.
    pub known: Vec<Known>,
    /// The folder for poses.mcap, poses.bvh, poses.states.csv and report.html; created if missing. With
    /// several performers, poses.NAME.bvh and poses.NAME.states.csv for each. `None` writes nothing.
    pub out: Option<PathBuf>,
    /// Replace these files if they exist.
    pub overwrite: bool,
    /// The performer's body, if it is known; otherwise it is estimated. With several performers, that of
    /// the first.
    pub body: Option<Arc<Skeleton>>,
    /// Use the capture times as they are: estimate no time offsets.
    pub no_sync: bool,
    /// The timecode of the house, for the poses of poses.mcap.
    pub timecode: Option<House>,
    /// Threads that solve several performers in parallel; 0: one for each processor. The poses do not depend on it.
    pub threads: usize,
    /// Adds messages for other programs, such as Foxglove, to poses.mcap.
    pub companion: Option<NewCompanion>,
    /// All settings as TOML, for the metadata of poses.mcap; `None`: those of `config`.
    pub config_toml: Option<String>,
}

impl Options {
    /// How often the recording is read: a first pass estimates the body and the time offsets, if the
    /// body is not switched off. It is repeated if the times of a camera, or the given body, are wrong.
    pub fn passes(&self) -> u64 {
        1 + u64::from(self.config.body_windows > 0)
    }

    pub(super) fn decoder(&self) -> Result<Decoder, WeightsError> {
        self.decoder.clone().map_or_else(Decoder::embedded, Ok)
    }
}

/// Observer of a solve; `()` ignores everything.
pub trait Observer {
    /// A message of the recording was read. This happens [`Options::passes`] times for each, or more often if times
    /// are corrected. Poses follow some hundred messages later. A break ends the solve with [`Error::Stopped`](super::Error::Stopped).
    fn message(&mut self) -> ControlFlow<()> {
        ControlFlow::Continue(())
    }

    /// A final pose of a performer, by name, with the body. The poses of a performer are in order of capture time.
    fn pose(&mut self, _performer: &str, _pose: &StampedPose, _skeleton: &Skeleton) {}
}

impl Observer for () {}
