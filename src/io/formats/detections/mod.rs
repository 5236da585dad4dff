//! Reads the detections of other programs as one stream.

use std::fs;
use std::path::{Path, PathBuf};

mod folders;
mod h5;
mod json;
mod order;
mod sources;
mod table;

use nalgebra::Point2;

use super::ImportError;
use crate::core::camera::Rig;
use crate::core::detections::{Detection, Detections, Person};
use crate::core::time::Timestamp;
use crate::io::file_name;
use folders::match_folders;
pub(super) use folders::natural_key;
pub use folders::{FolderMatch, MatchedBy};
pub use order::PointOrder;
use sources::{Source, TRIAL, ending, not_understood, sources};

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
    /// Points skipped because a number was null, NaN, infinite or above 1e38.
    pub non_finite_points: u64,
    /// Confidences above 1, which are used as 1.
    pub confidences_above_1: u64,
    /// Whether there are points of hands or faces, which are not used.
    pub left_out: bool,
    /// Whether points are in shares of the image.
    pub shares: bool,
}

impl CameraReport {
    /// A point. Detectors write unseen points as 0, 0 or with a confidence that is not positive.
    fn detection(&mut self, x: f64, y: f64, confidence: f64) -> Option<Detection> {
        // Messages have single precision.
        if ![x, y, confidence].iter().all(|number| (*number as f32).is_finite()) {
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
    /// Refuse broken files, cameras without detections, and detections without a calibrated camera.
    pub strict: bool,
}

/// A folder with the detections of each camera: a subfolder with a file for each frame, or one file.
///
/// An iterator of [`Detections`] in order of capture time, then of camera index. Frame numbers are
/// the last digits of the file names that differ, or are in the files; the capture time is the frame number divided by the
/// frame rate. Files of frames are read when they are needed. After an error the iterator ends.
pub struct DetectionFolder {
    order: PointOrder,
    others: Vec<PointOrder>,
    strict: bool,
    cameras: Vec<CameraFrames>,
    matches: Vec<FolderMatch>,
    reports: Vec<CameraReport>,
    /// The number of the frame at time 0.
    origin: u64,
    notes: Vec<String>,
    failed: bool,
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
        let unsynchronised = folder.join(TRIAL[1]);
        if unsynchronised.is_dir()
            && let Some(first) = matches.first()
            && first.folder.starts_with(folder.join(TRIAL[0]))
        {
            notes.push(format!("{} is used, not {}", TRIAL[0], TRIAL[1]));
        }
        let is_left = |source: &&Source| matches.iter().all(|one| one.folder != source.path);
        let left = sources.iter().filter(is_left).map(|source| file_name(&source.path));
        let left = left.collect::<Vec<_>>().join(", ");
        if !left.is_empty() {
            let names = rig.cameras.iter().map(|camera| &*camera.name).collect::<Vec<_>>();
            if options.strict {
                return Err(ImportError::CameraWithoutCalibration {
                    path: folder.to_owned(),
                    folders: left,
                    cameras: names.join(", "),
                });
            }
            notes.push(format!("there is no calibration for {left}: not used"));
        }
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
            let not_understood = not_understood(folder);
            notes.push(format!(
                "there are no detections of camera {unseen}; the others are used{not_understood}"
            ));
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
        // Cameras of several rates would be shifted.
        let is_from_one =
            first == Some(1) && cameras.iter().any(|camera| camera.fps != cameras[0].fps);
        match first {
            Some(1) if is_from_one => {
                notes.push("frame numbers begin at 1: frame 1 is time 0 of all cameras".into());
            }
            Some(first) if first > 0 => {
                notes.push(format!("the first frame is {first}; outputs count from this frame"));
            }
            _ => {}
        }
        let (order, others) = match (&options.mapping, options.order) {
            (Some(path), _) => (PointOrder::of_file(path, names.as_deref())?, Vec::new()),
            (None, Some(order)) => (order, Vec::new()),
            (None, None) => found_order(folder, &cameras, names.as_deref(), &mut notes)?,
        };
        let strict = options.strict;
        let (origin, failed) = (u64::from(is_from_one), false);
        Ok(Self { order, others, strict, cameras, matches, reports, origin, notes, failed })
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
                Some((Timestamp::of_frame(frame - self.origin, camera.fps), at, frame))
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

/// The files of frames that were searched for people.
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
