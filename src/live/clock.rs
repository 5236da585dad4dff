//! Compares the cameras' clock with the node's.
//!
//! The node sees arrivals only. Arrival minus capture time is the offset of the camera's clock plus
//! the time for exposure, detection and transport. The minimum over a second has the least
//! disturbance; a line through the minima of the last 30 s gives offset and drift. A slow detector
//! and a clock offset look the same and cannot be distinguished here.
//!
//! If arrival minus capture time is small, the cameras share the node's clock (PTP, NTP) and
//! poses are due on it. Otherwise the smallest offset of all cameras is used as the difference
//! between the clocks.

use std::collections::VecDeque;
use std::ops::Range;

use crate::core::time::{Nanos, Timestamp};
use crate::metrics::statistics::Line;

/// Number of minima that are kept, one per second.
const KEPT: usize = 30;
/// Number of minima that the line fit needs.
const LINE: usize = 5;
/// Cameras with delays in this range share the node's clock.
const SHARED: Range<Nanos> = Nanos::from_ms(-500)..Nanos::from_ms(2000);
/// A frame that arrives this much too early has a wrong time: the clock has jumped.
const EARLY: Nanos = Nanos::from_ms(-500);
/// A frame that arrives this much too late has a wrong time.
const LATE: Nanos = Nanos::from_ms(5000);
/// Jumps that differ by less than this are the same jump.
const SAME_JUMP: Nanos = Nanos::from_ms(100);
/// A foreign clock is followed by at most this a second, so that poses stay evenly spaced.
const STEP: Nanos = Nanos::new(500_000);
/// Number of consecutive frames that confirm a jump.
const SURE: u32 = 3;

/// Result of the check of a frame's capture time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Arrival {
    /// As expected.
    Usual,
    /// Differs from the camera's earlier frames or from the other cameras by this.
    Jumped(Nanos),
    /// Most cameras have jumped by the same amount: the clock was replaced.
    NewClock,
}

/// Offset and drift of one camera.
#[derive(Clone, Debug, Default)]
struct Camera {
    /// Second of the node's clock and smallest offset in it.
    smallest: VecDeque<(i64, Nanos)>,
    /// A possible jump: its offset, number of frames that support it, time of the last one.
    jump: Option<(Nanos, u32, Timestamp)>,
}

impl Camera {
    fn note(&mut self, now: Timestamp, offset: Nanos) {
        let second = second(now);
        match self.smallest.back_mut() {
            Some((last, smallest)) if *last == second => *smallest = offset.min(*smallest),
            _ => self.smallest.push_back((second, offset)),
        }
        while self.smallest.len() > KEPT {
            self.smallest.pop_front();
        }
    }

    /// Current offset, ns, and drift, parts per million.
    fn line(&self, now: Timestamp) -> Option<(f64, f64)> {
        let &(origin, base) = self.smallest.back()?;
        if self.smallest.len() < LINE {
            let smallest = self.smallest.iter().map(|(_, offset)| *offset).min()?;
            return Some((smallest.ns() as f64, 0.0));
        }
        let points = self
            .smallest
            .iter()
            .map(|&(second, offset)| ((second - origin) as f64 + 0.5, (offset - base).ns() as f64));
        let Line { mean_x, mean_y, slope, .. } = Line::fit(points)?;
        let at = (now.ns() as f64 / 1e9) - origin as f64;
        // ns per second are 1e-9; the drift is in 1e-6.
        Some((base.ns() as f64 + mean_y + slope * (at - mean_x), slope * 1e-3))
    }
}

/// The clocks of all cameras.
#[derive(Clone, Debug)]
pub(super) struct Clock {
    cameras: Vec<Camera>,
    /// Node's clock minus capture clock; `None` before the first frame.
    base: Option<Nanos>,
    is_shared: bool,
    /// Delays of the first frames above the base.
    delays: Vec<Nanos>,
}

/// Number of delays that are kept for a percentile.
const DELAYS: usize = 4096;

impl Clock {
    pub(super) fn new(cameras: usize) -> Self {
        let cameras = vec![Camera::default(); cameras];
        Self { cameras, base: None, is_shared: false, delays: Vec::new() }
    }

    /// Records the arrival of a frame.
    pub(super) fn arrive(&mut self, camera: usize, now: Timestamp, capture: Timestamp) -> Arrival {
        let offset = now - capture;
        if let Some(expected) = self.expected(camera) {
            let by = offset - expected;
            if !(EARLY..LATE).contains(&by) {
                return self.jumped(camera, now, offset, by);
            }
        }
        if let Some(camera) = self.cameras.get_mut(camera) {
            camera.jump = None;
            camera.note(now, offset);
        }
        let base = match self.base {
            Some(base) if self.is_shared => base,
            // First frames of a foreign clock: the fastest of them gives the base.
            Some(base) if self.delays.len() < DELAYS => base.min(offset),
            Some(base) => base,
            None => {
                self.is_shared = SHARED.contains(&offset);
                if self.is_shared { Nanos::ZERO } else { offset }
            }
        };
        self.base = Some(base);
        if self.delays.len() < DELAYS {
            self.delays.push(offset - base);
        }
        Arrival::Usual
    }

    /// The expected offset of a camera's frames: its own, or else that of the other cameras.
    fn expected(&self, camera: usize) -> Option<Nanos> {
        let last = |camera: &Camera| camera.smallest.back().map(|(_, offset)| *offset);
        if let Some(own) = self.cameras.get(camera).and_then(last) {
            return Some(own);
        }
        let mut others: Vec<Nanos> = self.cameras.iter().filter_map(last).collect();
        others.sort_unstable();
        others.get(others.len() / 2).copied()
    }

    fn jumped(&mut self, camera: usize, now: Timestamp, offset: Nanos, by: Nanos) -> Arrival {
        let Some(own) = self.cameras.get_mut(camera) else { return Arrival::Jumped(by) };
        let count = match own.jump {
            Some((before, count, _)) if (before - offset).abs() < SAME_JUMP => count + 1,
            _ => 1,
        };
        own.jump = Some((offset, count, now));
        let recent = |jump: &(Nanos, u32, Timestamp)| now - jump.2 < Nanos::SECOND * 2;
        let jumps = self.cameras.iter().filter_map(|camera| camera.jump).filter(recent);
        let alike = jumps
            .filter(|(other, count, _)| *count >= SURE && (*other - offset).abs() < SAME_JUMP)
            .count();
        let second = second(now);
        let is_active = |camera: &&Camera| {
            let seen = camera.smallest.back().is_some_and(|(last, _)| second - last <= 1);
            seen || camera.jump.as_ref().is_some_and(recent)
        };
        let active = self.cameras.iter().filter(is_active).count();
        if 2 * alike > active {
            *self = Self::new(self.cameras.len());
            return Arrival::NewClock;
        }
        Arrival::Jumped(by)
    }

    /// Whether the capture clock is known: a frame has arrived.
    pub(super) fn is_known(&self) -> bool {
        self.base.is_some()
    }

    /// Converts node time to capture time. They are equal until the first frame.
    pub(super) fn capture_time(&self, node: Timestamp) -> Timestamp {
        node - self.base.unwrap_or_default()
    }

    /// Converts capture time to node time.
    pub(super) fn node_time(&self, capture: Timestamp) -> Timestamp {
        capture + self.base.unwrap_or_default()
    }

    /// 99.9th percentile of the frames' delays so far.
    pub(super) fn delay_p999(&self) -> Nanos {
        let mut sorted = self.delays.clone();
        sorted.sort_unstable();
        let index = (sorted.len() as f64 * 0.999).ceil() as usize;
        sorted.get(index.saturating_sub(1)).copied().unwrap_or_default().max(Nanos::ZERO)
    }

    /// Shortest delay from capture to arrival for the slowest camera.
    pub(super) fn usual_delay(&self) -> Nanos {
        let last = |camera: &Camera| camera.smallest.back().map(|(_, offset)| *offset);
        let slowest = self.cameras.iter().filter_map(last).max();
        let base = self.base.unwrap_or_default();
        slowest.map_or(Nanos::ZERO, |offset| (offset - base).max(Nanos::ZERO))
    }

    /// Offset of a camera's clock from the node's, seconds, and drift, parts per million.
    pub(super) fn offset(&self, camera: usize, now: Timestamp) -> Option<(f64, f64)> {
        let (offset, drift) = self.cameras.get(camera)?.line(now)?;
        Some((offset * 1e-9, drift))
    }

    /// Deviation of each camera's offset from the median of all, seconds.
    pub(super) fn deviations(&self, now: Timestamp) -> Vec<(usize, f64)> {
        let offsets: Vec<(usize, f64)> = (0..self.cameras.len())
            .filter_map(|camera| Some((camera, self.offset(camera, now)?.0)))
            .collect();
        let mut sorted: Vec<f64> = offsets.iter().map(|(_, offset)| *offset).collect();
        sorted.sort_by(f64::total_cmp);
        let Some(median) = sorted.get(sorted.len().saturating_sub(1) / 2) else { return offsets };
        offsets.iter().map(|(camera, offset)| (*camera, offset - median)).collect()
    }

    /// Follows the drift of a foreign clock; called once a second.
    pub(super) fn follow(&mut self, now: Timestamp) {
        if self.is_shared || self.delays.len() < DELAYS {
            return;
        }
        let offsets = (0..self.cameras.len()).filter_map(|c| self.cameras[c].line(now));
        let smallest = offsets.map(|(offset, _)| Nanos::new(offset as i64)).min();
        if let (Some(base), Some(smallest)) = (&mut self.base, smallest) {
            let step = (smallest - *base).clamp(-STEP, STEP);
            *base = *base + step;
        }
    }
}

/// Whole seconds of a time.
fn second(time: Timestamp) -> i64 {
    time.ns().div_euclid(Nanos::SECOND.ns())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_ns(1_700_000_000_000_000_000 + (seconds * 1e9) as i64)
    }

    fn feed(
        clock: &mut Clock,
        camera: usize,
        seconds: std::ops::Range<f64>,
        offset: impl Fn(f64) -> f64,
    ) {
        let frames = ((seconds.end - seconds.start) * 50.0) as usize;
        for i in 0..frames {
            let arrival = seconds.start + i as f64 / 50.0;
            // Every second frame takes 4 ms longer.
            let delay = if i % 2 == 0 { 0.0 } else { 0.004 };
            let capture = at(arrival - offset(arrival) - delay);
            assert_eq!(clock.arrive(camera, at(arrival), capture), Arrival::Usual);
        }
    }

    #[test]
    fn offset_and_drift_are_found_under_jitter() {
        let mut clock = Clock::new(2);
        feed(&mut clock, 0, 0.0..20.0, |t| 0.005 + 100e-6 * t);
        feed(&mut clock, 1, 0.0..20.0, |_| 0.001);
        let (offset, drift) = clock.offset(0, at(20.0)).unwrap();
        assert!((offset - 0.007).abs() < 2e-4, "{offset}");
        assert!((drift - 100.0).abs() < 5.0, "{drift}");
        assert!(clock.offset(1, at(20.0)).unwrap().1.abs() < 5.0);
        assert_eq!(clock.capture_time(at(3.0)), at(3.0), "a shared clock");
    }

    #[test]
    fn a_foreign_epoch_is_bridged() {
        let mut clock = Clock::new(1);
        feed(&mut clock, 0, 0.0..2.0, |t| t + 1e6);
        // The capture clock stands still here; the first offset is used.
        let mut clock = Clock::new(1);
        feed(&mut clock, 0, 0.0..2.0, |_| 1e6);
        let error = clock.node_time(at(1.0 - 1e6)) - at(1.0);
        assert!(error.abs() < Nanos::new(1000), "{error:.4}");
    }

    #[test]
    fn one_camera_that_jumps_is_refused_and_all_together_are_a_new_clock() {
        let mut clock = Clock::new(3);
        for camera in 0..3 {
            feed(&mut clock, camera, 0.0..2.0, |_| 0.0);
        }
        let hour = Nanos::SECOND * 3600;
        for i in 0..10 {
            let now = at(2.0 + 0.02 * f64::from(i));
            assert!(matches!(clock.arrive(0, now, now + hour), Arrival::Jumped(_)));
            assert!(matches!(clock.arrive(0, now, now - hour), Arrival::Jumped(_)));
            assert_eq!(clock.arrive(1, now, now), Arrival::Usual);
        }
        let mut last = Arrival::Usual;
        for i in 0..SURE {
            for camera in 0..2 {
                let now = at(2.2 + 0.02 * f64::from(i));
                last = clock.arrive(camera, now, now + hour);
            }
        }
        assert_eq!(last, Arrival::NewClock);
        let now = at(2.3);
        assert_eq!(clock.arrive(2, now, now + hour), Arrival::Usual);
    }

    #[test]
    fn the_extremes_of_time_do_not_overflow() {
        let mut clock = Clock::new(2);
        for ns in [i64::MIN, i64::MAX, 0] {
            for camera in 0..3 {
                clock.arrive(camera, at(0.0), Timestamp::from_ns(ns));
            }
        }
        clock.deviations(at(1.0));
        clock.follow(at(1.0));
    }
}
