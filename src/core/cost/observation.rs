//! Observations of the performer, grouped by capture time.

use nalgebra::Vector2;

use crate::core::time::Timestamp;

/// One detected point of the performer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Index in the scene's points.
    pub point: usize,
    /// Index of the camera in the rig.
    pub camera: usize,
    /// The detected position, pixels.
    pub pixel: Vector2<f64>,
    /// The detector's confidence, (0, 1].
    pub confidence: f64,
    /// Factor of the loss's scale.
    pub scale_factor: f64,
}

/// All observations of one capture time.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameObservations {
    /// The capture time.
    pub capture: Timestamp,
    /// Sorted by point, so that the views of a point are adjacent.
    observations: Vec<Observation>,
}

impl FrameObservations {
    /// Sorts the observations.
    pub fn new(capture: Timestamp, mut observations: Vec<Observation>) -> Self {
        observations.sort_by_key(|o| (o.point, o.camera));
        Self { capture, observations }
    }

    /// All observations, sorted by point.
    pub fn observations(&self) -> &[Observation] {
        &self.observations
    }

    /// Sets the factor of the loss's scale of an observation, by its index.
    pub fn set_scale_factor(&mut self, index: usize, scale_factor: f64) {
        self.observations[index].scale_factor = scale_factor;
    }

    /// The observations of each point in turn.
    pub fn by_point(&self) -> impl Iterator<Item = &[Observation]> {
        self.observations.chunk_by(|a, b| a.point == b.point)
    }
}
