//! The files of each camera: a folder with a file for each frame, a file for all frames, or a part of a file with
//! several cameras.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use super::folders::{frame_number, frame_numbers, video_name};
use super::{CameraReport, Frames, json, table};
use crate::core::time::Timestamp;
use crate::io::file_name;
use crate::io::formats::ImportError;

/// Files of a camera before they are given to one.
pub(super) struct Source {
    /// Folder or file.
    pub(super) path: PathBuf,
    /// Whether the path is named after a camera, perhaps.
    pub(super) has_name: bool,
    content: Content,
}

/// Subfolders with detections in a trial's folder of Pose2Sim; the synchronised ones come first.
pub(super) const TRIAL: [&str; 2] = ["pose-sync", "pose"];

/// The files of all cameras, and the names of their points if they have some.
type Sources = (Vec<Source>, Option<Vec<String>>);

/// Where the frames of a camera are.
enum Content {
    /// A file for each frame.
    Files(Vec<PathBuf>),
    /// The file with all frames.
    File(PathBuf),
    /// A part of a file with several cameras.
    Part(table::Frames, CameraReport),
}

impl Source {
    /// The frames, and their counts. `names`: those of the points in all files, if files have some.
    pub(super) fn frames(
        self,
        fps: f64,
        size: [u32; 2],
        names: &mut Option<Vec<String>>,
    ) -> Result<(Frames, CameraReport), ImportError> {
        let fault = |what| ImportError::NotDetections { path: self.path.clone(), what };
        let (frames, mut report) = match self.content {
            Content::Files(files) => {
                (Frames::Files(frame_files(&self.path, files, fps)?), CameraReport::default())
            }
            Content::Part(frames, report) => (Frames::Whole(frames.into_iter().collect()), report),
            Content::File(path) => {
                let bytes = fs::read(&path).map_err(|error| ImportError::read(&path, error))?;
                let fault = |what| ImportError::NotDetections { path: path.clone(), what };
                let (frames, report) = whole_file(&path, &bytes, size, names).map_err(fault)?;
                (Frames::Whole(frames.into_iter().collect()), report)
            }
        };
        let numbers: Vec<u64> = (0..).map_while(|at| frames.number(at)).collect();
        if let (Some(first), Some(last)) = (numbers.first(), numbers.last()) {
            if !has_time(*last, fps) {
                return Err(fault(format!("frame {last} is too late")));
            }
            report.frames = numbers.len() as u64;
            (report.first_frame, report.last_frame) = (*first, *last);
            report.gaps = (last - first) - (report.frames - 1);
        }
        Ok((frames, report))
    }
}

/// The frames of a file that holds all of a camera.
fn whole_file(
    path: &Path,
    bytes: &[u8],
    size: [u32; 2],
    names: &mut Option<Vec<String>>,
) -> Result<(table::Frames, CameraReport), String> {
    if ending(path) == "npy" {
        let mut cameras = table::npy(bytes)?.into_iter();
        return match (cameras.next(), cameras.next()) {
            (Some(only), None) => Ok(only),
            _ => Err("it holds several cameras, and is not the only file".into()),
        };
    }
    if let kind @ ("csv" | "h5") = &*ending(path) {
        let mut table = if kind == "h5" { table::h5(bytes) } else { table::csv(bytes) }?;
        let (_, only) = table.cameras.pop_first().ok_or("no frames")?;
        if !table.cameras.is_empty() {
            return Err("it holds several cameras, and is not the only file".into());
        }
        if names.is_some() && *names != table.names {
            return Err("its points have other names than those of the file before".into());
        }
        *names = table.names;
        return Ok(only);
    }
    let file = json::parse(bytes)?;
    let frames = json::frames(&file).ok_or("not the detections of all frames of a camera")?;
    let mut report = CameraReport::default();
    let mut all = BTreeMap::new();
    for (number, parts) in frames {
        let people = parts.into_iter().map(|part| json::people(part, size, &mut report));
        let people = people.collect::<Result<Vec<_>, _>>();
        let people = people.map_err(|what| format!("frame {number}: {what}"))?;
        all.insert(number, people.concat());
    }
    Ok((all, report))
}

/// The files of frames in a folder.
fn frames(folder: &Path) -> Result<Vec<PathBuf>, ImportError> {
    Ok(entries(folder)?.into_iter().filter(|file| is_frame(file)).collect())
}

/// Groups files of frames by the video in their names: `cam01_12.txt` is of `cam01`.
fn by_video(files: Vec<PathBuf>) -> Vec<Source> {
    let mut videos = BTreeMap::<PathBuf, Vec<PathBuf>>::new();
    for path in files.into_iter().filter(|path| frame_number(&file_name(path)).is_some()) {
        let video = path.with_file_name(video_name(&file_name(&path)));
        videos.entry(video).or_default().push(path);
    }
    let source = |(path, files)| Source { path, has_name: true, content: Content::Files(files) };
    videos.into_iter().map(source).collect()
}

/// The end of a message: JSON files of a folder that hold no known form of detections. Empty if there are none.
pub(super) fn not_understood(root: &Path) -> String {
    const NAMED: usize = 3;
    let all = entries(root).unwrap_or_default();
    let is_other = |path: &&PathBuf| {
        let file = fs::read(path).ok().filter(|_| ending(path) == "json" && !path.is_dir());
        file.and_then(|bytes| json::parse(&bytes).ok()).is_some_and(|file| {
            let is_one = json::people(&file, [1, 1], &mut CameraReport::default()).is_ok();
            json::frames(&file).is_none() && !is_one
        })
    };
    let names: Vec<String> = all.iter().filter(is_other).map(|path| file_name(path)).collect();
    match names.len() {
        0 => String::new(),
        few if few <= NAMED => format!("; not understood: {}", names.join(", ")),
        many => {
            format!("; not understood: {} and {} more", names[..NAMED].join(", "), many - NAMED)
        }
    }
}

/// The subfolders or files of cameras, in natural order, and the names of their points.
pub(super) fn sources(root: &Path) -> Result<Sources, ImportError> {
    // FreeMoCap's folders hold other arrays beside the 2D data.
    let inner = ["output_data/raw_data", "raw_data", "output_data"].map(|inner| root.join(inner));
    let there = inner.into_iter().filter(|inner| inner.is_dir());
    for place in std::iter::once(root.to_owned()).chain(there) {
        if let Some(found) = shared_file(&place)? {
            return Ok(found);
        }
    }
    // A detector has put the frames of all videos into one folder.
    let together = by_video(frames(root)?);
    let has_frames = |one: &Source| match &one.content {
        Content::Files(files) => {
            // Nobody may be in the first frames.
            let first = files.iter().find(|file| !is_empty(file));
            files.len() > 1 && first.is_none_or(|first| !holds_all(first, false))
        }
        _ => false,
    };
    if together.len() > 1 && together.iter().all(has_frames) {
        return Ok((together, None));
    }
    let mut found = Vec::new();
    let mut add = |path, content| found.push(Source { path, has_name: true, content });
    for path in entries(root)? {
        if !path.is_dir() {
            if is_frame(&path) && holds_all(&path, true) {
                add(path.clone(), Content::File(path));
            }
            continue;
        }
        // YOLO's files are in `labels`. Others may be in `json`.
        let (labels, json) = (path.join("labels"), path.join("json"));
        let mut files = frames(if labels.is_dir() { &labels } else { &path })?;
        if files.is_empty() && json.is_dir() {
            files = frames(&json)?;
        }
        match &files[..] {
            [] => {}
            [only] if holds_all(only, false) || frame_number(&file_name(only)).is_none() => {
                add(path, Content::File(only.clone()));
            }
            [first, ..] => {
                if json::parse(&fs::read(first).unwrap_or_default())
                    .is_ok_and(|file| json::is_take(&file))
                {
                    let what = "its folder holds several takes; leave one of them in it. If \
                                each is of another camera, import this folder"
                        .into();
                    return Err(ImportError::NotDetections { path: first.clone(), what });
                }
                add(path, Content::Files(files));
            }
        }
    }
    if found.is_empty() {
        // The folder of a trial.
        let mut empty = None;
        for inner in TRIAL.map(|inner| root.join(inner)).into_iter().filter(|inner| inner.is_dir())
        {
            match sources(&inner) {
                Err(error @ ImportError::NoCameraFolders { .. }) => empty = Some(error),
                found => return found,
            }
        }
        if let Some(error) = empty {
            return Err(error);
        }
    }
    if let [Source { content: Content::Files(files), .. }] = &found[..] {
        let together = by_video(files.clone());
        if together.len() > 1 {
            found = together;
        }
    }
    if found.is_empty() {
        let not_understood = not_understood(root);
        return Err(ImportError::NoCameraFolders { path: root.to_owned(), not_understood });
    }
    Ok((found, None))
}

/// The cameras of a file that holds several: FreeMoCap's 2D data, or a CSV with a column `camera`.
fn shared_file(root: &Path) -> Result<Option<Sources>, ImportError> {
    let path = match root.is_dir() {
        false => root.to_owned(),
        true => {
            let all = entries(root)?;
            let is_2d = |path: &&PathBuf| {
                ending(path) == "npy" && file_name(path).to_lowercase().contains("2d")
            };
            // Others may have an array of each camera.
            let is_of_all = |path: &&&PathBuf| {
                let array = fs::read(path).ok().and_then(|bytes| table::npy(&bytes).ok());
                array.is_some_and(|cameras| cameras.len() > 1)
            };
            let arrays: Vec<&PathBuf> = all.iter().filter(is_2d).collect();
            match (&arrays[..], &all[..]) {
                ([path], _) => PathBuf::clone(path),
                ([], [only]) if ending(only) == "csv" => only.clone(),
                _ => match arrays.iter().find(is_of_all) {
                    Some(path) => PathBuf::clone(path),
                    None => return Ok(None),
                },
            }
        }
    };
    let bytes = fs::read(&path).map_err(|error| ImportError::read(&path, error))?;
    let fault = |what| ImportError::NotDetections { path: path.clone(), what };
    let source = |name: String, has_name, (frames, report)| Source {
        path: path.with_file_name(name),
        has_name,
        content: Content::Part(frames, report),
    };
    let found = match &*ending(&path) {
        "npy" => {
            let cameras = table::npy(&bytes).map_err(fault)?.into_iter().enumerate();
            let name = |i| format!("camera {i} of {}", file_name(&path));
            (cameras.map(|(i, camera)| source(name(i), false, camera)).collect(), None)
        }
        "csv" => {
            let table = table::csv(&bytes).map_err(fault)?;
            if table.cameras.contains_key("") {
                return Err(fault("it has no column camera, and is the only file".into()));
            }
            let cameras = table.cameras.into_iter();
            (cameras.map(|(name, camera)| source(name, true, camera)).collect(), table.names)
        }
        _ => {
            let what = "a folder with the files of each camera is needed, or a .csv or .npy of all";
            return Err(fault(what.into()));
        }
    };
    Ok(Some(found))
}

/// The files of a camera's frames, sorted by frame number; numbers must be unique.
fn frame_files(
    folder: &Path,
    paths: Vec<PathBuf>,
    fps: f64,
) -> Result<Vec<(u64, PathBuf)>, ImportError> {
    let mut files = Vec::new();
    let names: Vec<String> = paths.iter().map(|path| file_name(path)).collect();
    let numbers = frame_numbers(names.iter().map(String::as_str));
    for (path, number) in paths.into_iter().zip(numbers) {
        match number.filter(|frame| has_time(*frame, fps)) {
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
    paths.sort();
    Ok(paths)
}

/// The ending of a file's name in lower case.
pub(super) fn ending(path: &Path) -> String {
    path.extension().map_or(String::new(), |ending| ending.to_string_lossy().to_lowercase())
}

fn is_frame(path: &Path) -> bool {
    let is_label = || frame_number(&file_name(path)).is_some();
    match &*ending(path) {
        "json" | "csv" | "npy" => !path.is_dir(),
        // DeepLabCut may have written the same as CSV.
        "h5" => !path.is_dir() && !path.with_extension("csv").exists(),
        "txt" => !path.is_dir() && is_label(),
        _ => false,
    }
}

/// Whether a file is an empty list: nobody is in a frame, or in a take.
fn is_empty(path: &Path) -> bool {
    let bytes = if ending(path) == "json" { fs::read(path).ok() } else { None };
    let file = bytes.and_then(|bytes| json::parse(&bytes).ok());
    file.is_some_and(|file| file.as_array().is_some_and(Vec::is_empty))
}

/// Whether a file holds all frames of a camera; `broken`: what is said of one that cannot be parsed.
fn holds_all(path: &Path, broken: bool) -> bool {
    match &*ending(path) {
        "csv" | "npy" | "h5" => true,
        "json" => fs::read(path).is_ok_and(|bytes| {
            json::parse(&bytes).map_or(broken, |file| json::frames(&file).is_some())
        }),
        _ => false,
    }
}
