//! Distance from a reference: marker positions of another tool for the same recording.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Vector3};
use serde::{Serialize, Serializer};

use super::hold_out::Located;
use crate::core::detections::Detections;
use crate::core::time::Timestamp;
use crate::io::formats::Trajectories;
use crate::metrics::{COMPARED, MarkerDistances, MarkerPositions};

/// The clock of a recording's frame numbers, from the capture time of one frame.
#[derive(Clone, Copy, Debug)]
pub struct FrameClock {
    /// A frame number.
    pub frame: u64,
    /// The capture time of that frame.
    pub capture: Timestamp,
}

impl FrameClock {
    /// The clock of `detections`.
    pub fn of(detections: &Detections) -> Self {
        Self { frame: detections.frame, capture: detections.capture }
    }

    /// The frame number at a time at `fps`, with its fraction.
    fn frame_at(self, capture: Timestamp, fps: f64) -> f64 {
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
    /// The frame of the recording with that largest distance, at the rate of the reference.
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
    /// Rows that are added to the recording's frame numbers, at the rate of the trajectories.
    pub rows: f64,
    /// Rotation of their places, by rows of the matrix; then `way` is added.
    #[serde(serialize_with = "rows")]
    pub turn: Matrix3<f64>,
    /// Metres.
    #[serde(serialize_with = "metres")]
    pub way: Vector3<f64>,
}

impl Default for ReferenceFit {
    fn default() -> Self {
        Self { rows: 0.0, turn: Matrix3::identity(), way: Vector3::zeros() }
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
        let count = pairs.len() as f64;
        let mean = |of: fn(&(Vector3<f64>, Vector3<f64>)) -> Vector3<f64>| {
            pairs.iter().map(of).sum::<Vector3<f64>>() / count
        };
        let (to, from) = (mean(|pair| pair.0), mean(|pair| pair.1));
        let both: Matrix3<f64> = pairs.iter().map(|(a, b)| (a - to) * (b - from).transpose()).sum();
        let svd = both.svd(true, true);
        let (u, v) = (svd.u?, svd.v_t?);
        let sign = Vector3::new(1.0, 1.0, (u * v).determinant().signum());
        let turn = u * Matrix3::from_diagonal(&sign) * v;
        (pairs.len() > 2).then(|| Self { rows: 0.0, turn, way: to - turn * from })
    }

    fn of_place(&self, at: &Vector3<f64>) -> Vector3<f64> {
        self.turn * at + self.way
    }
}

/// Above this mean distance a reference is hardly of the recording, millimetres.
const UNFIT_MM: f64 = 250.0;
/// Number of bodies by which trajectories are fitted.
const SAMPLED: usize = 200;

impl Reference {
    /// A note if a reference obviously does not fit; `None` is one without a row in the recording.
    pub fn note(found: Option<&Self>) -> Option<String> {
        let reason = match found {
            None => "no row has the time of a pose".to_owned(),
            Some(found) if found.mean_mm > UNFIT_MM => {
                format!("it is {:.0} mm from the poses on average", found.mean_mm)
            }
            Some(_) => return None,
        };
        Some(format!(
            "the reference does not fit: {reason}; is it of this recording, in metres and y up, with \
             the same frame numbers?"
        ))
    }
}

/// Compares poses with marker trajectories in a stream.
///
/// Row i of the trajectories is frame `first_frame` + i of the recording, at the rate of the trajectories. Between rows
/// the markers are interpolated.
pub struct ReferenceComparison<'a> {
    reference: &'a Trajectories,
    columns: [Option<usize>; COMPARED.len()],
    fit: ReferenceFit,
    distances: MarkerDistances,
}

impl<'a> ReferenceComparison<'a> {
    /// A comparison with trajectories in the recording's world and time.
    pub fn new(reference: &'a Trajectories) -> Self {
        let columns = COMPARED.map(|keypoint| reference.column_of(keypoint));
        let (fit, distances) = (ReferenceFit::default(), MarkerDistances::default());
        Self { reference, columns, fit, distances }
    }

    /// Shifts the trajectories in time, and turns and moves them, to where they are nearest to the bodies: they are of
    /// another system. No shift is tried that leaves more than half of the bodies without markers. Nothing changes if
    /// there is no fit.
    pub fn fit(&mut self, clock: FrameClock, bodies: &[(Timestamp, MarkerPositions)]) {
        let sampled: Vec<_> =
            bodies.iter().step_by(bodies.len().div_ceil(SAMPLED).max(1)).collect();
        let mut best = (f64::INFINITY, ReferenceFit::default());
        let attempt = |rows: f64, best: &mut (f64, ReferenceFit)| {
            let (mut pairs, mut seen) = (Vec::new(), 0);
            for (capture, body) in &sampled {
                let Some(markers) = self.at(clock, *capture, rows) else { continue };
                let known = pairs.len();
                pairs.extend(body.iter().zip(&markers).filter_map(|(a, b)| (*a).zip(*b)));
                seen += usize::from(pairs.len() > known);
            }
            let Some(fit) = ReferenceFit::of(&pairs).filter(|_| 2 * seen > sampled.len()) else {
                return;
            };
            let mean = pairs.iter().map(|(a, b)| (a - fit.of_place(b)).norm()).sum::<f64>()
                / pairs.len() as f64;
            if mean < best.0 {
                *best = (mean, ReferenceFit { rows, ..fit });
            }
        };
        let frames = |at: &(Timestamp, MarkerPositions)| {
            clock.frame_at(at.0, self.reference.frame_rate) - self.reference.first_frame as f64
        };
        let (Some(first), Some(last)) = (bodies.first().map(frames), bodies.last().map(frames))
        else {
            return;
        };
        // Whole rows, then tenths and hundredths of one.
        let (least, most) = (-last.ceil() as i64, self.reference.rows.len() as i64 - first as i64);
        (least..=most).for_each(|rows| attempt(rows as f64, &mut best));
        for step in [0.1, 0.01] {
            let around = best.1.rows;
            (-10..=10).for_each(|steps| attempt(around + step * f64::from(steps), &mut best));
        }
        self.fit = best.1;
    }

    /// Adds the next body (`None` if it cannot be used).
    pub fn add(&mut self, clock: FrameClock, capture: Timestamp, body: Option<&impl Located>) {
        let Some(body) = body else { return };
        let Some(markers) = self.at(clock, capture, self.fit.rows) else { return };
        let markers = markers.map(|at| at.map(|at| self.fit.of_place(&at)));
        let frame = clock.frame_at(capture, self.reference.frame_rate).round().max(0.0) as u64;
        self.distances.add(frame, &positions(body), &markers);
    }

    /// The markers at a time, where they are in the file, so many rows later.
    fn at(&self, clock: FrameClock, capture: Timestamp, rows: f64) -> Option<MarkerPositions> {
        let frame = clock.frame_at(capture, self.reference.frame_rate) + rows;
        let points = self.reference.at(frame - self.reference.first_frame as f64)?;
        Some(self.columns.map(|column| points.get(column?).copied().flatten()))
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
                .map(|(point, mm)| (point.to_string(), mm))
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
    use crate::core::time::Nanos;
    use crate::io::formats::Row;

    const CLOCK: FrameClock = FrameClock { frame: 7, capture: Timestamp::from_ns(100_000_000) };

    fn trajectories(rate: f64, first_frame: u64, names: &[&str], rows: Vec<Row>) -> Trajectories {
        let names = names.iter().map(|name| (*name).to_owned()).collect();
        Trajectories { frame_rate: rate, first_frame, names, rows }
    }

    #[test]
    fn rows_are_compared_with_the_pose_of_their_time() {
        let skeleton = Skeleton::default();
        let at = |x: f64| {
            let mut pose = Pose::rest();
            pose.root_position.x = x;
            pose.posture(&skeleton)
        };
        let row = |x: Option<f64>| {
            let hip = x.and_then(|x| positions(&(&skeleton, &at(x)))[7]);
            Row { number: 1, points: vec![hip] }
        };
        assert_eq!(COMPARED[7], Keypoint::RHip);
        // Rows of frames 6 to 10; frame 7 is captured at 100 ms, at 100 Hz.
        let rows = [Some(0.0), Some(0.01), None, Some(0.04), Some(0.06)].map(row).into();
        let reference = trajectories(100.0, 6, &["RHip"], rows);
        let mut comparison = ReferenceComparison::new(&reference);
        assert_eq!(comparison.finish(), None);
        for (ms, usable) in [(100, true), (110, true), (125, true), (130, false), (200, true)] {
            let posture = at(0.0);
            let capture = Timestamp::from_ns(ms * 1_000_000);
            comparison.add(CLOCK, capture, usable.then_some(&(&skeleton, &posture)));
        }
        let reference = comparison.finish().unwrap();
        // Frame 8 has no marker, and 200 ms no row. Between frames 9 and 10 the marker is halfway.
        assert_eq!(reference.frames, 2);
        assert!((reference.mean_mm - 30.0).abs() < 1e-9, "{reference:?}");
        assert_eq!(reference.worst_mid_hip_mm, None);
        assert_eq!(reference.points_mm.keys().collect::<Vec<_>>(), ["RHip"]);
    }

    #[test]
    fn trajectories_of_another_system_are_fitted() {
        // A walk of wobbling points at 60 Hz, and the same at 200 Hz in another world, 1.234 s later.
        let point = |seconds: f64, index: usize| {
            let swing = 0.3 * (4.0 * seconds + index as f64).sin() + 0.1 * (7.0 * seconds).cos();
            Vector3::new(
                seconds + swing,
                0.1 * index as f64,
                0.2 * (index as f64).cos() + swing * 0.5,
            )
        };
        let turn = so3::exp(&Vector3::new(0.4, -2.0, 0.3));
        let way = Vector3::new(3.0, -1.0, 0.5);
        let row = |row: i64| Row {
            number: row,
            points: (0..COMPARED.len())
                .map(|index| {
                    let at = point(row as f64 / 200.0 - 1.234, index);
                    Some(turn.transpose() * (at - way))
                })
                .collect(),
        };
        let names: Vec<String> = COMPARED.iter().map(|point| point.to_string()).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let reference = trajectories(200.0, 0, &names, (0..1000).map(row).collect());
        let clock = FrameClock { frame: 0, capture: Timestamp::from_ns(0) };
        let bodies: Vec<(Timestamp, MarkerPositions)> = (0..150)
            .map(|frame| {
                let capture = clock.capture + Nanos::of_frames(frame, 60.0);
                let body = |index| Some(point(frame as f64 / 60.0, index));
                (capture, std::array::from_fn(body))
            })
            .collect();
        let mut comparison = ReferenceComparison::new(&reference);
        comparison.fit(clock, &bodies);
        let fit = comparison.fit.clone();
        assert!((fit.rows - 246.8).abs() < 0.02, "{fit:?}");
        assert!((fit.turn - turn).norm() < 1e-3 && (fit.way - way).norm() < 2e-3, "{fit:?}");
        // Without common frames nothing is moved.
        let mut none = ReferenceComparison::new(&reference);
        none.fit(clock, &[]);
        assert_eq!(none.fit, ReferenceFit::default());
    }
}
