//! The folder of known bodies: those of performers with a name are written to it.

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::io::recording::{body_file, write_body};
use crate::io::wire::Skeleton;

/// A folder of known bodies. What was there before stays as it is: a body of today may be somebody else's.
pub(super) struct BodiesFolder {
    path: PathBuf,
    /// Whose files are of this run.
    own: BTreeSet<String>,
}

impl BodiesFolder {
    pub(super) fn new(path: PathBuf) -> Self {
        Self { path, own: BTreeSet::new() }
    }

    /// Writes the body of that name, unless there is one of before.
    pub(super) fn keep(&mut self, name: &str, body: &Skeleton) {
        let file = body_file(&self.path, name);
        if !self.own.contains(name) && file.exists() {
            return;
        }
        match write_body(&self.path, name, body) {
            Ok(()) if self.own.insert(name.to_owned()) => {
                tracing::info!("the body of {name} is written to {}", file.display());
            }
            Ok(()) => {}
            Err(error) => tracing::warn!("the body of {name} is not written: {error}"),
        }
    }
}
