//! Poses as BVH, which knows no times: frames lie one period apart, so gaps must be filled.

use std::path::Path;

use super::kept::KeptPose;
use crate::cli::failure::Failure;
use crate::cli::terminal::complain;
use crate::core::body::Skeleton;
use crate::io::formats::bvh::BvhWriter;

/// Most time that is filled in a file, seconds.
const MOST_FILL_S: f64 = 600.0;
/// Most frames that are filled in a file: that time at the highest frame rate.
const MOST_FILL: f64 = 600_000.0;

/// Writes poses, which are in order of capture time, as BVH; the number of frames. See [`fill`].
pub(crate) fn write(
    path: &Path,
    poses: &[KeptPose],
    skeleton: &Skeleton,
    fps: f64,
) -> Result<usize, Failure> {
    let mut writer = BvhWriter::create(path, skeleton, fps)?;
    let frames = fill(path, poses, fps, |pose| Ok(writer.write(&pose.pose())?))?;
    writer.finish()?;
    Ok(frames)
}

/// Gives poses, which are in order of capture time, to `write` one period apart; the number of
/// frames. Over a gap the last pose before it is repeated, for ten minutes in all; a note on
/// standard error, which names `path`, says when that was not enough.
pub(crate) fn fill(
    path: &Path,
    poses: &[KeptPose],
    fps: f64,
    mut write: impl FnMut(&KeptPose) -> Result<(), Failure>,
) -> Result<usize, Failure> {
    let (repeats, missing) = repeats(poses.iter().map(|pose| pose.capture.ns()), fps);
    let mut frames = 0;
    for (pose, times) in poses.iter().zip(repeats) {
        for _ in 0..=times {
            write(pose)?;
        }
        frames += 1 + times;
    }
    if missing > 0.0 {
        let seconds = missing / fps;
        let text = format!(
            "{}: gaps of more than 10 minutes in all are not filled; the end is {seconds:.1} s \
             early",
            path.display()
        );
        complain("note", &text);
    }
    Ok(frames)
}

/// How often each pose is to be repeated so that the next comes at its time, from the capture
/// times in nanoseconds; and how many frames of gaps are left when the limit is reached. A gap
/// is more than 1.5 periods.
fn repeats(captures: impl Iterator<Item = i64>, fps: f64) -> (Vec<usize>, f64) {
    let (mut left, mut missing) = ((MOST_FILL_S * fps).min(MOST_FILL).floor(), 0.0);
    let mut before: Option<i64> = None;
    let mut repeats = Vec::new();
    for capture in captures {
        if let Some(before) = before {
            let periods = (capture as f64 - before as f64) * 1e-9 * fps;
            let wanted = if periods > 1.5 { periods.round() - 1.0 } else { 0.0 };
            let filled = wanted.min(left);
            left -= filled;
            missing += wanted - filled;
            repeats.push(filled as usize);
        }
        before = Some(capture);
    }
    repeats.extend(before.map(|_| 0));
    (repeats, missing)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Nanoseconds of frames at 50 Hz.
    fn at_50(frames: &[f64]) -> (Vec<usize>, f64) {
        repeats(frames.iter().map(|frame| (frame * 2e7) as i64), 50.0)
    }

    #[test]
    fn poses_before_a_gap_are_repeated() {
        assert_eq!(at_50(&[]), (vec![], 0.0));
        assert_eq!(at_50(&[7.0]), (vec![0], 0.0));
        assert_eq!(at_50(&[0.0, 1.0, 2.4, 3.3]), (vec![0; 4], 0.0));
        assert_eq!(at_50(&[0.0, 1.0, 5.0, 6.0, 8.0]), (vec![0, 3, 0, 1, 0], 0.0));
    }

    #[test]
    fn ten_minutes_are_filled_and_no_more() {
        let (filled, missing) = at_50(&[0.0, 30_000.0, 30_011.0, 30_013.0]);
        assert_eq!((filled, missing), (vec![29_999, 1, 0, 0], 10.0));
        let (filled, missing) = repeats([0, i64::MAX].into_iter(), 1e9);
        assert_eq!(filled, [600_000, 0]);
        assert!(missing > 9e18);
    }

    #[test]
    fn a_file_has_as_many_frames_as_time_has_passed() {
        use crate::core::body::{Pose, StampedPose, TrackingState};
        use crate::core::time::Timestamp;
        let poses = [0, 1, 2, 6, 7].map(|frame| {
            let (pose, state) = (Pose::rest(), TrackingState::Tracking);
            let capture = Timestamp::from_ns(frame * 20_000_000);
            let (window, rig_version, provisional, revision) = (0, 1, false, 0);
            let stamped =
                StampedPose { capture, pose, state, window, rig_version, provisional, revision };
            KeptPose::from(&stamped)
        });
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gap.bvh");
        assert_eq!(write(&path, &poses, &Skeleton::default(), 50.0).unwrap(), 8);
        let text = std::fs::read_to_string(&path).unwrap();
        let motion = text.lines().skip_while(|line| !line.starts_with("Frame Time"));
        assert_eq!(motion.count(), 1 + 8);
    }
}
