//! Reads the detections of other programs as one stream.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

mod folders;
mod h5;
mod json;
mod order;
mod table;

use nalgebra::Point2;

use super::ImportError;
use crate::core::camera::Rig;
use crate::core::detections::{Detection, Detections, Person};
use crate::core::time::Timestamp;
pub(super) use folders::natural_key;
pub use folders::{FolderMatch, MatchedBy};
use folders::{file_name, match_folders};
pub use order::PointOrder;

/// Content of one camera's files. Counts of files and gaps are known from the start; the others
/// grow while the stream is read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct CameraReport {
    /// Number of frames.
    pub frames: u64,
    /// Smallest frame number.
    pub first_frame: u64,
    /// Largest frame number.
    pub last_frame: u64,
    /// Frame numbers without a frame between the first and the last.
    pub gaps: u64,
    /// Files that are broken, cut or empty; their frames are missing.
    pub broken_files: u64,
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
    /// Confidences above 1, which are used as 1.
    pub confidences_above_1: u64,
    /// Whether there are points of hands or faces, which are not used.
    pub left_out: bool,
}

impl CameraReport {
    /// A point. Detectors write unseen points as 0, 0 or with a confidence that is not positive.
    fn detection(&mut self, x: f64, y: f64, confidence: f64) -> Option<Detection> {
        if !(x.is_finite() && y.is_finite() && confidence.is_finite()) {
            self.non_finite_points += 1;
            return None;
        }
        if confidence <= 0.0 || (x == 0.0 && y == 0.0) {
            return None;
        }
        Some(Detection { pixel: Point2::new(x, y), confidence })
    }
}

/// A person, with the points in the detector's order.
#[derive(Clone, Debug)]
struct RawPerson {
    id: Option<i64>,
    points: Vec<Option<Detection>>,
}

/// The frames of one camera, by frame number.
enum Frames {
    /// A file for each frame, read when it is needed.
    Files(Vec<(u64, PathBuf)>),
    /// One file for all frames.
    Whole(Vec<(u64, Vec<RawPerson>)>),
}

impl Frames {
    fn number(&self, at: usize) -> Option<u64> {
        match self {
            Self::Files(files) => files.get(at).map(|(number, _)| *number),
            Self::Whole(frames) => frames.get(at).map(|(number, _)| *number),
        }
    }
}

/// The files of one camera.
struct CameraFrames {
    camera: usize,
    size: [u32; 2],
    /// Frame rate, hertz.
    fps: f64,
    frames: Frames,
    next: usize,
}

/// How detections are read.
#[derive(Clone, Debug, Default)]
pub struct DetectionOptions {
    /// Frame rate of the cameras, hertz.
    pub fps: f64,
    /// Cameras with another frame rate, hertz.
    pub rates: Vec<(String, f64)>,
    /// Order of the points; `None`: by their names or number.
    pub order: Option<PointOrder>,
    /// A mapping file in place of it; see [`PointOrder::of_file`].
    pub mapping: Option<PathBuf>,
    /// Folders or files, and the cameras that they are of.
    pub cameras: Vec<(String, String)>,
    /// Refuse broken files, and a calibration with more cameras than there are detections of.
    pub strict: bool,
}

/// A folder with the detections of each camera: a subfolder with a file for each frame, or one file.
///
/// An iterator of [`Detections`] in order of capture time, then of camera index. Frame numbers are
/// the last digits of the file names, or are in the files; the capture time is the frame number divided by the
/// frame rate. Files of frames are read when they are needed. After an error the iterator ends.
pub struct DetectionFolder {
    order: PointOrder,
    others: Vec<PointOrder>,
    strict: bool,
    cameras: Vec<CameraFrames>,
    matches: Vec<FolderMatch>,
    reports: Vec<CameraReport>,
    notes: Vec<String>,
    failed: bool,
}

/// Files of a camera before they are given to one.
struct Source {
    /// Folder or file.
    path: PathBuf,
    /// Whether the path is named after a camera, perhaps.
    has_name: bool,
    content: SourceContent,
}

/// The files of all cameras, and the names of their points if they have some.
type Sources = (Vec<Source>, Option<Vec<String>>);

enum SourceContent {
    /// A file for each frame.
    Files(Vec<PathBuf>),
    /// The file with all frames.
    File(PathBuf),
    /// A part of a file with several cameras.
    Part(table::Frames, CameraReport),
}

impl DetectionFolder {
    /// Lists the files, pairs them with the rig's cameras and finds the order of the points. Files of frames
    /// are not yet read.
    ///
    /// # Errors
    /// Files that cannot be read or do not fit the rig; frames without numbers or with equal ones; an order
    /// of points that is not known; an invalid frame rate.
    pub fn open(folder: &Path, rig: &Rig, options: DetectionOptions) -> Result<Self, ImportError> {
        let rates = || options.rates.iter().map(|(_, fps)| *fps).chain([options.fps]);
        if let Some(fps) = rates().find(|fps| !(fps.is_finite() && *fps > 0.0)) {
            return Err(ImportError::FrameRate { fps });
        }
        if let Some((name, _)) = options.rates.iter().find(|(name, _)| rig.index_of(name).is_none())
        {
            let known = rig.cameras.iter().map(|camera| &*camera.name);
            let known = known.collect::<Vec<_>>().join(", ");
            return Err(ImportError::UnknownName {
                path: folder.to_owned(),
                name: name.clone(),
                known,
            });
        }
        let (mut sources, mut names) = sources(folder)?;
        sources.sort_by_cached_key(|source| natural_key(&file_name(&source.path)));
        let paths = sources.iter().map(|source| (source.path.clone(), source.has_name)).collect();
        let matches = match_folders(folder, paths, rig, &options.cameras)?;
        let mut notes = Vec::new();
        let is_unseen = |i: &usize| matches.iter().all(|one| one.camera != *i);
        let unseen = (0..rig.cameras.len()).filter(is_unseen).map(|i| &*rig.cameras[i].name);
        let unseen = unseen.collect::<Vec<_>>().join(", ");
        if !unseen.is_empty() {
            let folders = matches.iter().map(|one| file_name(&one.folder)).collect::<Vec<_>>();
            let error = ImportError::CalibrationWithoutCamera {
                path: folder.to_owned(),
                folders: folders.join(", "),
                cameras: unseen.clone(),
            };
            if options.strict || matches.len() < 2 {
                return Err(error);
            }
            notes.push(format!("there are no detections of camera {unseen}; the others are used"));
        }
        let (mut cameras, mut reports) = (Vec::new(), Vec::<CameraReport>::new());
        let mut sources: Vec<Option<Source>> = sources.into_iter().map(Some).collect();
        for found in &matches {
            let of =
                |one: &Option<Source>| one.as_ref().is_some_and(|one| one.path == found.folder);
            let source = sources.iter_mut().find(|one| of(one)).and_then(Option::take);
            let Some(source) = source else { continue };
            let camera = &rig.cameras[found.camera];
            let size = [camera.width, camera.height];
            let own = options.rates.iter().rfind(|(name, _)| *name == camera.name);
            let fps = own.map_or(options.fps, |(_, fps)| *fps);
            let (frames, report) = source.frames(fps, size, &mut names)?;
            cameras.push(CameraFrames { camera: found.camera, size, fps, frames, next: 0 });
            reports.push(report);
        }
        // Some detectors write only frames in which they see somebody.
        let first = reports
            .iter()
            .filter(|report| report.frames > 0)
            .map(|report| report.first_frame)
            .min();
        if let Some(first) = first.filter(|first| *first > 1) {
            notes.push(format!(
                "the first frame of all is {first}; times and frames of outputs count from there"
            ));
        }
        let (order, others) = match (&options.mapping, options.order) {
            (Some(path), _) => (PointOrder::of_file(path, names.as_deref())?, Vec::new()),
            (None, Some(order)) => (order, Vec::new()),
            (None, None) => found_order(folder, &cameras, names.as_deref(), &mut notes)?,
        };
        let strict = options.strict;
        let failed = false;
        Ok(Self { order, others, strict, cameras, matches, reports, notes, failed })
    }

    /// Folders or files and their cameras, by the camera's index.
    pub fn matches(&self) -> &[FolderMatch] {
        &self.matches
    }

    /// Content and tolerated faults so far, in the order of [`matches`](Self::matches).
    pub fn reports(&self) -> &[CameraReport] {
        &self.reports
    }

    /// The order of the points.
    pub fn order(&self) -> &PointOrder {
        &self.order
    }

    /// Other orders with as many points, if the order was found by their number.
    pub fn others(&self) -> &[PointOrder] {
        &self.others
    }

    /// What was guessed or left out so far.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Number of frames of all cameras, without those that are known to be broken.
    pub fn frame_count(&self) -> u64 {
        self.reports.iter().map(|r| r.frames - r.broken_files).sum()
    }

    /// Whether the cameras have different numbers of frames.
    pub fn frame_counts_differ(&self) -> bool {
        self.reports.windows(2).any(|pair| pair[0].frames != pair[1].frames)
    }

    /// The people of a frame; `None` if its file is broken.
    fn read(&mut self, at: usize) -> Result<Option<Vec<Person>>, ImportError> {
        let CameraFrames { frames, next, size, .. } = &mut self.cameras[at];
        let report = &mut self.reports[at];
        *next += 1;
        let (path, raw) = match frames {
            Frames::Whole(frames) => {
                (&self.matches[at].folder, Ok(std::mem::take(&mut frames[*next - 1].1)))
            }
            Frames::Files(files) => {
                let path = &files[*next - 1].1;
                (path, people_of_file(path, *size, report)?)
            }
        };
        let raw = raw.map_err(|what| ImportError::NotDetections { path: path.clone(), what });
        let raw = raw.and_then(|raw| {
            let counts = raw.iter().map(|person| person.points.len()).enumerate();
            let mut others = counts.filter(|(_, count)| *count > 0 && !self.order.takes(*count));
            match others.next() {
                None => Ok(raw),
                Some((person, found)) => {
                    let (path, order) = (path.clone(), Box::new(self.order.clone()));
                    Err(ImportError::PointCount { path, person, found, order })
                }
            }
        });
        let raw = match raw {
            Ok(raw) => raw,
            // Another number of points in the first frame is another detector's.
            Err(error @ ImportError::PointCount { .. }) if report.people == 0 => return Err(error),
            Err(error) if self.strict => return Err(error),
            Err(error) => {
                report.broken_files += 1;
                if report.broken_files <= NAMED {
                    self.notes.push(format!("the frame is missing: {error}"));
                }
                return Ok(None);
            }
        };
        let mut people = Vec::with_capacity(raw.len());
        for RawPerson { id, points } in raw {
            let points = self.order.put(&points);
            if points.iter().all(Option::is_none) {
                report.people_without_points += 1;
                continue;
            }
            report.confidences_above_1 +=
                points.iter().flatten().filter(|p| p.confidence > 1.0).count() as u64;
            report.points += points.iter().flatten().count() as u64;
            people.push(Person { id, points });
        }
        report.people += people.len() as u64;
        report.frames_without_people += u64::from(people.is_empty());
        Ok(Some(people))
    }
}

impl Iterator for DetectionFolder {
    type Item = Result<Detections, ImportError>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.failed {
            let heads = self.cameras.iter().enumerate();
            let head = |(at, camera): (usize, &CameraFrames)| {
                let frame = camera.frames.number(camera.next)?;
                Some((Timestamp::of_frame(frame, camera.fps), at, frame))
            };
            let (capture, at, frame) = heads.filter_map(head).min()?;
            match self.read(at) {
                Ok(None) => continue,
                Ok(Some(people)) => {
                    return Some(Ok(Detections {
                        camera: self.cameras[at].camera,
                        frame,
                        capture,
                        format: self.order.format,
                        people,
                    }));
                }
                Err(error) => {
                    self.failed = true;
                    return Some(Err(error));
                }
            }
        }
        None
    }
}

/// A mark of UTF-8 at the start of a text.
const BOM: &[u8] = b"\xef\xbb\xbf";

/// So many broken files of a camera are named.
const NAMED: u64 = 10;

/// The order of the points by their names, or by the number of the first person's; and others with that number.
fn found_order(
    folder: &Path,
    cameras: &[CameraFrames],
    names: Option<&[String]>,
    notes: &mut Vec<String>,
) -> Result<(PointOrder, Vec<PointOrder>), ImportError> {
    if let Some(names) = names {
        let Some((order, left)) = PointOrder::of_names(names) else {
            let what = format!("none of the points {} is known by its name", names.join(", "));
            return Err(ImportError::Mapping { path: folder.to_owned(), what });
        };
        if !left.is_empty() {
            notes.push(format!("points left out: {}", left.join(", ")));
        }
        return Ok((order, Vec::new()));
    }
    let mut tried = Tried::default();
    let count = cameras.iter().find_map(|camera| first_count(camera, &mut tried));
    let Some(count) = count else {
        let fault = tried.fault.filter(|_| tried.read == 0);
        return Err(fault.unwrap_or_else(|| ImportError::NoPeople { path: folder.to_owned() }));
    };
    let mut others = PointOrder::of_count(count);
    if others.is_empty() {
        return Err(ImportError::UnknownCount { path: folder.to_owned(), count });
    }
    let order = others.remove(0);
    let mut note = format!("{count} points, read as {}", order.name);
    for other in &others {
        note += &format!("; {} has as many (--format)", other.name);
    }
    notes.push(note);
    Ok((order, others))
}

/// The files in which people were searched.
#[derive(Default)]
struct Tried {
    /// Number of those that could be read.
    read: usize,
    /// What is wrong with the first of the others.
    fault: Option<ImportError>,
}

/// The number of points of the first person with points.
fn first_count(camera: &CameraFrames, tried: &mut Tried) -> Option<usize> {
    let count = |people: &[RawPerson]| {
        people.iter().map(|person| person.points.len()).find(|count| *count > 0)
    };
    match &camera.frames {
        Frames::Whole(frames) => frames.iter().find_map(|(_, people)| count(people)),
        Frames::Files(files) => files.iter().find_map(|(_, path)| {
            let people = people_of_file(path, camera.size, &mut CameraReport::default());
            let people = people.and_then(|people| {
                people.map_err(|what| ImportError::NotDetections { path: path.clone(), what })
            });
            match people {
                Ok(people) => {
                    tried.read += 1;
                    count(&people)
                }
                Err(error) => {
                    tried.fault.get_or_insert(error);
                    None
                }
            }
        }),
    }
}

/// The people of a frame's file; the inner error is of its content.
fn people_of_file(
    path: &Path,
    size: [u32; 2],
    report: &mut CameraReport,
) -> Result<Result<Vec<RawPerson>, String>, ImportError> {
    let bytes = fs::read(path).map_err(|error| ImportError::read(path, error))?;
    let bytes = bytes.strip_prefix(BOM).unwrap_or(&bytes).trim_ascii();
    // An empty text is a frame without people.
    if ending(path) == "txt" {
        let text = String::from_utf8_lossy(bytes);
        return Ok(table::yolo(&text, size, report));
    }
    if bytes.is_empty() {
        return Ok(Err("the file is empty".to_owned()));
    }
    Ok(json::parse(bytes).and_then(|frame| json::people(&frame, size, report)))
}

impl Source {
    fn frames(
        self,
        fps: f64,
        size: [u32; 2],
        names: &mut Option<Vec<String>>,
    ) -> Result<(Frames, CameraReport), ImportError> {
        let fault = |what| ImportError::NotDetections { path: self.path.clone(), what };
        let (frames, mut report) = match self.content {
            SourceContent::Files(files) => {
                (Frames::Files(frame_files(&self.path, files, fps)?), CameraReport::default())
            }
            SourceContent::Part(frames, report) => {
                (Frames::Whole(frames.into_iter().collect()), report)
            }
            SourceContent::File(path) => {
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

/// The subfolders or files of cameras, in natural order, and the names of their points.
fn sources(root: &Path) -> Result<Sources, ImportError> {
    // FreeMoCap's folders hold other arrays beside the 2D data.
    let inner = ["output_data/raw_data", "raw_data", "output_data"].map(|inner| root.join(inner));
    let there = inner.into_iter().filter(|inner| inner.is_dir());
    for place in std::iter::once(root.to_owned()).chain(there) {
        if let Some(found) = shared_file(&place)? {
            return Ok(found);
        }
    }
    let mut found = Vec::new();
    let mut add = |path, content| found.push(Source { path, has_name: true, content });
    for path in entries(root)? {
        if !path.is_dir() {
            if is_frame(&path) && holds_all(&path, true) {
                add(path.clone(), SourceContent::File(path));
            }
            continue;
        }
        // YOLO's are in a folder of their own.
        let inner = path.join("labels");
        let files = entries(if inner.is_dir() { &inner } else { &path })?;
        let files: Vec<PathBuf> = files.into_iter().filter(|file| is_frame(file)).collect();
        match &files[..] {
            [] => {}
            [only] if holds_all(only, false) || frame_number(&file_name(only)).is_none() => {
                add(path, SourceContent::File(only.clone()));
            }
            [first, ..] => {
                if json::parse(&fs::read(first).unwrap_or_default())
                    .is_ok_and(|file| json::is_take(&file))
                {
                    let what = "its folder holds several takes; leave one of them in it".into();
                    return Err(ImportError::NotDetections { path: first.clone(), what });
                }
                add(path, SourceContent::Files(files));
            }
        }
    }
    if found.is_empty() {
        // The folder of a trial.
        let inner = root.join("pose");
        if inner.is_dir() {
            return sources(&inner);
        }
        return Err(ImportError::NoCameraFolders { path: root.to_owned() });
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
            match (all.iter().find(is_2d), &all[..]) {
                (Some(path), _) => path.clone(),
                (None, [only]) if ending(only) == "csv" => only.clone(),
                _ => return Ok(None),
            }
        }
    };
    let bytes = fs::read(&path).map_err(|error| ImportError::read(&path, error))?;
    let fault = |what| ImportError::NotDetections { path: path.clone(), what };
    let source = |name: String, has_name, (frames, report)| Source {
        path: path.with_file_name(name),
        has_name,
        content: SourceContent::Part(frames, report),
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
    for path in paths {
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
fn ending(path: &Path) -> String {
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
