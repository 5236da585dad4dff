//! What the frames of one camera say by themselves: missing people, repeated or shuffled frames, odd
//! confidences.

use super::footage::{APART, Footage, Track, overlap};
use super::hypotheses::Finding;
use crate::core::camera::Camera;
use crate::core::detections::Keypoint as K;
use crate::core::points::{CONFIDENT, median};
use crate::core::time::{Nanos, Timestamp};

/// A share of frames that equal the one before. Detections of moving images always differ.
const REPEATED: f64 = 0.3;
/// A performer moves by this part of its size in [`APART`] frames.
const MOVES: f64 = 0.03;
/// In shuffled frames, one step is as long as many.
const ALIKE: f64 = 0.75;
/// In shuffled frames, the steps of neighbouring points have at least this correlation.
const TOGETHER: f64 = 0.4;
const NEIGHBOURS: [[K; 2]; 4] =
    [[K::LElbow, K::LWrist], [K::RElbow, K::RWrist], [K::LKnee, K::LAnkle], [K::RKnee, K::RAnkle]];
/// Slower cameras do not show how somebody moves from frame to frame.
const SLOW: Nanos = Nanos::from_ms(150);
/// Fewer frames say nothing.
const LEAST_FRAMES: usize = 20;

/// What is wrong with the frames of a camera. How people move is told from the
/// frames in which somebody is `alone`.
pub(super) fn findings(
    footage: &Footage,
    alone: &Footage,
    cameras: &[Camera],
    camera: usize,
) -> Vec<Finding> {
    let (track, alone) = (&footage.tracks[camera], &alone.tracks[camera]);
    let all = [
        absent(footage, cameras, camera),
        disordered(track),
        doubled(track),
        repeated(alone),
        shuffled(alone).then(|| {
            let what = "its frames are not in the order of time: one step is as long as many";
            Finding::new("shuffled", what, "sort its frames, or check their numbers")
        }),
        percent(track),
    ];
    all.into_iter().flatten().collect()
}

/// The capture times of a camera are not those of any of the others.
pub(super) fn away(
    footage: &Footage,
    cameras: &[Camera],
    camera: usize,
    is_other: impl Fn(usize) -> bool,
) -> Option<Finding> {
    let spans = footage.spans(cameras);
    let own = spans[camera]?;
    let others = (0..spans.len()).filter(|&other| other != camera && is_other(other));
    let others: Vec<[Timestamp; 2]> = others.filter_map(|other| spans[other]).collect();
    if others.iter().any(|other| overlap(own, *other)) {
        return None;
    }
    let mut away: Vec<f64> = others.iter().map(|[start, _]| own[0].seconds_since(*start)).collect();
    let away = median(&mut away)?;
    let what = format!("its capture times are {away:+.3} s from those of the others");
    let offset = (cameras[camera].time_offset.seconds() - away) * 1e3;
    let fix = format!(
        "set its clock; if all cameras began together, time_offset_ms = {offset:.0} in its calibration \
         mends it"
    );
    Some(Finding::new("clock", what, fix))
}

fn absent(footage: &Footage, cameras: &[Camera], camera: usize) -> Option<Finding> {
    if footage.spans(cameras)[camera].is_none() {
        return Some(Finding::new("no_frames", "it has no frames", "record or import them"));
    }
    if let Some(finding) = away(footage, cameras, camera, |_| true) {
        return Some(finding);
    }
    let Track { frames, points, confident, .. } = &footage.tracks[camera];
    (!frames.is_empty() && frames.iter().all(|frame| frame.people.is_empty())).then(|| {
        if *points > 0 && *confident == 0 {
            let what = format!("all its confidences are below {CONFIDENT}, so it is not judged");
            let fix = "scale them so that the largest is about 1";
            return Finding::new("confidence_unit", what, fix);
        }
        let fix = "check its detector, the keypoint format and what it looks at";
        Finding::new("nobody", "it sees nobody in any frame", fix)
    })
}

fn disordered(track: &Track) -> Option<Finding> {
    (10 * track.disordered > track.count).then(|| {
        let (bad, all) = (track.disordered, track.count);
        let what = format!("{bad} of its {all} frames are not after the one before");
        Finding::new("capture_order", what, "sort the recording by capture time")
    })
}

fn doubled(track: &Track) -> Option<Finding> {
    (10 * track.doubled > track.count).then(|| {
        let (bad, all) = (track.doubled, track.count);
        let what = format!("{bad} of its {all} frames have the capture time of the one before");
        Finding::new("duplicates", what, "record or import each frame once")
    })
}

/// Whether the frames repeat the one before.
fn repeated(track: &Track) -> Option<Finding> {
    let pairs = || track.frames.windows(2).filter(|pair| !pair[0].people.is_empty());
    let (same, all) =
        (pairs().filter(|pair| pair[0].people == pair[1].people).count(), pairs().count());
    (all >= LEAST_FRAMES && same as f64 > REPEATED * all as f64).then(|| {
        let what = format!("{} % of its frames repeat the one before", 100 * same / all);
        let fix = "check that its detector runs, and the frame rate of its video";
        Finding::new("repeated_frames", what, fix)
    })
}

/// Correlation of the steps of neighbouring points. It is 0 for points that jump about by themselves, and then one step
/// is as long as many, too.
fn correlation(track: &Track) -> f64 {
    let (mut both, mut squares) = (0.0, [0.0; 2]);
    for pair in track.frames.windows(2) {
        let ([before], [after]) = (&pair[0].people[..], &pair[1].people[..]) else { continue };
        for neighbours in NEIGHBOURS {
            let step = |point| {
                let index = pair[0].format.index_of(point)?;
                Some(after.at(index)? - before.at(index)?)
            };
            let [Some(a), Some(b)] = neighbours.map(step) else { continue };
            both += a.dot(&b);
            squares = [squares[0] + a.norm_squared(), squares[1] + b.norm_squared()];
        }
    }
    both / (squares[0] * squares[1]).sqrt().max(f64::MIN_POSITIVE)
}

/// Whether one step is as long as many, although the performer moves.
fn shuffled(track: &Track) -> bool {
    if track.period().is_none_or(|period| period > SLOW) {
        return false;
    }
    let step = |apart: usize| {
        let pairs = track.frames.iter().zip(track.frames.iter().skip(apart));
        let moved = pairs.filter_map(|(a, b)| {
            let ([a], [b]) = (&a.people[..], &b.people[..]) else { return None };
            Some(a.distance(b)? / a.extent().max(1.0))
        });
        let mut moved: Vec<f64> = moved.collect();
        // A performer may stand for most of the time.
        moved.sort_by(f64::total_cmp);
        moved.get(3 * moved.len() / 4).copied().filter(|_| moved.len() >= LEAST_FRAMES)
    };
    step(1).zip(step(APART)).is_some_and(|(one, many)| many > MOVES && one > ALIKE * many)
        && correlation(track) > TOGETHER
}

fn percent(track: &Track) -> Option<Finding> {
    (track.points > 0 && 2 * track.percent > track.points).then(|| {
        let what = "its confidences are above 1, as if in per cent; they are used as 1";
        Finding::new("confidence_unit", what, "divide them by 100, or by their largest")
    })
}
