//! The calibration file: read at the start and whenever it changes.

use std::path::PathBuf;
use std::time::SystemTime;

use crate::core::fnv::fnv1a;
use crate::io::formats::{ImportError, Up, read_calibration};
use crate::io::wire::{Rig, encode};

/// A calibration file that is checked for changes.
pub struct RigFile {
    path: PathBuf,
    up: Up,
    stamp: Option<Stamp>,
    version: u64,
}

/// Time of the last change, and length of the file.
type Stamp = (SystemTime, u64);

impl RigFile {
    /// Reads the file for the first time: the bytes of a [`Rig`] message. Its version is a hash of
    /// the cameras, so it depends on their content only.
    ///
    /// # Errors
    /// As [`read_calibration`].
    pub fn open(path: PathBuf, up: Up) -> Result<(Self, Vec<u8>), ImportError> {
        let mut file = Self { path, up, stamp: None, version: 0 };
        file.stamp = file.look();
        let rig = file.read()?;
        file.version = rig.version;
        Ok((file, encode(&rig)))
    }

    /// Path of the file.
    pub fn path(&self) -> &std::path::Path {
        &self.path
    }

    /// The new calibration, if the file has changed since the last check and its content differs.
    ///
    /// # Errors
    /// As [`read_calibration`]; the previous calibration stays valid.
    pub fn changed(&mut self) -> Result<Option<Vec<u8>>, ImportError> {
        let stamp = self.look();
        // A missing file is just being replaced; the next check finds it.
        if stamp.is_none() || stamp == self.stamp {
            return Ok(None);
        }
        self.stamp = stamp;
        let rig = self.read()?;
        if rig.version == self.version {
            return Ok(None);
        }
        self.version = rig.version;
        Ok(Some(encode(&rig)))
    }

    fn look(&self) -> Option<Stamp> {
        let about = std::fs::metadata(&self.path).ok()?;
        Some((about.modified().ok()?, about.len()))
    }

    fn read(&self) -> Result<Rig, ImportError> {
        let mut rig = Rig { version: 0, ..Rig::from_core(&read_calibration(&self.path, self.up)?) };
        rig.version = version(&encode(&rig));
        Ok(rig)
    }
}

/// A 32-bit hash, never 0; every language's numbers can hold it.
fn version(bytes: &[u8]) -> u64 {
    let hash = fnv1a(bytes);
    ((hash >> 32) ^ (hash & 0xffff_ffff)).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::wire::decode;
    use std::fs;

    const CAMERA: &str = "size = [1280.0, 1024.0]
matrix = [[1000.0, 0.0, 640.0], [0.0, 1000.0, 512.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [0.1, 0.2, 0.3]
";

    fn calibration(shift: f64) -> String {
        let camera = |name: &str, x: f64| {
            format!("[{name}]\nname = \"{name}\"\n{CAMERA}translation = [{x}, 0.0, 4.0]\n")
        };
        camera("one", 0.0) + &camera("two", shift)
    }

    #[test]
    fn a_change_is_found_once_and_a_broken_file_changes_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        fs::write(&path, calibration(1.0)).unwrap();
        let (mut file, first) = RigFile::open(path.clone(), Up::Z).unwrap();
        let version = |bytes: &[u8]| decode::<Rig>(bytes).unwrap().to_core().unwrap().version;
        assert_eq!(file.changed().unwrap(), None);

        fs::write(&path, calibration(1.25)).unwrap();
        let second = file.changed().unwrap().unwrap();
        assert_ne!(version(&first), version(&second));
        assert_eq!(file.changed().unwrap(), None);

        fs::write(&path, "no calibration").unwrap();
        let error = file.changed().unwrap_err().to_string();
        assert!(error.contains("rig.toml"), "{error}");
        assert_eq!(file.changed().unwrap(), None);

        fs::remove_file(&path).unwrap();
        assert_eq!(file.changed().unwrap(), None);
        fs::write(&path, calibration(1.25)).unwrap();
        assert_eq!(file.changed().unwrap(), None, "the same cameras again");
        fs::write(&path, calibration(1.0) + "\n").unwrap();
        assert_eq!(version(&file.changed().unwrap().unwrap()), version(&first));
    }

    #[test]
    fn a_file_that_is_not_there_is_an_error_at_the_start() {
        let path = PathBuf::from("/nowhere/rig.toml");
        let error = RigFile::open(path, Up::Z).err().unwrap().to_string();
        assert!(error.contains("/nowhere/rig.toml"), "{error}");
    }
}
