//! The calibration file: read at the start and whenever it changes, and written when a camera was mended.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use crate::io::formats::{
    Convention, ImportError, Up, calibration_files, read_calibration, write_calibration,
};
use crate::io::stamp;
use crate::io::wire::{Rig, encode};

/// A calibration file that is checked for changes.
pub struct RigFile {
    path: PathBuf,
    given: Convention,
    up: Up,
    /// Of its files at the last check.
    stamps: Option<Stamps>,
    version: u64,
    /// Checks in a row that found no file.
    missing: u32,
}

/// For each file of a calibration, see [`stamp`].
type Stamps = Vec<(SystemTime, u64)>;

/// `None` if a file is missing.
fn stamps(path: &Path) -> Option<Stamps> {
    calibration_files(path).ok()?.iter().map(|file| stamp(file)).collect()
}

impl RigFile {
    /// Reads the file for the first time: the bytes of a [`Rig`] message. Its version is a hash of
    /// the cameras, so it depends on their content only.
    ///
    /// # Errors
    /// As [`read_calibration`].
    pub fn open(path: PathBuf, given: Convention) -> Result<(Self, Vec<u8>), ImportError> {
        let mut file =
            Self { path, given, up: Up::default(), stamps: None, version: 0, missing: 0 };
        file.stamps = stamps(&file.path);
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
        let stamps = stamps(&self.path);
        // A missing file may just be being replaced; then the next check finds it.
        self.missing = if stamps.is_some() { 0 } else { self.missing.saturating_add(1) };
        if self.missing == 2 {
            let path = self.path.display();
            tracing::warn!("{path} is gone; the calibration that was read from it stays in use");
        }
        if stamps.is_none() || stamps == self.stamps {
            return Ok(None);
        }
        self.stamps = stamps;
        let rig = self.read()?;
        if rig.version == self.version {
            return Ok(None);
        }
        self.version = rig.version;
        Ok(Some(encode(&rig)))
    }

    fn read(&mut self) -> Result<Rig, ImportError> {
        let read = read_calibration(&self.path, &self.given)?;
        tracing::info!("{}: {}", self.path.display(), read.summary());
        for note in &read.notes {
            tracing::warn!("{}: {note}", self.path.display());
        }
        self.up = read.up;
        Ok(Rig::from_core(&read.rig).with_own_version())
    }

    /// Writes a calibration in place of the one of that version, which is kept beside it. Says where the
    /// one and the other are. A file that we cannot write, such as Qualisys', stays as it is: the new
    /// calibration is written beside it.
    ///
    /// # Errors
    /// The file has changed, or a file cannot be written.
    pub fn replace(&mut self, rig: &Rig, instead_of: u64) -> Result<String, String> {
        let path = self.path.display();
        if self.version != instead_of {
            return Err(format!(
                "{path} does not hold the calibration that was in use; it is not overwritten"
            ));
        }
        if stamps(&self.path) != self.stamps {
            return Err(format!("{path} was changed meanwhile; it is not overwritten"));
        }
        let cameras = rig.to_core().map_err(|error| error.to_string())?;
        let is_ours = std::fs::read_to_string(&self.path)
            .is_ok_and(|text| text.parse::<toml::Table>().is_ok());
        if !is_ours {
            let beside = self.path.with_extension("mended.toml");
            write_calibration(&beside, &cameras, self.up).map_err(|error| error.to_string())?;
            self.version = rig.version;
            let beside = beside.display();
            return Ok(format!(
                "{path} is not TOML and stays unchanged; the new calibration is in {beside}: set [node] rig to it"
            ));
        }
        let before = self.path.with_extension(format!("{instead_of}.toml"));
        let kept = std::fs::copy(&self.path, &before);
        kept.map_err(|error| format!("cannot write {}: {error}", before.display()))?;
        write_calibration(&self.path, &cameras, self.up).map_err(|error| error.to_string())?;
        (self.stamps, self.version) = (stamps(&self.path), rig.version);
        Ok(format!("{path} is overwritten; the old calibration is in {}", before.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::formats::write_opencv;
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
        let (mut file, first) = RigFile::open(path.clone(), Up::Z.into()).unwrap();
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
    fn a_mended_calibration_is_written_and_the_one_before_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        fs::write(&path, calibration(1.0)).unwrap();
        let (mut file, first) = RigFile::open(path.clone(), Up::Z.into()).unwrap();
        let before = decode::<Rig>(&first).unwrap();
        let mut cameras = before.to_core().unwrap();
        cameras.cameras[1].translation.x += 0.1;
        let mended = Rig::from_core(&cameras).with_own_version();
        let said = file.replace(&mended, before.version).unwrap();
        let kept = folder.path().join(format!("rig.{}.toml", before.version));
        assert!(said.contains(&kept.display().to_string()), "{said}");
        assert_eq!(fs::read_to_string(&kept).unwrap(), calibration(1.0));
        assert_eq!(file.changed().unwrap(), None, "it is in use already");
        let read = read_calibration(&path, &Up::Z.into()).unwrap().rig;
        assert_eq!(read.cameras[1].translation, cameras.cameras[1].translation);

        // Once more, and somebody changes the file.
        let again = Rig { version: 5, ..mended.clone() };
        file.replace(&again, mended.version).unwrap();
        fs::write(&path, calibration(2.0) + "\n").unwrap();
        let error = file.replace(&mended, 5).unwrap_err();
        assert!(error.contains("changed"), "{error}");
        assert!(fs::read_to_string(&path).unwrap().starts_with("[one]"));
    }

    /// EasyMocap's two files, with its usual names of cameras.
    #[test]
    fn a_calibration_of_two_files_that_are_not_ours_is_watched_and_not_changed() {
        let folder = tempfile::tempdir().unwrap();
        let [intri, extri] = ["intri.yml", "extri.yml"].map(|name| folder.path().join(name));
        let toml = folder.path().join("rig.toml");
        fs::write(&toml, calibration(1.0)).unwrap();
        let mut rig = read_calibration(&toml, &Up::Y.into()).unwrap().rig;
        for (camera, name) in rig.cameras.iter_mut().zip(["1", "2"]) {
            camera.name = name.into();
        }
        let write = |path: &PathBuf, rig: &crate::core::camera::Rig, [one, other]: [&str; 2]| {
            write_opencv(path, rig, Up::Y).unwrap();
            let text = fs::read_to_string(path).unwrap();
            let mut is_kept = true;
            let lines = text.lines().filter(|line| {
                let key = line.split('_').next().unwrap_or_default();
                is_kept = if line.starts_with(' ') { is_kept } else { key != one && key != other };
                is_kept
            });
            fs::write(path, lines.collect::<Vec<_>>().join("\n")).unwrap();
        };
        write(&intri, &rig, ["R", "T"]);
        write(&extri, &rig, ["K", "dist"]);
        let (mut file, first) = RigFile::open(intri.clone(), Up::Y.into()).unwrap();
        assert_eq!(decode::<Rig>(&first).unwrap().to_core().unwrap().cameras[1].name, "2");
        assert_eq!(file.changed().unwrap(), None);
        rig.cameras[1].translation.x += 0.25;
        write(&extri, &rig, ["K", "dist"]);
        let second = decode::<Rig>(&file.changed().unwrap().unwrap()).unwrap();

        let before = fs::read(&intri).unwrap();
        let mended = folder.path().join("intri.mended.toml");
        let mut version = second.version;
        for _ in 0..2 {
            rig.cameras[0].translation.x += 0.1;
            let wire = Rig::from_core(&rig).with_own_version();
            let said = file.replace(&wire, version).unwrap();
            assert!(said.contains("intri.yml is not TOML and stays unchanged"), "{said}");
            assert_eq!(fs::read(&intri).unwrap(), before);
            let read = read_calibration(&mended, &Up::Y.into()).unwrap().rig;
            let off = read.cameras[0].translation - rig.cameras[0].translation;
            assert!(off.norm() < 1e-9, "{off}");
            assert_eq!(file.changed().unwrap(), None);
            version = wire.version;
        }
    }

    #[test]
    fn a_file_that_is_not_there_is_an_error_at_the_start() {
        let path = PathBuf::from("/nowhere/rig.toml");
        let error = RigFile::open(path, Up::Z.into()).err().unwrap().to_string();
        assert!(error.contains("/nowhere/rig.toml"), "{error}");
    }
}
