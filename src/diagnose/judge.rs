//! Finds the faults: the reading of each camera with which most cameras agree.

use super::consensus::{Consensus, Fit, Points, Scene};
use super::hypotheses::{self, Finding, Hypothesis};
use super::performer;
use super::placement;
use super::reading::Reading;
use crate::core::camera::Camera;
use crate::core::points::median;

/// A camera below this error fits, whatever else would fit better.
const FITS: f64 = 0.02;
/// A fault explains an error if the error without it is below this part, and lower by [`GAIN`].
const EXPLAINED: f64 = 0.55;
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
/// Two cameras disagree above this error of each.
const DISAGREE: f64 = 0.05;
/// A fault must raise the sum of the cameras' support by this.
const COST: f64 = 0.25;
/// Sets of cameras that are tried as the right ones.
const STARTS: usize = 3;
/// Permutations are tried with at most so many cameras.
const MOST_PERMUTED: usize = 16;
/// Of two cameras, the faults that are listed: the best ones, up to this many times the least error.
const MOST_OPTIONS: usize = 3;
const ALIKE: f64 = 1.5;

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
    if n == 2 {
        return pair(scene, cameras);
    }
    let starts = scene.consensuses(STARTS);
    // Images may be those of a camera that seems to have none.
    let has_all = (0..n).all(|camera| scene.views.iter().any(|at| !at[camera].is_empty()));
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
    found.into_iter().max_by(|a, b| a.score().total_cmp(&b.score()))
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
struct Beside {
    fit: Fit,
    /// Median and least error of the other members.
    usual: f64,
    least: f64,
}

/// How each camera fits the others; `None` of a camera that cannot be judged.
fn fits(judged: &Judged) -> Vec<Option<Beside>> {
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
        let unknown = beside.filter(|_| findings[camera].is_none() && !is_base);
        let Beside { fit: now, usual, least: of_best } = unknown?;
        if now.error < FITS {
            return None;
        }
        let points = scene.points(consensus, Some(camera));
        let (best, error) = explain(scene, camera, &points, cameras)?;
        let (times, [least, most]) = GAIN_FREE;
        let gain = if best.weight < 1.2 { GAIN } else { (times * of_best).clamp(least, most) };
        let explained =
            error < (EXPLAINED * now.error).min(now.error - gain).min(2.0 * usual + FITS);
        explained.then_some((camera, best))
    };
    fits(judged).into_iter().enumerate().filter_map(explain).collect()
}

/// The fault that explains most, and the error without it.
fn explain(
    scene: &Scene,
    camera: usize,
    points: &[Points],
    cameras: &[Camera],
) -> Option<(Hypothesis, f64)> {
    let reading = &scene.readings[camera];
    let mut all = hypotheses::of_one(reading);
    all.extend(hypotheses::times(reading, scene.periods[camera]));
    all.extend(hypotheses::others(reading, cameras.iter()));
    all.extend(placement::placements(reading, &scene.matches(camera, reading, points)));
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
    let (order, _) = scene.permute()?;
    let readings = scene.readings.iter().zip(&order);
    let readings = readings
        .map(|(reading, &k)| Reading { camera: cameras[k].clone(), ..reading.clone() })
        .collect();
    let scene = scene.with(readings);
    let consensus = scene.agree()?;
    let other =
        |(i, &k): (usize, &usize)| (i != k).then(|| hypotheses::is_another(&cameras[k].name));
    let findings: Vec<Option<Finding>> = order.iter().enumerate().map(other).collect();
    let moved = findings.iter().flatten().count();
    let judged = Judged { scene, consensus, findings, general: Vec::new() };
    let judged = fix(judged, cameras);
    (moved > 0).then_some(judged)
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
        let Finding { cause, what, fix } = &by_camera[0][k].finding;
        let finding = Finding::new(cause, format!("of each camera: {what}"), &**fix);
        let findings = vec![None; scene.cameras()];
        Some(Judged { scene, consensus, findings, general: vec![finding] })
    });
    tried.max_by(|a, b| a.score().total_cmp(&b.score()))
}

/// Two cameras: which one is wrong is not known, but what would make them agree.
fn pair<'a>(scene: &Scene<'a>, cameras: &[Camera]) -> Option<Judged<'a>> {
    let error = |scene: &Scene| {
        let consensus = scene.agree()?;
        let points = scene.points(&consensus, None);
        let fit = |camera| scene.fit(camera, &scene.readings[camera], &points);
        let error = fit(0)?.error.max(fit(1)?.error);
        let height = performer::height_m(&points)?;
        Some((error, height, consensus))
    };
    let now = error(scene);
    let disagreement = now.as_ref().map(|now| now.0);
    let judged = |consensus, general| {
        let findings = vec![None; 2];
        Judged { scene: scene.clone(), consensus, findings, general }
    };
    if disagreement.is_some_and(|error| error < FITS / 2.0) {
        return now.map(|(_, _, consensus)| judged(consensus, Vec::new()));
    }
    let mut options = Vec::new();
    for (camera, Camera { name, .. }) in cameras.iter().enumerate() {
        let reading = &scene.readings[camera];
        let mut all = hypotheses::of_one(reading);
        all.extend(placement::factors(reading));
        all.extend(hypotheses::times(reading, scene.periods[camera]));
        for hypothesis in all {
            let tried = scene.with_one(camera, hypothesis.reading);
            let Some((error, height, consensus)) = error(&tried) else { continue };
            let before = disagreement.unwrap_or(2.0 * DISAGREE);
            let explained = error < EXPLAINED * before && before - error > GAIN / 2.0;
            if explained && (1.2..2.3).contains(&height) {
                let Finding { what, fix, .. } = hypothesis.finding;
                let text = format!("camera {name}: {what} ({fix})");
                options.push((error * hypothesis.weight, text, consensus));
            }
        }
    }
    let of_both =
        disagreement.is_none_or(|error| error > DISAGREE).then(|| common(scene)).flatten();
    if let Some(Judged { consensus, general, scene: tried, .. }) = of_both
        && let Some((error, height, _)) = error(&tried)
        && error < FITS
        && (1.2..2.3).contains(&height)
        && let Some(Finding { what, fix, .. }) = general.first()
    {
        options.push((error, format!("{what} ({fix})"), consensus));
    }
    let readings = &scene.readings;
    let exchanged: Vec<Reading> =
        [0, 1].map(|i| Reading { camera: cameras[1 - i].clone(), ..readings[i].clone() }).into();
    if let Some((error, _, consensus)) = error(&scene.with(exchanged))
        && error < EXPLAINED * disagreement.unwrap_or(2.0 * DISAGREE)
    {
        options.push((error, "the two cameras are exchanged".to_owned(), consensus));
    }
    options.sort_by(|a, b| a.0.total_cmp(&b.0));
    let least = options.first().map_or(0.0, |best| best.0);
    options.retain(|option| option.0 <= ALIKE * least);
    let disagrees = disagreement.is_none_or(|error| error > DISAGREE) || !options.is_empty();
    let consensus = options.first().map(|option| option.2.clone());
    let consensus = now.map(|now| now.2).or(consensus);
    let texts: Vec<String> =
        options.into_iter().take(MOST_OPTIONS).map(|option| option.1).collect();
    let what = "the two cameras disagree; which one is wrong is not known";
    let fix = match texts.is_empty() {
        true => "calibrate again; a third camera would tell".to_owned(),
        false => format!("they would agree without one of these: {}", texts.join("; ")),
    };
    let general = if disagrees { vec![Finding::new("disagree", what, fix)] } else { Vec::new() };
    let consensus = consensus.or_else(|| general.first().map(|_| Consensus::nobody(scene)))?;
    Some(judged(consensus, general))
}
