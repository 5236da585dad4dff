//! Checks before a file is written: `--overwrite`, the inputs, the ending of its name.

use std::path::Path;

use clap::Args;

use super::failure::{Exit, Failure};

/// Whether existing files may be replaced.
#[derive(Clone, Copy, Debug, Args)]
pub(crate) struct Overwrite {
    /// Replace existing files.
    #[arg(long)]
    pub(crate) overwrite: bool,
}

impl Overwrite {
    /// Fails if the file exists and may not be replaced, or cannot be made there.
    pub(crate) fn check(self, path: &Path) -> Result<(), Failure> {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        let (exit, what) = match path.symlink_metadata() {
            Ok(_) if !path.is_file() => (Exit::Usage, "is not a file; choose another name"),
            Ok(_) if self.overwrite => return Ok(()),
            Ok(_) => (Exit::Usage, "exists; choose another name, or use --overwrite"),
            Err(_) if folder.is_none_or(Path::is_dir) => return Ok(()),
            Err(_) => (Exit::Unexpected, "cannot be written; check that the folder exists"),
        };
        Err(Failure::new(exit, format!("{} {what}", path.display())))
    }

    /// As [`Overwrite::check`], for a command that reads `input`, which is never replaced.
    pub(crate) fn check_beside(self, input: &Path, path: &Path) -> Result<(), Failure> {
        is_no_input(input, path)?;
        self.check(path)
    }
}

/// Fails if a file to write has the ending of another format than `ending`.
pub(crate) fn check_ending(path: &Path, ending: &str) -> Result<(), Failure> {
    const ENDINGS: [&str; 24] = [
        "bvh", "c3d", "csv", "fbx", "glb", "gltf", "h5", "html", "jpg", "json", "mcap", "mot",
        "mp4", "npy", "npz", "png", "svg", "toml", "trc", "txt", "usd", "usda", "yaml", "yml",
    ];
    let own = path.extension().map(|own| own.to_string_lossy().to_lowercase());
    let is_other = |own: &String| own != ending && ENDINGS.contains(&own.as_str());
    if own.as_ref().is_none_or(|own| !is_other(own)) {
        return Ok(());
    }
    let message = format!("{}: the ending must be .{ending}", path.display());
    Err(Failure::new(Exit::Usage, message))
}

/// Fails if the file to write is the input.
pub(crate) fn is_no_input(input: &Path, path: &Path) -> Result<(), Failure> {
    if !is_same_file(input, path) {
        return Ok(());
    }
    let message = format!("{} is the input; choose another name", path.display());
    Err(Failure::new(Exit::Usage, message))
}

/// Whether two paths lead to the same existing file.
pub(crate) fn is_same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}
