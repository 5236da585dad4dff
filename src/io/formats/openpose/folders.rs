//! Assigns folders to calibrated cameras.

use std::path::{Path, PathBuf};

use crate::core::camera::Rig;
use crate::io::formats::ImportError;

/// How a folder was assigned to a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MatchedBy {
    /// By name, ignoring case, separators, a suffix `json` and leading zeros.
    Name,
    /// By natural order of the names, if names do not decide.
    Order,
}

/// A folder and its camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FolderMatch {
    /// The camera's folder of JSON files.
    pub folder: PathBuf,
    /// Index in the rig.
    pub camera: usize,
    /// How the camera was assigned.
    pub by: MatchedBy,
}

/// Sort key for natural order: runs of digits by value, the rest as lower-case letters.
pub(in crate::io::formats) fn natural_key(name: &str) -> Vec<(String, usize, String)> {
    let mut key = Vec::new();
    let mut rest = name;
    while !rest.is_empty() {
        let letters = rest.find(|c: char| c.is_ascii_digit()).unwrap_or(rest.len());
        let (text, after) = rest.split_at(letters);
        let digits = after.find(|c: char| !c.is_ascii_digit()).unwrap_or(after.len());
        let (number, after) = after.split_at(digits);
        let number = number.trim_start_matches('0');
        key.push((text.to_lowercase(), number.len(), number.to_owned()));
        rest = after;
    }
    key
}

/// A simplified name: `cam01_json`, `Cam-1` and `cam_01` all become `cam1`.
fn plain_name(name: &str) -> String {
    let lower = name.to_lowercase();
    let stem = lower.strip_suffix("json").filter(|s| !s.is_empty()).unwrap_or(&lower);
    let mut plain = String::new();
    let mut in_number = false;
    for c in stem.chars().filter(|c| c.is_alphanumeric()) {
        if c == '0' && !in_number {
            continue;
        }
        in_number = c.is_ascii_digit();
        plain.push(c);
    }
    plain
}

/// Pairs every folder with a camera: by name, then the rest by order.
///
/// # Errors
/// The numbers of folders and cameras differ; the error lists the rest.
pub(super) fn match_folders(
    root: &Path,
    folders: Vec<PathBuf>,
    rig: &Rig,
) -> Result<Vec<FolderMatch>, ImportError> {
    let named: Vec<Option<usize>> = folders.iter().map(|f| by_name(f, rig)).collect();
    // If two folders have one camera's name, the name decides for neither.
    let alone = |c: &usize| named.iter().filter(|other| **other == Some(*c)).count() == 1;
    let camera_of: Vec<Option<usize>> = named.iter().map(|c| c.filter(alone)).collect();
    let mut free: Vec<usize> =
        (0..rig.cameras.len()).filter(|i| !camera_of.contains(&Some(*i))).collect();
    free.sort_by_cached_key(|&i| natural_key(&rig.cameras[i].name));
    let left: Vec<usize> = (0..folders.len()).filter(|&i| camera_of[i].is_none()).collect();
    check_counts(root, &folders, &left, rig, &free)?;
    let by_order = |i: usize| {
        let place = left.iter().position(|&l| l == i)?;
        free.get(place).map(|&camera| (camera, MatchedBy::Order))
    };
    let mut matches: Vec<FolderMatch> = folders
        .into_iter()
        .enumerate()
        .filter_map(|(i, folder)| {
            let (camera, by) =
                camera_of[i].map(|c| (c, MatchedBy::Name)).or_else(|| by_order(i))?;
            Some(FolderMatch { folder, camera, by })
        })
        .collect();
    matches.sort_by_key(|m| m.camera);
    Ok(matches)
}

/// The camera with the folder's name, if there is exactly one.
pub(super) fn by_name(folder: &Path, rig: &Rig) -> Option<usize> {
    let name = plain_name(&file_name(folder));
    let mut same = (0..rig.cameras.len()).filter(|&i| plain_name(&rig.cameras[i].name) == name);
    same.next().filter(|_| same.next().is_none())
}

fn check_counts(
    root: &Path,
    folders: &[PathBuf],
    left: &[usize],
    rig: &Rig,
    free: &[usize],
) -> Result<(), ImportError> {
    let path = root.to_owned();
    let folder_names = |of: &mut dyn Iterator<Item = &PathBuf>| {
        of.map(|f| file_name(f)).collect::<Vec<_>>().join(", ")
    };
    let camera_names = |of: &mut dyn Iterator<Item = usize>| {
        of.map(|i| rig.cameras[i].name.as_str()).collect::<Vec<_>>().join(", ")
    };
    match left.len().cmp(&free.len()) {
        std::cmp::Ordering::Equal => Ok(()),
        std::cmp::Ordering::Greater => Err(ImportError::CameraWithoutCalibration {
            path,
            folders: folder_names(&mut left.iter().map(|&i| &folders[i])),
            cameras: camera_names(&mut (0..rig.cameras.len())),
        }),
        std::cmp::Ordering::Less => Err(ImportError::CalibrationWithoutCamera {
            path,
            folders: folder_names(&mut folders.iter()),
            cameras: camera_names(&mut free.iter().copied()),
        }),
    }
}

/// The last part of a path, for names and messages.
pub(super) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_compared_without_separators_suffix_and_leading_zeros() {
        for name in ["cam01_json", "cam_01", "Cam-1", "CAM 001.json"] {
            assert_eq!(plain_name(name), "cam1");
        }
        assert_eq!(plain_name("cam_10"), "cam10");
        assert_eq!(plain_name("gopro100_json"), "gopro100");
        assert_eq!(plain_name("json"), "json");
    }

    #[test]
    fn natural_order_counts() {
        let mut names = vec!["cam10", "cam2", "cam01", "Cam3", "back"];
        names.sort_by_cached_key(|n| natural_key(n));
        assert_eq!(names, ["back", "cam01", "cam2", "Cam3", "cam10"]);
    }
}
