//! The file of a recording while it is being written.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use crate::io::{new_file, with_ending};

/// The file before it is renamed.
#[derive(Debug)]
pub(super) enum Target {
    /// Deleted unless it is renamed.
    Temporary(NamedTempFile),
    /// Kept under this name unless it is renamed.
    Part(File, PathBuf),
}

impl Target {
    /// A temporary file in the folder of `path`, with the permissions of a normal new file.
    pub fn temporary(path: &Path) -> io::Result<Self> {
        new_file::temporary(path).map(Self::Temporary)
    }

    /// `path` with the suffix `.part`; fails if that file exists.
    pub fn part(path: &Path) -> io::Result<Self> {
        let part = part_of(path);
        let file = File::options().write(true).create_new(true).open(&part)?;
        Ok(Self::Part(file, part))
    }

    /// Syncs the file to disk and renames it.
    pub fn persist(self, path: &Path) -> io::Result<()> {
        match self {
            Self::Temporary(file) => {
                file.as_file().sync_all()?;
                file.persist(path).map(drop).map_err(|error| error.error)
            }
            Self::Part(file, part) => {
                file.sync_all()?;
                std::fs::rename(part, path)
            }
        }
    }
}

/// The path of a live recording until it is finished: `take.mcap.part` for `take.mcap`.
pub fn part_of(path: &Path) -> PathBuf {
    with_ending(path, ".part")
}

impl Write for Target {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Temporary(file) => file.write(bytes),
            Self::Part(file, _) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Temporary(file) => file.flush(),
            Self::Part(file, _) => file.flush(),
        }
    }
}

impl Seek for Target {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match self {
            Self::Temporary(file) => file.seek(to),
            Self::Part(file, _) => file.seek(to),
        }
    }
}
