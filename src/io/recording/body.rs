//! Performers' bodies in recordings.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::error::RecordError;
use super::message::Message;
use super::reader::Reader;
use super::writer::{Provenance, Writer};
use crate::core::body::Skeleton;
use crate::core::stage::{Known, PerformerId};
use crate::core::time::Timestamp;
use crate::io::wire::{self, Topic, Topics, valid_name};

/// Most known bodies of a folder: the others who enter need numbers too.
const MOST_KNOWN: usize = 128;

/// The file of a person in a folder of known bodies.
pub fn body_file(folder: &Path, name: &str) -> PathBuf {
    folder.join(format!("{name}.mcap"))
}

/// Writes a person's body to a folder of known bodies, as `NAME.mcap`. The folder is made if it is missing. `body` has
/// the measured lengths, see [`wire::Skeleton::of_known`]. A file that is there is only replaced if told so: it may be
/// of another person with this name. Returns the path of the file if it was written.
///
/// # Errors
/// The file cannot be written, or [`valid_name`] refuses the name.
pub fn write_body(
    folder: &Path,
    name: &str,
    body: &wire::Skeleton,
    replace: bool,
) -> Result<Option<PathBuf>, RecordError> {
    let path = body_file(folder, name);
    if valid_name(name).is_err() {
        // It could be in another folder.
        return Err(RecordError::NoName { path });
    }
    if !replace && path.exists() {
        return Ok(None);
    }
    std::fs::create_dir_all(folder).map_err(RecordError::write(&path))?;
    write_body_file(&path, name, body)?;
    Ok(Some(path))
}

/// Writes a recording that holds the body of an actor and nothing else.
///
/// # Errors
/// The file cannot be written.
pub fn write_body_file(path: &Path, actor: &str, body: &wire::Skeleton) -> Result<(), RecordError> {
    let topics = Topics { actor: actor.to_owned(), ..Topics::default() };
    let topic = topics.skeleton();
    let mut writer = Writer::create(path, topics, &Provenance::default())?;
    writer.write(&topic, Timestamp::default(), body)?;
    writer.finish()
}

/// The files of a folder of known bodies, `NAME.mcap` each, in the order of their names. None if there is no such folder.
///
/// # Errors
/// The folder cannot be read.
pub fn body_files(folder: &Path) -> Result<Vec<PathBuf>, RecordError> {
    let entries = match std::fs::read_dir(folder) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(RecordError::read(folder))?,
    };
    let paths = entries.map(|entry| Ok(entry.map_err(RecordError::read(folder))?.path()));
    let mut paths = paths.collect::<Result<Vec<_>, RecordError>>()?;
    paths.retain(|path| path.extension().is_some_and(|ending| ending == "mcap"));
    paths.sort();
    Ok(paths)
}

/// The people of a folder of known bodies, `NAME.mcap` each, in the order of their names. Nobody if there is no such
/// folder.
///
/// # Errors
/// The folder or a file cannot be read, or there are more than 128; a file has no measured lengths, or a name that
/// nobody can have, such as `node`; there is none of somebody in `needed`.
pub fn known_people(
    folder: &Path,
    node: &str,
    needed: &[String],
) -> Result<Vec<Known>, RecordError> {
    let paths = body_files(folder)?;
    if paths.len() > MOST_KNOWN {
        return Err(RecordError::ManyBodies { path: folder.to_owned(), count: paths.len() });
    }
    let person = |(number, path): (usize, PathBuf)| person(PerformerId(number), &path, node);
    let people: Vec<Known> = paths.into_iter().enumerate().map(person).collect::<Result<_, _>>()?;
    let names: Vec<&str> = people.iter().map(|known| known.name.as_str()).collect();
    match needed.iter().find(|name| !names.contains(&name.as_str())) {
        Some(actor) => Err(RecordError::NoBodyOf {
            path: folder.to_owned(),
            actor: actor.clone(),
            names: if names.is_empty() { "nobody".to_owned() } else { names.join(", ") },
        }),
        None => Ok(people),
    }
}

fn person(performer: PerformerId, path: &Path, node: &str) -> Result<Known, RecordError> {
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    if valid_name(&name).is_err() || PerformerId::is_name(&name) || name == node {
        return Err(RecordError::NoName { path: path.to_owned() });
    }
    let mut known = None;
    for entry in Reader::open(path)? {
        if let Message::Skeleton(body) = entry?.message {
            let lengths = body.lengths();
            let body = body.to_core().ok().map(Arc::new);
            known = lengths.map(|lengths| (body, lengths));
        }
    }
    let (body, lengths) = known.ok_or_else(|| RecordError::NoLengths { path: path.to_owned() })?;
    Ok(Known { performer, name, body, lengths, ..Known::default() })
}

/// The last solved body of an actor in a recording, or else the true one of a synthetic recording.
/// `None` is the only actor of the recording.
///
/// # Errors
/// The file cannot be read, holds no body of that actor, or those of several actors if none is named.
pub fn last_body(path: &Path, actor: Option<&str>) -> Result<Skeleton, RecordError> {
    let (mut solved, mut truth) = (BTreeMap::new(), BTreeMap::new());
    for entry in Reader::open(path)? {
        let entry = entry?;
        let (body, bodies) = match entry.message {
            Message::Skeleton(body) => (body, &mut solved),
            Message::TruthSkeleton(body) => (body, &mut truth),
            _ => continue,
        };
        if let Ok(body) = body.to_core() {
            bodies.insert(Topic::actor(&entry.topic), body);
        }
    }
    let mut bodies = if solved.is_empty() { truth } else { solved };
    let names = bodies.keys().cloned().collect::<Vec<_>>().join(", ");
    let (path, count) = (path.to_owned(), bodies.len());
    match actor {
        Some(actor) => bodies.remove(actor),
        None if count > 1 => return Err(RecordError::SeveralBodies { path, names }),
        None => bodies.pop_first().map(|(_, body)| body),
    }
    .ok_or(match count {
        0 => RecordError::NoBody { path },
        _ => RecordError::NoBodyOf { path, actor: actor.unwrap_or_default().to_owned(), names },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_with_a_path_are_refused() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("bodies");
        let body = wire::Skeleton::from_core(&Skeleton::default());
        for name in ["../lead", "/tmp/lead", ""] {
            let error = write_body(&folder, name, &body, true).unwrap_err();
            assert!(matches!(error, RecordError::NoName { .. }), "{error}");
        }
        let written = write_body(&folder, "lead", &body, true).unwrap();
        assert_eq!(written, Some(folder.join("lead.mcap")));
    }
}
