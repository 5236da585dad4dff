//! Poses as BVH. The format has no times: frames are one period apart, so gaps must be filled.

use std::fmt::Write as _;
use std::path::Path;

use super::Error;
use super::compact_pose::CompactPose;
use crate::core::body::Skeleton;
use crate::core::time::Timestamp;
use crate::io::formats::Style;
use crate::io::formats::bvh::BvhWriter;

/// Longest total time that is filled in a file, seconds.
const MOST_FILL_S: f64 = 600.0;
/// Most frames that are filled in a file: that time at the highest frame rate.
const MOST_FILL: f64 = 600_000.0;

/// Largest time shift of a pose in a file, periods.
const MOST_OFF: f64 = 0.75;

/// Computes how often a pose must be repeated, or that it must be left out, so that each frame of a file is at its time.
/// At most ten minutes per file are filled.
#[derive(Clone, Debug)]
pub(crate) struct Fill {
    fps: f64,
    /// The time of the file's first frame.
    start: Option<Timestamp>,
    /// Number of frames before the next one, with those that are missing.
    frames: f64,
    /// Frames that may still be filled.
    left: f64,
    /// Frames that were not filled.
    missing: f64,
}

impl Fill {
    /// For a file of `fps` frames per second.
    pub(crate) fn new(fps: f64) -> Self {
        let left = (MOST_FILL_S * fps).min(MOST_FILL).floor();
        Self { fps, start: None, frames: 0.0, left, missing: 0.0 }
    }

    /// For a file whose gaps have any length.
    #[cfg(feature = "cli")]
    pub(crate) fn without_limit(fps: f64) -> Self {
        Self { left: f64::INFINITY, ..Self::new(fps) }
    }

    /// Starts the file at `start`: the time before the first pose is a gap.
    pub(crate) fn from(mut self, start: Timestamp) -> Self {
        self.start = Some(start);
        self
    }

    /// Number of missing frames before a pose; `None` if there is no place for the pose. Capture times are in order.
    pub(crate) fn gap_before(&mut self, capture: Timestamp) -> Option<usize> {
        let start = *self.start.get_or_insert(capture);
        let off = (capture.ns() as f64 - start.ns() as f64) * 1e-9 * self.fps - self.frames;
        if off < -MOST_OFF {
            return None;
        }
        let wanted = if off > MOST_OFF { off.round() } else { 0.0 };
        let filled = wanted.min(self.left);
        self.left -= filled;
        self.missing += wanted - filled;
        self.frames += wanted + 1.0;
        Some(filled as usize)
    }

    /// A note on the gaps in the file at `path` that were not filled, if there are any.
    pub(crate) fn note(&self, path: &Path) -> Option<String> {
        (self.missing > 0.0).then(|| {
            format!(
                "{}: only 10 minutes of gaps are filled; the file ends {:.1} s early",
                path.display(),
                self.missing / self.fps
            )
        })
    }
}

/// A BVH file that is written pose by pose.
pub(crate) struct BvhFile {
    writer: BvhWriter,
    fill: Fill,
    last: Option<CompactPose>,
    states: States,
}

impl BvhFile {
    /// A file that starts at `start`, or else at the first pose. It repeats the first pose before
    /// that pose's time, and the pose before a gap in the gap.
    pub(crate) fn create(
        path: &Path,
        skeleton: &Skeleton,
        fps: f64,
        start: Option<Timestamp>,
        style: &Style,
    ) -> Result<Self, Error> {
        let fill = Fill::new(fps);
        let fill = match start {
            Some(start) => fill.from(start),
            None => fill,
        };
        let writer = BvhWriter::create(path, skeleton, fps, style)?;
        Ok(Self { writer, fill, last: None, states: States::default() })
    }

    /// Adds a pose, or leaves it out if the file has no place for it. Poses are in order of capture time.
    pub(crate) fn write(&mut self, pose: &CompactPose) -> Result<(), Error> {
        let Some(gap) = self.fill.gap_before(pose.capture) else { return Ok(()) };
        let held = self.last.as_ref().unwrap_or(pose).pose();
        for _ in 0..gap {
            self.writer.write(&held)?;
        }
        self.states.add(gap, HELD);
        self.writer.write(&pose.pose())?;
        self.states.add(1, pose.state.name());
        self.last = Some(pose.clone());
        Ok(())
    }

    /// Completes the file. Returns the states of its frames and the notes.
    pub(crate) fn finish(self, path: &Path) -> Result<(States, Option<String>), Error> {
        self.writer.finish()?;
        Ok((self.states, self.fill.note(path)))
    }
}

/// A frame that repeats another pose.
pub(crate) const HELD: &str = "held";

/// The frames of a BVH file as runs with the same state.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct States {
    /// The number of frames of each run, and their state.
    runs: Vec<(usize, &'static str)>,
}

impl States {
    pub(crate) fn add(&mut self, frames: usize, state: &'static str) {
        match self.runs.last_mut() {
            _ if frames == 0 => {}
            Some((count, last)) if *last == state => *count += frames,
            _ => self.runs.push((frames, state)),
        }
    }

    /// Number of frames of the file.
    #[cfg(any(test, feature = "cli"))]
    pub(crate) fn frames(&self) -> usize {
        self.runs.iter().map(|(frames, _)| frames).sum()
    }

    /// A line for each run: its first and last frame, from 0, and its state.
    pub(crate) fn csv(&self) -> String {
        let mut text = "first_frame,last_frame,state\n".to_owned();
        let mut first = 0;
        for (frames, state) in &self.runs {
            // Writing into a string cannot fail.
            let _ = writeln!(text, "{first},{},{state}", first + frames - 1);
            first += frames;
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::compact_pose::tests::in_state;

    fn gaps(mut fill: Fill, ns: impl IntoIterator<Item = i64>) -> (Vec<usize>, f64) {
        let gaps = ns.into_iter().filter_map(|ns| fill.gap_before(Timestamp::from_ns(ns)));
        (gaps.collect(), fill.missing)
    }

    /// At 50 Hz.
    fn at_50(frames: &[f64]) -> (Vec<usize>, f64) {
        gaps(Fill::new(50.0), frames.iter().map(|frame| (frame * 2e7) as i64))
    }

    #[test]
    fn gaps_are_counted_in_frames() {
        assert_eq!(at_50(&[]), (vec![], 0.0));
        assert_eq!(at_50(&[7.0]), (vec![0], 0.0));
        assert_eq!(at_50(&[0.0, 1.0, 2.4, 3.3]), (vec![0; 4], 0.0));
        assert_eq!(at_50(&[0.0, 1.0, 5.0, 6.0, 8.0]), (vec![0, 0, 3, 0, 1], 0.0));
        // Times do not drift: twice the rate, and tracking that begins anew between two frames.
        assert_eq!(at_50(&[0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]), (vec![0; 4], 0.0));
        assert_eq!(at_50(&[0.0, 1.4, 2.8, 4.2]), (vec![0, 0, 1, 0], 0.0));
        let from = |start: i64| gaps(Fill::new(50.0).from(Timestamp::from_ns(start)), [60_000_000]);
        assert_eq!((from(0), from(60_000_000)), ((vec![3], 0.0), (vec![0], 0.0)));
    }

    #[test]
    fn ten_minutes_are_filled_and_no_more() {
        let (filled, missing) = at_50(&[0.0, 30_000.0, 30_011.0, 30_013.0]);
        assert_eq!((filled, missing), (vec![0, 29_999, 1, 0], 10.0));
        let (filled, missing) = gaps(Fill::new(1e9), [0, i64::MAX]);
        assert_eq!(filled, [0, 600_000]);
        assert!(missing > 9e18);
    }

    #[test]
    fn a_file_starts_with_the_take_and_says_what_its_frames_are() {
        use crate::core::body::TrackingState::{Coasting, Lost, Tracking};
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gap.bvh");
        let start = Some(Timestamp::default());
        let mut file =
            BvhFile::create(&path, &Skeleton::default(), 50.0, start, &Style::default()).unwrap();
        let poses = [(3, Tracking), (4, Tracking), (8, Coasting), (9, Lost), (10, Tracking)];
        for (frame, state) in poses {
            file.write(&in_state(frame * 20_000_000, frame as f64, state)).unwrap();
        }
        let (states, note) = file.finish(&path).unwrap();
        assert_eq!((states.frames(), note), (11, None));
        assert_eq!(
            states.csv(),
            "first_frame,last_frame,state\n0,2,held\n3,4,tracking\n5,7,held\n8,8,coasting\n\
             9,9,lost\n10,10,tracking\n"
        );
        let text = std::fs::read_to_string(&path).unwrap();
        let motion = text.lines().skip_while(|line| !line.starts_with("Frame Time")).skip(1);
        let x: Vec<f64> = motion
            .map(|line| line.split(' ').next().unwrap().parse::<f64>().unwrap() / 100.0)
            .collect();
        assert_eq!(x, [3.0, 3.0, 3.0, 3.0, 4.0, 4.0, 4.0, 4.0, 8.0, 9.0, 10.0]);
    }
}
