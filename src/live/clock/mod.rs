//! Compares the cameras' clock with the node's.
//!
//! The node sees arrivals only. Arrival minus capture time is the offset of the camera's clock plus
//! the time for exposure, detection and transport. What tells them apart is how the offset changes:
//! if capture times go on evenly, the delay has changed; if they jump, the clock has; a slow, steady
//! change is drift.
//!
//! The cameras' clock may be the node's (PTP, NTP), TAI (PTP without the leap seconds), or any other.
//! Capture time plus `base` is the node's time. Without a common epoch, the smallest offset is the
//! base, and delays are those above the fastest camera's.

pub(crate) mod base;
pub(super) mod camera;
pub(super) mod delays;
pub(super) mod wall;

use crate::core::time::{Nanos, Timestamp};
use base::{AHEAD, Base};
use camera::{CameraClock, LeftOut, Step};

/// A smaller change of the offset is none of the clock.
const STEP: Nanos = Nanos::from_ms(100);
/// Capture times go back by at least this if the clock does, and not if frames are out of order.
const BACK: Nanos = Nanos::from_ms(50);
/// A frame that arrives this much too early has a wrong time.
const EARLY: Nanos = Nanos::from_ms(-500);
/// A frame that arrives this much too late and does not continue its camera has a wrong time.
const LATE: Nanos = Nanos::from_ms(5000);
/// Number of frames in a row that show a step, and that a camera needs to come back.
const SURE: u32 = 3;
/// A step is forgotten after this time, and a camera that sends no frames while others do.
pub(crate) const RECENT: Nanos = Nanos::from_ms(2000);
/// In this time after the first frame, any frame can change the base.
const SETTLING: Nanos = Nanos::from_ms(1000);
/// Result of the check of a frame's capture time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Arrival {
    /// It is used.
    Used,
    /// It is not used.
    Refused,
    /// The clock of most cameras has stepped by this (positive: back), or a better one was found.
    NewClock(Nanos),
}

/// The clocks of all cameras.
#[derive(Clone, Debug, Default)]
pub(crate) struct Clock {
    pub(crate) cameras: Vec<CameraClock>,
    /// Node's clock minus capture clock; `None` before the first frame.
    pub(crate) base: Option<Base>,
    /// Arrival of the first frame.
    since: Option<Timestamp>,
    /// Whether it was checked after a while that no camera's clock is ahead.
    is_settled: bool,
    strays: Vec<(usize, Nanos, u32)>,
    /// Whether a quarter of a second has begun since delays were reviewed.
    pub(crate) is_to_review: bool,
    /// The last description in an event.
    reported: Option<&'static str>,
}

impl Clock {
    pub(crate) fn new(cameras: usize) -> Self {
        Self { cameras: vec![CameraClock::default(); cameras], ..Self::default() }
    }

    /// Checks and records the arrival of a frame.
    pub(crate) fn arrive(&mut self, camera: usize, now: Timestamp, capture: Timestamp) -> Arrival {
        let offset = now - capture;
        if camera >= self.cameras.len() {
            return Arrival::Refused;
        }
        let since = *self.since.get_or_insert(now);
        let base = self.base.get_or_insert_with(|| Base::of(offset)).value();
        let by = self.expected(camera).map_or(Nanos::ZERO, |expected| offset - expected);
        let own = &mut self.cameras[camera];
        let last = own.last.map(|(last, _)| last);
        let goes_on = last.is_some_and(|last| capture > last);
        let is_back = last.is_some_and(|last| last - capture > BACK) && by > STEP;
        let is_ahead = by < -STEP && offset - base < -AHEAD;
        let is_far = by < EARLY && offset - base < -AHEAD || by > LATE && !goes_on;
        if is_back || is_ahead || is_far {
            own.agreeing = 0;
            return self.stepped(camera, now, by, is_far);
        }
        let strayed = own.step.take();
        match own.left_out {
            Some(LeftOut::Clock(_)) => {
                own.agreeing = if by.abs() < STEP { own.agreeing + 1 } else { 0 };
                if own.agreeing < SURE {
                    return Arrival::Refused;
                }
                own.left_out = None;
                own.restart(now, offset);
            }
            Some(LeftOut::Late(_)) => {
                self.is_to_review |= own.note(now, capture, offset);
                return Arrival::Refused;
            }
            None => self.is_to_review |= own.note(now, capture, offset),
        }
        if now - since < SETTLING {
            let least = self.levels().min();
            self.base = least.map(Base::of).or(self.base);
        } else if self.leave_out_ahead(camera) {
            return Arrival::NewClock(Nanos::ZERO);
        }
        self.stray(camera, strayed);
        Arrival::Used
    }

    /// Once, when three cameras have sent for a while: if most have a common clock, leaves out those whose clocks are ahead
    /// of it. Returns whether there are any, when a frame of another camera comes.
    fn leave_out_ahead(&mut self, camera: usize) -> bool {
        if self.is_settled || self.levels().count() < 3 {
            return false;
        }
        let Some(middle) = median(self.levels()) else { return false };
        let base = Base::of(middle);
        let is_ahead = |level: Nanos| {
            base.is_common() && level < base.value() - AHEAD && level < middle - STEP
        };
        if self.cameras[camera].level().is_some_and(is_ahead) {
            return false;
        }
        self.is_settled = true;
        let mut is_any = false;
        for one in self.cameras.iter_mut().filter(|one| one.is_used()) {
            if let Some(level) = one.level().filter(|level| is_ahead(*level)) {
                one.leave_out(LeftOut::Clock(level - middle));
                is_any = true;
            }
        }
        if is_any {
            self.base = self.levels().min().map(Base::of).or(self.base);
        }
        is_any
    }

    /// The capture times of a camera are corrected by so much from here on.
    pub(crate) fn correct(&mut self, camera: usize, correction: Nanos) {
        if let Some(camera) = self.cameras.get_mut(camera) {
            camera.correct(correction);
        }
    }

    /// The expected offset of a camera's frames: its own, or else that of the other cameras.
    fn expected(&self, camera: usize) -> Option<Nanos> {
        let own = self.cameras.get(camera)?;
        let is_in = own.left_out.is_none_or(|why| matches!(why, LeftOut::Late(_)));
        own.level().filter(|_| is_in).or_else(|| median(self.levels()))
    }

    /// Lasting smallest offsets of the cameras that are used.
    pub(crate) fn levels(&self) -> impl Iterator<Item = Nanos> {
        let used = self.cameras.iter().filter(|camera| camera.is_used());
        used.filter_map(CameraClock::level)
    }

    /// A series of refused frames ended before it was a step.
    fn stray(&mut self, camera: usize, step: Option<Step>) {
        let step = step.filter(|step| step.is_far && step.count < SURE);
        self.strays.extend(step.map(|step| (camera, step.by, step.count)));
    }

    /// Refused frames that were no step: camera, how far their time was off, and number.
    pub(crate) fn take_strays(&mut self) -> Vec<(usize, Nanos, u32)> {
        std::mem::take(&mut self.strays)
    }

    /// A frame that does not continue its camera's time line.
    fn stepped(&mut self, camera: usize, now: Timestamp, by: Nanos, is_far: bool) -> Arrival {
        let alike = |step: &Step| now - step.at < RECENT && (step.by - by).abs() < STEP;
        let own = &mut self.cameras[camera];
        let before = own.step.filter(alike);
        let count = before.map_or(0, |step| step.count) + 1;
        let by = before.map_or(by, |step| step.by.min(by));
        let strayed = own.step.replace(Step { by, count, at: now, is_far });
        if before.is_none() {
            self.stray(camera, strayed);
        }
        let of_all = |camera: &CameraClock| camera.step.as_ref().is_some_and(alike);
        let stepped: Vec<usize> =
            (0..self.cameras.len()).filter(|&c| of_all(&self.cameras[c])).collect();
        let frames: u32 =
            stepped.iter().filter_map(|&c| self.cameras[c].step).map(|s| s.count).sum();
        let is_active = |c: &&CameraClock| {
            let at = c.last.filter(|_| c.left_out.is_none()).map(|(_, at)| at);
            at.max(c.step.map(|step| step.at)).is_some_and(|at| now - at < RECENT)
        };
        let active = self.cameras.iter().filter(is_active).count();
        let is_heard = |camera: &&CameraClock| camera.last.is_some() && !camera.is_silent;
        let known = self.cameras.iter().filter(is_heard).count();
        let is_better = stepped.len() * 2 == active
            && !self.base.is_some_and(Base::is_common)
            && Base::of(self.expected(camera).unwrap_or_default() + by).is_common();
        let is_most = stepped.len() * 2 > active && stepped.len() >= known.min(2);
        if frames >= SURE && (is_most || is_better) {
            return self.replace(&stepped, now, by);
        }
        let own = &mut self.cameras[camera];
        if count < SURE {
            let is_used = !is_far && own.left_out.is_none();
            return if is_used { Arrival::Used } else { Arrival::Refused };
        }
        own.left_out = Some(LeftOut::Clock(by));
        Arrival::Refused
    }

    /// The clock of those cameras replaces the others'.
    fn replace(&mut self, stepped: &[usize], now: Timestamp, by: Nanos) -> Arrival {
        let by =
            stepped.iter().filter_map(|&c| self.cameras[c].step).map(|s| s.by).min().unwrap_or(by);
        let offsets: Vec<Nanos> =
            stepped.iter().map(|&c| self.expected(c).unwrap_or_default() + by).collect();
        let least = offsets.iter().min().copied().unwrap_or_default();
        for (index, camera) in self.cameras.iter_mut().enumerate() {
            match stepped.iter().position(|&c| c == index) {
                Some(at) => camera.restart(now, offsets[at]),
                // It may come back with either clock.
                None if camera.is_silent && camera.left_out.is_none() => camera.forget(),
                None if camera.last.is_some() => {
                    camera.leave_out(LeftOut::Clock(-by));
                    // Perhaps its next frame has stepped too.
                    camera.agreeing = SURE - 1;
                }
                None => {}
            }
        }
        // A step keeps the delays, if they are known.
        let is_settling = self.since.is_none_or(|since| now - since < SETTLING);
        let before = self.base.filter(|base| base.is_common() && !is_settling);
        self.base = Some(before.map_or(Base::of(least), |base| base.stepped(by)));
        Arrival::NewClock(if is_settling { Nanos::ZERO } else { by })
    }

    /// Whether the capture clock is known: a frame has arrived.
    pub(crate) fn is_known(&self) -> bool {
        self.base.is_some()
    }

    /// Node's clock minus capture clock.
    pub(crate) fn base(&self) -> Nanos {
        self.base.unwrap_or_default().value()
    }

    /// Converts node time to capture time. They are equal until the first frame.
    pub(crate) fn capture_time(&self, node: Timestamp) -> Timestamp {
        node - self.base()
    }

    /// Converts capture time to node time.
    pub(crate) fn node_time(&self, capture: Timestamp) -> Timestamp {
        capture + self.base()
    }

    /// Which clock the cameras use; "" before it is known.
    pub(crate) fn kind(&self) -> &'static str {
        self.base.map_or("", Base::kind)
    }

    /// What to say about the cameras' clock, if that is new since the last time.
    pub(crate) fn news(&mut self, now: Timestamp) -> Option<String> {
        let is_settled = self.since.is_some_and(|since| now - since >= SETTLING);
        let delay = self.median_delay().filter(|_| is_settled)?;
        let key = if Base::is_early(delay) { "early" } else { self.kind() };
        (self.reported.replace(key) != Some(key)).then(|| self.base.map(|b| b.describe(delay)))?
    }

    /// The kind of the clock, in words; it is no news then.
    pub(crate) fn told(&mut self) -> String {
        self.reported = Some(self.kind());
        self.base.unwrap_or_default().describe(self.median_delay().unwrap_or_default())
    }

    fn median_delay(&self) -> Option<Nanos> {
        Some(median(self.levels())? - self.base())
    }

    /// Cameras that are left out, or again used, and were not reported as that.
    pub(crate) fn take_left_out(&mut self) -> Vec<(usize, Option<LeftOut>)> {
        let changed = |(index, camera): (usize, &mut CameraClock)| {
            let is_new = camera.left_out.is_some() != camera.is_reported;
            camera.is_reported = camera.left_out.is_some();
            is_new.then_some((index, camera.left_out))
        };
        self.cameras.iter_mut().enumerate().filter_map(changed).collect()
    }

    /// Whether a camera's frames are not used.
    pub(crate) fn is_left_out(&self, camera: usize) -> bool {
        self.cameras.get(camera).is_some_and(|camera| camera.left_out.is_some())
    }

    /// Offset of a camera's clock from the node's, seconds, and drift, parts per million.
    pub(crate) fn offset(&self, camera: usize, now: Timestamp) -> Option<(f64, f64)> {
        let (offset, drift) = self.cameras.get(camera)?.line(now)?;
        Some((offset * 1e-9, drift))
    }
}

/// The lower median.
pub(crate) fn median(values: impl Iterator<Item = Nanos>) -> Option<Nanos> {
    let mut sorted: Vec<Nanos> = values.collect();
    sorted.sort_unstable();
    sorted.get(sorted.len().saturating_sub(1) / 2).copied()
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
            assert_eq!(clock.arrive(camera, at(arrival), capture), Arrival::Used);
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
    fn a_correction_is_neither_drift_nor_a_step() {
        let mut clock = Clock::new(2);
        for second in 0..60 {
            let seconds = f64::from(second)..f64::from(second + 1);
            // The motion shows that the second camera is late; 5 ms are corrected a second.
            let correction = 0.005 * f64::from(second);
            clock.correct(1, Nanos::rounded(-1e9 * correction));
            feed(&mut clock, 0, seconds.clone(), |_| 0.002);
            feed(&mut clock, 1, seconds, |_| 0.002 + correction);
            let off = clock.levels().nth(1).unwrap().seconds() - 0.002 - correction;
            assert!(off.abs() < 1e-6, "{off}");
        }
        assert_eq!(clock.growth(), Nanos::ZERO);
        assert!(clock.deviations().iter().all(|(_, off)| off.abs() < 1e-3));
        let (offset, drift) = clock.offset(1, at(60.0)).unwrap();
        assert!((offset - 0.297).abs() < 1e-3 && drift.abs() < 5.0, "{offset} {drift}");
        // All at once: more than any step of a clock.
        clock.correct(1, Nanos::rounded(-1e9));
        feed(&mut clock, 1, 60.0..61.0, |_| 1.002);
        clock.correct(1, Nanos::ZERO);
        feed(&mut clock, 1, 61.0..62.0, |_| 0.002);
    }

    #[test]
    fn the_only_camera_that_sends_may_step() {
        let mut clock = Clock::new(2);
        for camera in 0..2 {
            feed(&mut clock, camera, 0.0..3.0, |_| 0.002);
        }
        // The second one is silent, and the clock of the first steps ahead.
        for second in 3..8 {
            let seconds = f64::from(second)..f64::from(second + 1);
            feed(&mut clock, 0, seconds, |_| 0.002);
            clock.follow(at(f64::from(second + 1)));
        }
        let base = clock.base();
        let step = |i: i32| {
            let arrival = 8.0 + f64::from(i) / 50.0;
            clock.arrive(0, at(arrival), at(arrival - 0.002 + 0.5))
        };
        let arrivals: Vec<Arrival> = (0..6).map(step).collect();
        assert!(arrivals.contains(&Arrival::NewClock(Nanos::from_ms(-500))), "{arrivals:?}");
        assert_eq!(clock.base() - base, Nanos::from_ms(-500));
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
    fn one_camera_that_jumps_is_left_out_and_all_together_are_a_step() {
        let mut clock = Clock::new(3);
        for camera in 0..3 {
            feed(&mut clock, camera, 0.0..2.0, |_| 0.0);
        }
        let hour = Nanos::SECOND * 3600;
        for i in 0..10 {
            let now = at(2.0 + 0.02 * f64::from(i));
            assert_eq!(clock.arrive(0, now, now + hour), Arrival::Refused);
            assert_eq!(clock.arrive(1, now, now), Arrival::Used);
        }
        assert_eq!(clock.take_left_out(), [(0, Some(LeftOut::Clock(-hour)))]);
        // Two of three have that time now.
        assert_eq!(clock.arrive(1, at(2.2), at(2.2) + hour), Arrival::NewClock(-hour));
        assert_eq!(clock.arrive(2, at(2.2), at(2.2) + hour), Arrival::Used);
        assert_eq!((clock.kind(), clock.take_left_out()), ("ahead", vec![(0, None)]));
        assert_eq!(clock.arrive(0, at(2.2), at(2.2) + hour), Arrival::Used);
        assert_eq!(clock.capture_time(at(2.2)), at(2.2) + hour);
    }

    #[test]
    fn late_frames_are_no_offset_until_all_are_late() {
        let mut clock = Clock::new(2);
        feed(&mut clock, 0, 0.0..5.0, |_| 0.003);
        feed(&mut clock, 1, 0.0..5.0, |_| 0.003);
        // Half a second of frames had queued.
        for i in 0..25 {
            let capture = at(5.0 + 0.02 * f64::from(i));
            assert_eq!(clock.arrive(0, at(6.0), capture), Arrival::Used);
        }
        assert_eq!(clock.usual_delay(), Nanos::from_ms(3));
        feed(&mut clock, 0, 6.0..7.0, |_| 0.503);
        assert_eq!(clock.usual_delay(), Nanos::from_ms(503));
        assert!(clock.lasting_delay()[0] >= Nanos::from_ms(503));
        assert!(clock.deviations().iter().all(|(_, off)| off.abs() < 1e-3), "a delay");
        assert_eq!((clock.kind(), clock.absorb_delay()), ("shared", None));
    }

    #[test]
    fn the_kinds_of_clocks_are_told() {
        let kind = |offset: f64| {
            let mut clock = Clock::new(2);
            feed(&mut clock, 0, 0.0..1.2, |_| offset + 0.03);
            feed(&mut clock, 1, 0.0..1.2, |_| offset + 0.01);
            (clock.kind(), clock.news(at(1.2)).unwrap())
        };
        for (offset, expected, word) in [
            (0.0, "shared", "after 10.0 ms"),
            (-0.015, "shared", "5.0 ms before their capture time"),
            (-0.5, "ahead", "0.490 s ahead"),
            (-37.0, "tai", "TAI"),
            (30.0, "behind", "30.010 s behind"),
            (1e8, "foreign", "another epoch"),
        ] {
            let (kind, news) = kind(offset);
            assert!(kind == expected && news.contains(word), "{offset}: {kind}, {news}");
        }
    }

    #[test]
    fn the_extremes_of_time_do_not_overflow() {
        let mut clock = Clock::new(2);
        for ns in [i64::MIN, i64::MAX, 0] {
            for camera in 0..3 {
                clock.arrive(camera, at(0.0), Timestamp::from_ns(ns));
            }
        }
        clock.deviations();
        clock.follow(at(0.0));
    }
}
