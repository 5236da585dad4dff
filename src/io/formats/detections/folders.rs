//! Assigns folders to calibrated cameras.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::core::camera::Rig;
use crate::io::file_name;
use crate::io::formats::ImportError;

/// How a folder was assigned to a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MatchedBy {
    /// By name, ignoring case, separators, a suffix `json` and leading zeros. One name may be a part of the other, or
    /// only their last numbers are the same.
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

/// Pairs every folder or file with a camera: as `given` (folder and camera), by names, by numbers in the names,
/// then the rest by order. `folders`: each with whether it has a name.
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
    let mut camera_of = by_given.clone();
    // The strongest likeness first. A weaker one decides among the folders and cameras that are left.
    for is_alike in [has_its_name, has_it_as_a_part, is_a_part_of_it] {
        let is_free = |camera: &usize| !camera_of.contains(&Some(*camera));
        let free: Vec<usize> = (0..rig.cameras.len()).filter(is_free).collect();
        let named: Vec<Option<usize>> = (0..folders.len())
            .map(|i| {
                let is_open = has_name[i] && camera_of[i].is_none();
                let is_its = |camera: &&usize| is_alike(&folders[i], &rig.cameras[**camera].name);
                only(free.iter().filter(|_| is_open).filter(is_its)).copied()
            })
            .collect();
        // If two folders have one camera's name, the name decides for neither.
        for (i, camera) in named.iter().enumerate() {
            if camera.is_some() && named.iter().filter(|other| *other == camera).count() == 1 {
                camera_of[i] = *camera;
            }
        }
    }
    by_numbers(&folders, &has_name, rig, &mut camera_of);
    let mut free: Vec<usize> =
        (0..rig.cameras.len()).filter(|i| !camera_of.contains(&Some(*i))).collect();
    free.sort_by_cached_key(|&i| natural_key(&rig.cameras[i].name));
    let left: Vec<usize> = (0..folders.len()).filter(|&i| camera_of[i].is_none()).collect();
    // If each camera has its own, the rest is of cameras that are not calibrated.
    if left.len() > free.len() && !free.is_empty() {
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

/// Gives each folder that is left the free camera with the same last number, if that works for all of them.
fn by_numbers(folders: &[PathBuf], has_name: &[bool], rig: &Rig, camera_of: &mut [Option<usize>]) {
    let left: Vec<usize> = (0..folders.len()).filter(|&i| camera_of[i].is_none()).collect();
    let is_free = |camera: &usize| !camera_of.contains(&Some(*camera));
    let free: Vec<usize> = (0..rig.cameras.len()).filter(is_free).collect();
    let camera = |i: &usize| {
        let number = frame_number(&stem_of(&folders[*i])).filter(|_| has_name[*i])?;
        only(free.iter().filter(|c| frame_number(&rig.cameras[**c].name) == Some(number))).copied()
    };
    let Some(found) = left.iter().map(camera).collect::<Option<Vec<usize>>>() else { return };
    if found.iter().collect::<BTreeSet<_>>().len() == found.len() {
        left.into_iter().zip(found).for_each(|(i, camera)| camera_of[i] = Some(camera));
    }
}

/// The one item, if there is exactly one.
fn only<T>(mut all: impl Iterator<Item = T>) -> Option<T> {
    all.next().filter(|_| all.next().is_none())
}

/// The name of a camera's folder or file without what does not name the camera.
fn stem_of(folder: &Path) -> String {
    let whole = file_name(folder);
    let endings = [".json", ".csv", ".npy", ".h5"];
    let stem = endings.iter().find_map(|ending| whole.strip_suffix(ending)).unwrap_or(&whole);
    // DeepLabCut adds the name of its network.
    stem.split("DLC_").next().unwrap_or(stem).to_owned()
}

fn has_its_name(folder: &Path, camera: &str) -> bool {
    let camera = plain_name(camera);
    [file_name(folder), stem_of(folder)].iter().any(|name| plain_name(name) == camera)
}

fn has_it_as_a_part(folder: &Path, camera: &str) -> bool {
    has_words(&stem_of(folder), &plain_name(camera))
}

fn is_a_part_of_it(folder: &Path, camera: &str) -> bool {
    has_words(camera, &plain_name(&stem_of(folder)))
}

/// Whether some words of a name, one after the other, are another name, as [`plain_name`] has it.
fn has_words(name: &str, other: &str) -> bool {
    let words = name.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty());
    let words: Vec<&str> = words.collect();
    let run = |from: usize, to: usize| plain_name(&words[from..to].concat());
    let upto = |from: usize| (from + 1..=words.len()).any(|to| run(from, to) == other);
    !other.is_empty() && (0..words.len()).any(upto)
}

/// The last run of digits of a name without its suffix `.json` or `_keypoints.json`. `None` without
/// digits, or if the number is too large.
pub(super) fn frame_number(name: &str) -> Option<u64> {
    numbers(name).next_back()?.parse().ok()
}

/// The part of a file's name before the frame number: `cam1` in `cam1_000012_keypoints.json`.
pub(super) fn video_name(name: &str) -> &str {
    let begin = numbers(name).next_back().map_or(0, |last| name.rfind(last).unwrap_or_default());
    name[..begin].trim_end_matches(['_', '-', '.', ' '])
}

/// Number of runs of digits of a name that are compared.
const MOST_NUMBERS: usize = 8;

/// The frame numbers of the names of one camera. Each is the last run of digits that is not the same in all names:
/// 12 and 13 in `12_cam1.jpg` and `13_cam1.jpg`. `None` as for [`frame_number`].
pub(super) fn frame_numbers<'a>(names: impl Iterator<Item = &'a str> + Clone) -> Vec<Option<u64>> {
    let last = |name: &'a str, k: usize| numbers(name).nth_back(k);
    let differs = |k: &usize| {
        let mut all = names.clone().map(|name| last(name, *k));
        all.next().is_some_and(|first| all.any(|other| other != first))
    };
    let most =
        names.clone().map(|name| numbers(name).take(MOST_NUMBERS).count()).min().unwrap_or(0);
    let k = (0..most).find(differs).unwrap_or(0);
    names.map(|name| last(name, k)?.parse().ok()).collect()
}

/// The runs of digits of a name.
fn numbers(name: &str) -> impl DoubleEndedIterator<Item = &str> {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let stem = stem.strip_suffix("_keypoints").unwrap_or(stem);
    stem.split(|c: char| !c.is_ascii_digit()).filter(|digits| !digits.is_empty())
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
    fn the_number_of_a_frame_is_the_last_one_that_differs() {
        let of = |names: &[&str]| frame_numbers(names.iter().copied());
        assert_eq!(of(&["000012_cam1.jpg", "000013_cam1.jpg"]), [Some(12), Some(13)]);
        assert_eq!(of(&["c1_8_keypoints.json", "c1_9_keypoints.json"]), [Some(8), Some(9)]);
        assert_eq!(of(&["t1_5.json", "t2_5.json", "t2_6.json"]), [Some(5), Some(5), Some(6)]);
        assert_eq!(of(&["7_cam1.jpg"]), [Some(1)]);
        assert_eq!(of(&["a.jpg", "b2.jpg"]), [None, Some(2)]);
        assert_eq!(of(&[]), []);
    }

    #[test]
    fn natural_order_counts() {
        let mut names = vec!["cam10", "cam2", "cam01", "Cam3", "back"];
        names.sort_by_cached_key(|n| natural_key(n));
        assert_eq!(names, ["back", "cam01", "cam2", "Cam3", "cam10"]);
    }
}
