//! The epipolar distance of a point seen by two cameras.

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::core::camera::Camera;

/// Two cameras, and what their views of one point must satisfy.
#[derive(Clone, Debug)]
pub(super) struct Pair {
    /// Index of the first camera.
    pub(super) a: usize,
    /// Index of the second camera.
    pub(super) b: usize,
    /// x_b^T E x_a = 0 for normalised coordinates of the same point.
    essential: Matrix3<f64>,
    /// Mean focal lengths, pixels.
    focal: [f64; 2],
}

impl Pair {
    /// The pair of the cameras with these indices. `None` if they share their centre.
    pub(super) fn of(cameras: &[Camera], a: usize, b: usize) -> Option<Self> {
        let (from, to) = (&cameras[a], &cameras[b]);
        let rotation = to.rotation * from.rotation.transpose();
        let translation = to.translation - rotation * from.translation;
        let essential = translation.try_normalize(1e-6)?.cross_matrix() * rotation;
        Some(Self { a, b, essential, focal: [from.focal.mean(), to.focal.mean()] })
    }

    /// The signed Sampson distance of two normalised points from being views of one point, pixels.
    pub(super) fn distance(&self, a: &Vector2<f64>, b: &Vector2<f64>) -> f64 {
        let (a, b) = (Vector3::new(a.x, a.y, 1.0), Vector3::new(b.x, b.y, 1.0));
        let line_in_b = self.essential * a;
        let line_in_a = self.essential.tr_mul(&b);
        let [focal_a, focal_b] = self.focal;
        let by_b = line_in_b.xy().norm_squared() / (focal_b * focal_b);
        let by_a = line_in_a.xy().norm_squared() / (focal_a * focal_a);
        b.dot(&line_in_b) / (by_a + by_b).sqrt().max(f64::MIN_POSITIVE)
    }
}
