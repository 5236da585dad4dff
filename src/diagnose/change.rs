//! Faults that begin or end during the recording: a camera that is bumped, or loses frames.

use super::clock::is_of_clock;
use super::consensus::{FAR, Scene, capped_mean};
use super::hypotheses::{Finding, Hypothesis};
use super::judge::{Beside, Judged, explained, fits};
use super::times::{Only, WrongTimes};
use crate::core::camera::Camera;
use crate::core::time::Nanos;

/// A part of the recording has at least so many instants.
const LEAST_PART: usize = 6;
/// The error in the bad part is this many times that in the good one.
const TIMES_WORSE: f64 = 2.0;
/// A fault of a part lowers the mean error to this part of what a fault of the whole recording leaves.
const LOWERED: f64 = 0.7;
/// The same if that is a wrong frame rate: in periodic motion it looks much like a step of the clock.
const LOWERED_OF_RATE: f64 = 0.9;

/// A recording in two parts; one of them is bad.
#[derive(Clone, Copy, Debug)]
struct Split {
    /// The last instant of the first part that was judged, and the first one of the second part.
    before: usize,
    at: usize,
    is_first_bad: bool,
}

/// Looks for faults of a part of the recording. They replace faults of the whole recording that explain less. In `scene`
/// no fault is undone. Returns what is wrong with the times of each camera.
pub(super) fn find(
    scene: &Scene,
    judged: &mut Judged,
    cameras: &[Camera],
) -> Vec<Option<WrongTimes>> {
    let of_clock = |finding: &Option<Finding>| finding.as_ref().is_some_and(is_of_clock);
    let readings = judged.findings.iter().zip(&judged.scene.readings);
    let times = readings.map(|(finding, reading)| {
        of_clock(finding).then_some(WrongTimes { clock: reading.clock, only: None })
    });
    let mut times: Vec<_> = times.collect();
    let mut changed = vec![false; cameras.len()];
    loop {
        let is_open = |camera: &usize| {
            let others = judged.consensus.count() - usize::from(judged.consensus.members[*camera]);
            !changed[*camera] && others >= 2
        };
        let all = fits(judged).into_iter().enumerate();
        let found = all.filter(|(camera, _)| is_open(camera)).filter_map(|(camera, beside)| {
            Some((camera, fault(scene, judged, (camera, beside?), cameras)?))
        });
        // The worst camera makes others look wrong.
        let Some((camera, (_, (finding, wrong)))) = found.max_by(|a, b| a.1.0.total_cmp(&b.1.0))
        else {
            return times;
        };
        judged.scene = judged.scene.with_one(camera, scene.readings[camera].clone());
        judged.findings[camera] = Some(finding);
        times[camera] = wrong;
        judged.consensus.members[camera] = false;
        changed[camera] = true;
    }
}

/// The fault of a part of the recording, and how much it lowers the mean error.
fn fault(
    scene: &Scene,
    judged: &Judged,
    (camera, beside): (usize, Beside),
    cameras: &[Camera],
) -> Option<(f64, Change)> {
    let points = judged.scene.points(&judged.consensus, Some(camera));
    let now = scene.errors(camera, &scene.readings[camera], &points);
    // Lost frames look like a wrong rate.
    let unsure = ["disagrees", "frame_rate"];
    let found = judged.findings[camera].as_ref().filter(|found| !unsure.contains(&found.cause));
    let hypothesis = match found {
        Some(finding) => {
            let reading = judged.scene.readings[camera].clone();
            Hypothesis { finding: finding.clone(), reading, weight: 1.0 }
        }
        None => {
            let Split { at, is_first_bad, .. } = bad_part(&now)?;
            let part = if is_first_bad { 0..at } else { at..now.len() };
            let (some, points) = (scene.part(part.clone()), &points[part]);
            let fit = some.fit(camera, &scene.readings[camera], points)?;
            explained(&some, camera, points, (Beside { fit, ..beside }, true), cameras)?
        }
    };
    let then = scene.errors(camera, &hypothesis.reading, &points);
    let undone = scene.errors(camera, &judged.scene.readings[camera], &points);
    let mean = |errors: &[Option<f64>]| capped_mean(errors.iter().flatten().copied());
    let (left, split) = split(&now, &then)?;
    let before = mean(&now);
    let whole = before.min(mean(&then)).min(mean(&undone));
    let is_rate = judged.findings[camera].as_ref().is_some_and(|found| found.cause == "frame_rate");
    let lowered = if is_rate { LOWERED_OF_RATE } else { LOWERED };
    (left < lowered * whole).then(|| (before - left, described(scene, split, camera, hypothesis)))
}

/// The two parts that differ most, if one is much worse.
fn bad_part(errors: &[Option<f64>]) -> Option<Split> {
    let all = errors.iter().enumerate();
    let seen: Vec<_> = all.filter_map(|(at, error)| Some((at, (*error)?))).collect();
    let mean = |part: &[(usize, f64)]| capped_mean(part.iter().map(|(_, error)| *error));
    let last = seen.len().checked_sub(LEAST_PART)?;
    let differ = |k: usize| {
        let (first, second) = seen.split_at(k);
        let share = k as f64 * (seen.len() - k) as f64;
        (mean(first) - mean(second)) * share.sqrt()
    };
    let best = (LEAST_PART..=last).max_by(|&a, &b| differ(a).abs().total_cmp(&differ(b).abs()))?;
    let (first, second) = seen.split_at(best);
    let [bad, good] = if differ(best) > 0.0 { [first, second] } else { [second, first] };
    let (before, at) = (seen[best - 1].0, seen[best].0);
    let split = Split { before, at, is_first_bad: differ(best) > 0.0 };
    (mean(bad) > TIMES_WORSE * mean(good)).then_some(split)
}

/// The best split: one part keeps its errors `now`, the bad one has those `then`, without the fault. Also the mean error.
fn split(now: &[Option<f64>], then: &[Option<f64>]) -> Option<(f64, Split)> {
    let both: Vec<(usize, f64, f64)> = std::iter::zip(now, then)
        .enumerate()
        .filter_map(|(at, (now, then))| Some((at, now.as_ref()?.min(FAR), then.as_ref()?.min(FAR))))
        .collect();
    let last = both.len().checked_sub(LEAST_PART)?;
    let sum = |part: &[(usize, f64, f64)], is_bad: bool| -> f64 {
        part.iter().map(|(_, now, then)| if is_bad { then } else { now }).sum()
    };
    let tried = (LEAST_PART..=last).flat_map(|k| [(k, false), (k, true)]);
    let tried = tried.map(|(k, is_first_bad)| {
        let (first, second) = both.split_at(k);
        (sum(first, is_first_bad) + sum(second, !is_first_bad), k, is_first_bad)
    });
    let (least, k, is_first_bad) = tried.min_by(|a, b| a.0.total_cmp(&b.0))?;
    Some((least / both.len() as f64, Split { before: both[k - 1].0, at: both[k].0, is_first_bad }))
}

/// What is wrong with a part of the recording, and with its times, if that is it.
type Change = (Finding, Option<WrongTimes>);

/// The finding with the time when the fault begins or ends.
fn described(scene: &Scene, split: Split, camera: usize, hypothesis: Hypothesis) -> Change {
    let Split { before, at, is_first_bad } = split;
    let middle =
        scene.instants[before] + Nanos::new((scene.instants[at] - scene.instants[before]).ns() / 2);
    let seconds = scene.start.map_or(0.0, |start| middle.seconds_since(start));
    let changes_at_ns = Some(middle.ns());
    let Hypothesis { finding: Finding { cause, what, fix, .. }, reading, .. } = hypothesis;
    let late = reading.clock.late;
    if cause == "time_shift" {
        let frames = late.ns() / scene.periods[camera].ns().max(1);
        let (count, lost) = (frames.abs(), (frames > 0) == is_first_bad);
        let (cause, word) = if lost { ("frames_lost", "lost") } else { ("frames_added", "added") };
        let finding = Finding::new(
            cause,
            format!("about {count} frames were {word} at about {seconds:.1} s"),
            "correct the numbers or the capture times of its frames",
        );
        // Between the last frame of the first part and the first one of the second part.
        let at = middle - reading.camera.time_offset + Nanos::new(late.ns() / 2);
        let only = Some((at, if is_first_bad { Only::Before } else { Only::From }));
        return (
            Finding { changes_at_ns, ..finding },
            Some(WrongTimes { clock: reading.clock, only }),
        );
    }
    let when = if is_first_bad { "until" } else { "from" };
    let what = format!("{when} about {seconds:.1} s, {what}");
    (Finding { cause, what, fix, changes_at_ns }, None)
}
