//! Reads `.xcp` of Vicon, which is XML.
//!
//! Per camera, the first `KeyFrame` holds the position (mm), the rotation from the world to the camera
//! as a quaternion x y z w, the focal length and the principal point in pixels, and the radial
//! distortion: a point at distance r (pixels) from the principal point is seen without distortion at
//! r (1 + k1 r^2 + k2 r^4 + k3 r^6). Our model goes the other way, so its coefficients are fitted to that.

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};
use roxmltree::{Document, Node};

use super::xml::Fields;
use super::{Calibrated, Fault, size_px};
use crate::core::camera::Lens;
use crate::core::so3;
use crate::core::time::Nanos;

/// Radii at which the distortion is fitted.
const RADII: usize = 100;
/// A lens that is matched worse is noted, pixels.
const MAX_OFF_PX: f64 = 0.1;

/// Reads the video cameras; all calibrated cameras if none is one.
///
/// Where a lens cannot be matched to a tenth of a pixel, a note says so.
pub(super) fn cameras(
    document: &Document,
    notes: &mut Vec<String>,
) -> Result<Vec<Calibrated>, Fault> {
    let nodes = document.descendants().filter(|node| node.has_tag_name("Camera"));
    let calibrated = nodes.filter(|node| node.descendants().any(|n| n.has_tag_name("KeyFrame")));
    let (video, markers): (Vec<Node>, Vec<Node>) = calibrated.partition(is_video);
    (if video.is_empty() { markers } else { video })
        .iter()
        .map(|node| camera(node, notes))
        .collect()
}

fn is_video(node: &Node) -> bool {
    let kind = node.attribute("DISPLAY_TYPE").or_else(|| node.attribute("TYPE"));
    let kind = kind.unwrap_or_default().to_lowercase();
    node.attribute("SYSTEM") == Some("DV") || kind.contains("video") || kind.contains("vue")
}

fn camera(node: &Node, notes: &mut Vec<String>) -> Result<Calibrated, Fault> {
    let name = node.attribute("DEVICEID").or_else(|| node.attribute("USERID"));
    let name = name.ok_or_else(|| Fault::Text("a <Camera> has no DEVICEID".into()))?;
    let (own, frame) = (Fields::own(node, name), Fields::of(node, name, "KeyFrame")?);
    let size = own.numbers("SENSOR_SIZE")?;
    let focal = frame.number("FOCAL_LENGTH")?;
    let aspect =
        own.text("PIXEL_ASPECT_RATIO").map_or(Ok(1.0), |_| own.number("PIXEL_ASPECT_RATIO"))?;
    let [cx, cy] = frame.numbers("PRINCIPAL_POINT")?;
    let is_positive = |value: f64| value > 0.0 && value.is_finite();
    if !(is_positive(focal) && is_positive(aspect) && cx.is_finite() && cy.is_finite()) {
        return Err(
            frame.fault("FOCAL_LENGTH", "or PRINCIPAL_POINT is not usable; is it calibrated?")
        );
    }
    let matrix = Matrix3::new(focal, 0.0, cx, 0.0, focal / aspect, cy, 0.0, 0.0, 1.0);
    let rotation = so3::rotation_from_xyzw(frame.numbers("ORIENTATION")?)
        .ok_or_else(|| frame.fault("ORIENTATION", "is no quaternion"))?;
    let position = Vector3::from(frame.numbers::<3>("POSITION")?);
    let reach = [cx.max(size[0] - cx), cy.max(size[1] - cy)];
    let (lens, off) = lens(radial(&frame)?, focal, reach[0].hypot(reach[1]))
        .ok_or_else(|| frame.fault("VICON_RADIAL2", "is not the distortion of a lens"))?;
    if off > MAX_OFF_PX {
        notes.push(format!("camera {name}: the lens is matched to {off:.1} px in the corners"));
    }
    let (translation, time_offset) = (-rotation * position, Nanos::ZERO);
    let size = Some(size_px(name, size)?);
    Ok(Calibrated { name: name.to_owned(), size, matrix, lens, rotation, translation, time_offset })
}

/// k1, k2, k3 by pixels.
fn radial(frame: &Fields) -> Result<[f64; 3], Fault> {
    // "ViconRadial2", the centre, and three coefficients; in older files two coefficients alone.
    if let Some(text) = frame.text("VICON_RADIAL2") {
        let words: Vec<&str> = text.split_whitespace().collect();
        let numbers = words.iter().rev().take(3).rev().map(|word| word.parse::<f64>());
        let numbers: Vec<f64> = numbers.filter_map(Result::ok).collect();
        let fault = |_| frame.fault("VICON_RADIAL2", "must end with 3 numbers");
        return numbers.try_into().map_err(fault);
    }
    if frame.text("VICON_RADIAL").is_none() {
        return Ok([0.0; 3]);
    }
    let [k1, k2] = frame.numbers("VICON_RADIAL")?;
    Ok([k1, k2, 0.0])
}

/// The lens whose distortion undoes that polynomial, within `reach` pixels of the centre; and its largest error
/// there, pixels. `None` if there is none.
fn lens(k: [f64; 3], focal: f64, reach: f64) -> Option<(Lens, f64)> {
    // Where a point is seen and where it would be without distortion, normalised.
    let radii = (1..=RADII).map(|i| {
        let seen = reach * i as f64 / RADII as f64;
        let squared = seen * seen;
        let gain = 1.0 + squared * (k[0] + squared * (k[1] + squared * k[2]));
        (seen / focal, seen * gain / focal)
    });
    let (mut left, mut right) = (SMatrix::<f64, 6, 6>::zeros(), SVector::<f64, 6>::zeros());
    for (seen, ideal) in radii.clone() {
        // seen (1 + k4 r^2 + k5 r^4 + k6 r^6) = ideal (1 + k1 r^2 + k2 r^4 + k3 r^6)
        let powers = [2, 4, 6].map(|power| ideal.powi(power));
        let [a, b, c] = powers;
        let row = SVector::<f64, 6>::from([
            a * ideal,
            b * ideal,
            c * ideal,
            -a * seen,
            -b * seen,
            -c * seen,
        ]);
        left += row * row.transpose();
        right += row * (seen - ideal);
    }
    // The decomposition of other numbers does not end.
    if !left.iter().chain(right.iter()).all(|value| value.is_finite()) {
        return None;
    }
    let found = left.svd(true, true).solve(&right, 1e-14).unwrap_or_else(|_| SVector::zeros());
    let [k1, k2, k3, k4, k5, k6] = found.into();
    let lens = Lens::BrownConrady([k1, k2, 0.0, 0.0, k3, k4, k5, k6]);
    let error =
        |(seen, ideal): (f64, f64)| (lens.distort(&Vector2::new(ideal, 0.0)).x - seen).abs();
    Some((lens, radii.map(error).fold(0.0, f64::max) * focal))
}
