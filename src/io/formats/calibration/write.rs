//! Writes a rig as a calibration file.

use std::fmt::Write;
use std::path::Path;

use super::Up;
use crate::core::camera::{Camera, Lens, Rig};
use crate::core::so3;
use crate::io::formats::ExportError;
use crate::io::new_file;

/// Writes the TOML that [`read_calibration`](super::read_calibration) reads with the same `up`.
///
/// # Errors
/// The file cannot be written.
pub fn write_calibration(path: &Path, rig: &Rig, up: Up) -> Result<(), ExportError> {
    let text: String = rig.cameras.iter().map(|camera| table(camera, up)).collect();
    new_file::write(path, text.as_bytes()).map_err(ExportError::write(path))
}

/// A camera's table. Numbers have all digits.
fn table(camera: &Camera, up: Up) -> String {
    let name = toml::Value::from(camera.name.as_str());
    let matrix = camera.matrix();
    let rows = [0, 1, 2].map(|row| [0, 1, 2].map(|column| matrix[(row, column)]));
    let rotation = so3::log(&(camera.rotation * up.calibration_from_world().transpose()));
    let all = camera.lens().coefficients();
    // Files of other tools hold 4 or 5 coefficients unless the lens model is rational.
    let is_rational = all.iter().skip(5).any(|k| *k != 0.0);
    let coefficients = if is_rational { all } else { &all[..all.len().min(5)] };
    let mut text = format!("[{name}]\nname = {name}\n");
    let mut line = |key: &str, value: String| {
        // Writing to a string does not fail.
        let _ = writeln!(text, "{key} = {value}");
    };
    line("size", format!("[{:?}, {:?}]", f64::from(camera.width), f64::from(camera.height)));
    line("matrix", format!("{rows:?}"));
    line("distortions", format!("{coefficients:?}"));
    line("rotation", format!("{:?}", rotation.as_slice()));
    line("translation", format!("{:?}", camera.translation.as_slice()));
    line("fisheye", matches!(camera.lens(), Lens::Fisheye(_)).to_string());
    if camera.time_offset.ns() != 0 {
        line("time_offset_ms", format!("{:?}", camera.time_offset.ms()));
    }
    text + "\n"
}
