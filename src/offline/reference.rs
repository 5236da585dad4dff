//! Distance from a reference: marker positions of another tool for the same recording.

use serde::Serialize;

use super::hold_out::Located;
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};
use crate::io::formats::Trc;
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

    /// The capture time of frame number `frame` at `fps`.
    fn time_of(self, frame: u64, fps: f64) -> Timestamp {
        let frames = frame as f64 - self.frame as f64;
        self.capture + Nanos::rounded(frames * 1e9 / fps)
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
}

/// Above this mean distance a reference is hardly of the recording, millimetres.
const UNFIT_MM: f64 = 250.0;

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

/// Compares poses with a TRC file in a stream, in order of capture time.
///
/// Row i of the file is frame OrigDataStartFrame + i of the recording; the file's own Frame# is
/// ignored, since tools start it at 1. A row is compared with the first pose within a quarter of
/// the file's frame period.
pub struct ReferenceComparison<'a> {
    trc: &'a Trc,
    columns: [Option<usize>; COMPARED.len()],
    /// The next row.
    row: usize,
    distances: MarkerDistances,
}

impl<'a> ReferenceComparison<'a> {
    /// A comparison with a file.
    pub fn new(trc: &'a Trc) -> Self {
        let columns = COMPARED.map(|keypoint| trc.column_of(keypoint));
        Self { trc, columns, row: 0, distances: MarkerDistances::default() }
    }

    /// Adds the next body (`None` if it cannot be used).
    pub fn add(&mut self, clock: FrameClock, capture: Timestamp, body: Option<&impl Located>) {
        let tolerance = Nanos::new((0.25e9 / self.trc.frame_rate) as i64);
        let mut estimate = None;
        while self.row < self.trc.rows.len() {
            let frame = self.trc.first_frame + self.row as u64;
            let at = clock.time_of(frame, self.trc.frame_rate);
            if capture + tolerance < at {
                return;
            }
            if capture - at <= tolerance
                && let Some(body) = body
            {
                let estimate = estimate.get_or_insert_with(|| positions(body));
                self.distances.add(frame, estimate, &self.reference());
            }
            self.row += 1;
        }
    }

    fn reference(&self) -> MarkerPositions {
        let points = &self.trc.rows[self.row].points;
        self.columns.map(|column| points.get(column?).copied().flatten())
    }

    /// The distances; `None` if no row of the reference has a pose.
    pub fn finish(&self) -> Option<Reference> {
        let distance = self.distances.finish()?;
        Some(Reference {
            frames: distance.frames,
            mean_mm: distance.mean_mm,
            worst_mid_hip_mm: distance.worst_mid_hip.map(|(_, mm)| mm),
            worst_mid_hip_frame: distance.worst_mid_hip.map(|(frame, _)| frame),
        })
    }
}

fn positions(body: &impl Located) -> MarkerPositions {
    COMPARED.map(|keypoint| body.keypoint(keypoint))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Pose, Skeleton};
    use crate::core::detections::Keypoint;
    use crate::io::formats::trc::TrcRow;

    #[test]
    fn rows_are_compared_with_the_pose_of_their_frame() {
        let skeleton = Skeleton::default();
        let at = |x: f64| {
            let mut pose = Pose::rest();
            pose.root_position.x = x;
            pose.posture(&skeleton)
        };
        let row = |x: Option<f64>| {
            let hip = x.and_then(|x| positions(&(&skeleton, &at(x)))[7]);
            TrcRow { number: 1, seconds: 0.0, points: vec![hip] }
        };
        assert_eq!(COMPARED[7], Keypoint::RHip);
        // Rows of frames 6 to 9; frame 7 is captured at 100 ms, at 100 Hz.
        let rows = vec![row(Some(0.0)), row(Some(0.01)), row(None), row(Some(0.04))];
        let trc = Trc { frame_rate: 100.0, first_frame: 6, names: vec!["RHip".into()], rows };
        let clock = FrameClock { frame: 7, capture: Timestamp::from_ns(100_000_000) };
        let mut comparison = ReferenceComparison::new(&trc);
        assert_eq!(comparison.finish(), None);
        for (ms, usable) in [(101, true), (110, true), (118, true), (200, false)] {
            let posture = at(0.0);
            let capture = Timestamp::from_ns(ms * 1_000_000);
            comparison.add(clock, capture, usable.then_some(&(&skeleton, &posture)));
        }
        let reference = comparison.finish().unwrap();
        // Frame 6 has no pose and frame 8 no marker; frames 7 and 9 are 10 and 40 mm off.
        assert_eq!(reference.frames, 2);
        assert!((reference.mean_mm - 25.0).abs() < 1e-9, "{reference:?}");
        assert_eq!(reference.worst_mid_hip_mm, None);
    }
}
