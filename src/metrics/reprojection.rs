//! Reprojection error: distance in the image between the projected body and the detections.

use nalgebra::Point2;

use super::statistics::{median, percentiles};
use crate::core::detections::Detection;

/// One point in one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReprojectionSample {
    /// Index of the camera in the rig.
    pub camera: usize,
    /// Projection of the solved body's point, pixels.
    pub projected: Point2<f64>,
    /// The detection.
    pub detected: Detection,
}

/// Distances in pixels between projected and detected points, by camera.
#[derive(Clone, Debug)]
pub struct ReprojectionErrors {
    least_confidence: f64,
    /// Single precision, since a long recording has millions of points.
    by_camera: Vec<Vec<f32>>,
}

impl ReprojectionErrors {
    /// For that many cameras; points with a confidence of `least_confidence` or less are skipped.
    pub fn new(cameras: usize, least_confidence: f64) -> Self {
        Self { least_confidence, by_camera: vec![Vec::new(); cameras] }
    }

    /// Adds a point. Returns whether it counts: confident, and of one of the cameras.
    pub fn add(&mut self, sample: &ReprojectionSample) -> bool {
        let confident = sample.detected.confidence > self.least_confidence;
        match self.by_camera.get_mut(sample.camera) {
            Some(errors) if confident => {
                errors.push((sample.projected - sample.detected.pixel).norm() as f32);
                true
            }
            _ => false,
        }
    }

    /// Number of counted points of a camera.
    pub fn count(&self, camera: usize) -> usize {
        self.by_camera.get(camera).map_or(0, Vec::len)
    }

    /// Median of one camera, pixels; `None` without counted points.
    pub fn median_of(&self, camera: usize) -> Option<f64> {
        median(&self.values(self.by_camera.get(camera)?))
    }

    /// Median over the points of all cameras, pixels.
    pub fn median(&self) -> Option<f64> {
        median(&self.values(&self.by_camera.concat()))
    }

    /// 25th, 50th and 75th percentile over the points of all cameras, pixels.
    pub fn quartiles(&self) -> Option<[f64; 3]> {
        percentiles(&self.values(&self.by_camera.concat()), [25.0, 50.0, 75.0])
    }

    fn values(&self, errors: &[f32]) -> Vec<f64> {
        errors.iter().map(|&e| f64::from(e)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(camera: usize, error: f64, confidence: f64) -> ReprojectionSample {
        let pixel = Point2::new(100.0, 50.0);
        let projected = Point2::new(100.0 + 0.6 * error, 50.0 - 0.8 * error);
        ReprojectionSample { camera, projected, detected: Detection { pixel, confidence } }
    }

    #[test]
    fn medians_are_by_camera_and_of_confident_points() {
        let mut errors = ReprojectionErrors::new(2, 0.3);
        for (camera, error, confidence) in
            [(0, 1.0, 0.9), (0, 2.0, 0.9), (0, 100.0, 0.3), (1, 5.0, 0.5), (1, 7.0, 0.31)]
        {
            assert_eq!(errors.add(&sample(camera, error, confidence)), confidence > 0.3);
        }
        assert!(!errors.add(&sample(2, 1.0, 0.9)), "no such camera");
        let close = |a: Option<f64>, b: f64| (a.unwrap() - b).abs() < 1e-5;
        assert!(close(errors.median_of(0), 1.5));
        assert!(close(errors.median_of(1), 6.0));
        assert!(close(errors.median(), 3.5));
        assert_eq!((errors.count(0), errors.count(1)), (2, 2));
        assert_eq!(errors.median_of(2), None);
    }
}
