//! Files that appear whole or not at all: they are written under a temporary name in the same
//! folder, then renamed. All files that the program writes in one go use this module.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
#[cfg(feature = "cli")]
use std::sync::{Mutex, PoisonError};

use tempfile::NamedTempFile;

/// A file that is being written. It leaves nothing if dropped before [`NewFile::finish`].
#[derive(Debug)]
pub(crate) struct NewFile {
    path: PathBuf,
    file: BufWriter<NamedTempFile>,
}

impl NewFile {
    /// Begins a file for `path`.
    pub(crate) fn create(path: &Path) -> io::Result<Self> {
        Ok(Self { path: path.into(), file: BufWriter::new(temporary(path)?) })
    }

    /// The final path of the file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The file, to write to and to seek in.
    pub(crate) fn file(&mut self) -> &mut BufWriter<NamedTempFile> {
        &mut self.file
    }

    /// Moves the file to its path.
    pub(crate) fn finish(self) -> io::Result<File> {
        let file = self.file.into_inner().map_err(io::IntoInnerError::into_error)?;
        file.persist(&self.path).map_err(|error| error.error)
    }
}

/// Writes a whole file.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = NewFile::create(path)?;
    file.file().write_all(bytes)?;
    file.finish().map(drop)
}

/// How the names of temporary files begin and end.
const TEMPORARY: [&str; 2] = [".bundlemocap-", ".part"];

/// Temporary files of this process, of which some are complete.
#[cfg(feature = "cli")]
static OPEN: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Removes temporary files that a killed process left in a folder, as far as possible. Nobody may be writing there.
#[cfg(feature = "cli")]
pub(crate) fn remove_parts(folder: &Path) {
    let is_part = |name: &str| name.starts_with(TEMPORARY[0]) && name.ends_with(TEMPORARY[1]);
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        if entry.file_name().to_str().is_some_and(is_part) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// A temporary file in the folder of `path`, with the permissions of a normal new file.
pub(crate) fn temporary(path: &Path) -> io::Result<NamedTempFile> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMPORARY[0]).suffix(TEMPORARY[1]);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    // A signal between the making of the file and its entry would leave it.
    #[cfg(feature = "cli")]
    let mut open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
    let file = builder.tempfile_in(folder.unwrap_or(Path::new(".")))?;
    #[cfg(feature = "cli")]
    {
        open.retain(|path| path.exists());
        open.push(file.path().to_owned());
    }
    Ok(file)
}

/// Removes the temporary files of this process, which ends.
#[cfg(feature = "cli")]
pub(crate) fn remove_open() {
    for path in OPEN.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
        let _ = std::fs::remove_file(path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_appears_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        let names = || std::fs::read_dir(folder.path()).unwrap().count();
        let mut file = NewFile::create(&path).unwrap();
        file.file().write_all(b"half").unwrap();
        assert!(!path.exists());
        drop(file);
        assert_eq!(names(), 0);
        write(&path, b"whole").unwrap();
        assert_eq!((std::fs::read(&path).unwrap(), names()), (b"whole".to_vec(), 1));
        assert!(write(&folder.path().join("no/such/folder.txt"), b"").is_err());
    }
}
