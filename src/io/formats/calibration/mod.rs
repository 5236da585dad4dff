//! Reads calibration files into a rig in our world.

use std::path::Path;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

mod qualisys;
mod write;

pub use write::write_calibration;

use super::ImportError;
use super::openpose::natural_key;
use crate::core::camera::{Camera, CameraError, Lens, Rig};
use crate::core::so3;
use crate::core::time::Nanos;

/// The axis of the calibration's world that points up. In our world it is y.
///
/// A z-up world is converted by x = y', y = z', z = x' (a cyclic permutation, which keeps the
/// ground plane and the handedness). These are the axes that Pose2Sim writes to TRC files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Up {
    /// Same axes as our world.
    Y,
    /// z up, as in Qualisys and Pose2Sim.
    #[default]
    Z,
}

impl Up {
    /// Parses `y` or `z`.
    pub fn from_name(name: &str) -> Option<Self> {
        match name {
            "y" => Some(Self::Y),
            "z" => Some(Self::Z),
            _ => None,
        }
    }

    /// The rotation from our coordinates to the calibration's.
    pub fn calibration_from_world(self) -> Matrix3<f64> {
        match self {
            Self::Y => Matrix3::identity(),
            Self::Z => Matrix3::new(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
        }
    }
}

/// A camera of a calibration file, in the file's world.
pub(super) struct Calibrated {
    pub name: String,
    pub size: [u32; 2],
    pub matrix: Matrix3<f64>,
    pub lens: Lens,
    /// camera_from_calibration.
    pub rotation: Matrix3<f64>,
    /// camera_from_calibration, metres.
    pub translation: Vector3<f64>,
    pub time_offset: Nanos,
}

/// Why a calibration cannot be used.
pub(super) enum Fault {
    /// A fault of the file.
    Text(String),
    /// A fault of a camera.
    Camera(CameraError),
}

/// Reads a calibration: XML as Qualisys', any other text as TOML of Pose2Sim or aniposelib (lengths
/// in metres). The rig has version 1. Its cameras are in natural order of their names for TOML, and
/// in the file's order for Qualisys.
///
/// # Errors
/// The file cannot be read or is not a calibration, or its cameras cannot be used.
pub fn read_calibration(path: &Path, up: Up) -> Result<Rig, ImportError> {
    let text = std::fs::read_to_string(path).map_err(|e| ImportError::read(path, e))?;
    rig_from_text(&text, up).map_err(|fault| match fault {
        Fault::Text(what) => ImportError::NotACalibration { path: path.to_owned(), what },
        Fault::Camera(source) => ImportError::Camera { path: path.to_owned(), source },
    })
}

fn rig_from_text(text: &str, up: Up) -> Result<Rig, Fault> {
    let text = text.trim_start_matches('\u{feff}');
    let calibrated = if text.trim_start().starts_with('<') {
        qualisys::cameras(text)?
    } else {
        toml_cameras(text)?
    };
    let camera = |c: Calibrated| {
        let rotation = c.rotation * up.calibration_from_world();
        let mut camera = Camera::new(c.name, c.size, &c.matrix, c.lens, rotation, c.translation)?;
        camera.time_offset = c.time_offset;
        Ok(camera)
    };
    let cameras = calibrated.into_iter().map(camera).collect::<Result<_, _>>();
    cameras.and_then(|cameras| Rig::new(1, cameras)).map_err(Fault::Camera)
}

/// A camera table of a Pose2Sim or aniposelib file.
#[derive(Deserialize)]
#[serde(rename = "camera")]
struct CameraTable {
    name: Option<String>,
    size: [f64; 2],
    matrix: [[f64; 3]; 3],
    distortions: Vec<f64>,
    /// Rotation vector, camera_from_calibration.
    rotation: [f64; 3],
    /// Metres.
    translation: [f64; 3],
    #[serde(default)]
    fisheye: bool,
    /// Added to capture times, milliseconds.
    #[serde(default)]
    time_offset_ms: f64,
}

/// Reads every table except `metadata` as a camera.
fn toml_cameras(text: &str) -> Result<Vec<Calibrated>, Fault> {
    let tables: toml::Table =
        text.parse().map_err(|e: toml::de::Error| Fault::Text(toml_fault(text, &e)))?;
    let is_camera = |(key, value): &(String, toml::Value)| key != "metadata" && value.is_table();
    let mut tables: Vec<_> = tables.into_iter().filter(is_camera).collect();
    if tables.is_empty() {
        return Err(Fault::Text("no table describes a camera".into()));
    }
    tables.sort_by_cached_key(|(key, _)| natural_key(key));
    tables.into_iter().map(|(key, value)| toml_camera(key, value)).collect()
}

fn toml_camera(key: String, value: toml::Value) -> Result<Calibrated, Fault> {
    let table: CameraTable = value.try_into().map_err(|e: toml::de::Error| {
        Fault::Text(format!("camera table {key}: {}", e.message()))
    })?;
    let lens = if table.fisheye {
        Lens::fisheye(&table.distortions)
    } else {
        Lens::brown_conrady(&table.distortions)
    };
    let name = table.name.unwrap_or(key);
    Ok(Calibrated {
        size: size_px(&name, table.size)?,
        matrix: Matrix3::from_row_iterator(table.matrix.into_iter().flatten()),
        lens: lens.map_err(|e| Fault::Text(format!("camera {name}: {e}")))?,
        rotation: so3::exp(&Vector3::from(table.rotation)),
        translation: Vector3::from(table.translation),
        time_offset: Nanos::rounded(table.time_offset_ms * 1e6),
        name,
    })
}

/// The error message on one line, with the line number of the fault.
fn toml_fault(text: &str, error: &toml::de::Error) -> String {
    let message = error.message().lines().collect::<Vec<_>>().join(", ");
    let line = error.span().map(|span| text[..span.start.min(text.len())].lines().count().max(1));
    match line {
        Some(line) => format!("line {line} is not TOML: {message}"),
        None => format!("not TOML: {message}"),
    }
}

/// Width and height as integers; files store them as reals.
pub(super) fn size_px(camera: &str, size: [f64; 2]) -> Result<[u32; 2], Fault> {
    let whole = |v: f64| v.fract() == 0.0 && (1.0..=1e6).contains(&v);
    if size.into_iter().all(whole) {
        return Ok(size.map(|v| v as u32));
    }
    Err(Fault::Text(format!("camera {camera}: image size {} x {} is not valid", size[0], size[1])))
}
