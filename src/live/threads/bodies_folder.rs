//! The folder of known bodies: those of performers with a name are written to it.

use std::collections::BTreeMap;
use std::path::PathBuf;

use crate::core::stage::PerformerId;
use crate::io::recording::{body_file, write_body};
use crate::io::wire::Skeleton;

/// A folder of known bodies. Only files of this run are replaced.
pub(super) struct BodiesFolder {
    path: PathBuf,
    /// By the names of those, whose body was written last.
    own: BTreeMap<String, PerformerId>,
}

impl BodiesFolder {
    pub(super) fn new(path: PathBuf) -> Self {
        Self { path, own: BTreeMap::new() }
    }

    /// Writes the body of that name, unless there is one of an earlier run. Without a body, removes that of this performer.
    pub(super) fn change(&mut self, performer: PerformerId, name: &str, body: Option<Skeleton>) {
        match body {
            Some(body) => self.keep(performer, name, &body),
            None if self.own.get(name) == Some(&performer) => {
                self.own.remove(name);
                let file = body_file(&self.path, name);
                match std::fs::remove_file(&file) {
                    Ok(()) => {
                        tracing::info!("nobody is {name} any more: {} is removed", file.display())
                    }
                    Err(error) => tracing::warn!("{} is not removed: {error}", file.display()),
                }
            }
            None => {}
        }
    }

    fn keep(&mut self, performer: PerformerId, name: &str, body: &Skeleton) {
        match write_body(&self.path, name, body, self.own.contains_key(name)) {
            Ok(Some(file)) => {
                if self.own.insert(name.to_owned(), performer).is_none() {
                    tracing::info!("the body of {name} is written to {}", file.display());
                }
            }
            Ok(None) => {}
            Err(error) => tracing::warn!("the body of {name} is not written: {error}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::Shape;

    #[test]
    fn a_file_is_replaced_and_removed_only_by_the_run_that_wrote_it() {
        let folder = tempfile::tempdir().unwrap();
        let [own, earlier] = ["own", "earlier"].map(|name| body_file(folder.path(), name));
        std::fs::write(&earlier, "of an earlier run").unwrap();
        let mut bodies = BodiesFolder::new(folder.path().into());
        let body = Skeleton::from_core(&crate::core::body::Skeleton::new(Shape::default()));
        for name in ["own", "earlier"] {
            bodies.change(PerformerId(1), name, Some(body.clone()));
            bodies.change(PerformerId(2), name, None);
            assert!(body_file(folder.path(), name).exists());
            bodies.change(PerformerId(1), name, None);
        }
        assert!(!own.exists());
        assert_eq!(std::fs::read_to_string(earlier).unwrap(), "of an earlier run");
    }
}
