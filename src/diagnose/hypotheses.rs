//! Faults of a camera that have names. Each is undone by a reading, see [`Reading`].

use nalgebra::{Matrix2, Matrix3, Vector2};
use serde::Serialize;

use super::reading::Reading;
use crate::core::camera::{Camera, Lens};
use crate::core::so3;

/// What is wrong, and what fixes it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// Name of the fault for programs, such as `image_mirrored`.
    pub cause: &'static str,
    /// What is wrong, for people.
    pub what: String,
    /// What fixes it.
    pub fix: String,
    /// Capture time when it begins or ends, nanoseconds; `None`: it is there in the whole recording.
    pub changes_at_ns: Option<i64>,
}

impl Finding {
    pub(super) fn new(
        cause: &'static str,
        what: impl Into<String>,
        fix: impl Into<String>,
    ) -> Self {
        Self { cause, what: what.into(), fix: fix.into(), changes_at_ns: None }
    }
}

/// A fault explains an error if the error without it is below this part.
pub(super) const EXPLAINED: f64 = 0.55;
/// The weight from which on a fault is one of very many, or has several free parameters: it needs more evidence.
pub(super) const OF_MANY: f64 = 1.2;

/// A fault, and the reading without it.
#[derive(Clone, Debug)]
pub(super) struct Hypothesis {
    pub(super) finding: Finding,
    pub(super) reading: Reading,
    /// A fault with more free parameters must fit better, by this factor.
    pub(super) weight: f64,
}

/// The faults of one camera with a known undoing, except time shifts and exchanged cameras.
pub(super) fn of_one(reading: &Reading) -> Vec<Hypothesis> {
    let mut all = images(reading);
    all.extend(poses(reading));
    all.extend(intrinsics(reading));
    all
}

/// The faults of the pixels and labels.
pub(super) fn images(reading: &Reading) -> Vec<Hypothesis> {
    let [width, height] = [reading.camera.width, reading.camera.height].map(f64::from);
    let mut all = Vec::new();
    let mut add = |finding: Finding, turn: [f64; 4], shift: [f64; 2], swapped: bool| {
        let turn = Matrix2::new(turn[0], turn[1], turn[2], turn[3]);
        let mut reading = reading.clone();
        reading.turn = turn * reading.turn;
        reading.shift = turn * reading.shift + Vector2::from(shift);
        reading.swapped ^= swapped;
        all.push(Hypothesis { finding, reading, weight: 1.0 });
    };
    let [right, below] = [width - 1.0, height - 1.0];
    let back = format!(
        "use the image as it was calibrated, or replace x by {right} - x and exchange left and right"
    );
    let finding = Finding::new("image_mirrored", "its image is mirrored", &back);
    add(finding, [-1.0, 0.0, 0.0, 1.0], [right, 0.0], true);
    let finding = Finding::new(
        "pixels_mirrored",
        "its x coordinates are mirrored, left and right are not",
        format!("replace x by {right} - x"),
    );
    add(finding, [-1.0, 0.0, 0.0, 1.0], [right, 0.0], false);
    let finding = Finding::new(
        "sides_exchanged",
        "left and right are exchanged",
        "check its keypoint order, or whether the detector got mirrored images",
    );
    add(finding, [1.0, 0.0, 0.0, 1.0], [0.0, 0.0], true);
    let finding = Finding::new(
        "y_upwards",
        "its y coordinates count from below",
        format!("replace y by {below} - y"),
    );
    add(finding, [1.0, 0.0, 0.0, -1.0], [0.0, below], false);
    let turned = |degrees: i32| {
        let what = format!("its image is turned by {degrees} degrees");
        Finding::new("image_turned", what, "turn it back, or calibrate with the turned image")
    };
    add(turned(180), [-1.0, 0.0, 0.0, -1.0], [right, below], false);
    // The turned image may be as wide as the calibrated one is high.
    add(turned(90), [0.0, 1.0, -1.0, 0.0], [0.0, below], false);
    add(turned(270), [0.0, -1.0, 1.0, 0.0], [right, 0.0], false);
    let finding =
        Finding::new("axes_exchanged", "its x and y coordinates are exchanged", "exchange them");
    add(finding, [0.0, 1.0, 1.0, 0.0], [0.0, 0.0], false);
    let finding = Finding::new(
        "normalised_pixels",
        "its coordinates are parts of the image's size, 0 to 1",
        format!("multiply x by {width} and y by {height}"),
    );
    add(finding, [width, 0.0, 0.0, height], [0.0, 0.0], false);
    all
}

/// The faults of the pose in the calibration.
pub(super) fn poses(reading: &Reading) -> Vec<Hypothesis> {
    let (rotation, translation) = (reading.camera.rotation, reading.camera.translation);
    let transposed = rotation.transpose();
    let mut all = Vec::new();
    let mut add = |finding: Finding, rotation: Matrix3<f64>, translation| {
        let mut reading = reading.clone();
        (reading.camera.rotation, reading.camera.translation) = (rotation, translation);
        all.push(Hypothesis { finding, reading, weight: 1.0 });
    };
    let fix = "write the pose that takes the world to the camera";
    // The world of the file may have had z up.
    let worlds = [Matrix3::identity(), so3::Z_UP];
    for up in worlds {
        let (back, transposed) = (up * transposed, up * transposed * up);
        let finding = Finding::new("pose_inverted", "its pose takes the camera to the world", fix);
        add(finding, transposed, -(back * translation));
        let finding = Finding::new("rotation_transposed", "its rotation is transposed", fix);
        add(finding, transposed, translation);
    }
    for up in worlds {
        let finding = Finding::new(
            "position_as_translation",
            "its translation is the camera's position",
            "write the translation as -R times the position",
        );
        add(finding, rotation, -(rotation * up.transpose() * translation));
    }
    let finding = Finding::new("translation_negated", "its translation has the wrong sign", fix);
    add(finding, rotation, -translation);
    let opengl = Matrix3::from_diagonal(&[1.0, -1.0, -1.0].into());
    let finding = Finding::new(
        "camera_axes",
        "its camera frame has y up and z backwards",
        "turn its pose to y down and z forwards",
    );
    add(finding, opengl * rotation, opengl * translation);
    let units = [(1000.0, "millimetres"), (100.0, "centimetres"), (1.0 / 0.0254, "inches")];
    let units = units.into_iter().chain([(1.0 / 0.3048, "feet")]);
    for (factor, unit) in units {
        let what = format!("its translation is in {unit}, that of the others in metres");
        let finding = Finding::new("translation_unit", what, format!("divide it by {factor:.4}"));
        add(finding, rotation, translation / factor);
        let what = format!("its translation is in metres, that of the others in {unit}");
        let finding = Finding::new("translation_unit", what, format!("multiply it by {factor:.4}"));
        add(finding, rotation, translation * factor);
    }
    all
}

/// The faults of the lens and the principal point in the calibration.
fn intrinsics(reading: &Reading) -> Vec<Hypothesis> {
    let camera = &reading.camera;
    let hypothesis = |finding: Finding, camera: Camera, weight: f64| {
        let reading = Reading { camera, ..reading.clone() };
        Hypothesis { finding, reading, weight }
    };
    let middle = Vector2::new(f64::from(camera.width), f64::from(camera.height)) / 2.0;
    let off = camera.centre - middle;
    let mut all = Vec::new();
    if off.norm() > 0.05 * middle.norm() {
        let what = format!("its principal point is {:.0} px off the middle", off.norm());
        let fix = format!("the middle of the image, ({}, {}), fits", middle.x, middle.y);
        let finding = Finding::new("principal_point", what, fix);
        let mut other = camera.clone();
        other.centre = middle;
        all.push(hypothesis(finding, other, 1.0));
    }
    let own = camera.lens().coefficients()[0];
    for k1 in [-0.4, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2] {
        let lens = Lens::BrownConrady([k1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        if lens == *camera.lens() {
            continue;
        }
        let size = [camera.width, camera.height];
        let (rotation, translation) = (camera.rotation, camera.translation);
        let other = Camera::new(&*camera.name, size, &camera.matrix(), lens, rotation, translation);
        let Ok(mut other) = other else { continue };
        other.time_offset = camera.time_offset;
        let what = format!("its distortion is wrong (k1 of {own})");
        let fits = format!("calibrate its lens; k1 of about {k1} fits");
        all.push(hypothesis(Finding::new("distortion", what, fits), other, 1.1));
    }
    all
}

/// The calibrations of other cameras.
pub(super) fn others<'a>(
    reading: &'a Reading,
    cameras: impl Iterator<Item = &'a Camera> + 'a,
) -> impl Iterator<Item = Hypothesis> + 'a {
    let others = cameras.filter(|camera| camera.name != reading.camera.name);
    others.map(|camera| {
        let reading = Reading { camera: camera.clone(), ..reading.clone() };
        Hypothesis { finding: is_another(&camera.name), reading, weight: 1.0 }
    })
}

/// The fault of a camera whose images are those of another one.
pub(super) fn is_another(name: &str) -> Finding {
    Finding::new(
        "other_camera",
        format!("its images are those of camera {name}"),
        format!("give them the name {name}, or this camera {name}'s calibration"),
    )
}
