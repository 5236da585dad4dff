//! Points that are seen and not followed.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::core::detections::Keypoint;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{Residual, Unfollowed, Verdict, WindowReport};

/// An episode ends if its point is followed for longer than this time, and than this many frame periods.
const BREAK: Nanos = Nanos::from_ms(60);
const BREAK_FRAMES: f64 = 1.5;
/// Number of the longest episodes that are kept.
const KEPT: usize = 5;

/// Points on which the views agree and from which the body is more than 10 cm away ([`Unfollowed`]), in
/// windows that are tracked.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct NotFollowed {
    /// Share of the points that two views see, percent.
    pub percent: f64,
    /// Number of episodes: one point, frame after frame.
    pub episodes: usize,
    /// Number of frames of the longest one.
    pub longest_frames: usize,
    /// The longest ones, the longest first.
    pub longest: Vec<Episode>,
}

/// A point that is seen and not followed for a while.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Episode {
    /// As `left ankle`.
    pub keypoint: String,
    /// Capture time of the first frame, nanoseconds.
    pub capture_time_ns: i64,
    /// Number of frames.
    pub frames: usize,
    /// The largest distance of the body's point from where the views see it, metres.
    pub distance_m: f64,
}

/// An episode that may go on.
#[derive(Clone, Copy, Debug)]
struct Open {
    first: Unfollowed,
    last: Timestamp,
    frames: usize,
    distance_m: f64,
}

/// The points of a motion so far.
#[derive(Clone, Debug, Default)]
pub struct FollowedSums {
    seen: usize,
    unfollowed: usize,
    episodes: usize,
    open: BTreeMap<Keypoint, Open>,
    longest: Vec<Open>,
}

impl FollowedSums {
    /// Adds a window. Windows that are not tracked do not count.
    pub fn add(&mut self, report: &WindowReport) {
        if report.verdict != Verdict::Tracked {
            return;
        }
        let place = |residual: &Residual| (residual.capture, residual.point);
        let points = report.residuals.chunk_by(|a, b| place(a) == place(b));
        self.seen += points.filter(|views| views.len() > 1).count();
        let frames = report.residuals.chunk_by(|a, b| a.capture == b.capture).count();
        let ends = report.residuals.first().zip(report.residuals.last());
        let seconds = ends.map_or(0.0, |(a, b)| b.capture.seconds_since(a.capture));
        let period = seconds / frames.saturating_sub(1).max(1) as f64;
        let longest = BREAK.max(Nanos::rounded(BREAK_FRAMES * period * 1e9));
        self.unfollowed += report.unfollowed.len();
        for found in &report.unfollowed {
            let before = self.open.remove(&found.keypoint);
            let is_next = |open: &Open| found.capture - open.last <= longest;
            let episode = match before.filter(is_next) {
                Some(open) => Open {
                    last: found.capture,
                    frames: open.frames + 1,
                    distance_m: open.distance_m.max(found.distance_m),
                    ..open
                },
                None => {
                    self.episodes += 1;
                    before.into_iter().for_each(|ended| self.keep(ended));
                    let (last, distance_m) = (found.capture, found.distance_m);
                    Open { first: *found, last, frames: 1, distance_m }
                }
            };
            self.open.insert(found.keypoint, episode);
        }
    }

    fn keep(&mut self, ended: Open) {
        self.longest.push(ended);
        self.longest.sort_by_key(|one| (std::cmp::Reverse(one.frames), one.first.capture));
        self.longest.truncate(KEPT);
    }

    /// The result; `None` if no point was seen by two views.
    pub fn finish(mut self) -> Option<NotFollowed> {
        for ended in std::mem::take(&mut self.open).into_values() {
            self.keep(ended);
        }
        let episode = |one: &Open| Episode {
            keypoint: one.first.keypoint.to_string(),
            capture_time_ns: one.first.capture.ns(),
            frames: one.frames,
            distance_m: one.distance_m,
        };
        (self.seen > 0).then(|| NotFollowed {
            percent: 100.0 * self.unfollowed as f64 / self.seen as f64,
            episodes: self.episodes,
            longest_frames: self.longest.first().map_or(0, |one| one.frames),
            longest: self.longest.iter().map(episode).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(frames: std::ops::Range<u64>, unfollowed: impl Fn(u64) -> bool) -> WindowReport {
        report_at(50.0, frames, unfollowed)
    }

    fn report_at(
        fps: f64,
        frames: std::ops::Range<u64>,
        unfollowed: impl Fn(u64) -> bool,
    ) -> WindowReport {
        let at = |frame| Timestamp::of_frame(frame, fps);
        let residual = |frame, camera| Residual {
            capture: at(frame),
            camera,
            point: 7,
            way_px: nalgebra::Vector2::new(1.0, 0.0),
            error_relative: 0.01,
            confidence: 1.0,
        };
        let lost = frames.clone().filter(|frame| unfollowed(*frame));
        let lost = lost.map(|f| Unfollowed {
            capture: at(f),
            keypoint: Keypoint::LElbow,
            distance_m: 0.1 * f as f64,
        });
        WindowReport {
            window: 0,
            start: at(frames.start),
            end: at(frames.end),
            summary: None,
            latent_norm: 0.0,
            residuals: frames.flat_map(|f| [residual(f, 0), residual(f, 1)]).collect(),
            unfollowed: lost.collect(),
            verdict: Verdict::Tracked,
        }
    }

    #[test]
    fn episodes_go_on_over_windows_and_short_breaks() {
        let mut sums = FollowedSums::default();
        let is_lost = |frame| matches!(frame, 8..=9 | 11 | 20..=24);
        (0..5).for_each(|k| sums.add(&report(5 * k..5 * k + 5, is_lost)));
        let found = sums.finish().unwrap();
        assert_eq!((found.percent, found.episodes, found.longest_frames), (32.0, 2, 5));
        let [first, second] = &found.longest[..] else { panic!("{found:?}") };
        assert_eq!((first.keypoint.as_str(), first.capture_time_ns), ("left elbow", 400_000_000));
        assert_eq!((second.frames, second.capture_time_ns), (3, 160_000_000));
        assert!((first.distance_m - 2.4).abs() < 1e-9);
    }

    #[test]
    fn episodes_of_slow_cameras_go_on_from_frame_to_frame() {
        let mut sums = FollowedSums::default();
        let is_lost = |frame| matches!(frame, 3..=12 | 20);
        (0..5).for_each(|k| sums.add(&report_at(10.0, 5 * k..5 * k + 5, is_lost)));
        let found = sums.finish().unwrap();
        assert_eq!((found.episodes, found.longest_frames), (2, 10));
    }

    #[test]
    fn nothing_is_said_where_nothing_is_seen() {
        assert_eq!(FollowedSums::default().finish(), None);
    }
}
