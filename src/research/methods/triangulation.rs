//! Triangulation: no body. Each limb keypoint is triangulated in each frame, and its track smoothed.
//!
//! As Pose2Sim does \[Pagnon 2022\]: a least-squares point weighted by confidence, without the views
//! that are more than 15 px off, the worst first, while more than two remain. Gaps are filled by
//! straight lines. Differences: the performer's detections are those that MuVS followed, as in all
//! methods here.

use nalgebra::Vector3;

use super::filter::Filter;
use super::muvs::{MuVsWeights, PerFrame};
use super::{Delay, Method, Motion, Solved, Take};
use crate::core::body::fitted_points;
use crate::core::camera::{Rig, View, triangulate_dropping};
use crate::core::cost::FrameObservations;
use crate::core::manifold::Decoder;
use crate::metrics::{COMPARED, MarkerPositions};

/// A view that is farther off, pixels, is left out: Pose2Sim's threshold.
const AGREE_PX: f64 = 15.0;

/// Triangulated and smoothed limb keypoints.
#[derive(Clone, Copy, Debug)]
pub struct Triangulation {
    filter: Filter,
    agree_px: f64,
}

impl Triangulation {
    /// With a filter and the largest distance of a view, pixels.
    pub fn new(filter: Filter, agree_px: f64) -> Self {
        Self { filter, agree_px }
    }

    /// With Pose2Sim's filter: Butterworth at 6 Hz.
    pub fn butterworth() -> Self {
        Self::new(Filter::Butterworth { cutoff_hz: 6.0 }, AGREE_PX)
    }

    /// With a Kalman smoother.
    pub fn kalman() -> Self {
        Self::new(Filter::Kalman { noise_m: 0.01, acceleration_m_s2: 20.0 }, AGREE_PX)
    }

    /// The limb keypoints of a frame; `indices` gives the place of each fitted point among them.
    fn points(
        &self,
        rig: &Rig,
        seen: &[FrameObservations],
        indices: &[Option<usize>],
    ) -> MarkerPositions {
        let mut views: [Vec<View>; COMPARED.len()] = Default::default();
        for observation in seen.iter().flat_map(FrameObservations::observations) {
            if let Some(index) = indices[observation.point] {
                views[index].push((observation.camera, observation.pixel, observation.confidence));
            }
        }
        views.map(|views| Some(triangulate_dropping(rig, &views, self.agree_px, 2)?.0))
    }
}

impl Method for Triangulation {
    fn name(&self) -> String {
        format!("triangulation, {}", self.filter.name())
    }

    fn delay(&self, _: f64) -> Delay {
        Delay::Recording
    }

    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        let found = PerFrame::solve(take, decoder, &MuVsWeights::default())?;
        let index = |point: usize| {
            let keypoint = fitted_points(take.format).get(point)?.keypoint;
            COMPARED.iter().position(|&compared| compared == keypoint)
        };
        let indices: Vec<Option<usize>> =
            (0..fitted_points(take.format).len()).map(index).collect();
        let raw: Vec<MarkerPositions> = (found.observations.iter())
            .map(|seen| self.points(&take.rig, seen, &indices))
            .collect();
        let mut smooth = vec![[None; COMPARED.len()]; raw.len()];
        for point in 0..COMPARED.len() {
            let track: Vec<_> = raw.iter().map(|points| points[point]).collect();
            let Some(track) = filled(&track) else { continue };
            let axes = [0, 1, 2].map(|axis| {
                let axis: Vec<f64> = track.iter().map(|point| point[axis]).collect();
                self.filter.smooth(&axis, take.fps)
            });
            for (frame, points) in smooth.iter_mut().enumerate() {
                points[point] = Some(Vector3::from([0, 1, 2].map(|axis| axes[axis][frame])));
            }
        }
        let motion = Motion::Points(found.times.into_iter().zip(smooth).collect());
        Some(Solved { motion, deviations: Vec::new(), borders: Vec::new(), not_followed: None })
    }
}

/// Gaps filled by straight lines, the ends by the nearest point; `None` for a track without points.
fn filled(track: &[Option<Vector3<f64>>]) -> Option<Vec<Vector3<f64>>> {
    let known: Vec<(usize, Vector3<f64>)> =
        track.iter().enumerate().filter_map(|(frame, point)| Some((frame, (*point)?))).collect();
    let at = |frame: usize| {
        let next = known.partition_point(|(known, _)| *known < frame);
        match (next.checked_sub(1).map(|before| known[before]), known.get(next)) {
            (_, Some((at, point))) if *at == frame => Some(*point),
            (Some((from, a)), Some((to, b))) => {
                Some(a.lerp(b, (frame - from) as f64 / (to - from) as f64))
            }
            (Some((_, point)), None) | (None, Some(&(_, point))) => Some(point),
            (None, None) => None,
        }
    };
    (0..track.len()).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_filled_by_lines_and_ends_by_their_neighbours() {
        let at = |x: f64| Some(Vector3::new(x, 0.0, 1.0));
        let track = filled(&[None, at(1.0), None, None, at(4.0), None]).unwrap();
        assert_eq!(track.iter().map(|p| p.x).collect::<Vec<_>>(), [1.0, 1.0, 2.0, 3.0, 4.0, 4.0]);
        assert_eq!(filled(&[None, None]), None);
    }
}
