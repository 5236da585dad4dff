//! How the frames of a camera are read: with which calibration, labels, image and clock. A fault is a
//! reading that fits better than the declared one.

use nalgebra::{Matrix2, Vector2};

use super::footage::{Frame, POINTS, Track};
use super::times::Clock;
use crate::core::camera::Camera;
use crate::core::detections::{Keypoint, KeypointFormat};
use crate::core::points::extent;
use crate::core::time::{Nanos, Timestamp};

/// A person in calibrated pixels, by index in [`POINTS`].
#[derive(Clone, Debug)]
pub(super) struct View {
    pub(super) pixels: [Option<Vector2<f64>>; POINTS.len()],
    /// The longer side of the bounding box, pixels.
    pub(super) extent: f64,
}

/// How the frames of a camera are read.
#[derive(Clone, Debug)]
pub(super) struct Reading {
    pub(super) camera: Camera,
    /// Left and right change places.
    pub(super) swapped: bool,
    /// The format of the points, if it is not the declared one.
    pub(super) format: Option<KeypointFormat>,
    /// The calibrated pixel is `turn` times the detected one, plus `shift`.
    pub(super) turn: Matrix2<f64>,
    pub(super) shift: Vector2<f64>,
    pub(super) clock: Clock,
}

impl Reading {
    pub(super) fn new(camera: &Camera) -> Self {
        Self {
            camera: camera.clone(),
            swapped: false,
            format: None,
            turn: Matrix2::identity(),
            shift: Vector2::zeros(),
            clock: Clock::default(),
        }
    }

    /// The people seen at a time of the rig. Empty without a frame within three quarters of a period.
    pub(super) fn views(&self, track: &Track, period: Nanos, time: Timestamp) -> Vec<View> {
        let capture = self.clock.of(time - self.camera.time_offset);
        let reach = Nanos::rounded(0.75 * period.ns() as f64);
        track.nearest(capture, reach).map_or_else(Vec::new, |frame| self.people(frame))
    }

    fn people(&self, frame: &Frame) -> Vec<View> {
        let format = self.format.unwrap_or(frame.format);
        let index = POINTS.map(|point| {
            let point = if self.swapped { mirrored(point) } else { point };
            format.index_of(point)
        });
        let view = |seen: &super::footage::Seen| {
            let pixels = index.map(|index| Some(self.turn * seen.at(index?)? + self.shift));
            View { pixels, extent: extent(pixels.iter().flatten().copied()) }
        };
        frame.people.iter().map(view).collect()
    }
}

/// The same point of the other side.
fn mirrored(point: Keypoint) -> Keypoint {
    let (left, side) = point.of_left();
    match side < 0.0 {
        true => left,
        false => POINTS.into_iter().find(|p| p.of_left() == (left, -1.0)).unwrap_or(point),
    }
}
