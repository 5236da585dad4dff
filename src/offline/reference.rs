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
    /// Seconds that are added to the time of a pose.
    pub seconds: f64,
    /// Rotation of their places, by rows of the matrix; then `way` is added.
    #[serde(serialize_with = "rows")]
    pub turn: Matrix3<f64>,
    /// Metres.
    #[serde(serialize_with = "metres")]
    pub way: Vector3<f64>,
}

impl Default for ReferenceFit {
    fn default() -> Self {
        Self { seconds: 0.0, turn: Matrix3::identity(), way: Vector3::zeros() }
    }
}

fn rows<S: Serializer>(turn: &Matrix3<f64>, to: S) -> Result<S::Ok, S::Error> {
    to.collect_seq(<[[f64; 3]; 3]>::from(turn.transpose()))
}

fn metres<S: Serializer>(way: &Vector3<f64>, to: S) -> Result<S::Ok, S::Error> {
    to.collect_seq(way)
}

impl ReferenceFit {
    /// The rotation and translation that take the second places to the first ones, by least squares; `None` for fewer
    /// than three.
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
        let turn = u * Matrix3::from_diagonal(&sign) * v;
        Some(Self { seconds: 0.0, turn, way: to - turn * from })
    }

    fn of_place(&self, at: &Vector3<f64>) -> Vector3<f64> {
        self.turn * at + self.way
    }
}

/// Above this mean distance a reference is hardly of the recording, millimetres.
const UNFIT_MM: f64 = 250.0;
/// Number of bodies by which trajectories are fitted.
const SAMPLED: usize = 200;
/// The first steps of the search for the time of trajectories are not shorter, seconds.
const STEP_S: f64 = 0.015;
/// Rates that differ by less than this part are the same: one of them is nominal.
const SAME_RATE: f64 = 0.01;
/// A pose this part of a row before the first row or after the last one is compared with it.
const NEAR: f64 = 0.25;

impl Reference {
    /// A note if a reference obviously does not fit; `None` is one without a row in the recording, or, if it was
    /// `aligned`, one that could not be.
    pub fn note(found: Option<&Self>, aligned: bool) -> Option<String> {
        let reason = match found {
            None if aligned => {
                "at no shift half of the poses have three markers or more".to_owned()
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
    rate: f64,
    first: f64,
    /// The compared points.
    rows: Vec<MarkerPositions>,
    fit: ReferenceFit,
    distances: MarkerDistances,
}

impl ReferenceComparison {
    /// A comparison with trajectories in the recording's world and time.
    pub fn new(reference: &Trajectories) -> Self {
        let columns = COMPARED.map(|keypoint| reference.column_of(keypoint));
        let row = |row: &Vec<_>| columns.map(|column| row.get(column?).copied().flatten());
        Self {
            rate: reference.frame_rate,
            first: reference.first_frame,
            rows: reference.rows.iter().map(row).collect(),
            fit: ReferenceFit::default(),
            distances: MarkerDistances::default(),
        }
    }

    /// Shifts the trajectories in time, and turns and moves them, to where they are nearest to the bodies: they are of
    /// another system. `bodies` are in order, with their frame numbers at `fps`, and should move. No shift is tried that
    /// leaves half of them without markers. Returns whether there is a fit.
    pub fn fit(&mut self, fps: f64, bodies: &[(f64, MarkerPositions)]) -> bool {
        let every = bodies.len().div_ceil(SAMPLED).max(1);
        let sampled: Vec<_> = bodies.iter().step_by(every).collect();
        let sampled: Vec<_> =
            sampled.iter().map(|(frame, at)| (self.row_of(*frame, fps), at)).collect();
        let (Some((first, _)), Some((last, _))) = (sampled.first(), sampled.last()) else {
            return false;
        };
        let mut best = (f64::INFINITY, 0.0, None);
        let mut attempt = |shift: f64| {
            let (mut pairs, mut seen) = (Vec::new(), 0);
            for (row, body) in &sampled {
                let Some(markers) = self.at(row + shift) else { continue };
                let known = pairs.len();
                pairs.extend(body.iter().zip(&markers).filter_map(|(a, b)| (*a).zip(*b)));
                seen += usize::from(pairs.len() > known);
            }
            let found = ReferenceFit::of(&pairs).filter(|_| 2 * seen > sampled.len());
            if let Some(fit) = found {
                let distances = pairs.iter().map(|(a, b)| (a - fit.of_place(b)).norm());
                let mean = distances.sum::<f64>() / pairs.len() as f64;
                if mean < best.0 {
                    best = (mean, shift, Some(fit));
                }
            }
            best.1
        };
        let step = (STEP_S * self.rate).floor().max(1.0);
        // At these shifts half of the bodies are outside.
        let middle = (first + last) / 2.0;
        let count = (self.rows.len() as f64 / step).ceil() as usize;
        (0..=count).for_each(|k| _ = attempt(step * k as f64 - middle));
        for part in [0.1, 0.01, 0.001] {
            let around = attempt(0.0);
            (-10..=10).for_each(|k| _ = attempt(around + step * part * f64::from(k)));
        }
        let (_, shift, fit) = best;
        let Some(fit) = fit else { return false };
        self.fit = ReferenceFit { seconds: shift / self.rate, ..fit };
        true
    }

    /// Adds the body in a frame of the recording, at its rate.
    pub fn add(&mut self, frame: f64, fps: f64, body: &impl Located) {
        let row = self.row_of(frame, fps) + self.fit.seconds * self.rate;
        let Some(markers) = self.at(row) else { return };
        let markers = markers.map(|at| at.map(|at| self.fit.of_place(&at)));
        self.distances.add(frame.round().max(0.0) as u64, &positions(body), &markers);
    }

    /// The row of a frame.
    fn row_of(&self, frame: f64, fps: f64) -> f64 {
        let ratio = self.rate / fps;
        let ratio = if (ratio - 1.0).abs() < SAME_RATE { 1.0 } else { ratio };
        frame * ratio - self.first
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
            fit: (self.fit != ReferenceFit::default()).then(|| self.fit.clone()),
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
        let turn = so3::exp(&Vector3::new(0.4, -2.0, 0.3));
        let way = Vector3::new(3.0, -1.0, 0.5);
        let row = |row: i32| {
            let at = |index| point(f64::from(row) / 200.0 - 1.234, index);
            let place = |index| Some(turn.transpose() * (at(index) - way));
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
        let fit = &comparison.fit;
        assert!((fit.seconds - 1.234).abs() < 1e-4, "{fit:?}");
        assert!((fit.turn - turn).norm() < 1e-3 && (fit.way - way).norm() < 2e-3, "{fit:?}");
        // Without common frames there is no fit.
        assert!(!ReferenceComparison::new(&reference).fit(60.0, &[]));
        let empty = trajectories(200.0, 0.0, &names, Vec::new());
        assert!(!ReferenceComparison::new(&empty).fit(60.0, &bodies));
    }
}
