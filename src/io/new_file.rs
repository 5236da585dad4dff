//! A file that appears whole or not at all.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use super::formats::ExportError;

/// A file being written beside its destination; dropped unfinished, it is gone.
#[derive(Debug)]
pub(super) struct NewFile {
    path: PathBuf,
    file: BufWriter<NamedTempFile>,
}

impl NewFile {
    pub(super) fn create(path: &Path) -> Result<Self, ExportError> {
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
        let file = builder().tempfile_in(folder.unwrap_or(Path::new(".")));
        let file = file.map_err(|source| ExportError::Write { path: path.into(), source })?;
        Ok(Self { path: path.into(), file: BufWriter::new(file) })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Runs `write` on the file and adds the path to what goes wrong.
    pub(super) fn write(
        &mut self,
        write: impl FnOnce(&mut BufWriter<NamedTempFile>) -> io::Result<()>,
    ) -> Result<(), ExportError> {
        write(&mut self.file)
            .map_err(|source| ExportError::Write { path: self.path.clone(), source })
    }

    /// Puts the file in its place.
    pub(super) fn finish(mut self) -> Result<File, ExportError> {
        self.write(|file| file.flush())?;
        let Self { path, file } = self;
        let failed = |source| ExportError::Write { path: path.clone(), source };
        let file = file.into_inner().map_err(|e| failed(e.into_error()))?;
        file.persist(&path).map_err(|e| failed(e.error))
    }
}

/// Temporary files are private by default; this one becomes an ordinary file.
fn builder() -> tempfile::Builder<'static, 'static> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".bundlemocap-");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder
}
