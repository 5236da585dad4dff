//! The folder of known bodies: those of performers with a name are written to it.

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::io::recording::write_body;
use crate::io::wire::Skeleton;

/// A folder of known bodies. Only files of this run are replaced.
pub(super) struct BodiesFolder {
    path: PathBuf,
    /// The names of those.
    own: BTreeSet<String>,
}

impl BodiesFolder {
    pub(super) fn new(path: PathBuf) -> Self {
        Self { path, own: BTreeSet::new() }
    }

    /// Writes the body of that name, unless there is one of an earlier run.
    pub(super) fn keep(&mut self, name: &str, body: &Skeleton) {
        match write_body(&self.path, name, body, self.own.contains(name)) {
            Ok(Some(file)) if self.own.insert(name.to_owned()) => {
                tracing::info!("the body of {name} is written to {}", file.display());
            }
            Ok(_) => {}
            Err(error) => tracing::warn!("the body of {name} is not written: {error}"),
        }
    }
}
