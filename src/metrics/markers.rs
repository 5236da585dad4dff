//! Distances between keypoints of a solved body and the markers of a reference.

use nalgebra::Vector3;

use crate::core::detections::Keypoint;

/// The points that are compared with a reference.
pub use crate::core::calibration::LIMBS as COMPARED;

/// Positions of the [`COMPARED`] points in the world, metres; `None` where a point is missing.
pub type MarkerPositions = [Option<Vector3<f64>>; COMPARED.len()];

/// Distance between an estimate and a reference, millimetres.
#[derive(Clone, Debug, PartialEq)]
pub struct MarkerDistance {
    /// Frames with at least one compared point.
    pub frames: usize,
    /// Mean over all compared points and frames.
    pub mean_mm: f64,
    /// Mean of each compared point.
    pub per_keypoint_mm: Vec<(Keypoint, f64)>,
    /// The frame with the largest distance between the two mid-hips, and that distance; `None`
    /// if no frame has the hips in both.
    pub worst_mid_hip: Option<(u64, f64)>,
}

/// Sums distances over frames.
#[derive(Clone, Debug, Default)]
pub struct MarkerDistances {
    sums: [(f64, usize); COMPARED.len()],
    frames: usize,
    worst_mid_hip: Option<(u64, f64)>,
}

impl MarkerDistances {
    /// Adds frame number `frame`.
    pub fn add(&mut self, frame: u64, estimate: &MarkerPositions, reference: &MarkerPositions) {
        let differences: MarkerPositions =
            std::array::from_fn(|i| Some(estimate[i]? - reference[i]?));
        for (difference, (sum, count)) in differences.iter().zip(&mut self.sums) {
            if let Some(difference) = difference {
                *sum += 1e3 * difference.norm();
                *count += 1;
            }
        }
        self.frames += usize::from(differences.iter().any(Option::is_some));
        let of =
            |keypoint| COMPARED.iter().position(|&k| k == keypoint).and_then(|i| differences[i]);
        if let (Some(left), Some(right)) = (of(Keypoint::LHip), of(Keypoint::RHip)) {
            let distance = 1e3 * (left + right).norm() / 2.0;
            if self.worst_mid_hip.is_none_or(|(_, worst)| distance > worst) {
                self.worst_mid_hip = Some((frame, distance));
            }
        }
    }

    /// The mean distances; `None` if nothing was compared.
    pub fn finish(&self) -> Option<MarkerDistance> {
        let count: usize = self.sums.iter().map(|sum| sum.1).sum();
        let per_keypoint_mm = COMPARED
            .into_iter()
            .zip(self.sums)
            .filter(|(_, (_, n))| *n > 0)
            .map(|(keypoint, (sum, n))| (keypoint, sum / n as f64))
            .collect();
        (count > 0).then(|| MarkerDistance {
            frames: self.frames,
            mean_mm: self.sums.iter().map(|sum| sum.0).sum::<f64>() / count as f64,
            per_keypoint_mm,
            worst_mid_hip: self.worst_mid_hip,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_means_over_points_that_are_in_both() {
        let at = |right: Option<f64>, left: Option<f64>| {
            let mut points: MarkerPositions = [None; COMPARED.len()];
            points[7] = right.map(|x| Vector3::new(1.0, x, 0.0));
            points[6] = left.map(|x| Vector3::new(1.2, x, 0.0));
            points
        };
        let mut distances = MarkerDistances::default();
        assert_eq!(distances.finish(), None);
        distances.add(7, &at(Some(0.03), Some(0.05)), &at(Some(0.0), Some(0.0)));
        distances.add(8, &at(Some(0.04), Some(9.0)), &at(Some(0.0), None));
        distances.add(9, &at(None, None), &at(Some(0.0), Some(0.0)));
        let distance = distances.finish().unwrap();
        assert_eq!(distance.frames, 2);
        assert!((distance.mean_mm - 40.0).abs() < 1e-9);
        let (frame, worst) = distance.worst_mid_hip.unwrap();
        assert!(frame == 7 && (worst - 40.0).abs() < 1e-9);
        assert_eq!(distance.per_keypoint_mm[0].0, Keypoint::LHip);
        assert!((distance.per_keypoint_mm[0].1 - 50.0).abs() < 1e-9);
        assert!((distance.per_keypoint_mm[1].1 - 35.0).abs() < 1e-9);
    }
}
