//! Assigns folders to calibrated cameras.

use std::path::{Path, PathBuf};

use crate::core::camera::Rig;
use crate::io::formats::ImportError;

/// How a folder was assigned to a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MatchedBy {
    /// By name, ignoring case, separators, a suffix `json` and leading zeros.
    Name,
    /// As the user says.
    Given,
    /// By natural order of the names, if names do not decide.
    Order,
}

/// A folder or file and its camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FolderMatch {
    /// The camera's folder, or file.
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
    for c in stem.chars().filter(|c| c.is_alphanumeric()) {
        // Of zeros before a number none stays.
        if c.is_ascii_digit() && plain.ends_with('0') {
            let before = plain.len() - 1;
            if !plain[..before].ends_with(|c: char| c.is_ascii_digit()) {
                plain.truncate(before);
            }
        }
        plain.push(c);
    }
    plain
}

/// Pairs every folder or file with a camera: as `given` (folder and camera), by name if it has one, then the
/// rest by order.
///
/// # Errors
/// A given name is not there or is given twice; or folders are left over.
pub(super) fn match_folders(
    root: &Path,
    folders: Vec<(PathBuf, bool)>,
    rig: &Rig,
    given: &[(String, String)],
) -> Result<Vec<FolderMatch>, ImportError> {
    let (folders, has_name): (Vec<PathBuf>, Vec<bool>) = folders.into_iter().unzip();
    let by_given = given_cameras(root, &folders, rig, given)?;
    let is_free = |camera: &usize| !by_given.contains(&Some(*camera));
    let named =
        |i: usize| by_name(&folders[i], rig).filter(|camera| has_name[i] && is_free(camera));
    let named: Vec<Option<usize>> =
        (0..folders.len()).map(|i| by_given[i].or_else(|| named(i))).collect();
    // If two folders have one camera's name, the name decides for neither.
    let alone = |c: &usize| named.iter().filter(|other| **other == Some(*c)).count() == 1;
    let camera_of: Vec<Option<usize>> = named.iter().map(|c| c.filter(alone)).collect();
    let mut free: Vec<usize> =
        (0..rig.cameras.len()).filter(|i| !camera_of.contains(&Some(*i))).collect();
    free.sort_by_cached_key(|&i| natural_key(&rig.cameras[i].name));
    let left: Vec<usize> = (0..folders.len()).filter(|&i| camera_of[i].is_none()).collect();
    if left.len() > free.len() {
        let names = |of: &mut dyn Iterator<Item = String>| of.collect::<Vec<_>>().join(", ");
        return Err(ImportError::CameraWithoutCalibration {
            path: root.to_owned(),
            folders: names(&mut left.iter().map(|&i| file_name(&folders[i]))),
            cameras: names(&mut rig.cameras.iter().map(|camera| camera.name.clone())),
        });
    }
    let by_order = |i: usize| {
        let place = left.iter().position(|&l| l == i)?;
        free.get(place).map(|&camera| (camera, MatchedBy::Order))
    };
    let mut matches: Vec<FolderMatch> = folders
        .into_iter()
        .enumerate()
        .filter_map(|(i, folder)| {
            let name = if by_given[i].is_some() { MatchedBy::Given } else { MatchedBy::Name };
            let (camera, by) = camera_of[i].map(|c| (c, name)).or_else(|| by_order(i))?;
            Some(FolderMatch { folder, camera, by })
        })
        .collect();
    matches.sort_by_key(|m| m.camera);
    Ok(matches)
}

/// The given camera of each folder.
fn given_cameras(
    root: &Path,
    folders: &[PathBuf],
    rig: &Rig,
    given: &[(String, String)],
) -> Result<Vec<Option<usize>>, ImportError> {
    let mut cameras = vec![None; folders.len()];
    for (folder, camera) in given {
        let unknown = |name: &str, known: String| ImportError::UnknownName {
            path: root.to_owned(),
            name: name.to_owned(),
            known,
        };
        let place = folders.iter().position(|path| file_name(path) == *folder);
        let all = || folders.iter().map(|path| file_name(path)).collect::<Vec<_>>().join(", ");
        let place = place.ok_or_else(|| unknown(folder, all()))?;
        let all = || rig.cameras.iter().map(|one| &*one.name).collect::<Vec<_>>().join(", ");
        let index = rig.index_of(camera).ok_or_else(|| unknown(camera, all()))?;
        if cameras[place].is_some() || cameras.contains(&Some(index)) {
            let (path, name) = (root.to_owned(), format!("{folder}={camera}"));
            return Err(ImportError::GivenTwice { path, name });
        }
        cameras[place] = Some(index);
    }
    Ok(cameras)
}

/// The camera with the folder's or file's name, or else the one whose name is a part of it, if there is exactly
/// one.
fn by_name(folder: &Path, rig: &Rig) -> Option<usize> {
    let whole = file_name(folder);
    let endings = [".json", ".csv", ".npy", ".h5"];
    let stem = endings.iter().find_map(|ending| whole.strip_suffix(ending)).unwrap_or(&whole);
    // DeepLabCut adds the name of its network.
    let stem = stem.split("DLC_").next().unwrap_or(stem);
    let cameras: Vec<String> = rig.cameras.iter().map(|camera| plain_name(&camera.name)).collect();
    let only = |is_its: &dyn Fn(&str) -> bool| {
        let mut all = (0..cameras.len()).filter(|&i| is_its(&cameras[i]));
        all.next().filter(|_| all.next().is_none())
    };
    let words = stem.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty());
    let words: Vec<&str> = words.collect();
    let run = |from: usize, to: usize| plain_name(&words[from..to].concat());
    let has = |camera: &str| {
        let upto = |from: usize| (from + 1..=words.len()).any(|to| run(from, to) == camera);
        (0..words.len()).any(upto)
    };
    only(&|camera| camera == plain_name(&whole) || camera == plain_name(stem))
        .or_else(|| only(&|camera| !camera.is_empty() && has(camera)))
}

/// The last part of a path, for names and messages.
pub(super) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The last run of digits of a name without its suffix `.json` or `_keypoints.json`. `None` without
/// digits, or if the number is too large.
pub(super) fn frame_number(name: &str) -> Option<u64> {
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
    fn names_are_compared_without_separators_suffix_and_leading_zeros() {
        for name in ["cam01_json", "cam_01", "Cam-1", "CAM 001.json"] {
            assert_eq!(plain_name(name), "cam1");
        }
        assert_eq!(plain_name("cam_10"), "cam10");
        assert_eq!(plain_name("gopro100_json"), "gopro100");
        assert_eq!(plain_name("json"), "json");
        assert_eq!((&*plain_name("cam0"), &*plain_name("cam_00")), ("cam0", "cam0"));
        assert_eq!((&*plain_name("cam_101"), &*plain_name("10_0")), ("cam101", "100"));
    }

    #[test]
    fn natural_order_counts() {
        let mut names = vec!["cam10", "cam2", "cam01", "Cam3", "back"];
        names.sort_by_cached_key(|n| natural_key(n));
        assert_eq!(names, ["back", "cam01", "cam2", "Cam3", "cam10"]);
    }
}
