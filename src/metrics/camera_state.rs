//! Per camera: counters, frame rate, residuals, and signs of a second publisher.

use std::collections::BTreeMap;

use crate::core::points::median;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{EventKind, Placed, WindowReport};
use crate::io::wire::CameraCounters;

/// This many conflicts in a second between frame numbers and capture times mean two publishers.
const CONFLICTS: u32 = 3;
/// A residual this many times the usual one says nothing of what is usual.
const UNUSUAL: f64 = 1.7;
/// Part of a second's residual in the usual one.
const SECOND: f64 = 0.05;
/// A camera is silent after this time without a frame, and after so many periods of its frames. Cameras that stop together
/// are silent together, at a multiple of this time on the node's clock.
const SILENT: Nanos = Nanos::from_ms(700);
const SILENT_PERIODS: f64 = 3.0;
const TOGETHER: Nanos = Nanos::from_ms(50);
/// A point is near the body within this many times the median distance.
const NEAR: f64 = 3.0;

/// Sets the residuals of the cameras from those of a window. Returns the median of all, pixels.
pub(crate) fn set_residuals(cameras: &mut [CameraState], report: &WindowReport) -> f64 {
    let mut errors: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
    for residual in report.residuals.iter().filter(|residual| residual.error_px().is_finite()) {
        errors.entry(residual.camera).or_default().push(residual.error_px());
    }
    let mut all: Vec<f64> = errors.values().flatten().copied().collect();
    let usual = median(&mut all).unwrap_or(0.0);
    for (camera, mut errors) in errors {
        if let Some(camera) = cameras.get_mut(camera) {
            let near = errors.iter().filter(|error| **error <= NEAR * usual).count();
            camera.counters.near = near as f64 / errors.len() as f64;
            camera.counters.residual_px = median(&mut errors).unwrap_or(0.0);
        }
    }
    usual
}

/// State and counters of one camera.
#[derive(Clone, Debug, Default)]
pub(crate) struct CameraState {
    name: String,
    counters: CameraCounters,
    /// Number, capture time and arrival time of its last frame.
    last: Option<(u64, Timestamp, Timestamp)>,
    /// Frames in the current second, and how many of them had a conflict.
    recent: u64,
    odd: u32,
    /// Frames a second over the last second, and over the last one in which it was not silent.
    rate: f64,
    usual_rate: f64,
    #[cfg(feature = "live")]
    units: crate::core::tracker::UnitCheck,
    /// Whether its capture times are not in nanoseconds.
    #[cfg(feature = "live")]
    has_other_unit: bool,
    /// Whether it was silent when a status told of it.
    was_silent: bool,
    /// Whether its clock has been reported as off.
    #[cfg(feature = "live")]
    pub(crate) is_off: bool,
    /// Where it is, if it was moved and that is known.
    pub(crate) placed: Option<Placed>,
}

impl CameraState {
    pub(crate) fn new(name: &str) -> Self {
        Self { name: name.to_owned(), ..Self::default() }
    }

    /// Counts a frame. Returns a warning if two publishers seem to use the camera's name: frame
    /// number and capture time of one publisher change in the same direction.
    pub(crate) fn frame(
        &mut self,
        now: Timestamp,
        number: u64,
        capture: Timestamp,
    ) -> Option<String> {
        self.recent += 1;
        let (last, last_capture, _) = self.last.replace((number, capture, now))?;
        // Some cameras have no counter.
        if number == last || (number > last) == (capture > last_capture) {
            return None;
        }
        self.odd += 1;
        (self.odd == CONFLICTS).then(|| {
            let ahead = capture.seconds_since(last_capture);
            format!("frame {number} after frame {last}, {ahead:+.3} s: a second publisher?")
        })
    }

    /// Counts an event of this camera.
    pub(crate) fn event(&mut self, kind: EventKind, count: u64) {
        let counter = match kind {
            EventKind::Late => &mut self.counters.late,
            EventKind::Duplicate => &mut self.counters.duplicate,
            EventKind::OutOfOrder => &mut self.counters.out_of_order,
            EventKind::Missing => &mut self.counters.missing,
            EventKind::Dropped => &mut self.counters.dropped,
            EventKind::Unusable => &mut self.counters.unusable,
            _ => return,
        };
        *counter += count;
    }

    /// Updates the rate and the usual residual; called once a second.
    pub(crate) fn second(&mut self, now: Timestamp, passed: Nanos) {
        self.rate = self.recent as f64 * 1e9 / passed.ns().max(1) as f64;
        self.was_silent = self.is_silent(now);
        if self.rate > 0.0 && !self.was_silent {
            self.usual_rate = self.rate;
        }
        (self.recent, self.odd) = (0, 0);
        let (px, usual) = (self.counters.residual_px, &mut self.counters.usual_px);
        if *usual == 0.0 {
            *usual = px;
        } else if px < UNUSUAL * *usual {
            *usual += SECOND * (px - *usual);
        }
    }

    /// From when on it is silent if no frame comes; `None` before its first second.
    pub(crate) fn silent_from(&self) -> Option<Timestamp> {
        let (_, _, arrival) = self.last.filter(|_| self.usual_rate > 0.0)?;
        let at = arrival + SILENT.max(Nanos::rounded(SILENT_PERIODS * 1e9 / self.usual_rate));
        Some(at + Nanos::new((-at.ns()).rem_euclid(TOGETHER.ns())))
    }

    fn is_silent(&self, now: Timestamp) -> bool {
        self.silent_from().is_some_and(|at| at <= now)
    }

    /// The counters, completed with values from the tracker and the clock.
    pub(crate) fn counters(
        &self,
        now: Timestamp,
        used: u64,
        waited_for: bool,
        (offset_s, drift_ppm): (f64, f64),
    ) -> CameraCounters {
        CameraCounters {
            camera: self.name.clone(),
            used,
            rate_hz: self.rate,
            age_s: self.last.map_or(0.0, |(_, _, arrival)| now.seconds_since(arrival)),
            offset_s,
            drift_ppm,
            waited_for,
            silent: self.is_silent(now),
            moved: self.placed.as_ref().map(Placed::to_string).unwrap_or_default(),
            ..self.counters.clone()
        }
    }
}

/// What only a live node needs.
#[cfg(feature = "live")]
impl CameraState {
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Whether its capture times are in nanoseconds; and a warning if they no longer are.
    pub(crate) fn check_unit(&mut self, capture: Timestamp) -> (bool, Option<String>) {
        let fault = self.units.add(capture);
        let had_other_unit = std::mem::replace(&mut self.has_other_unit, fault.is_some());
        (fault.is_none(), fault.filter(|_| !had_other_unit))
    }

    /// Whether it has fallen silent since the last status.
    pub(crate) fn falls_silent(&mut self, now: Timestamp) -> bool {
        let is_silent = self.is_silent(now);
        is_silent && !std::mem::replace(&mut self.was_silent, is_silent)
    }

    /// Sets what a check finds wrong with it.
    pub(crate) fn set_verdict(&mut self, verdict: &str) {
        verdict.clone_into(&mut self.counters.verdict);
    }

    pub(crate) fn verdict(&self) -> &str {
        &self.counters.verdict
    }

    /// Counts a frame with a time that cannot be used.
    pub(crate) fn refused(&mut self) {
        self.counters.unusable += 1;
    }

    /// Sets its residual, pixels, and the share of its points near the bodies.
    pub(crate) fn set_residual(&mut self, residual_px: f64, near: f64) {
        (self.counters.residual_px, self.counters.near) = (residual_px, near);
    }

    /// Sets its usual residual, pixels; 0: not known.
    pub(crate) fn set_usual_px(&mut self, usual_px: f64) {
        self.counters.usual_px = usual_px;
    }

    pub(crate) fn usual_px(&self) -> f64 {
        self.counters.usual_px
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_residual_is_usual_for_a_camera_after_a_while() {
        let mut camera = CameraState::new("left");
        let mut usual = |px: f64, seconds: usize| {
            camera.counters.residual_px = px;
            (0..seconds).for_each(|_| camera.second(Timestamp::default(), Nanos::SECOND));
            camera.counters.usual_px
        };
        assert_eq!(usual(4.0, 1), 4.0);
        assert!((usual(5.0, 100) - 5.0).abs() < 0.01);
        // A camera that was moved does not become usual.
        assert!((usual(12.0, 1000) - 5.0).abs() < 0.01);
    }

    /// Whenever in a second it stops, it is silent after about 0.7 s, and stays so.
    #[test]
    fn a_camera_that_stops_is_silent_once() {
        let at = |ms: i64| Timestamp::from_ns(ms * 1_000_000);
        // Of slow cameras, the last second may have few frames.
        for (period, limit, more) in [(16, 700, 60), (100, 700, 120), (500, 1500, 1600)] {
            for last in (3000..4000).step_by(17) {
                let mut camera = CameraState::new("left");
                let (mut frames, mut silent) = (0, Vec::new());
                for now in 0..9000 {
                    if now % period == 0 && now <= last {
                        camera.frame(at(now), frames, at(now));
                        frames += 1;
                    }
                    if now % 1000 == 999 {
                        camera.second(at(now), Nanos::SECOND);
                    }
                    silent.extend(camera.is_silent(at(now)).then_some(now));
                }
                let first = last / period * period + limit;
                let (from, count) = (silent[0], silent.len() as i64);
                assert!((first..=first + more).contains(&from), "{period}, {last}: {from}");
                assert_eq!(count, 9000 - from, "{period}, {last}");
            }
        }
    }

    #[test]
    fn two_publishers_are_distinguished_from_disorder() {
        let at = |ms: i64| Timestamp::from_ns(ms * 1_000_000);
        let mut camera = CameraState::new("left");
        let mut said = 0;
        for i in 0..10_u64 {
            // One counts from 0, the other from 1000; both at 50 Hz.
            let capture = 20 * i as i64;
            said += usize::from(camera.frame(at(capture), i, at(capture)).is_some());
            said += usize::from(camera.frame(at(capture), 1000 + i, at(capture + 7)).is_some());
        }
        assert_eq!(said, 1);
        let mut camera = CameraState::new("left");
        for i in [0, 2, 1, 4, 3, 5, 5, 6] {
            let capture = 20 * i as i64;
            assert!(camera.frame(at(capture), i, at(capture)).is_none());
        }
        let mut camera = CameraState::new("without a counter");
        assert!((0..20).all(|i| camera.frame(at(20 * i), 0, at(20 * i)).is_none()));
    }
}
