//! Errors of recordings, and the losses of damaged ones.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

/// Why a recording cannot be read or written. Its text says what is wrong, with units.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum RecordError {
    #[error("cannot read {}: {source}", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("cannot write {}: {source}; check that the folder exists and has room", path.display())]
    Write { path: PathBuf, source: io::Error },
    /// The limit is [`Writer::MOST_TOPICS`](super::Writer::MOST_TOPICS).
    #[error("{topic} is not recorded: a recording has at most {most} topics")]
    TooManyTopics { topic: String, most: usize },
    /// `found` are the first bytes of the file.
    #[error("{} is not an MCAP recording: {found}; make one with `bundlemocap import`", path.display())]
    NotMcap { path: PathBuf, found: String },
    /// The topics have their schemas.
    #[error(
        "{} holds no messages of bundlemocap.v1, but {}; make a recording of keypoints with \
         `bundlemocap import`",
        path.display(),
        topic_list(topics)
    )]
    NoChannels { path: PathBuf, topics: Vec<String> },
    #[error(
        "{} holds no body; give the poses.mcap of `bundlemocap solve` or a recorded live take",
        path.display()
    )]
    NoBody { path: PathBuf },
    #[error(
        "{} holds no measured lengths of a body; files of known bodies are written by `run` and `solve` \
         with --bodies", path.display()
    )]
    NoLengths { path: PathBuf },
    #[error("{}: {count} known bodies, at most 128; move those of people who do not come", path.display())]
    ManyBodies { path: PathBuf, count: usize },
    #[error(
        "{}: a known body is called by its file: letters, digits, `-`, `_` and `.`, not p1, p2, ..., \
         and not like [node] actor; rename it", path.display()
    )]
    NoName { path: PathBuf },
    #[error(
        "{} exists: a recorder writes it, or has not finished it; choose another name. If no recorder \
         writes it, rename or remove it; `bundlemocap info` reads it",
        part.display()
    )]
    LeftOver { part: PathBuf },
    /// `names` are separated by commas.
    #[error("{} holds no body of {actor}, but of {names}", path.display())]
    NoBodyOf { path: PathBuf, actor: String, names: String },
    /// `names` are separated by commas.
    #[error("{} holds the bodies of {names}; name one with --body-actor", path.display())]
    SeveralBodies { path: PathBuf, names: String },
}

fn topic_list(topics: &[String]) -> String {
    const SHOWN: usize = 12;
    match topics.len() {
        0 => "no topics".to_owned(),
        n if n > SHOWN => format!("{} and {} more", topics[..SHOWN].join(", "), n - SHOWN),
        _ => topics.join(", "),
    }
}

impl RecordError {
    pub(super) fn read(path: &Path) -> impl Fn(io::Error) -> Self + '_ {
        move |source| Self::Read { path: path.to_owned(), source }
    }

    pub(super) fn write(path: &Path) -> impl Fn(io::Error) -> Self + '_ {
        move |source| Self::Write { path: path.to_owned(), source }
    }
}

/// A part of a file that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Byte offset of the unusable record from the start of the file.
    pub offset: u64,
    /// What is wrong.
    pub reason: String,
}

impl std::fmt::Display for Damage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "damaged at byte {}: {}", self.offset, self.reason)
    }
}

/// Messages of one topic that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Undecodable {
    /// Number of messages.
    pub count: u64,
    /// What is wrong with the first.
    pub first: String,
}

/// Losses of a read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// Damaged parts in the order of the file.
    pub damage: Vec<Damage>,
    /// Unusable messages by topic.
    pub undecodable: BTreeMap<String, Undecodable>,
}

impl Report {
    /// Whether nothing was lost.
    pub fn is_clean(&self) -> bool {
        self.damage.is_empty() && self.undecodable.is_empty()
    }

    /// The losses, one line each.
    pub fn losses(&self) -> Vec<String> {
        let damage = self.damage.iter().map(ToString::to_string);
        let undecodable = self.undecodable.iter().map(|(topic, lost)| {
            format!("{} messages of {topic} cannot be used, the first: {}", lost.count, lost.first)
        });
        damage.chain(undecodable).collect()
    }

    /// Counts a message of `topic` that cannot be used.
    pub fn reject(&mut self, topic: &str, reason: &dyn std::fmt::Display) {
        if let Some(undecodable) = self.undecodable.get_mut(topic) {
            undecodable.count += 1;
            return;
        }
        let first = Undecodable { count: 1, first: reason.to_string() };
        self.undecodable.insert(topic.to_owned(), first);
    }

    pub(super) fn damaged(&mut self, offset: u64, reason: impl ToString) {
        self.damage.push(Damage { offset, reason: reason.to_string() });
    }
}
