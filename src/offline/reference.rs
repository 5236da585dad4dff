//! Distance from a reference: marker positions of another tool for the same recording.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Vector3};
use serde::{Serialize, Serializer};

use super::hold_out::Located;
use crate::core::detections::Detections;
use crate::core::time::Timestamp;
use crate::io::formats::Trajectories;
use crate::metrics::{COMPARED, MarkerDistances, MarkerPositions};

/// The frame number and the capture time of a frame of a recording.
#[derive(Clone, Copy, Debug)]
pub struct FrameClock {
    /// The frame number.
    pub frame: u64,
    /// The capture time.
    pub capture: Timestamp,
}

impl FrameClock {
    /// The clock of `detections`.
    pub fn of(detections: &Detections) -> Self {
        Self { frame: detections.frame, capture: detections.capture }
    }

    /// The frame number at a time near this frame, with its fraction, at `fps`.
    pub fn frame_at(self, capture: Timestamp, fps: f64) -> f64 {
        self.frame as f64 + (capture - self.capture).ns() as f64 * 1e-9 * fps
    }
}

/// The distance of the poses from the reference.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reference {
    /// Number of compared frames.
    pub frames: usize,
    /// Mean distance of shoulders, elbows, wrists, hips, knees and ankles, millimetres.
    pub mean_mm: f64,
    /// Largest distance between the middles of the hips, millimetres.
    pub worst_mid_hip_mm: Option<f64>,
    /// The frame of the recording with that largest distance.
    pub worst_mid_hip_frame: Option<u64>,
    /// Mean distance of each point, millimetres.
    pub points_mm: BTreeMap<String, f64>,
    /// How the reference was moved first, if it was.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fit: Option<ReferenceFit>,
}

/// How trajectories of another system are moved to the poses.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReferenceFit {
    /// Seconds from the time of a pose to that of its markers.
    pub shift_s: f64,
    /// Rotation from the world of the trajectories to that of the recording, by rows.
    #[serde(serialize_with = "rows")]
    pub rotation: Matrix3<f64>,
    /// What is added after the rotation, metres.
    #[serde(serialize_with = "entries")]
    pub translation_m: Vector3<f64>,
}

fn rows<S: Serializer>(matrix: &Matrix3<f64>, to: S) -> Result<S::Ok, S::Error> {
    to.collect_seq(<[[f64; 3]; 3]>::from(matrix.transpose()))
}

fn entries<S: Serializer>(vector: &Vector3<f64>, to: S) -> Result<S::Ok, S::Error> {
    to.collect_seq(vector)
}

impl ReferenceFit {
    /// The rotation and the translation that take the second places to the first ones, by least squares, without a shift
    /// in time; `None` for fewer than three places.
    ///
    /// Source: Kabsch 1976.
    fn of(pairs: &[(Vector3<f64>, Vector3<f64>)]) -> Option<Self> {
        if pairs.len() < 3 {
            return None;
        }
        let count = pairs.len() as f64;
        let sums =
            pairs.iter().fold([Vector3::zeros(); 2], |[to, from], (a, b)| [to + a, from + b]);
        let [to, from] = sums.map(|sum| sum / count);
        let both: Matrix3<f64> = pairs.iter().map(|(a, b)| (a - to) * (b - from).transpose()).sum();
        let svd = both.svd(true, true);
        let (u, v) = (svd.u?, svd.v_t?);
        let sign = Vector3::new(1.0, 1.0, (u * v).determinant().signum());
        let rotation = u * Matrix3::from_diagonal(&sign) * v;
        Some(Self { shift_s: 0.0, rotation, translation_m: to - rotation * from })
    }

    fn moved(&self, place: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * place + self.translation_m
    }
}

/// Above this mean distance a reference is hardly of the recording, millimetres.
const UNFIT_MM: f64 = 250.0;
/// Most bodies by which trajectories are fitted.
const SAMPLED: usize = 200;
/// First step of the search for the shift in time, seconds; or one row, if that is longer.
const STEP_S: f64 = 0.015;
/// Rates that differ by less than this part are the same: one of them is nominal.
const SAME_RATE: f64 = 0.01;
/// A pose this part of a row before the first row is compared with the first row; the last row likewise.
const NEAR: f64 = 0.25;

impl Reference {
    /// A note if a reference obviously does not fit. `found` is `None` if no row has the time of a pose, or if the
    /// reference should be `aligned` and could not be.
    pub fn note(found: Option<&Self>, aligned: bool) -> Option<String> {
        let reason = match found {
            None if aligned => {
                "no shift in time gives markers to more than half of the poses".to_owned()
            }
            None => "no row has the time of a pose".to_owned(),
            Some(found) if found.mean_mm > UNFIT_MM => {
                format!("it is {:.0} mm from the poses on average", found.mean_mm)
            }
            Some(_) => return None,
        };
        let expected = match aligned {
            true => "",
            false => ", in its world and with the same frame numbers",
        };
        Some(format!("the reference does not fit: {reason}; is it of this recording{expected}?"))
    }
}

/// Compares poses with marker trajectories in a stream.
///
/// Row i of the trajectories is frame `first_frame` + i of the recording, or the frame of that time if the rates differ.
/// Between rows the markers are interpolated.
pub struct ReferenceComparison {
    /// Frame rate of the rows, hertz.
    rate: f64,
    /// Number of row 0's frame at that rate.
    first_frame: f64,
    /// The compared points.
    rows: Vec<MarkerPositions>,
    fit: Option<ReferenceFit>,
    distances: MarkerDistances,
}

impl ReferenceComparison {
    /// A comparison with trajectories in the recording's world and time.
    pub fn new(reference: &Trajectories) -> Self {
        let columns = COMPARED.map(|keypoint| reference.column_of(keypoint));
        let row = |row: &Vec<_>| columns.map(|column| row.get(column?).copied().flatten());
        Self {
            rate: reference.frame_rate,
            first_frame: reference.first_frame,
            rows: reference.rows.iter().map(row).collect(),
            fit: None,
            distances: MarkerDistances::default(),
        }
    }

    /// Finds how to shift the trajectories in time and to move them, so that they are nearest to the bodies: they are of
    /// another system. `bodies` are in order, with their frame numbers at `fps`, and should move. At a shift with markers
    /// for half of them or fewer there is no fit. Returns whether one was found.
    pub fn fit(&mut self, fps: f64, bodies: &[(f64, MarkerPositions)]) -> bool {
        let every = bodies.len().div_ceil(SAMPLED).max(1);
        let bodies: Vec<(f64, &MarkerPositions)> = bodies
            .iter()
            .step_by(every)
            .map(|(frame, at)| (self.row_of(*frame, fps), at))
            .collect();
        self.fit = self.best_fit(&bodies);
        self.fit.is_some()
    }

    /// The same for bodies in order of their rows.
    fn best_fit(&self, bodies: &[(f64, &MarkerPositions)]) -> Option<ReferenceFit> {
        let nearest = |shifts: &mut dyn Iterator<Item = f64>| {
            let fits = shifts.filter_map(|rows| Some((rows, self.fit_at(rows, bodies)?)));
            fits.min_by(|(_, (a, _)), (_, (b, _))| a.total_cmp(b))
        };
        let step = (STEP_S * self.rate).floor().max(1.0);
        // At the first and the last shift half of the bodies are outside.
        let middle = (bodies.first()?.0 + bodies.last()?.0) / 2.0;
        let steps = (self.rows.len() as f64 / step).ceil() as usize;
        let mut best = nearest(&mut (0..=steps).map(|k| step * k as f64 - middle))?;
        for part in [0.1, 0.01, 0.001] {
            let around = best.0;
            best = nearest(&mut (-10..=10).map(|k| around + step * part * f64::from(k)))?;
        }
        let (rows, (_, fit)) = best;
        Some(ReferenceFit { shift_s: rows / self.rate, ..fit })
    }

    /// The fit at a shift of so many rows, and its mean distance, metres.
    fn fit_at(&self, rows: f64, bodies: &[(f64, &MarkerPositions)]) -> Option<(f64, ReferenceFit)> {
        let (mut pairs, mut seen) = (Vec::new(), 0);
        for (row, body) in bodies {
            let Some(markers) = self.at(row + rows) else { continue };
            let known = pairs.len();
            pairs.extend(body.iter().zip(&markers).filter_map(|(a, b)| (*a).zip(*b)));
            seen += usize::from(pairs.len() > known);
        }
        let fit = ReferenceFit::of(&pairs).filter(|_| 2 * seen > bodies.len())?;
        let distances = pairs.iter().map(|(body, marker)| (body - fit.moved(marker)).norm());
        Some((distances.sum::<f64>() / pairs.len() as f64, fit))
    }

    /// Adds the body in a frame of the recording, at its rate.
    pub fn add(&mut self, frame: f64, fps: f64, body: &impl Located) {
        let shift = self.fit.as_ref().map_or(0.0, |fit| fit.shift_s * self.rate);
        let Some(mut markers) = self.at(self.row_of(frame, fps) + shift) else { return };
        if let Some(fit) = &self.fit {
            markers = markers.map(|place| place.map(|place| fit.moved(&place)));
        }
        self.distances.add(frame.round().max(0.0) as u64, &positions(body), &markers);
    }

    /// The row of a frame.
    fn row_of(&self, frame: f64, fps: f64) -> f64 {
        let ratio = self.rate / fps;
        let ratio = if (ratio - 1.0).abs() < SAME_RATE { 1.0 } else { ratio };
        frame * ratio - self.first_frame
    }

    /// The markers between two rows; `None` before the first and after the last.
    fn at(&self, row: f64) -> Option<MarkerPositions> {
        let last = self.rows.len() as f64 - 1.0;
        if !(-NEAR..=last + NEAR).contains(&row) {
            return None;
        }
        let nearest = row.round();
        // Times are rounded.
        let row = if (row - nearest).abs() < 1e-3 { nearest } else { row }.clamp(0.0, last);
        let (before, share) = (self.rows.get(row as usize)?, row.fract());
        if share == 0.0 {
            return Some(*before);
        }
        let after = self.rows.get(row as usize + 1)?;
        Some(std::array::from_fn(|i| Some(before[i]?.lerp(&after[i]?, share))))
    }

    /// The distances; `None` if no row of the reference has a pose.
    pub fn finish(&self) -> Option<Reference> {
        let distance = self.distances.finish()?;
        Some(Reference {
            frames: distance.frames,
            mean_mm: distance.mean_mm,
            worst_mid_hip_mm: distance.worst_mid_hip.map(|(_, mm)| mm),
            worst_mid_hip_frame: distance.worst_mid_hip.map(|(frame, _)| frame),
            points_mm: (distance.per_keypoint_mm.into_iter())
                .map(|(point, mm)| (point.to_string().replace(' ', "_"), mm))
                .collect(),
            fit: self.fit.clone(),
        })
    }
}

/// The compared points of a body.
pub fn positions(body: &impl Located) -> MarkerPositions {
    COMPARED.map(|keypoint| body.keypoint(keypoint))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Pose, Skeleton};
    use crate::core::detections::Keypoint;
    use crate::core::so3;

    fn trajectories(
        frame_rate: f64,
        first_frame: f64,
        names: &[String],
        rows: Vec<Vec<Option<Vector3<f64>>>>,
    ) -> Trajectories {
        Trajectories { frame_rate, first_frame, names: names.to_vec(), rows }
    }

    #[test]
    fn rows_are_compared_with_the_pose_of_their_frame() {
        let skeleton = Skeleton::default();
        let at = |x: f64| {
            let mut pose = Pose::rest();
            pose.root_position.x = x;
            pose.posture(&skeleton)
        };
        let row = |x: Option<f64>| vec![x.and_then(|x| positions(&(&skeleton, &at(x)))[7])];
        assert_eq!(COMPARED[7], Keypoint::RHip);
        let names = ["RHip".to_owned()];
        let posture = at(0.0);
        let compared = |rate: f64, first: f64, fps: f64, frames: &[f64]| {
            let rows = [Some(0.0), Some(0.01), None, Some(0.04), Some(0.06)].map(row).into();
            let mut comparison = ReferenceComparison::new(&trajectories(rate, first, &names, rows));
            assert_eq!(comparison.finish(), None);
            frames.iter().for_each(|frame| comparison.add(*frame, fps, &(&skeleton, &posture)));
            comparison.finish().unwrap()
        };
        // Rows of frames 6 to 10. Frame 8 has no marker, frame 11 no row. Between frames 9 and 10 the marker is halfway.
        for fps in [100.0, 99.7] {
            let reference = compared(100.0, 6.0, fps, &[7.0, 8.0, 9.5, 11.0]);
            assert_eq!(reference.frames, 2);
            assert!((reference.mean_mm - 30.0).abs() < 1e-9, "{reference:?}");
            assert_eq!(reference.worst_mid_hip_mm, None);
            assert_eq!(reference.points_mm.keys().collect::<Vec<_>>(), ["right_hip"]);
        }
        // Rows at 100 Hz from 10 s on, frames at 50 Hz: frame 500 is row 0.
        let reference = compared(100.0, 1000.0, 50.0, &[499.0, 500.5, 502.0]);
        assert_eq!(reference.frames, 2);
        assert!((reference.mean_mm - 35.0).abs() < 1e-9, "{reference:?}");
    }

    #[test]
    fn trajectories_of_another_system_are_fitted() {
        // A walk of wobbling points at 60 Hz, and the same at 200 Hz in another world, 1.234 s later.
        let point = |seconds: f64, index: usize| {
            let swing = 0.3 * (4.0 * seconds + index as f64).sin() + 0.1 * (7.0 * seconds).cos();
            let (y, z) = (0.1 * index as f64, 0.2 * (index as f64).cos() + 0.5 * swing);
            Vector3::new(seconds + swing, y, z)
        };
        let rotation = so3::exp(&Vector3::new(0.4, -2.0, 0.3));
        let translation = Vector3::new(3.0, -1.0, 0.5);
        let row = |row: i32| {
            let at = |index| point(f64::from(row) / 200.0 - 1.234, index);
            let place = |index| Some(rotation.transpose() * (at(index) - translation));
            (0..COMPARED.len()).map(place).collect()
        };
        let names = COMPARED.map(|point| point.to_string());
        let reference = trajectories(200.0, 0.0, &names, (0..1000).map(row).collect());
        let body = |frame: i32| {
            let at = |index| Some(point(f64::from(frame) / 60.0, index));
            (f64::from(frame), std::array::from_fn(at))
        };
        let bodies: Vec<(f64, MarkerPositions)> = (0..150).map(body).collect();
        let mut comparison = ReferenceComparison::new(&reference);
        assert!(comparison.fit(60.0, &bodies));
        let fit = comparison.fit.unwrap();
        assert!((fit.shift_s - 1.234).abs() < 1e-4, "{fit:?}");
        assert!((fit.rotation - rotation).norm() < 1e-3, "{fit:?}");
        assert!((fit.translation_m - translation).norm() < 2e-3, "{fit:?}");
        // Without common frames there is no fit.
        assert!(!ReferenceComparison::new(&reference).fit(60.0, &[]));
        let empty = trajectories(200.0, 0.0, &names, Vec::new());
        assert!(!ReferenceComparison::new(&empty).fit(60.0, &bodies));
    }
}
