//! Reads folders of OpenPose JSON files as one stream.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

mod folders;
mod frame_file;

use super::ImportError;
use crate::core::camera::Rig;
use crate::core::detections::{Detections, KeypointFormat, Person};
use crate::core::time::Timestamp;
pub(super) use folders::natural_key;
pub use folders::{FolderMatch, MatchedBy};
use folders::{by_name, file_name, match_folders};

/// Content of one camera's folder. Counts of files and gaps are known from the start; the others
/// grow while the stream is read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct CameraReport {
    /// Number of JSON files.
    pub files: u64,
    /// Smallest frame number.
    pub first_frame: u64,
    /// Largest frame number.
    pub last_frame: u64,
    /// Frame numbers without a file between the first and the last.
    pub gaps: u64,
    /// Empty files; they count as frames without people.
    pub empty_files: u64,
    /// Frames without people.
    pub frames_without_people: u64,
    /// People kept.
    pub people: u64,
    /// People skipped because no point of theirs was seen.
    pub people_without_points: u64,
    /// Points kept.
    pub points: u64,
    /// Points skipped because a number was null, NaN or infinite.
    pub non_finite_points: u64,
    /// Confidences above 1, set to 1.
    pub clamped_confidences: u64,
}

/// The files of one camera.
struct CameraFiles {
    camera: usize,
    /// Sorted by frame number.
    files: Vec<(u64, PathBuf)>,
    next: usize,
}

impl CameraFiles {
    fn next_frame(&self) -> Option<u64> {
        self.files.get(self.next).map(|(frame, _)| *frame)
    }
}

/// A folder with one subfolder of OpenPose JSON files per camera.
///
/// An iterator of [`Detections`] in order of capture time, then of camera index. Frame numbers are
/// the last digits of the file names; the capture time is the frame number divided by the frame
/// rate. Each file is read when it is needed. After an error the iterator ends.
pub struct OpenposeFolder {
    format: KeypointFormat,
    fps: f64,
    cameras: Vec<CameraFiles>,
    matches: Vec<FolderMatch>,
    reports: Vec<CameraReport>,
    failed: bool,
}

impl OpenposeFolder {
    /// Lists the files and pairs the subfolders with the rig's cameras; reads no file yet.
    ///
    /// # Errors
    /// A folder that cannot be read, has no JSON, or does not fit the rig; file names without frame
    /// numbers or with equal ones; an invalid frame rate.
    pub fn open(
        folder: &Path,
        rig: &Rig,
        format: KeypointFormat,
        fps: f64,
    ) -> Result<Self, ImportError> {
        if !(fps.is_finite() && fps > 0.0) {
            return Err(ImportError::FrameRate { fps });
        }
        let matches = match_folders(folder, camera_folders(folder, rig)?, rig)?;
        let list = |m: &FolderMatch| {
            Ok(CameraFiles { camera: m.camera, files: frame_files(&m.folder, fps)?, next: 0 })
        };
        let cameras = matches.iter().map(list).collect::<Result<Vec<_>, ImportError>>()?;
        let reports = cameras.iter().map(|c| counts(&c.files)).collect();
        Ok(Self { format, fps, cameras, matches, reports, failed: false })
    }

    /// Folders and their cameras, by the camera's index.
    pub fn matches(&self) -> &[FolderMatch] {
        &self.matches
    }

    /// Content and tolerated faults so far, by the camera's index.
    pub fn reports(&self) -> &[CameraReport] {
        &self.reports
    }

    /// Number of files of all cameras.
    pub fn file_count(&self) -> u64 {
        self.reports.iter().map(|r| r.files).sum()
    }

    /// Whether the cameras have different numbers of frames.
    pub fn frame_counts_differ(&self) -> bool {
        self.reports.windows(2).any(|pair| pair[0].files != pair[1].files)
    }

    fn read(&self, path: &Path, report: &mut CameraReport) -> Result<Vec<Person>, ImportError> {
        let bytes = fs::read(path).map_err(|e| ImportError::read(path, e))?;
        frame_file::people(path, &bytes, self.format, report)
    }
}

impl Iterator for OpenposeFolder {
    type Item = Result<Detections, ImportError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.failed {
            return None;
        }
        let heads = self.cameras.iter().enumerate();
        let (_, at) = heads.filter_map(|(i, c)| Some((c.next_frame()?, i))).min()?;
        let next = self.cameras[at].next;
        self.cameras[at].next += 1;
        let (frame, path) = &self.cameras[at].files[next];
        let mut report = self.reports[at];
        let people = self.read(path, &mut report);
        let item = people.map(|people| {
            report.frames_without_people += u64::from(people.is_empty());
            Detections {
                camera: self.cameras[at].camera,
                frame: *frame,
                capture: Timestamp::of_frame(*frame, self.fps),
                format: self.format,
                people,
            }
        });
        self.failed = item.is_err();
        self.reports[at] = report;
        Some(item)
    }
}

/// The subfolders with JSON files, in natural order.
fn camera_folders(root: &Path, rig: &Rig) -> Result<Vec<PathBuf>, ImportError> {
    let mut folders = Vec::new();
    for path in entries(root)? {
        if !path.is_dir() {
            continue;
        }
        if entries(&path)?.iter().any(|file| is_json(file)) {
            folders.push(path);
        } else if let Some(camera) = by_name(&path, rig) {
            let camera = rig.cameras[camera].name.clone();
            return Err(ImportError::EmptyCameraFolder { path, camera });
        }
    }
    if folders.is_empty() {
        return Err(ImportError::NoCameraFolders { path: root.to_owned() });
    }
    folders.sort_by_cached_key(|f| natural_key(&file_name(f)));
    Ok(folders)
}

/// The JSON files of a camera, sorted by frame number; numbers must be unique.
fn frame_files(folder: &Path, fps: f64) -> Result<Vec<(u64, PathBuf)>, ImportError> {
    let mut files = Vec::new();
    for path in entries(folder)?.into_iter().filter(|path| is_json(path)) {
        match frame_number(&file_name(&path)).filter(|frame| has_time(*frame, fps)) {
            Some(frame) => files.push((frame, path)),
            None => return Err(ImportError::FrameNumber { path }),
        }
    }
    files.sort();
    if let Some(pair) = files.windows(2).find(|pair| pair[0].0 == pair[1].0) {
        return Err(ImportError::DuplicateFrame {
            path: folder.to_owned(),
            frame: pair[0].0,
            first: file_name(&pair[0].1),
            second: file_name(&pair[1].1),
        });
    }
    Ok(files)
}

/// Whether the frame's capture time fits into nanoseconds.
fn has_time(frame: u64, fps: f64) -> bool {
    Timestamp::of_frame(frame, fps) < Timestamp::from_ns(i64::MAX)
}

fn counts(files: &[(u64, PathBuf)]) -> CameraReport {
    let (first, last) = match files {
        [first, .., last] => (first.0, last.0),
        [only] => (only.0, only.0),
        [] => return CameraReport::default(),
    };
    let count = files.len() as u64;
    CameraReport {
        files: count,
        first_frame: first,
        last_frame: last,
        gaps: (last - first) - (count - 1),
        ..CameraReport::default()
    }
}

/// The entries of a folder, without hidden files.
fn entries(folder: &Path) -> Result<Vec<PathBuf>, ImportError> {
    let fail = |e| ImportError::read(folder, e);
    let mut paths = Vec::new();
    for entry in fs::read_dir(folder).map_err(fail)? {
        let path = entry.map_err(fail)?.path();
        if !file_name(&path).starts_with('.') {
            paths.push(path);
        }
    }
    Ok(paths)
}

fn is_json(path: &Path) -> bool {
    path.extension().and_then(OsStr::to_str).is_some_and(|e| e.eq_ignore_ascii_case("json"))
        && !path.is_dir()
}

/// The last run of digits of a name without its suffix `.json` or `_keypoints.json`. `None` without
/// digits, or if the number is too large.
fn frame_number(name: &str) -> Option<u64> {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let stem = stem.strip_suffix("_keypoints").unwrap_or(stem);
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end]
        .rfind(|c: char| !c.is_ascii_digit())
        .map_or(0, |at| at + stem[at..].chars().next().map_or(1, char::len_utf8));
    stem[start..end].parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_numbers_are_the_last_digits() {
        assert_eq!(frame_number("cam01.0042.json"), Some(42));
        assert_eq!(frame_number("take2_000000000123_keypoints.json"), Some(123));
        assert_eq!(frame_number("12.json"), Some(12));
        assert_eq!(frame_number("caméra7é.json"), Some(7));
        assert_eq!(frame_number("é7.json"), Some(7));
        assert_eq!(frame_number("nothing.json"), None);
        assert_eq!(frame_number("99999999999999999999999.json"), None);
    }
}
