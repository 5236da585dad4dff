//! The performer's body in a recording.

use std::path::Path;

use super::error::RecordError;
use super::message::Message;
use super::reader::Reader;
use crate::core::body::Skeleton;

/// The last solved body in a recording, or else the true one of a synthetic recording.
///
/// # Errors
/// The file cannot be read, or holds no body.
pub fn last_body(path: &Path) -> Result<Skeleton, RecordError> {
    let (mut solved, mut truth) = (None, None);
    for entry in Reader::open(path)? {
        match entry?.message {
            Message::Skeleton(body) => solved = body.to_core().ok().or(solved),
            Message::TruthSkeleton(body) => truth = body.to_core().ok().or(truth),
            _ => {}
        }
    }
    solved.or(truth).ok_or_else(|| RecordError::NoBody { path: path.to_owned() })
}
