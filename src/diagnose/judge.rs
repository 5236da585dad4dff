//! Finds the faults: the reading of each camera with which most cameras agree.

use super::clock::{self, is_of_clock};
use super::consensus::{Consensus, Fit, Points, Scene};
use super::hypotheses::{self, EXPLAINED, Finding, Hypothesis, OF_MANY};
use super::performer;
use super::placement;
use super::reading::Reading;
use super::times::Clock;
use crate::core::camera::Camera;
use crate::core::points::median;

/// A camera below this error fits, unless its clock is wrong.
const FITS: f64 = 0.02;
/// A fault lowers the error by this, at least.
const GAIN: f64 = 0.015;
/// The same for a fault with more than one free parameter: this many times the best error, within
/// bounds.
const GAIN_FREE: (f64, [f64; 2]) = (4.0, [0.02, 0.045]);
/// Above this error, and this many times that of the others, a camera is wrong even if no fault
/// explains it.
const WRONG: f64 = 0.06;
const TIMES_OTHERS: f64 = 2.5;
/// The same beside two others, whose own errors say little.
const WRONG_OF_THREE: f64 = 0.12;
/// Heights of the performer with which two cameras may agree, metres.
const HEIGHTS_M: std::ops::Range<f64> = 1.2..2.3;
/// Two cameras disagree above this error of each.
const DISAGREE: f64 = 0.05;
/// [`FITS`] and [`GAIN`] of clocks: a performer who hardly moves shows little of them.
const FITS_IN_TIME: f64 = 0.01;
const GAIN_IN_TIME: f64 = 0.006;
/// A fault must raise the sum of the cameras' support by this.
const COST: f64 = 0.25;
/// A fault explains all if the error without it is at most this many times that of the others.
const EXPLAINS_ALL: f64 = 1.3;
/// Sets of cameras that are tried as the right ones.
const STARTS: usize = 3;
/// Permutations are tried with at most so many cameras.
const MOST_PERMUTED: usize = 16;
/// Of two cameras, the number of faults that are listed.
const MOST_OPTIONS: usize = 3;
/// They have up to this many times the least error.
const ALIKE: f64 = 1.5;
/// Shifts that differ by at most so many frames are one.
const ONE_SHIFT: f64 = 3.0;
/// Two frame periods are equal if their natural logarithms differ by less.
const SAME_RATE: f64 = 0.05;

/// The cameras without their faults.
#[derive(Clone, Debug)]
pub(super) struct Judged<'a> {
    pub(super) scene: Scene<'a>,
    pub(super) consensus: Consensus,
    /// By camera.
    pub(super) findings: Vec<Option<Finding>>,
    /// Of all cameras.
    pub(super) general: Vec<Finding>,
}

impl Judged<'_> {
    /// Few faults after which many cameras agree on a performer as people are.
    fn score(&self) -> f64 {
        // Two cameras are exchanged by one fault.
        let cost = |finding: &Finding| if finding.cause == "other_camera" { 0.5 } else { 1.0 };
        let faults: f64 = self.findings.iter().flatten().chain(&self.general).map(cost).sum();
        self.consensus.total - COST * (faults + self.odd().len() as f64)
    }

    fn odd(&self) -> Vec<Finding> {
        let points = self.scene.points(&self.consensus, None);
        performer::findings(&points, self.consensus.count())
    }
}

/// `None` if no cameras agree, whatever is tried.
pub(super) fn judge<'a>(scene: &Scene<'a>, cameras: &[Camera]) -> Option<Judged<'a>> {
    let n = scene.cameras();
    let is_seen = |camera: &usize| scene.views.iter().any(|at| !at[*camera].is_empty());
    let seen: Vec<usize> = (0..n).filter(is_seen).collect();
    if n == 2 {
        return pair(scene, cameras, [0, 1]);
    }
    let starts = scene.consensuses(STARTS);
    // Images may be those of a camera that seems to have none.
    let has_all = seen.len() == n;
    let secure =
        has_all && starts.last().is_some_and(|best| best.count() >= 3 && 2 * best.count() > n);
    let mut found: Vec<Judged> = Vec::new();
    if !secure {
        found.extend(exchanged(scene, cameras));
        found.extend(common(scene));
    }
    let starts = starts.into_iter().rev().take(if secure { 1 } else { STARTS });
    found.extend(starts.map(|consensus| {
        let (findings, general) = (vec![None; n], Vec::new());
        let start = Judged { scene: scene.clone(), consensus, findings, general };
        fix(start, cameras)
    }));
    let judged = found.into_iter().max_by(|a, b| a.score().total_cmp(&b.score()));
    let finds = |one: &Judged| !one.general.is_empty() || one.findings.iter().any(Option::is_some);
    match seen[..] {
        // Other cameras have no images. These two may be theirs.
        [a, b] if !judged.as_ref().is_some_and(finds) => pair(scene, cameras, [a, b]),
        _ => judged,
    }
}

/// Undoes one fault after another.
fn fix<'a>(mut judged: Judged<'a>, cameras: &[Camera]) -> Judged<'a> {
    for _ in 0..judged.scene.cameras() {
        let explained = explain_all(&judged, cameras);
        let tried = explained.into_iter().filter_map(|(camera, hypothesis)| {
            let scene = judged.scene.with_one(camera, hypothesis.reading);
            let consensus = scene.agree()?;
            let mut findings = judged.findings.clone();
            findings[camera] = Some(hypothesis.finding);
            Some(Judged { scene, consensus, findings, general: judged.general.clone() })
        });
        let best = tried.max_by(|a, b| a.consensus.total.total_cmp(&b.consensus.total));
        match best.filter(|best| best.consensus.total > judged.consensus.total) {
            Some(best) => judged = best,
            None => break,
        }
    }
    for (camera, beside) in fits(&judged).into_iter().enumerate() {
        let Some(Beside { fit, usual, .. }) = beside.filter(|_| judged.findings[camera].is_none())
        else {
            continue;
        };
        let wrong = if judged.consensus.count() <= 2 { WRONG_OF_THREE } else { WRONG };
        if fit.error > wrong && fit.error > TIMES_OTHERS * usual {
            let what = "it disagrees with the others, cause not found";
            let fix = "is it the calibration of this take, and does it see the same person?";
            judged.findings[camera] = Some(Finding::new("disagrees", what, fix));
        }
    }
    judged
}

/// How a camera fits the others.
#[derive(Clone, Copy)]
pub(super) struct Beside {
    pub(super) fit: Fit,
    /// Median and least error of the other members.
    pub(super) usual: f64,
    pub(super) least: f64,
}

/// How each camera fits the others; `None` of a camera that cannot be judged.
pub(super) fn fits(judged: &Judged) -> Vec<Option<Beside>> {
    let Judged { scene, consensus, .. } = judged;
    let fit = |camera: usize| {
        let points = scene.points(consensus, Some(camera));
        scene.fit(camera, &scene.readings[camera], &points)
    };
    let all: Vec<Option<Fit>> = (0..scene.cameras()).map(fit).collect();
    let beside = |camera: usize| {
        let others = (0..all.len()).filter(|&i| i != camera && consensus.members[i]);
        let mut others: Vec<f64> = others.filter_map(|i| Some(all[i]?.error)).collect();
        let least = others.iter().copied().fold(f64::INFINITY, f64::min);
        Some(Beside { fit: all[camera]?, usual: median(&mut others)?, least })
    };
    (0..all.len()).map(beside).collect()
}

/// The fault of each camera that explains why it does not fit the others.
fn explain_all(judged: &Judged, cameras: &[Camera]) -> Vec<(usize, Hypothesis)> {
    let Judged { scene, consensus, findings, .. } = judged;
    let count = consensus.count();
    let explain = |(camera, beside): (usize, Option<Beside>)| {
        let is_base = consensus.members[camera] && count <= 2;
        let beside = beside.filter(|_| findings[camera].is_none() && !is_base)?;
        let points = scene.points(consensus, Some(camera));
        Some((camera, explained(scene, camera, &points, (beside, false), cameras)?))
    };
    fits(judged).into_iter().enumerate().filter_map(explain).collect()
}

/// The fault of a camera that explains why it does not fit the others. `is_part`: in a part of the recording, where a
/// clock can only be shifted.
pub(super) fn explained(
    scene: &Scene,
    camera: usize,
    points: &[Points],
    (beside, is_part): (Beside, bool),
    cameras: &[Camera],
) -> Option<Hypothesis> {
    let Beside { fit: now, usual, least: of_best } = beside;
    if now.error < FITS_IN_TIME {
        return None;
    }
    let (best, error) = explain(scene, camera, points, (usual, is_part), cameras)?;
    let is_near_clock = is_of_clock(&best.finding) && best.weight < OF_MANY;
    let (times, [least, most]) = GAIN_FREE;
    let gain = match best.weight {
        _ if is_near_clock => GAIN_IN_TIME,
        _ if is_of_clock(&best.finding) && !is_part => GAIN,
        weight if weight < OF_MANY => GAIN,
        _ => (times * of_best).clamp(least, most),
    };
    let is_explained =
        error < (EXPLAINED * now.error).min(now.error - gain).min(2.0 * usual + FITS);
    (is_explained && (is_near_clock || now.error >= FITS)).then_some(best)
}

/// The fault that explains most, and the error without it. `usual` is the error of the others.
fn explain(
    scene: &Scene,
    camera: usize,
    points: &[Points],
    (usual, is_part): (f64, bool),
    cameras: &[Camera],
) -> Option<(Hypothesis, f64)> {
    let reading = &scene.readings[camera];
    let mut all = hypotheses::of_one(reading);
    all.extend(clock::shifts(reading, scene.periods[camera]));
    all.extend(hypotheses::others(reading, cameras.iter()));
    all.extend(placement::placements(reading, &scene.matches(camera, reading, points)));
    let found = best(scene, camera, points, all);
    let explains_all = |(one, error): &(Hypothesis, f64)| {
        // Motion may be periodic: another shift may fit better.
        *error < EXPLAINS_ALL * usual && !is_of_clock(&one.finding)
    };
    if found.as_ref().is_some_and(explains_all) {
        return found;
    }
    let clocks = clock::clocks(scene, camera, points, is_part);
    let all = found.map(|(one, _)| one).into_iter().chain(clocks);
    best(scene, camera, points, all)
}

/// The hypothesis with the least weighed error, and its error.
fn best(
    scene: &Scene,
    camera: usize,
    points: &[Points],
    all: impl IntoIterator<Item = Hypothesis>,
) -> Option<(Hypothesis, f64)> {
    let tried = all.into_iter().filter_map(|hypothesis| {
        let error = scene.fit(camera, &hypothesis.reading, points)?.error;
        Some((hypothesis, error))
    });
    tried.min_by(|a, b| (a.0.weight * a.1).total_cmp(&(b.0.weight * b.1)))
}

/// The cameras with their calibrations exchanged, if most agree then.
fn exchanged<'a>(scene: &Scene<'a>, cameras: &[Camera]) -> Option<Judged<'a>> {
    if scene.cameras() > MOST_PERMUTED {
        return None;
    }
    let tried = scene.orders().into_iter().filter_map(|order| in_order(scene, cameras, &order));
    tried.max_by(|a, b| a.score().total_cmp(&b.score()))
}

fn in_order<'a>(scene: &Scene<'a>, cameras: &[Camera], order: &[usize]) -> Option<Judged<'a>> {
    if order.is_sorted() {
        return None;
    }
    let readings = scene.readings.iter().zip(order);
    let readings = readings
        .map(|(reading, &k)| Reading { camera: cameras[k].clone(), ..reading.clone() })
        .collect();
    let scene = scene.with(readings);
    let consensus = scene.agree()?;
    let other =
        |(i, &k): (usize, &usize)| (i != k).then(|| hypotheses::is_another(&cameras[k].name));
    let findings: Vec<Option<Finding>> = order.iter().enumerate().map(other).collect();
    let judged = Judged { scene, consensus, findings, general: Vec::new() };
    Some(fix(judged, cameras))
}

/// A fault of all cameras, if most agree without it.
fn common<'a>(scene: &Scene<'a>) -> Option<Judged<'a>> {
    let all = |reading: &Reading| {
        let mut all = hypotheses::images(reading);
        all.extend(hypotheses::poses(reading));
        all.extend(placement::factors(reading));
        // A scale of all translations and exchanged labels change no agreement.
        all.retain(|hypothesis| hypothesis.finding.cause != "translation_unit");
        all.retain(|hypothesis| hypothesis.reading.swapped == reading.swapped);
        all
    };
    let by_camera: Vec<Vec<Hypothesis>> = scene.readings.iter().map(all).collect();
    let count = by_camera.iter().map(Vec::len).min()?;
    let tried = (0..count).filter_map(|k| {
        let readings = by_camera.iter().map(|all| all[k].reading.clone()).collect();
        let scene = scene.with(readings);
        let consensus = scene.agree()?;
        let Finding { cause, what, fix, .. } = &by_camera[0][k].finding;
        let finding = Finding::new(cause, format!("of each camera: {what}"), &**fix);
        let findings = vec![None; scene.cameras()];
        Some(Judged { scene, consensus, findings, general: vec![finding] })
    });
    tried.max_by(|a, b| a.score().total_cmp(&b.score()))
}

/// What would make two cameras agree.
struct Alternative {
    error: f64,
    text: String,
    consensus: Consensus,
    /// The camera and the fault, if it is one of its clock.
    shift: Option<(usize, Hypothesis)>,
}

/// Two cameras: which one is wrong is not known, but what would make them agree.
fn pair<'a>(scene: &Scene<'a>, cameras: &[Camera], two: [usize; 2]) -> Option<Judged<'a>> {
    let [first, second] = two;
    let error = |scene: &Scene| {
        let consensus = scene.agree()?;
        let points = scene.points(&consensus, None);
        let fit = |camera| scene.fit(camera, &scene.readings[camera], &points);
        let error = fit(first)?.error.max(fit(second)?.error);
        let height = performer::height_m(&points)?;
        Some((error, height, consensus))
    };
    let now = error(scene);
    let disagreement = now.as_ref().map(|now| now.0);
    let judged = |consensus, general| {
        let findings = vec![None; cameras.len()];
        Judged { scene: scene.clone(), consensus, findings, general }
    };
    if disagreement.is_some_and(|error| error < FITS / 2.0) {
        return now.map(|(_, _, consensus)| judged(consensus, Vec::new()));
    }
    let before = disagreement.unwrap_or(2.0 * DISAGREE);
    // Without the fault, the two agree on somebody.
    let alternative = |camera: usize, hypothesis: Hypothesis| {
        let (error, height, consensus) =
            error(&scene.with_one(camera, hypothesis.reading.clone()))?;
        let is_explained = error < EXPLAINED * before && before - error > GAIN / 2.0;
        let Finding { what, fix, .. } = &hypothesis.finding;
        let text = format!("camera {}: {what} ({fix})", cameras[camera].name);
        let shift = Some((camera, hypothesis.clone())).filter(|_| is_of_clock(&hypothesis.finding));
        let option = Alternative { error: error * hypothesis.weight, text, consensus, shift };
        (is_explained && HEIGHTS_M.contains(&height)).then_some(option)
    };
    let mut options = Vec::new();
    for camera in two {
        let reading = &scene.readings[camera];
        let mut all = hypotheses::of_one(reading);
        all.extend(placement::factors(reading));
        all.extend(clock::shifts(reading, scene.periods[camera]));
        options.extend(all.into_iter().filter_map(|one| alternative(camera, one)));
    }
    if options.iter().all(|option| option.shift.is_some()) {
        let both = |scene: &Scene| {
            let are_there = |at: &&Vec<Vec<_>>| two.iter().all(|camera| !at[*camera].is_empty());
            scene.views.iter().filter(are_there).count()
        };
        let least = both(scene) / 2;
        let reading = &scene.readings[second];
        let error = |clock: Clock| {
            let tried = scene.with_one(second, Reading { clock, ..reading.clone() });
            error(&tried).map(|(error, ..)| error).filter(|_| both(&tried) >= least)
        };
        let far = clock::far(scene, second, clock::MOST_IF_UNSURE, error);
        let far = far.map(|clock| clock::with_clock(reading, scene.periods[second], clock));
        options.extend(far.and_then(|far| alternative(second, far)));
    }
    let of_both =
        disagreement.is_none_or(|error| error > DISAGREE).then(|| common(scene)).flatten();
    if let Some(Judged { consensus, general, scene: tried, .. }) = of_both
        && let Some((error, height, _)) = error(&tried)
        && error < FITS
        && HEIGHTS_M.contains(&height)
        && let Some(Finding { what, fix, .. }) = general.first()
    {
        let text = format!("{what} ({fix})");
        options.push(Alternative { error, text, consensus, shift: None });
    }
    let readings = &scene.readings;
    let mut exchanged = readings.clone();
    exchanged[first].camera = cameras[second].clone();
    exchanged[second].camera = cameras[first].clone();
    if let Some((error, _, consensus)) = error(&scene.with(exchanged))
        && error < EXPLAINED * before
    {
        let text = "the two cameras are exchanged".to_owned();
        options.push(Alternative { error, text, consensus, shift: None });
    }
    options.sort_by(|a, b| a.error.total_cmp(&b.error));
    let least = options.first().map_or(0.0, |best| best.error);
    options.retain(|option| option.error <= ALIKE * least);
    // At different rates, one of them may be wrong.
    let [one, other] = two.map(|camera| scene.periods[camera].ns() as f64);
    let is_one_rate = (one / other).ln().abs() < SAME_RATE;
    // Only their clocks can be wrong, by one shift. Which of the two is shifted is the same.
    let shift = |option: &Alternative| {
        let (camera, hypothesis) = option.shift.as_ref()?;
        let late = hypothesis.reading.clock.late - scene.readings[*camera].clock.late;
        let frames = late.ns() as f64 / scene.periods[*camera].ns() as f64;
        Some(if *camera == first { -frames } else { frames })
    };
    if let Some(best) = options.first()
        && let Some((camera, hypothesis)) = &best.shift
        && let Some(frames) = shift(best)
        && best.error < hypothesis.weight * FITS
        && is_one_rate
        && options.iter().all(|one| shift(one).is_some_and(|s| (s - frames).abs() <= ONE_SHIFT))
    {
        let scene = scene.with_one(*camera, hypothesis.reading.clone());
        let mut findings = vec![None; cameras.len()];
        findings[*camera] = Some(hypothesis.finding.clone());
        let consensus = best.consensus.clone();
        return Some(Judged { scene, consensus, findings, general: Vec::new() });
    }
    // Perhaps the two never see somebody at the same time.
    let are_there = |at: &Vec<Vec<_>>| two.iter().all(|camera| !at[*camera].is_empty());
    let disagrees = scene.views.iter().any(are_there)
        && (disagreement.is_none_or(|error| error > DISAGREE) || !options.is_empty());
    let consensus = options.first().map(|option| option.consensus.clone());
    let consensus = now.map(|now| now.2).or(consensus);
    let texts: Vec<String> =
        options.into_iter().take(MOST_OPTIONS).map(|option| option.text).collect();
    let what = "the two cameras disagree; which one is wrong is not known";
    let fix = match texts.is_empty() {
        true => "calibrate again; a third camera would tell".to_owned(),
        false => format!("they would agree without one of these: {}", texts.join("; ")),
    };
    let general = if disagrees { vec![Finding::new("disagree", what, fix)] } else { Vec::new() };
    let consensus = consensus.or_else(|| general.first().map(|_| Consensus::nobody(scene)))?;
    Some(judged(consensus, general))
}
