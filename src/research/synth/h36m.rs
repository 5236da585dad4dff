//! Reads the four cameras of Human3.6M from an external JSON file.
//!
//! Its keys: `intrinsics` (by camera: `calibration_matrix`, `distortion` as k1, k2, p1, p2, k3),
//! `extrinsics_S9_S11` (by subject and camera: `R`, `t`, camera_from_world, millimetres, z up) and
//! `res` (by camera: width and height).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;

use crate::core::camera::{Camera, CameraError, Lens, Rig};
use crate::core::so3;

/// Why the cameras cannot be read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum H36mError {
    #[error("{}: cannot be read ({source}); give the Human3.6M cameras as JSON", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error(
        "{}: {source}; it needs the keys intrinsics, extrinsics_S9_S11 and res", path.display()
    )]
    Malformed { path: PathBuf, source: serde_json::Error },
    #[error("{}: no cameras for subject {subject}; the file has {known}", path.display())]
    Subject { path: PathBuf, subject: String, known: String },
    #[error("{}: camera {camera} has no {field}; add it", path.display())]
    Missing { path: PathBuf, camera: String, field: &'static str },
    #[error("{}: {source}", path.display())]
    Camera { path: PathBuf, source: CameraError },
    #[error(
        "{}: all optical axes are parallel; cameras around a capture area are needed",
        path.display()
    )]
    NoMiddle { path: PathBuf },
}

#[derive(Deserialize)]
struct File {
    intrinsics: BTreeMap<String, Intrinsics>,
    #[serde(rename = "extrinsics_S9_S11")]
    extrinsics: BTreeMap<String, BTreeMap<String, Extrinsics>>,
    res: BTreeMap<String, [u32; 2]>,
}

#[derive(Deserialize)]
struct Intrinsics {
    calibration_matrix: [[f64; 3]; 3],
    distortion: Vec<f64>,
}

#[derive(Deserialize)]
struct Extrinsics {
    #[serde(rename = "R")]
    rotation: [[f64; 3]; 3],
    #[serde(rename = "t")]
    translation: [[f64; 1]; 3],
}

/// The cameras of a subject (`S9` or `S11`), metres, y up. The origin is the middle of the capture
/// area: the floor below the point nearest to all optical axes.
///
/// # Errors
/// The file cannot be read or used, or it does not have the subject.
pub fn h36m_rig(path: &Path, subject: &str) -> Result<Rig, H36mError> {
    let here = || path.to_path_buf();
    let text =
        std::fs::read_to_string(path).map_err(|source| H36mError::Read { path: here(), source })?;
    let file: File = serde_json::from_str(&text)
        .map_err(|source| H36mError::Malformed { path: here(), source })?;
    let poses = file.extrinsics.get(subject).ok_or_else(|| H36mError::Subject {
        path: here(),
        subject: subject.to_owned(),
        known: file.extrinsics.keys().cloned().collect::<Vec<_>>().join(", "),
    })?;
    let cameras = (poses.iter().map(|(name, pose)| camera(&file, name, pose)))
        .collect::<Result<Vec<_>, Fault>>()
        .map_err(|fault| fault.in_file(path))?;
    let middle = middle(&cameras).ok_or_else(|| H36mError::NoMiddle { path: here() })?;
    let shifted = cameras.into_iter().map(|camera| shifted(camera, &middle)).collect();
    Rig::new(1, shifted).map_err(|source| H36mError::Camera { path: here(), source })
}

enum Fault {
    Missing(String, &'static str),
    Camera(CameraError),
}

impl Fault {
    fn in_file(self, path: &Path) -> H36mError {
        let path = path.to_path_buf();
        match self {
            Self::Missing(camera, field) => H36mError::Missing { path, camera, field },
            Self::Camera(source) => H36mError::Camera { path, source },
        }
    }
}

fn camera(file: &File, name: &str, pose: &Extrinsics) -> Result<Camera, Fault> {
    let missing = |field| Fault::Missing(name.to_owned(), field);
    let lens = file.intrinsics.get(name).ok_or_else(|| missing("intrinsics"))?;
    let size = *file.res.get(name).ok_or_else(|| missing("res"))?;
    let of_rows = |rows: &[[f64; 3]; 3]| Matrix3::from_fn(|i, j| rows[i][j]);
    let translation = Vector3::from(pose.translation.map(|[t]| 1e-3 * t));
    Camera::new(
        name,
        size,
        &of_rows(&lens.calibration_matrix),
        Lens::brown_conrady(&lens.distortion).map_err(Fault::Camera)?,
        of_rows(&pose.rotation) * so3::Z_UP,
        translation,
    )
    .map_err(Fault::Camera)
}

/// The floor below the point x with the least sum of squared distances to the optical axes:
/// (sum of P) x = sum of P c with P = I - a a^T, for axes with direction a through c. `None` if all
/// axes are parallel.
fn middle(cameras: &[Camera]) -> Option<Vector3<f64>> {
    let (mut sum, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for camera in cameras {
        let axis = camera.rotation.row(2).transpose();
        let across = Matrix3::identity() - axis * axis.transpose();
        sum += across;
        right += across * camera.centre_in_world();
    }
    let nearest = sum.try_inverse()? * right;
    Some(Vector3::new(nearest.x, 0.0, nearest.z))
}

/// The same camera in a world with its origin at `origin`.
fn shifted(mut camera: Camera, origin: &Vector3<f64>) -> Camera {
    camera.translation += camera.rotation * origin;
    camera
}
