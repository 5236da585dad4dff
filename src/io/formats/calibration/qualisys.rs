//! Reads `.qca.txt` of Qualisys, which is XML.
//!
//! Per camera: `transform` holds the camera's position (mm) and a matrix whose rows are the
//! camera's axes in the world, with y up and z backwards (opposite to OpenCV's y and z).
//! `intrinsic` holds lengths in pixels times 64, the centre relative to the sensor's corner, and
//! distortion coefficients without unit.
//!
//! Difference to Pose2Sim: it also divides the distortion coefficients by 64, so its TOML files
//! have almost no distortion. Here they are used unchanged. The detections of Pose2Sim's demo set
//! do not decide: robust triangulation of 12 limb joints leaves (median, mean) 13.93, 14.87 px
//! either way in its balancing take; 9.04, 9.62 px unchanged and 8.91, 9.64 px divided in the
//! static one.

use nalgebra::{Matrix3, Vector3};
use roxmltree::{Document, Node};

use super::xml::Fields;
use super::{Calibrated, Fault, size_px};
use crate::core::camera::Lens;
use crate::core::time::Nanos;

/// Units of `intrinsic` per pixel.
const SUBPIXELS: f64 = 64.0;

/// Reads the active video cameras, in the file's order.
///
/// Files of mixed systems also list marker cameras; a video camera has a model that contains
/// "video", the model "none", or no model.
pub(super) fn cameras(document: &Document) -> Result<Vec<Calibrated>, Fault> {
    let nodes = document.descendants().filter(|n| n.has_tag_name("camera"));
    let active: Vec<Node> = nodes.filter(|n| n.attribute("active") != Some("0")).collect();
    let is_video = |n: &&Node| {
        let model = n.attribute("model").unwrap_or("none").to_lowercase();
        model == "none" || model.contains("video")
    };
    if active.is_empty() {
        return Err(Fault::Text("XML without an active <camera>".into()));
    }
    active.iter().filter(is_video).map(camera).collect()
}

fn camera(node: &Node) -> Result<Calibrated, Fault> {
    let name = node
        .attribute("serial")
        .ok_or_else(|| Fault::Text("a <camera> has no serial".into()))?
        .to_owned();
    let fields = |tag: &'static str| Fields::of(node, &name, tag);
    if let Some(turn) = node.attribute("viewrotation").filter(|v| *v != "0") {
        let what = format!("camera {name}: viewrotation {turn} cannot be used, only 0");
        return Err(Fault::Text(what));
    }
    let view = fields("fov_video")?;
    let (left, top) = (view.number("left")?, view.number("top")?);
    let size = [view.number("right")? - left + 1.0, view.number("bottom")? - top + 1.0];
    let (rotation, translation) = extrinsics(&fields("transform")?)?;
    let (mut matrix, lens) = intrinsics(&fields("intrinsic")?, left, top)?;
    // The file may have pixels of 1080p, whatever the resolution of the videos is, such as 720p.
    let lines = node.attribute("video_resolution").and_then(|text| text.strip_suffix('p'));
    let lines = lines.and_then(|lines| lines.parse::<f64>().ok());
    let scale = lines.filter(|lines| size[1] > 1.1 * lines).map_or(1.0, |lines| lines / 1080.0);
    matrix.fixed_rows_mut::<2>(0).scale_mut(scale);
    let size = size.map(|px| (px * scale).round());
    let (size, time_offset) = (Some(size_px(&name, size)?), Nanos::ZERO);
    Ok(Calibrated { size, name, matrix, lens, rotation, translation, time_offset })
}

/// camera_from_calibration, millimetres.
fn extrinsics(transform: &Fields) -> Result<(Matrix3<f64>, Vector3<f64>), Fault> {
    let mut rotation = Matrix3::zeros();
    for row in 0..3 {
        // OpenCV's y points down and its z into the scene.
        let sign = if row == 0 { 1.0 } else { -1.0 };
        for column in 0..3 {
            let entry = transform.number(&format!("r{}{}", row + 1, column + 1))?;
            rotation[(row, column)] = sign * entry;
        }
    }
    let centre =
        Vector3::new(transform.number("x")?, transform.number("y")?, transform.number("z")?);
    Ok((rotation, -rotation * centre))
}

fn intrinsics(intrinsic: &Fields, left: f64, top: f64) -> Result<(Matrix3<f64>, Lens), Fault> {
    let pixels = |field: &str| Ok::<_, Fault>(intrinsic.number(field)? / SUBPIXELS);
    let matrix = Matrix3::new(
        pixels("focalLengthU")?,
        pixels("skew")?,
        pixels("centerPointU")? - left,
        0.0,
        pixels("focalLengthV")?,
        pixels("centerPointV")? - top,
        0.0,
        0.0,
        1.0,
    );
    let [k1, k2, k3] = [1, 2, 3].map(|i| intrinsic.number(&format!("radialDistortion{i}")));
    let [p1, p2] = [1, 2].map(|i| intrinsic.number(&format!("tangentalDistortion{i}")));
    Ok((matrix, Lens::BrownConrady([k1?, k2?, p1?, p2?, k3?, 0.0, 0.0, 0.0])))
}
