//! Reads `.mcal` of OptiTrack Motive, which is XML in UTF-16.
//!
//! Per camera: `Extrinsic` holds the position (m) and, row by row, the rotation from the camera to the world,
//! with y up and z backwards (opposite to OpenCV's y and z). `IntrinsicStandardCameraModel` holds pixels and
//! the coefficients of OpenCV's model; files of old versions have only `Intrinsic`, whose distortion is of
//! another model and is not used. The signs of the tangential distortion are unconfirmed; it is taken as
//! OpenCV's p1 and p2.

use nalgebra::{Matrix3, Vector3};
use roxmltree::{Document, Node};

use super::convention::opengl;
use super::xml::Fields;
use super::{Calibrated, Fault, size_px};
use crate::core::camera::Lens;
use crate::core::time::Nanos;

/// Reads all cameras, in the file's order.
pub(super) fn cameras(document: &Document) -> Result<Vec<Calibrated>, Fault> {
    let nodes = document.descendants().filter(|node| {
        node.has_tag_name("Camera") && node.children().any(|child| child.has_tag_name("Extrinsic"))
    });
    nodes.map(|node| camera(&node)).collect()
}

fn camera(node: &Node) -> Result<Calibrated, Fault> {
    let name = node.attribute("Serial");
    let name = name.ok_or_else(|| Fault::Text("a <Camera> has no Serial".into()))?;
    let image = Fields::of(node, name, "Attributes")?;
    let size = [image.number("ImagerPixelWidth")?, image.number("ImagerPixelHeight")?];
    let standard = Fields::of(node, name, "IntrinsicStandardCameraModel").ok();
    let lens = standard.as_ref().map_or(Ok(Lens::IDEAL), lens)?;
    let inside = standard.map_or_else(|| Fields::of(node, name, "Intrinsic"), Ok)?;
    let [fx, fy] = [inside.number("HorizontalFocalLength")?, inside.number("VerticalFocalLength")?];
    let [cx, cy] = [inside.number("LensCenterX")?, inside.number("LensCenterY")?];
    let place = Fields::of(node, name, "Extrinsic")?;
    let position = Vector3::new(place.number("X")?, place.number("Y")?, place.number("Z")?);
    let mut world_from_camera = Matrix3::zeros();
    for i in 0..9 {
        world_from_camera[(i / 3, i % 3)] = place.number(&format!("OrientMatrix{i}"))?;
    }
    let rotation = opengl() * world_from_camera.transpose();
    Ok(Calibrated {
        name: name.to_owned(),
        size: Some(size_px(name, size)?),
        matrix: Matrix3::new(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
        lens,
        rotation,
        translation: -rotation * position,
        time_offset: Nanos::ZERO,
    })
}

fn lens(standard: &Fields) -> Result<Lens, Fault> {
    let coefficient = |field| standard.text(field).map_or(Ok(0.0), |_| standard.number(field));
    let [k1, k2, p1] = ["k1", "k2", "TangentialX"].map(coefficient);
    let [p2, k3] = ["TangentialY", "k3"].map(coefficient);
    Ok(Lens::BrownConrady([k1?, k2?, p1?, p2?, k3?, 0.0, 0.0, 0.0]))
}
