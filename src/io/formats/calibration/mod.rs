//! Reads calibration files into a rig in our world.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};
use roxmltree::Document;

mod colmap;
mod convention;
mod optitrack;
mod qualisys;
mod table;
mod tree;
mod vicon;
mod write;
mod xml;

pub use convention::{Auto, Convention, Poses, UP_IS_GUESSED, Unit, Up};
pub use write::{write_calibration, write_opencv};

use super::ImportError;
use super::detections::natural_key;
use crate::core::camera::{Camera, CameraError, Lens, Rig};
use crate::core::time::Nanos;
use crate::io::file_name;
use crate::io::wire::valid_name;
use convention::{Found, settle};
use table::Tables;
use tree::{Content, content};

/// A camera of a calibration file, in the file's world.
pub(super) struct Calibrated {
    pub name: String,
    /// `None`: the file does not say it.
    pub size: Option<[u32; 2]>,
    pub matrix: Matrix3<f64>,
    pub lens: Lens,
    /// camera_from_calibration.
    pub rotation: Matrix3<f64>,
    /// camera_from_calibration, in the file's unit.
    pub translation: Vector3<f64>,
    pub time_offset: Nanos,
}

impl Calibrated {
    /// The image size. If the file has none, the principal point is taken as its middle.
    pub(super) fn size(&self) -> [f64; 2] {
        let twice = [0, 1].map(|axis| (2.0 * self.matrix[(axis, 2)]).round());
        self.size.map_or(twice, |size| size.map(f64::from))
    }
}

/// Why a calibration cannot be used.
pub(super) enum Fault {
    /// A fault of the file.
    Text(String),
    /// A fault of a camera.
    Camera(CameraError),
}

/// A calibration, with what its file did not say.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The cameras in our world: metres, y up. Its version is 1.
    pub rig: Rig,
    /// The kind of file.
    pub format: &'static str,
    /// The axis of the file's world that points up.
    pub up: Up,
    /// Whether neither the file, nor the cameras' images, nor the user says so.
    pub up_is_guessed: bool,
    /// What the file's poses are.
    pub poses: Poses,
    /// The file's unit of length.
    pub unit: Unit,
    /// The cameras without an image size in the file.
    pub without_size: Vec<String>,
    /// What was guessed or left out, and may be wrong.
    pub notes: Vec<String>,
}

impl Calibration {
    /// Number of cameras, kind of file, unit and up axis, in one line.
    pub fn summary(&self) -> String {
        let Self { rig, format, up, unit, .. } = self;
        format!("{} cameras, {format}, unit {unit}, {up} up", rig.cameras.len())
    }
}

/// Reads a calibration: a file, or a folder whose files each hold a part. The kind is found by content.
///
/// | kind | what is read |
/// |---|---|
/// | TOML, JSON, YAML, OpenCV's YAML and XML | cameras with a matrix, distortion, rotation and translation under any of the usual names: Pose2Sim, aniposelib, FreeMoCap, Caliscope, EasyMocap (`intri.yml` and `extri.yml`), Panoptic Studio, Human3.6M, multical, Kalibr |
/// | pickle | OpenCap's `cameraIntrinsicsExtrinsics.pickle`; a folder with one for each camera |
/// | XML | Qualisys `.qca.txt`, Vicon `.xcp`, OptiTrack `.mcal` |
/// | text | COLMAP's `cameras.txt` and `images.txt` |
///
/// What `given` leaves open is taken from the file, then from the format, then found from the cameras: the
/// unit by their distance from where they look, the up axis by their images. Poses that make sense only the
/// other way round (of the cameras in the world) are turned round, with a note. Cameras are in natural
/// order of their names.
///
/// # Errors
/// The file cannot be read or is not a calibration, or its cameras cannot be used.
pub fn read_calibration(path: &Path, given: &Convention) -> Result<Calibration, ImportError> {
    let files = calibration_files(path)?;
    let fault = |path: &Path, fault| match fault {
        Fault::Text(what) => ImportError::NotACalibration { path: path.to_owned(), what },
        Fault::Camera(source) => ImportError::Camera { path: path.to_owned(), source },
    };
    let mut parts = Parts::default();
    for file in &files {
        let bytes = std::fs::read(file).map_err(|error| ImportError::read(file, error))?;
        parts.add(file, &bytes, given).map_err(|what| fault(file, what))?;
    }
    parts.calibration(given).map_err(|what| fault(path, what))
}

/// The files that belong to a calibration: itself, those of a folder, and EasyMocap's and COLMAP's other half.
///
/// # Errors
/// The folder cannot be read.
pub fn calibration_files(path: &Path) -> Result<Vec<PathBuf>, ImportError> {
    files(path).map_err(|error| ImportError::read(path, error))
}

fn files(path: &Path) -> std::io::Result<Vec<PathBuf>> {
    if path.is_dir() {
        let mut all = Vec::new();
        for entry in std::fs::read_dir(path)? {
            let entry = entry?.path();
            match entry.is_dir() {
                true => all.extend(listed(&entry)?),
                false => all.push(entry),
            }
        }
        all.retain(|file| is_part(file));
        all.sort_by_cached_key(|file| natural_key(&file.to_string_lossy()));
        return Ok(all);
    }
    let name = file_name(path);
    let halves = [("intri", "extri"), ("cameras.txt", "images.txt")];
    let other = |(one, other): (&str, &str)| match (name.contains(one), name.contains(other)) {
        (true, _) => Some(path.with_file_name(name.replace(one, other))),
        (_, true) => Some(path.with_file_name(name.replace(other, one))),
        _ => None,
    };
    let other = halves.into_iter().find_map(other).filter(|other| other.is_file());
    Ok([Some(path.to_owned()), other].into_iter().flatten().collect())
}

fn listed(folder: &Path) -> std::io::Result<Vec<PathBuf>> {
    std::fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect()
}

/// Whether a file of a folder can hold a part of a calibration.
fn is_part(file: &Path) -> bool {
    let name = file_name(file).to_lowercase();
    let endings =
        [".toml", ".json", ".yml", ".yaml", ".xml", ".pickle", ".pkl", ".qca.txt", ".xcp", ".mcal"];
    let is_colmap = COLMAP.contains(&&*name) || is_binary_colmap(file);
    file.is_file() && (endings.iter().any(|one| name.ends_with(one)) || is_colmap)
}

/// Whether it is COLMAP's binary form, without the text.
fn is_binary_colmap(file: &Path) -> bool {
    let text = file.with_extension("txt");
    let is_text = COLMAP.iter().any(|one| text.ends_with(one));
    is_text && file.extension().is_some_and(|ending| ending == "bin") && !text.exists()
}

/// COLMAP's files.
const COLMAP: [&str; 2] = ["cameras.txt", "images.txt"];

/// What the files of a calibration hold.
#[derive(Default)]
struct Parts {
    tables: Tables,
    /// Cameras of formats that hold them whole, and the unit of those formats.
    whole: Option<(Vec<Calibrated>, Unit)>,
    colmap: [Option<String>; 2],
    format: Option<&'static str>,
    /// What the file itself says in `[metadata]`, as ours do.
    up: Auto<Up>,
    unit: Auto<Unit>,
}

impl Parts {
    fn add(&mut self, file: &Path, bytes: &[u8], given: &Convention) -> Result<(), Fault> {
        let name = file_name(file).to_lowercase();
        if let Some(i) = COLMAP.iter().position(|one| *one == name) {
            self.format = Some("COLMAP");
            self.colmap[i] = Some(String::from_utf8_lossy(bytes).into_owned());
            return Ok(());
        }
        if is_binary_colmap(file) {
            let what = "COLMAP's binary form is not read; convert it with its model_converter, output \
                        type TXT";
            return Err(Fault::Text(what.into()));
        }
        let xml = match content(bytes, &name)? {
            Content::Tree(tree, format) => {
                self.format = self.format.or(Some(format));
                let said = |key| tree.get("metadata")?.get(key)?.as_str();
                self.up = said("up").and_then(|up| up.parse().ok()).unwrap_or(self.up);
                self.unit = said("unit").and_then(|unit| unit.parse().ok()).unwrap_or(self.unit);
                return self.tables.add(&tree, &own_name(file), given.set.as_deref());
            }
            Content::Xml(text) => text,
        };
        let document = Document::parse(&xml).map_err(|e| Fault::Text(format!("not XML: {e}")))?;
        let has = |tag| document.descendants().any(|node| node.has_tag_name(tag));
        let (format, cameras, unit) = if has("KeyFrame") {
            ("Vicon", vicon::cameras(&document, &mut self.tables.notes)?, Unit::MM)
        } else if has("Extrinsic") {
            ("OptiTrack", optitrack::cameras(&document)?, Unit::M)
        } else {
            ("Qualisys", qualisys::cameras(&document)?, Unit::MM)
        };
        if self.whole.is_some() {
            let what = "the folder holds two calibrations; give one of the files";
            return Err(Fault::Text(what.into()));
        }
        (self.format, self.whole) = (Some(format), Some((cameras, unit)));
        Ok(())
    }

    fn calibration(self, given: &Convention) -> Result<Calibration, Fault> {
        let (mut cameras, prescribed, mut notes) = match (self.whole, self.colmap) {
            (Some((cameras, unit)), _) => (cameras, Some(unit), self.tables.notes),
            (None, [Some(cameras), Some(images)]) => {
                let note = "COLMAP's lengths have no unit; scale them with --unit, by the performer's height that \
                            `bundlemocap check` prints";
                (colmap::cameras(&cameras, &images)?, Some(Unit::M), vec![note.to_owned()])
            }
            (None, [None, None]) => {
                if let Some(set) = given.set.as_ref().filter(|_| !self.tables.has_set) {
                    return Err(Fault::Text(format!("nothing in it is named {set} (--set)")));
                }
                let (cameras, notes) = self.tables.cameras()?;
                (cameras, None, notes)
            }
            (None, [_, _]) => {
                let what =
                    "cameras.txt and images.txt of COLMAP belong together, and one is missing";
                return Err(Fault::Text(what.into()));
            }
        };
        let (up, unit) = (self.up.0, self.unit.0);
        let of_both = match given.file_first {
            true => (up.or(given.up.0), unit.or(given.unit.0)),
            false => (given.up.0.or(up), given.unit.0.or(unit)),
        };
        let given = Convention { up: Auto(of_both.0), unit: Auto(of_both.1), ..given.clone() };
        let found = settle(&mut cameras, prescribed, &given);
        let Found { up, up_is_guessed, poses, unit, notes: more } = found;
        notes.extend(more);
        let without_size = cameras.iter().filter(|camera| camera.size.is_none());
        let without_size: Vec<String> = without_size.map(|camera| camera.name.clone()).collect();
        for camera in &cameras {
            let name = &camera.name;
            if camera.size.is_none() {
                let size = size_px(name, camera.size()).map_err(|_| {
                    let what = "the file has no image size; add width and height";
                    Fault::Text(format!("camera {name}: {what}"))
                })?;
                notes.push(format!(
                    "camera {name}: the file has no image size; images of about {} x {}, twice the \
                     principal point, are taken",
                    size[0], size[1]
                ));
            }
            notes.extend(odd_size(camera));
            if valid_name(name).is_err() {
                notes.push(format!("camera {name} cannot be live: topics have no such names"));
            }
        }
        let camera = |c: Calibrated| {
            let rotation = c.rotation * up.calibration_from_world();
            let mut camera = Camera::new(
                c.name.clone(),
                c.size().map(|px| px as u32),
                &c.matrix,
                c.lens,
                rotation,
                c.translation,
            )?;
            camera.time_offset = c.time_offset;
            Ok(camera)
        };
        let cameras = cameras.into_iter().map(camera).collect::<Result<_, _>>();
        let rig = cameras.and_then(|cameras| Rig::new(1, cameras)).map_err(Fault::Camera)?;
        let format = self.format.unwrap_or("TOML");
        Ok(Calibration { rig, format, up, up_is_guessed, poses, unit, without_size, notes })
    }
}

/// The camera's name where a file is one camera's: the file's, or the folder's if the file's says nothing.
fn own_name(file: &Path) -> String {
    let stem = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut name = stem(file);
    for word in ["extrinsics", "intrinsics", "calibration", "calib", "camera"] {
        let length = name.to_ascii_lowercase().strip_suffix(word).map_or(name.len(), str::len);
        name.truncate(length);
        name.truncate(name.trim_end_matches(['_', '-', '.']).len());
    }
    if name.is_empty() { file.parent().map(stem).unwrap_or_default() } else { name }
}

/// A note if the principal point shows that the image size is wrong.
fn odd_size(camera: &Calibrated) -> Option<String> {
    const NEAR: f64 = 0.04;
    let [width, height] = camera.size?.map(f64::from);
    let centre = [camera.matrix[(0, 2)], camera.matrix[(1, 2)]];
    let is_middle_of =
        |size: [f64; 2]| (0..2).all(|axis| (centre[axis] / size[axis] - 0.5).abs() < NEAR);
    let (name, [x, y]) = (&camera.name, centre);
    if width != height && is_middle_of([height, width]) && !is_middle_of([width, height]) {
        return Some(format!(
            "camera {name}: the image size is {width} x {height}, but the principal point is in the middle of {height} x \
             {width}: are width and height exchanged?"
        ));
    }
    let is_inside = (0.0..width).contains(&x) && (0.0..height).contains(&y);
    (!is_inside).then(|| {
        format!(
            "camera {name}: the principal point ({x:.0}, {y:.0}) is outside of the image of {width} x {height}: is this the \
             size of the images that were calibrated?"
        )
    })
}

/// Width and height as integers; files store them as reals.
pub(super) fn size_px(camera: &str, size: [f64; 2]) -> Result<[u32; 2], Fault> {
    let whole = |v: f64| v.fract() == 0.0 && (1.0..=1e6).contains(&v);
    if size.into_iter().all(whole) {
        return Ok(size.map(|v| v as u32));
    }
    Err(Fault::Text(format!("camera {camera}: image size {} x {} is not valid", size[0], size[1])))
}
