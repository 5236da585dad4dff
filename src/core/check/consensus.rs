//! What the views agree on: the cameras that see one performer in one place, and the performer's
//! points in the world.
//!
//! Each pair of cameras proposes points; the cameras that see them where the pair puts them support
//! the pair. The best supported pair and its supporters are the members. Errors are fractions of the
//! performer's height in the image.

use nalgebra::{Vector2, Vector3};

use super::footage::{FITTED, Footage, LEAST_POINTS, POINTS, extent, median};
use super::reading::{Reading, View};
use crate::core::camera::{Camera, Rig, triangulate, triangulate_robust};
use crate::core::time::{Nanos, Timestamp};

/// A camera sees a point where the others put it, up to this error.
pub(super) const NEAR: f64 = 0.03;
/// A camera supports a pair with this share of its frames.
const SUPPORTS: f64 = 0.5;
/// A camera with fewer frames of the performer is not judged.
pub(super) const LEAST_INSTANTS: usize = 4;

/// World points by index in [`POINTS`].
pub(super) type Points = [Option<Vector3<f64>>; POINTS.len()];

/// The people of all cameras at some instants.
#[derive(Clone, Debug)]
pub(super) struct Scene<'a> {
    pub(super) footage: &'a Footage,
    pub(super) readings: Vec<Reading>,
    pub(super) instants: Vec<Timestamp>,
    pub(super) periods: Vec<Nanos>,
    rig: Rig,
    /// By instant and camera.
    views: Vec<Vec<Vec<View>>>,
}

/// What a camera says of some points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fit {
    /// Median error, as a fraction of the performer's height in the image, and in pixels.
    pub(super) error: f64,
    pub(super) px: f64,
    /// Share of the points that are seen where they should be.
    pub(super) share: f64,
    /// Number of frames.
    pub(super) frames: usize,
}

/// The support of a pair of cameras.
#[derive(Clone, Debug)]
struct Proposal {
    pair: [usize; 2],
    /// For each camera, the share of its frames that agree.
    shares: Vec<f64>,
    /// By instant: the people of the pair, and the number of cameras that agree.
    people: Vec<Option<([usize; 2], usize)>>,
}

impl Proposal {
    fn total(&self) -> f64 {
        self.shares.iter().sum()
    }

    fn members(&self) -> Vec<bool> {
        self.shares.iter().map(|share| *share > SUPPORTS).collect()
    }
}

/// The cameras that agree, and whom they see.
#[derive(Clone, Debug)]
pub(super) struct Consensus {
    /// By camera.
    pub(super) members: Vec<bool>,
    /// Sum of the shares of frames that agree.
    pub(super) total: f64,
    /// The largest such sum of cameras that are not all members.
    pub(super) rival: f64,
    /// By instant and camera, the index of the person.
    people: Vec<Vec<Option<usize>>>,
}

impl Consensus {
    pub(super) fn count(&self) -> usize {
        self.members.iter().filter(|member| **member).count()
    }
}

impl<'a> Scene<'a> {
    pub(super) fn new(footage: &'a Footage, readings: Vec<Reading>, count: usize) -> Self {
        let instants = footage.instants(count);
        let usual = footage.period();
        let periods = footage.tracks.iter().map(|track| track.period().unwrap_or(usual)).collect();
        let rig = Rig { version: 0, cameras: Vec::new() };
        let mut scene = Self { footage, readings, instants, periods, rig, views: Vec::new() };
        scene.read();
        scene
    }

    /// The same with other readings.
    pub(super) fn with(&self, readings: Vec<Reading>) -> Self {
        let mut scene = Self { readings, views: Vec::new(), ..self.clone() };
        scene.read();
        scene
    }

    fn read(&mut self) {
        self.rig.cameras = self.readings.iter().map(|reading| reading.camera.clone()).collect();
        self.views = self.instants.iter().map(|&time| self.views_at(time)).collect();
    }

    fn views_at(&self, time: Timestamp) -> Vec<Vec<View>> {
        let all = self.readings.iter().zip(&self.footage.tracks).zip(&self.periods);
        all.map(|((reading, track), period)| reading.views(track, *period, time)).collect()
    }

    pub(super) fn cameras(&self) -> usize {
        self.readings.len()
    }

    /// Finds the cameras that agree. `None` if no two do.
    pub(super) fn agree(&self) -> Option<Consensus> {
        let n = self.cameras();
        let pairs = (0..n).flat_map(|b| (0..b).map(move |a| [a, b]));
        let proposals: Vec<Proposal> = pairs.map(|pair| self.propose(pair)).collect();
        let best = proposals.iter().max_by(|a, b| a.total().total_cmp(&b.total()))?;
        let members = best.members();
        if members.iter().filter(|member| **member).count() < 2 {
            return None;
        }
        let among = |proposal: &Proposal| {
            proposal.members().iter().zip(&members).all(|(other, member)| *member || !other)
        };
        let rivals = proposals.iter().filter(|proposal| !among(proposal));
        let rival = rivals.map(Proposal::total).fold(0.0, f64::max);
        let people = (0..self.instants.len()).map(|at| self.assign(at, &proposals, &members));
        Some(Consensus { total: best.total(), rival, people: people.collect(), members })
    }

    /// The person of each camera at an instant, from the best supported pair of members.
    fn assign(&self, at: usize, proposals: &[Proposal], members: &[bool]) -> Vec<Option<usize>> {
        let of_members = proposals.iter().filter(|p| p.pair.iter().all(|&i| members[i]));
        let known = of_members.filter_map(|p| p.people[at].map(|(people, count)| (p, people, count)));
        let Some((proposal, people, _)) = known.max_by_key(|(_, _, count)| *count) else {
            return vec![None; self.cameras()];
        };
        let Some(points) = self.propose_points(at, proposal.pair, people) else {
            return vec![None; self.cameras()];
        };
        let person = |camera: usize| {
            let views = self.views[at][camera].iter().enumerate();
            let fits = views.filter_map(|(person, view)| {
                Some((errors(&self.rig.cameras[camera], view, &points)?.0, person))
            });
            fits.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, person)| person)
        };
        let mut all: Vec<Option<usize>> = (0..self.cameras()).map(person).collect();
        proposal.pair.iter().zip(people).for_each(|(&camera, person)| all[camera] = Some(person));
        all
    }

    fn propose(&self, pair: [usize; 2]) -> Proposal {
        let n = self.cameras();
        let (mut agreed, mut seen) = (vec![0_usize; n], vec![0_usize; n]);
        let mut people = Vec::with_capacity(self.instants.len());
        for (at, views) in self.views.iter().enumerate() {
            let [a, b] = pair.map(|camera| views[camera].len());
            let tried = (0..a).flat_map(|a| (0..b).map(move |b| [a, b]));
            let best = tried.filter_map(|people| Some((people, self.support(at, pair, people)?)));
            let best = best.max_by_key(|(_, near)| near.iter().flatten().filter(|n| **n).count());
            if a > 0 && b > 0 {
                pair.iter().for_each(|&camera| seen[camera] += 1);
            }
            people.push(best.map(|(people, near)| {
                let mut count = 0;
                for (camera, near) in near.into_iter().enumerate() {
                    let Some(near) = near else { continue };
                    agreed[camera] += usize::from(near);
                    seen[camera] += usize::from(!pair.contains(&camera));
                    count += usize::from(near);
                }
                (people, count)
            }));
        }
        let share = |(agreed, seen): (usize, usize)| match seen < LEAST_INSTANTS.min(people.len()) {
            true => 0.0,
            false => agreed as f64 / seen as f64,
        };
        let shares = agreed.into_iter().zip(seen).map(share).collect();
        Proposal { pair, shares, people }
    }

    fn propose_points(&self, at: usize, pair: [usize; 2], people: [usize; 2]) -> Option<Points> {
        let [a, b] = [0, 1].map(|i| &self.views[at][pair[i]][people[i]]);
        let point = |i: usize| {
            let views = [(pair[0], a.pixels[i]?, 1.0), (pair[1], b.pixels[i]?, 1.0)];
            triangulate(&self.rig, &views)
        };
        let points: Points = std::array::from_fn(|i| point(i).filter(|_| i < FITTED));
        (points.iter().flatten().count() >= LEAST_POINTS).then_some(points)
    }

    /// Whether each camera agrees with a pair at an instant; `None` of a camera without people.
    /// `None` if the pair itself does not agree.
    fn support(&self, at: usize, pair: [usize; 2], people: [usize; 2]) -> Option<Vec<Option<bool>>> {
        let points = self.propose_points(at, pair, people)?;
        let cameras = &self.rig.cameras;
        let error = |camera: usize, view| Some(errors(&cameras[camera], view, &points)?.0);
        let own = [0, 1].map(|i| error(pair[i], &self.views[at][pair[i]][people[i]]));
        // Each of the two takes half of their disagreement.
        if own.iter().any(|own| own.is_none_or(|own| own > 0.5 * NEAR)) {
            return None;
        }
        let near = |camera: usize| {
            if pair.contains(&camera) {
                return Some(true);
            }
            let errors = self.views[at][camera].iter().map(|view| error(camera, view));
            let least = errors.map(|error| error.unwrap_or(f64::INFINITY)).reduce(f64::min)?;
            Some(least < NEAR)
        };
        Some((0..self.cameras()).map(near).collect())
    }

    /// The points of the members at each instant, without one camera.
    pub(super) fn points(&self, consensus: &Consensus, without: Option<usize>) -> Vec<Points> {
        let members: Vec<usize> =
            (0..self.cameras()).filter(|&i| consensus.members[i] && Some(i) != without).collect();
        let at = |(at, people): (usize, &Vec<Option<usize>>)| {
            let views: Vec<(usize, &View)> = members
                .iter()
                .filter_map(|&i| Some((i, &self.views[at][i][people[i]?])))
                .collect();
            let largest = views.iter().map(|(_, view)| view.extent).fold(0.0, f64::max);
            std::array::from_fn(|point| {
                let seen = views.iter().filter_map(|(i, v)| Some((*i, v.pixels[point]?, 1.0)));
                let seen: Vec<_> = seen.collect();
                let found = triangulate_robust(&self.rig, &seen, NEAR * largest, point as u64);
                found.map(|found| found.point)
            })
        };
        consensus.people.iter().enumerate().map(at).collect()
    }

    /// How well a camera with a reading sees the points of each instant. `None` with too few frames.
    pub(super) fn fit(&self, camera: usize, reading: &Reading, points: &[Points]) -> Option<Fit> {
        let (track, period) = (&self.footage.tracks[camera], self.periods[camera]);
        let (mut relative, mut px, mut near, mut all) = (Vec::new(), Vec::new(), 0, 0);
        for (time, points) in self.instants.iter().zip(points) {
            if points[..FITTED].iter().flatten().count() < LEAST_POINTS {
                continue;
            }
            let views = reading.views(track, period, *time);
            let fits = views.iter().filter_map(|view| errors(&reading.camera, view, points));
            let Some(best) = fits.min_by(|a, b| a.0.total_cmp(&b.0)) else { continue };
            relative.push(best.0);
            px.push(best.1);
            (near, all) = (near + best.2[0], all + best.2[1]);
        }
        let frames = relative.len();
        let (error, px) = median(&mut relative).zip(median(&mut px))?;
        let share = near as f64 / all.max(1) as f64;
        (frames >= LEAST_INSTANTS.min(self.instants.len())).then_some(Fit { error, px, share, frames })
    }

    /// The pixels of a camera's person nearest to the points, at each instant.
    pub(super) fn matched(
        &self,
        camera: usize,
        reading: &Reading,
        points: &[Points],
    ) -> Vec<Vec<(Vector3<f64>, Vector2<f64>)>> {
        let (track, period) = (&self.footage.tracks[camera], self.periods[camera]);
        let at = |(time, points): (&Timestamp, &Points)| {
            let views = reading.views(track, period, *time);
            let distance = |view: &View| errors(&reading.camera, view, points).map_or(f64::MAX, |e| e.0);
            let nearest = views.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
            let pixels = nearest.map(|view| view.pixels).unwrap_or([None; POINTS.len()]);
            let both = points.iter().zip(pixels).take(FITTED);
            both.filter_map(|(point, pixel)| Some(((*point)?, pixel?))).collect()
        };
        self.instants.iter().zip(points).map(at).collect()
    }
}

/// The median distance of a view from the points, as a fraction of their height in the image and in
/// pixels, and the number of near points and of all. `None` with fewer points than are enough. A
/// point behind the camera is infinitely far.
fn errors(camera: &Camera, view: &View, points: &Points) -> Option<(f64, f64, [usize; 2])> {
    let projected: [_; FITTED] = std::array::from_fn(|i| camera.project(points[i].as_ref()?));
    let size = extent(projected.iter().flatten().copied()).max(f64::MIN_POSITIVE);
    let distance = |i: usize| {
        let pixel = view.pixels[i].filter(|_| points[i].is_some())?;
        Some(projected[i].map_or(f64::INFINITY, |projected| (projected - pixel).norm()))
    };
    let mut distances: Vec<f64> = (0..FITTED).filter_map(distance).collect();
    let near = distances.iter().filter(|distance| **distance < NEAR * size).count();
    let all = distances.len();
    let px = median(&mut distances).filter(|_| all >= LEAST_POINTS)?;
    Some((px / size, px, [near, all]))
}
