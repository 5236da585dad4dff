//! A rig with its cameras on a ring.

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Vector3};

use crate::core::camera::{Camera, CameraError, Lens, Rig};

/// Image size, pixels.
const SIZE: [u32; 2] = [1280, 1024];
/// Brown-Conrady k1, k2, p1, p2, k3: mild barrel distortion.
const DISTORTION: [f64; 5] = [-0.08, 0.03, 0.0004, -0.0003, 0.0];
/// Height of the point that the cameras look at, metres.
const TARGET_HEIGHT: f64 = 0.95;
/// Radius of one person's floor, and height of the view at the edge of the floor, metres.
const FLOOR_RADIUS: f64 = 1.6;
const VIEW_HEIGHT: f64 = 2.1;

/// `n` cameras at `radius` metres from the middle and `height` metres up. They look at the middle
/// and see a person who walks a circle of about 1.3 m radius. The first camera is on +z.
///
/// # Errors
/// `n` is below two, or `radius` or `height` is not finite.
pub fn ring_rig(n: usize, radius: f64, height: f64) -> Result<Rig, CameraError> {
    ring_around(n, radius, height, FLOOR_RADIUS)
}

/// As [`ring_rig`]; the cameras see everybody within `floor_radius` of the middle.
///
/// # Errors
/// As [`ring_rig`].
pub fn ring_around(
    n: usize,
    radius: f64,
    height: f64,
    floor_radius: f64,
) -> Result<Rig, CameraError> {
    let nearest = (radius - floor_radius).max(0.3 * radius).max(0.1);
    let focal = f64::from(SIZE[1]) * nearest / VIEW_HEIGHT;
    let [cx, cy] = SIZE.map(|pixels| 0.5 * (f64::from(pixels) - 1.0));
    let lens = Lens::brown_conrady(&DISTORTION)?;
    let cameras = (0..n)
        .map(|index| {
            let angle = TAU * index as f64 / n as f64;
            let eye = Vector3::new(radius * angle.sin(), height, radius * angle.cos());
            let rotation = looking_at(&eye, &Vector3::new(0.0, TARGET_HEIGHT, 0.0));
            // Real cameras differ in focal length and principal point.
            let (f, off) = (focal * (1.0 + 0.01 * angle.sin()), 6.0 * angle.cos());
            let matrix = Matrix3::new(f, 0.0, cx + off, 0.0, f, cy - off, 0.0, 0.0, 1.0);
            let name = format!("cam{:02}", index + 1);
            Camera::new(name, SIZE, &matrix, lens, rotation, -(rotation * eye))
        })
        .collect::<Result<_, _>>()?;
    Rig::new(1, cameras)
}

/// Rotation `camera_from_world` of a level camera at `eye` that looks at `target`.
pub(super) fn looking_at(eye: &Vector3<f64>, target: &Vector3<f64>) -> Matrix3<f64> {
    let forward = (target - eye).normalize();
    let right = forward.cross(&Vector3::y()).normalize();
    let down = forward.cross(&right);
    Matrix3::from_columns(&[right, down, forward]).transpose()
}
