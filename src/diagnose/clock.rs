//! Faults of a camera's clock: it is early or late, or too fast or too slow.

use super::consensus::{Points, Scene};
use super::hypotheses::{Finding, Hypothesis};
use super::reading::Reading;
use super::times::Clock;
use crate::core::points::median;
use crate::core::time::Nanos;

/// Shifts up to this number of frames are tried one by one, larger ones every [`STRIDE`] frames first.
const MOST_FRAMES: i64 = 30;
const STRIDE: i64 = 3;
/// Frames by which a clock that runs too fast or too slowly is off at most.
const MOST_DRIFT: i64 = 60;
/// Frames by which a camera with another frame rate is shifted at most.
const NEAR_FRAMES: i64 = 6;
/// Usual frame rates, Hz.
const RATES: [f64; 10] = [20.0, 24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 90.0, 100.0, 120.0];
/// At least this part of the instants that have a frame must have one with another clock.
const SEEN: f64 = 0.9;

/// Frames whose capture times are late or early by a few frames.
pub(super) fn shifts(reading: &Reading, period: Nanos) -> impl Iterator<Item = Hypothesis> {
    let frames = (-MOST_FRAMES..=MOST_FRAMES).filter(|frames| *frames != 0);
    frames.map(move |frames| shift(reading, period, frames, 1.05))
}

fn shift(reading: &Reading, period: Nanos, frames: i64, weight: f64) -> Hypothesis {
    let late = period * frames;
    let word = if frames > 0 { "late" } else { "early" };
    let (count, ms) = (frames.abs(), late.ms().abs());
    let clock = reading.clock.later(late);
    let offset = (reading.camera.time_offset - clock.late).ms();
    let finding = Finding::new(
        "time_shift",
        format!("its capture times are {count} frames ({ms:.0} ms) {word}"),
        format!("time_offset_ms = {offset:.1} in its calibration, or fix its clock"),
    );
    Hypothesis { finding, reading: Reading { clock, ..reading.clone() }, weight }
}

/// Whether it is a fault of a clock.
pub(super) fn is_of_clock(finding: &Finding) -> bool {
    ["time_shift", "frame_rate"].contains(&finding.cause)
}

/// Other clocks of a camera, the best one of each kind: shifted further than in [`shifts`], or with another rate.
pub(super) fn clocks(scene: &Scene, camera: usize, points: &[Points]) -> Vec<Hypothesis> {
    let far = far(scene, camera, i64::MAX, beside(scene, camera, points));
    far.into_iter().chain(rates(scene, camera, points)).collect()
}

/// Other rates of a camera's clock, the best one of each kind.
pub(super) fn rates(scene: &Scene, camera: usize, points: &[Points]) -> Vec<Hypothesis> {
    let kinds = [rated(scene, camera, points), drifting(scene, camera, points)];
    kinds.into_iter().flatten().collect()
}

/// The median error. `None` if too few of `all` instants have one.
fn middle(errors: Vec<Option<f64>>, all: usize) -> Option<f64> {
    let mut seen: Vec<f64> = errors.into_iter().flatten().collect();
    median(&mut seen).filter(|_| seen.len() as f64 >= SEEN * all as f64)
}

/// Number of the instants at which a camera has a frame.
fn seen(scene: &Scene, camera: usize, points: &[Points]) -> usize {
    scene.errors(camera, &scene.readings[camera], points).iter().flatten().count()
}

/// The error of a camera's readings beside points of the others.
fn beside(scene: &Scene, camera: usize, points: &[Points]) -> impl Fn(&Reading) -> Option<f64> {
    let seen = seen(scene, camera, points);
    move |reading| middle(scene.errors(camera, reading, points), seen)
}

/// The hypothesis with the least error.
fn best(
    all: impl Iterator<Item = Hypothesis>,
    error: impl Fn(&Reading) -> Option<f64>,
) -> Option<Hypothesis> {
    let tried = all.filter_map(|one| Some((error(&one.reading)?, one)));
    tried.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, one)| one)
}

/// A shift of more than a few frames and at most `most`.
pub(super) fn far(
    scene: &Scene,
    camera: usize,
    most: i64,
    error: impl Fn(&Reading) -> Option<f64>,
) -> Option<Hypothesis> {
    let (reading, period) = (&scene.readings[camera], scene.periods[camera]);
    let [first, last] = scene.footage.tracks[camera].span?;
    let most = most.min((last - first).ns() / period.ns().max(1));
    let of = |frames: i64| shift(reading, period, frames, 1.3);
    let coarse = (MOST_FRAMES..=most).step_by(STRIDE as usize).flat_map(|frames| [-frames, frames]);
    let coarse = best(coarse.map(of), &error)?;
    let about = (coarse.reading.clock.late - reading.clock.late).ns() / period.ns().max(1);
    best((about - STRIDE..=about + STRIDE).map(of), error)
}

/// Another frame rate, of the usual ones: files of frames have no times, and one rate was given for all cameras.
fn rated(scene: &Scene, camera: usize, points: &[Points]) -> Option<Hypothesis> {
    let own = 1e9 / scene.periods[camera].ns() as f64;
    let rates = RATES.into_iter().filter(|rate| (rate / own).ln().abs() > 0.02);
    let all = rates.flat_map(|rate| {
        (-NEAR_FRAMES..=NEAR_FRAMES)
            .filter_map(move |late| running(scene, camera, rate / own, late))
    });
    best(all, beside(scene, camera, points))
}

/// A clock that runs a little too fast or too slowly. The errors at whole shifts are looked up.
fn drifting(scene: &Scene, camera: usize, points: &[Points]) -> Option<Hypothesis> {
    let (reading, period) = (&scene.readings[camera], scene.periods[camera]);
    let [first, last] = scene.footage.tracks[camera].span?;
    let span = (last - first).ns() as f64;
    let shifts = || -MOST_DRIFT..=MOST_DRIFT;
    let errors = |frames| {
        let reading = Reading { clock: reading.clock.later(period * frames), ..reading.clone() };
        scene.errors(camera, &reading, points)
    };
    let table: Vec<Vec<Option<f64>>> = shifts().map(errors).collect();
    let parts = scene.instants.iter().map(|time| {
        let own = *time - reading.camera.time_offset;
        (own - first).ns() as f64 / span
    });
    let parts: Vec<f64> = parts.collect();
    let seen = seen(scene, camera, points);
    let of = |start: i64, drift: i64| {
        let at = |(instant, part): (usize, &f64)| {
            let frames = libm::round(start as f64 + part * drift as f64) as i64 + MOST_DRIFT;
            table.get(usize::try_from(frames).ok()?)?[instant]
        };
        middle(parts.iter().enumerate().map(at).collect(), seen)
    };
    let all = shifts().flat_map(|drift| shifts().map(move |start| (start, drift)));
    let tried = all.filter(|(_, drift)| *drift != 0);
    let tried = tried.filter_map(|(start, drift)| Some((of(start, drift)?, start, drift)));
    let (_, start, drift) = tried.min_by(|a, b| a.0.total_cmp(&b.0))?;
    running(scene, camera, 1.0 + drift as f64 * period.ns() as f64 / span, start)
}

/// A clock that runs `rate` times as fast as it should, and is late at the start.
fn running(scene: &Scene, camera: usize, rate: f64, late: i64) -> Option<Hypothesis> {
    let (reading, period) = (&scene.readings[camera], scene.periods[camera]);
    let [first, _] = scene.footage.tracks[camera].span?;
    let own = 1e9 / period.ns() as f64;
    let right = own * rate;
    let finding = Finding::new(
        "frame_rate",
        format!("its capture times run {rate:.4} times as fast as those of the others"),
        format!(
            "its frame rate is {right:.2}, not {own:.2} Hz (import it with --fps {}={right:.2}), or its clock is wrong",
            reading.camera.name
        ),
    );
    let clock = Clock { rate: Some((first, rate)), ..reading.clock.later(period * late) };
    let reading = Reading { clock, ..reading.clone() };
    Some(Hypothesis { finding, reading, weight: 1.3 })
}
