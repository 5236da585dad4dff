//! Faults of a camera's clock: it is early or late, or too fast or too slow.

use super::consensus::{Points, Scene};
use super::hypotheses::{EXPLAINED, Finding, Hypothesis, OF_MANY};
use super::reading::Reading;
use super::times::Clock;
use crate::core::points::median;
use crate::core::time::{Nanos, Timestamp};

/// Shifts up to this number of frames are tried one by one, larger ones every [`STRIDE`] frames first.
const NEAR: i64 = 30;
const STRIDE: i64 = 3;
/// In a part of a recording, and with two cameras, shifts are tried up to this number of frames.
pub(super) const MOST_IF_UNSURE: i64 = 300;
/// A camera with another frame rate is late by so many frames at most, at the start.
const NEAR_AT_START: i64 = 6;
/// Usual frame rates, Hz.
const RATES: [f64; 7] = [24.0, 25.0, 30.0, 50.0, 60.0, 100.0, 120.0];
/// A drift is between so many frames over the recording, and at most this part of it.
const DRIFTS: std::ops::RangeInclusive<i64> = 10..=60;
const MOST_DRIFT: f64 = 0.1;
/// Another clock must leave a frame at this part of the instants that have one now.
const SEEN: f64 = 0.35;
/// The instants that lose theirs must be this bad now, beside the others: they must not be the good ones.
const AS_BAD: f64 = 0.5;
/// Weights as in [`Hypothesis`], of near shifts, of drifts and of other clocks. Only the last are [`OF_MANY`].
const NEAR_WEIGHT: f64 = 1.05;
const DRIFT_WEIGHT: f64 = 1.19;
const WEIGHT: f64 = 1.3;
const _: () = assert!(DRIFT_WEIGHT < OF_MANY && WEIGHT >= OF_MANY);

/// Frames whose capture times are late or early by up to [`NEAR`] frames.
pub(super) fn shifts(reading: &Reading, period: Nanos) -> impl Iterator<Item = Hypothesis> {
    let frames = (-NEAR..=NEAR).filter(|frames| *frames != 0);
    frames.map(move |frames| {
        let clock = reading.clock.later(period * frames);
        Hypothesis { weight: NEAR_WEIGHT, ..with_clock(reading, period, clock) }
    })
}

/// Whether it is a fault of a clock.
pub(super) fn is_of_clock(finding: &Finding) -> bool {
    ["time_shift", "frame_rate"].contains(&finding.cause)
}

/// Other clocks of a camera, the best one of each kind: shifted further than in [`shifts`], or with another rate. `is_part`:
/// in a part of the recording, where a clock can only be shifted.
pub(super) fn clocks(
    scene: &Scene,
    camera: usize,
    points: &[Points],
    is_part: bool,
) -> Vec<Hypothesis> {
    let Some([first, last]) = scene.footage.tracks[camera].span else { return Vec::new() };
    let reading = &scene.readings[camera];
    let now = scene.errors(camera, reading, points);
    let period = scene.periods[camera];
    let search = Search { scene, camera, points, now, period, first, last };
    let most = if is_part { MOST_IF_UNSURE } else { i64::MAX };
    let far = far(scene, camera, most, |clock| search.error(&search.errors(clock)));
    let mut kinds = vec![(far, WEIGHT)];
    if !is_part && !scene.footage.have_right_rates {
        kinds.extend([(search.rated(), WEIGHT), (search.drifting(), DRIFT_WEIGHT)]);
    }
    let kinds = kinds.into_iter().filter_map(|(clock, weight)| Some((clock?, weight)));
    let of = |(clock, weight)| Hypothesis { weight, ..with_clock(reading, period, clock) };
    kinds.map(of).collect()
}

/// The fault of a clock.
pub(super) fn with_clock(reading: &Reading, period: Nanos, clock: Clock) -> Hypothesis {
    let (camera, late) = (&reading.camera, clock.late - reading.clock.late);
    let finding = match clock.rate {
        None => {
            let frames = late.ns() / period.ns().max(1);
            let word = if frames > 0 { "late" } else { "early" };
            let offset = (camera.time_offset - clock.late).ms();
            Finding::new(
                "time_shift",
                format!(
                    "its capture times are {} frames ({:.0} ms) {word}",
                    frames.abs(),
                    late.ms().abs()
                ),
                format!("time_offset_ms = {offset:.1} in its calibration, or fix its clock"),
            )
        }
        Some((_, rate)) => {
            let own = 1e9 / period.ns() as f64;
            let (name, right) = (&camera.name, own * rate);
            Finding::new(
                "frame_rate",
                format!("its capture times run {rate:.4} times as fast as those of the others"),
                format!(
                    "its frame rate is {right:.3}, not {own:.3} Hz (import it with --fps {name}={right:.3}), or its \
                     clock is wrong"
                ),
            )
        }
    };
    Hypothesis { finding, reading: Reading { clock, ..reading.clone() }, weight: WEIGHT }
}

/// The clock with the least error.
fn best(all: impl Iterator<Item = Clock>, error: impl Fn(Clock) -> Option<f64>) -> Option<Clock> {
    let tried = all.filter_map(|clock| Some((error(clock)?, clock)));
    tried.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, clock)| clock)
}

/// A clock that is off by [`NEAR`] to `most` frames.
pub(super) fn far(
    scene: &Scene,
    camera: usize,
    most: i64,
    error: impl Fn(Clock) -> Option<f64>,
) -> Option<Clock> {
    let (clock, period) = (scene.readings[camera].clock, scene.periods[camera]);
    let [first, last] = scene.footage.tracks[camera].span?;
    let most = most.min((last - first).ns() / period.ns().max(1));
    let of = |frames: i64| clock.later(period * frames);
    let coarse = (NEAR..=most).step_by(STRIDE as usize).flat_map(|frames| [-frames, frames]);
    let coarse = best(coarse.map(of), &error)?;
    let about = (coarse.late - clock.late).ns() / period.ns().max(1);
    best((about - STRIDE..=about + STRIDE).map(of), error)
}

/// A search for the clock of a camera beside points of the others.
struct Search<'a> {
    scene: &'a Scene<'a>,
    camera: usize,
    points: &'a [Points],
    /// The errors with its own clock, by instant.
    now: Vec<Option<f64>>,
    period: Nanos,
    /// Its first and last capture time.
    first: Timestamp,
    last: Timestamp,
}

impl Search<'_> {
    /// The errors with a clock, by instant.
    fn errors(&self, clock: Clock) -> Vec<Option<f64>> {
        let reading = Reading { clock, ..self.scene.readings[self.camera].clone() };
        self.scene.errors(self.camera, &reading, self.points)
    }

    /// The median error. `None` if too few instants have a frame with that clock, if those that lose theirs are the good
    /// ones, or if the others are not much better.
    fn error(&self, errors: &[Option<f64>]) -> Option<f64> {
        let both = || errors.iter().zip(&self.now);
        let now = |has_frame: bool| {
            let of = both().filter(|(then, _)| then.is_some() == has_frame);
            of.filter_map(|(_, now)| *now).collect::<Vec<f64>>()
        };
        let mut seen: Vec<f64> = errors.iter().flatten().copied().collect();
        let before = self.now.iter().flatten().count();
        let (lost, kept) = (median(&mut now(false)), median(&mut now(true)));
        let is_good_lost = lost.zip(kept).is_some_and(|(lost, kept)| lost < AS_BAD * kept);
        let is_enough = seen.len() as f64 >= SEEN * before as f64 && !is_good_lost;
        let is_better = |then: &f64| kept.is_none_or(|kept| *then < EXPLAINED * kept);
        median(&mut seen).filter(|_| is_enough).filter(is_better)
    }

    /// Another usual frame rate: files of frames have no times, and one rate was given for all cameras.
    fn rated(&self) -> Option<Clock> {
        let starts = || -NEAR_AT_START..=NEAR_AT_START;
        let ratios = RATES.into_iter().flat_map(|a| RATES.map(|b| a / b));
        let mut ratios: Vec<f64> = ratios.filter(|ratio| *ratio != 1.0).collect();
        ratios.sort_by(f64::total_cmp);
        ratios.dedup();
        let all =
            ratios.into_iter().flat_map(|rate| starts().map(move |late| self.running(rate, late)));
        best(all, |clock| self.error(&self.errors(clock)))
    }

    /// A clock that runs a little too fast or too slowly. The errors at whole shifts are looked up.
    fn drifting(&self) -> Option<Clock> {
        let own = self.scene.readings[self.camera].clock;
        let span = (self.last - self.first).ns() as f64;
        let frames = span / self.period.ns() as f64;
        let shifts = || -*DRIFTS.end()..=*DRIFTS.end();
        let table: Vec<_> =
            shifts().map(|frames| self.errors(own.later(self.period * frames))).collect();
        let offset = self.scene.readings[self.camera].camera.time_offset;
        let part = |time: &Timestamp| (*time - offset - self.first).ns() as f64 / span;
        let parts: Vec<f64> = self.scene.instants.iter().map(part).collect();
        let error = |start: i64, drift: i64| {
            let at = |(instant, part): (usize, &f64)| {
                let frames = libm::round(start as f64 + part * drift as f64) as i64 + DRIFTS.end();
                table.get(usize::try_from(frames).ok()?)?[instant]
            };
            self.error(&parts.iter().enumerate().map(at).collect::<Vec<_>>())
        };
        let is_drift = |drift: &i64| {
            DRIFTS.contains(&drift.abs()) && drift.abs() as f64 <= MOST_DRIFT * frames
        };
        let all = shifts().filter(is_drift);
        let all = all.flat_map(|drift| shifts().map(move |start| (start, drift)));
        let tried = all.filter_map(|(start, drift)| Some((error(start, drift)?, start, drift)));
        let (_, start, drift) = tried.min_by(|a, b| a.0.total_cmp(&b.0))?;
        Some(self.running(1.0 + drift as f64 / frames, start))
    }

    /// A clock that runs `rate` times as fast as it should, and is late at the start.
    fn running(&self, rate: f64, late: i64) -> Clock {
        let clock = self.scene.readings[self.camera].clock.later(self.period * late);
        Clock { rate: Some((self.first, rate)), ..clock }
    }
}
