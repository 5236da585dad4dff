//! A performer's body in a recording.

use std::collections::BTreeMap;
use std::path::Path;

use super::error::RecordError;
use super::message::Message;
use super::reader::Reader;
use crate::core::body::Skeleton;
use crate::io::wire::Topic;

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
