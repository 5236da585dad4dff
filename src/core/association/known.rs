//! The detections of known performers.

use super::consensus::consensus;
use super::matching::{Edge, matching};
use super::parts::{Bounds, KEYPOINTS, Part, Pixels, Points};
use super::{Assigned, Expectation, Gates, LastSeen, Sight, View};

/// Assignments, each from where most views saw the performers in the one before.
const ROUNDS: usize = 3;
/// A distance of a point, and of an arm or a leg, counts as this one if it is larger: limbs of somebody
/// else do not outvote the trunk.
const FAR: f64 = 0.4;
const FAR_LIMB: f64 = 0.15;
/// Where the views agree, a detection is accepted up to this cost plus twice the median of the views'
/// errors.
const AGREED: f64 = 0.06;
/// Gain of a detection with the id of the last one.
const SAME_ID: f64 = 0.03;
/// Factor on the gain of a hidden performer.
const HIDDEN: f64 = 0.2;
/// A part within this distance is in its place.
const IN_PLACE: f64 = 0.08;
/// A part of another detection is taken within this distance, and must be nearer by the second than
/// the detection's own.
const BORROWED: f64 = 0.10;
const NEARER: f64 = 0.04;
/// A detection that lies on a known performer up to this cost is another one of the same person.
const COPY: f64 = 0.06;

/// A performer as expected in one view.
struct Outline {
    pixels: Pixels,
    bounds: Bounds,
    /// Of the whole body, pixels.
    size: f64,
    id: Option<i64>,
}

impl Outline {
    /// `None` if nothing of the performer lies before the camera.
    fn of(view: &View, points: &Points, last: Option<&LastSeen>) -> Option<Self> {
        let mut pixels = view.project(points);
        if let Some(last) = last {
            for at in (0..KEYPOINTS).filter(|&at| points[at].is_none()) {
                pixels[at] = last.pixels[at];
            }
        }
        let bounds = Bounds::of(&pixels)?;
        let size = bounds.extent().max(1.0);
        Some(Self { pixels, bounds, size, id: last.and_then(|last| last.id) })
    }

    /// The mean distance of a part's points from `place` as a fraction of the size. `None` if no point
    /// is both seen and expected.
    fn part(&self, sight: &Sight, part: Part, place: Part) -> Option<f64> {
        let (mut sum, mut count) = (0.0, 0.0);
        for (&seen, &expected) in part.compared().iter().zip(place.compared()) {
            let pair = sight.pixels[seen as usize].zip(self.pixels[expected as usize]);
            if let Some((seen, expected)) = pair {
                sum += ((seen - expected).norm() / self.size).min(FAR);
                count += 1.0;
            }
        }
        (count > 0.0).then(|| sum / count)
    }

    /// The mean distance of the parts by their weights, and the share of the weights that are seen.
    fn cost(&self, sight: &Sight) -> Option<(f64, f64)> {
        let (mut sum, mut seen, mut all) = (0.0, 0.0, 0.0);
        for part in Part::ALL {
            all += part.weight();
            if let Some(distance) = self.part(sight, part, part) {
                let is_trunk = matches!(part, Part::Upper | Part::Hips);
                sum += part.weight() * distance.min(if is_trunk { FAR } else { FAR_LIMB });
                seen += part.weight();
            }
        }
        (seen > 0.0).then(|| (sum / seen, seen / all))
    }
}

/// The performers' detections by performer and view (indices of sights), and where the performers are.
pub(super) fn assign(
    views: &[View],
    performers: &[Expectation],
    gates: &Gates,
) -> (Vec<Vec<Assigned>>, Vec<Points>) {
    let mut places: Vec<Points> = performers.iter().map(|performer| performer.points).collect();
    let mut accepted = vec![gates.follow; performers.len()];
    let trust = performers.iter().map(|one| if one.is_hidden { HIDDEN } else { 1.0 });
    let trust: Vec<f64> = trust.collect();
    let (mut outlines, mut owned) = (Vec::new(), Vec::new());
    for round in 0..ROUNDS {
        outlines = outline(views, performers, &places);
        let of_view = |(view, outlines): (&View, &Vec<_>)| whole(view, outlines, &accepted, &trust);
        let again: Vec<Vec<Option<usize>>> = views.iter().zip(&outlines).map(of_view).collect();
        let is_settled = again == owned;
        owned = again;
        if is_settled || round + 1 == ROUNDS {
            break;
        }
        for (at, performer) in performers.iter().enumerate() {
            let seen =
                views.iter().zip(&owned).zip(&outlines).filter_map(|((view, owned), all)| {
                    Some((view, &view.sights[owned[at]?], all[at].as_ref()?.size))
                });
            if let Some(found) = consensus(&performer.points, &seen.collect::<Vec<_>>()) {
                places[at] = performer.points.map(|point| Some(point? + found.shift));
                accepted[at] = gates.follow.min(AGREED + 2.0 * found.error);
            }
        }
    }
    let by_view: Vec<Vec<Assigned>> = views
        .iter()
        .zip(&outlines)
        .zip(&owned)
        .map(|((view, outlines), owned)| parts(view, outlines, owned))
        .collect();
    let of_performer = |at: usize| by_view.iter().map(|view| view[at]).collect();
    ((0..performers.len()).map(of_performer).collect(), places)
}

fn outline(
    views: &[View],
    performers: &[Expectation],
    places: &[Points],
) -> Vec<Vec<Option<Outline>>> {
    let of_view = |view: &View| {
        let all = performers.iter().zip(places).map(|(performer, points)| {
            let last = performer.last.get(view.index).and_then(Option::as_ref);
            Outline::of(view, points, last)
        });
        all.collect()
    };
    views.iter().map(of_view).collect()
}

/// The detection of each performer in a view, as a whole; `accepted` is the largest cost, and `trust` the
/// factor on the gain, of each.
fn whole(
    view: &View,
    outlines: &[Option<Outline>],
    accepted: &[f64],
    trust: &[f64],
) -> Vec<Option<usize>> {
    let mut edges = Vec::new();
    for (row, ((outline, accepted), trust)) in outlines.iter().zip(accepted).zip(trust).enumerate()
    {
        let Some(outline) = outline else { continue };
        for (column, sight) in view.sights.iter().enumerate() {
            if !outline.bounds.is_near(&sight.bounds, accepted * outline.size) {
                continue;
            }
            let Some((cost, share)) = outline.cost(sight) else { continue };
            let hint = if sight.id.is_some() && sight.id == outline.id { SAME_ID } else { 0.0 };
            let gain = (accepted - cost + hint) * share * trust;
            if cost < *accepted && gain > 0.0 {
                edges.push(Edge { row, column, gain });
            }
        }
    }
    matching(outlines.len(), view.sights.len(), &edges)
}

/// The parts of each performer in a view. A performer keeps the parts of its own detection, but
/// - parts that are not in their place are exchanged for nearer ones, of detections that are nobody's
///   or in which they are not in their place either,
/// - and are dropped if they lie on another performer.
fn parts(view: &View, outlines: &[Option<Outline>], owned: &[Option<usize>]) -> Vec<Assigned> {
    let whole = |own: &Option<usize>| own.map_or(Assigned::default(), Assigned::whole);
    let mut all: Vec<Assigned> = owned.iter().map(whole).collect();
    for part in Part::ALL.into_iter().filter(|part| *part != Part::Upper) {
        let distance = |row: usize, sight: usize| {
            outlines[row].as_ref()?.part(&view.sights[sight], part, part)
        };
        let own: Vec<Option<f64>> =
            owned.iter().enumerate().map(|(row, own)| distance(row, (*own)?)).collect();
        let is_in_place = |row: &usize| own[*row].is_some_and(|distance| distance <= IN_PLACE);
        let needy: Vec<usize> = (0..owned.len()).filter(|row| !is_in_place(row)).collect();
        if needy.is_empty() {
            continue;
        }
        let mut is_taken = vec![false; view.sights.len()];
        for row in (0..owned.len()).filter(is_in_place) {
            owned[row].into_iter().for_each(|sight| is_taken[sight] = true);
        }
        let mut edges = Vec::new();
        for &row in &needy {
            let Some(outline) = &outlines[row] else { continue };
            for (column, sight) in view.sights.iter().enumerate() {
                let is_near = outline.bounds.is_near(&sight.bounds, BORROWED * outline.size);
                if is_taken[column] || owned[row] == Some(column) || !is_near {
                    continue;
                }
                let Some(found) = distance(row, column) else { continue };
                if found < BORROWED.min(own[row].map_or(FAR, |own| own - NEARER)) {
                    edges.push(Edge { row, column, gain: BORROWED - found });
                }
            }
        }
        let borrowed = matching(owned.len(), view.sights.len(), &edges);
        borrowed.iter().flatten().for_each(|&sight| is_taken[sight] = true);
        for &row in &needy {
            let kept = owned[row].filter(|&sight| {
                let lies_on = |other: &Outline| {
                    let places = [part, part.twin()];
                    let found = places.map(|place| other.part(&view.sights[sight], part, place));
                    let found = found.into_iter().flatten().fold(FAR, f64::min);
                    found < IN_PLACE.min(own[row].unwrap_or(0.0) - NEARER)
                };
                let others = outlines.iter().enumerate().filter(|(other, _)| *other != row);
                !is_taken[sight] && !others.filter_map(|(_, o)| o.as_ref()).any(lies_on)
            });
            all[row].parts[part as usize] = borrowed[row].or(kept);
        }
    }
    all
}

/// Marks detections that lie on a known performer as not free.
pub(super) fn exclude_copies(view: &View, place: &Points, free: &mut [bool]) {
    let Some(outline) = Outline::of(view, place, None) else { return };
    for (sight, free) in view.sights.iter().zip(free) {
        let is_near = || outline.bounds.is_near(&sight.bounds, 0.0);
        if *free && is_near() && outline.cost(sight).is_some_and(|(cost, _)| cost < COPY) {
            *free = false;
        }
    }
}
