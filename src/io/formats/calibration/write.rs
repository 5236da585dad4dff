//! Writes a rig as a calibration file.

use std::fmt::Write;
use std::path::Path;

use super::Up;
use crate::core::camera::{Camera, Lens, Rig};
use crate::core::so3;
use crate::io::formats::ExportError;
use crate::io::new_file;

/// Writes TOML in metres, as Pose2Sim and aniposelib do; its `[metadata]` says the unit and the up axis.
///
/// # Errors
/// The file cannot be written, or the format cannot have the name of a camera.
pub fn write_calibration(path: &Path, rig: &Rig, up: Up) -> Result<(), ExportError> {
    let tables = rig.cameras.iter().map(|camera| table(camera, up));
    check_names(path, rig, |name| name != "metadata")?;
    let metadata = format!("[metadata]\nup = \"{up}\"\nunit = \"m\"\n");
    let text: String = tables.chain([metadata]).collect();
    new_file::write(path, text.as_bytes()).map_err(ExportError::write(path))
}

/// Writes OpenCV's YAML in metres: `names`, and for each camera `K_`, `dist_` (`D_` of a fisheye), `R_`
/// (rotation vector), `Rot_`, `T_`, `W_` and `H_`. EasyMocap reads a copy of it as `intri.yml` and as
/// `extri.yml`.
///
/// # Errors
/// The file cannot be written, or the format cannot have the name of a camera.
pub fn write_opencv(path: &Path, rig: &Rig, up: Up) -> Result<(), ExportError> {
    check_names(path, rig, |name| !name.contains(['#', ':']))?;
    let mut text = String::from("%YAML:1.0\n---\nnames:\n");
    // Writing to a string does not fail.
    for camera in &rig.cameras {
        let _ = writeln!(text, "   - {:?}", camera.name);
    }
    let mut matrix = |field: &str, name: &str, rows: usize, numbers: &[f64]| {
        let columns = numbers.len() / rows;
        let _ = writeln!(
            text,
            "{field}_{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {numbers:?}"
        );
    };
    for camera in &rig.cameras {
        let name = &camera.name;
        let rotation = camera.rotation * up.calibration_from_world().transpose();
        matrix("K", name, 3, camera.matrix().transpose().as_slice());
        let field = if matches!(camera.lens(), Lens::Fisheye(_)) { "D" } else { "dist" };
        matrix(field, name, 1, coefficients(camera));
        matrix("R", name, 3, so3::log(&rotation).as_slice());
        matrix("Rot", name, 3, rotation.transpose().as_slice());
        matrix("T", name, 3, camera.translation.as_slice());
    }
    for camera in &rig.cameras {
        let (name, fisheye) = (&camera.name, matches!(camera.lens(), Lens::Fisheye(_)));
        let _ = writeln!(text, "W_{name}: {}\nH_{name}: {}", camera.width, camera.height);
        if fisheye {
            let _ = writeln!(text, "model_{name}: fisheye");
        }
    }
    new_file::write(path, text.as_bytes()).map_err(ExportError::write(path))
}

/// Checks that the format can have the names of all cameras.
fn check_names(path: &Path, rig: &Rig, is_valid: fn(&str) -> bool) -> Result<(), ExportError> {
    match rig.cameras.iter().find(|camera| !is_valid(&camera.name)) {
        Some(Camera { name, .. }) => {
            Err(ExportError::Name { path: path.into(), name: name.clone() })
        }
        None => Ok(()),
    }
}

/// The distortion; 4 or 5 coefficients unless the lens model is rational.
fn coefficients(camera: &Camera) -> &[f64] {
    let all = camera.lens().coefficients();
    let is_rational = all.iter().skip(5).any(|k| *k != 0.0);
    if is_rational { all } else { &all[..all.len().min(5)] }
}

/// A camera's table. Numbers have all digits.
fn table(camera: &Camera, up: Up) -> String {
    let name = toml::Value::from(camera.name.as_str());
    let matrix = camera.matrix();
    let rows = [0, 1, 2].map(|row| [0, 1, 2].map(|column| matrix[(row, column)]));
    let rotation = so3::log(&(camera.rotation * up.calibration_from_world().transpose()));
    let mut text = format!("[{name}]\nname = {name}\n");
    let mut line = |key: &str, value: String| {
        // Writing to a string does not fail.
        let _ = writeln!(text, "{key} = {value}");
    };
    line("size", format!("[{:?}, {:?}]", f64::from(camera.width), f64::from(camera.height)));
    line("matrix", format!("{rows:?}"));
    line("distortions", format!("{:?}", coefficients(camera)));
    line("rotation", format!("{:?}", rotation.as_slice()));
    line("translation", format!("{:?}", camera.translation.as_slice()));
    line("fisheye", matches!(camera.lens(), Lens::Fisheye(_)).to_string());
    if camera.time_offset.ns() != 0 {
        line("time_offset_ms", format!("{:?}", camera.time_offset.ms()));
    }
    text + "\n"
}
