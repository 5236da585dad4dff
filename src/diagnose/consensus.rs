//! What the views agree on: the cameras that see one performer in one place, and the performer's
//! points in the world.
//!
//! Each pair of cameras proposes points; each camera supports the pair by how near it sees them. The
//! best supported pair and its supporters are the members. Errors are fractions of the performer's
//! height in the image.

use nalgebra::{Vector2, Vector3};

use super::footage::{FITTED, Footage, LEAST_POINTS, POINTS};
use super::reading::{Reading, View};
use crate::core::camera::{Camera, Rig, triangulate, triangulate_robust};
use crate::core::points::{extent, median};
use crate::core::time::{Nanos, Timestamp};

/// A point agrees with the others up to this error.
pub(super) const NEAR: f64 = 0.05;
/// An error from which on a camera does not support a pair.
pub(super) const FAR: f64 = 0.15;
/// A member's mean support: 1 without errors, 0 with errors above [`FAR`].
pub(super) const MEMBER: f64 = 0.4;
/// A camera with fewer frames of the performer is not judged.
const LEAST_INSTANTS: usize = 4;
/// Hardly ever is once in so many times.
const HARDLY: usize = 10;
/// Pairs that are tried.
const MOST_PAIRS: usize = 120;

/// World points by index in [`POINTS`].
pub(super) type Points = [Option<Vector3<f64>>; POINTS.len()];
/// A point in the world, and where a camera sees it.
pub(super) type Match = (Vector3<f64>, Vector2<f64>);

/// The people of all cameras at some instants.
#[derive(Clone, Debug)]
pub(super) struct Scene<'a> {
    pub(super) footage: &'a Footage,
    pub(super) readings: Vec<Reading>,
    pub(super) periods: Vec<Nanos>,
    pub(super) instants: Vec<Timestamp>,
    pub(super) rig: Rig,
    /// When the recording begins.
    pub(super) start: Option<Timestamp>,
    /// By instant and camera.
    pub(super) views: Vec<Vec<Vec<View>>>,
}

/// What a camera says of some points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fit {
    /// Median error, as a fraction of the performer's height in the image, and in pixels.
    pub(super) error: f64,
    pub(super) px: f64,
    /// Mean error as a fraction; those above [`FAR`] count as that.
    pub(super) mean: f64,
    /// Share of the points that are seen where they should be.
    pub(super) share: f64,
}

/// The support of a pair of cameras.
#[derive(Clone, Debug)]
pub(super) struct Proposal {
    pair: [usize; 2],
    /// Mean support by each camera.
    pub(super) support: Vec<f64>,
    /// By instant: the people of the pair, and their support.
    pub(super) people: Vec<Option<([usize; 2], f64)>>,
}

impl Proposal {
    fn total(&self) -> f64 {
        self.support.iter().sum()
    }

    fn members(&self) -> Vec<bool> {
        self.support.iter().map(|support| *support > MEMBER).collect()
    }
}

/// The cameras that agree, and whom they see.
#[derive(Clone, Debug)]
pub(super) struct Consensus {
    /// By camera.
    pub(super) members: Vec<bool>,
    /// Sum of the cameras' support.
    pub(super) total: f64,
    /// By instant and camera, the index of the person.
    people: Vec<Vec<Option<usize>>>,
}

impl Consensus {
    /// Nobody is seen.
    pub(super) fn nobody(scene: &Scene) -> Self {
        let n = scene.cameras();
        let people = vec![vec![None; n]; scene.instants.len()];
        Self { members: vec![false; n], total: 0.0, people }
    }

    pub(super) fn count(&self) -> usize {
        self.members.iter().filter(|member| **member).count()
    }
}

impl<'a> Scene<'a> {
    pub(super) fn new(footage: &'a Footage, readings: Vec<Reading>, count: usize) -> Self {
        let cameras: Vec<Camera> = readings.iter().map(|reading| reading.camera.clone()).collect();
        let instants = footage.instants(count, &cameras);
        let usual = footage.period();
        let periods = footage.tracks.iter().map(|track| track.period().unwrap_or(usual)).collect();
        let start = footage.start(&cameras);
        let rig = Rig { version: 0, cameras: Vec::new() };
        let views = Vec::new();
        let mut scene = Self { footage, readings, instants, periods, rig, start, views };
        scene.read();
        scene
    }

    /// The same with other readings.
    pub(super) fn with(&self, readings: Vec<Reading>) -> Self {
        let mut scene = Self { readings, views: Vec::new(), ..self.clone() };
        scene.read();
        scene
    }

    /// The same with another reading of one camera.
    pub(super) fn with_one(&self, camera: usize, reading: Reading) -> Self {
        let mut readings = self.readings.clone();
        readings[camera] = reading;
        self.with(readings)
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

    /// The cameras that agree. `None` if no two do.
    pub(super) fn agree(&self) -> Option<Consensus> {
        self.consensuses(1).pop()
    }

    /// The `most` best supported sets of cameras that agree, the best last.
    pub(super) fn consensuses(&self, most: usize) -> Vec<Consensus> {
        let n = self.cameras();
        let pairs: Vec<[usize; 2]> = (0..n).flat_map(|b| (0..b).map(move |a| [a, b])).collect();
        let stride = pairs.len().div_ceil(MOST_PAIRS).max(1);
        let mut proposals: Vec<Proposal> =
            pairs.into_iter().step_by(stride).map(|pair| self.propose(pair)).collect();
        proposals.sort_by(|a, b| b.total().total_cmp(&a.total()));
        let mut found: Vec<Consensus> = Vec::new();
        for proposal in &proposals {
            let members = proposal.members();
            if found.len() == most {
                break;
            }
            let are_two = members.iter().filter(|member| **member).count() > 1;
            if are_two && found.iter().all(|other| other.members != members) {
                let at = |at| self.assign(at, &proposals, &members);
                let people = (0..self.instants.len()).map(at).collect();
                found.push(Consensus { total: proposal.total(), people, members });
            }
        }
        found.reverse();
        found
    }

    /// The person of each camera at an instant, from the best supported pair of members.
    fn assign(&self, at: usize, proposals: &[Proposal], members: &[bool]) -> Vec<Option<usize>> {
        let of_members = proposals.iter().filter(|p| p.pair.iter().all(|&i| members[i]));
        let known = of_members.filter_map(|p| p.people[at].map(|(people, sum)| (p, people, sum)));
        let best = known.max_by(|a, b| a.2.total_cmp(&b.2));
        let points = best.and_then(|(p, people, _)| self.propose_points(at, p.pair, people));
        let Some((points, (proposal, people, _))) = points.zip(best) else {
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

    pub(super) fn propose(&self, pair: [usize; 2]) -> Proposal {
        let n = self.cameras();
        let (mut sums, mut seen) = (vec![0.0; n], vec![0_usize; n]);
        let mut people = Vec::with_capacity(self.instants.len());
        for (at, views) in self.views.iter().enumerate() {
            let [a, b] = pair.map(|camera| views[camera].len());
            let tried = (0..a).flat_map(|a| (0..b).map(move |b| [a, b]));
            let sum = |support: &[Option<f64>]| support.iter().flatten().sum::<f64>();
            let best = tried
                .filter_map(|people| Some((people, self.support(at, pair, people)?)))
                .max_by(|a, b| sum(&a.1).total_cmp(&sum(&b.1)));
            if a > 0 && b > 0 {
                pair.iter().for_each(|&camera| seen[camera] += 1);
            }
            people.push(best.map(|(people, support)| {
                for (camera, support) in support.iter().enumerate() {
                    sums[camera] += support.unwrap_or(0.0);
                    seen[camera] += usize::from(support.is_some() && !pair.contains(&camera));
                }
                (people, sum(&support))
            }));
        }
        let least = LEAST_INSTANTS.min(people.len());
        let mean = |(sum, seen): (f64, usize)| if seen < least { 0.0 } else { sum / seen as f64 };
        Proposal { pair, support: sums.into_iter().zip(seen).map(mean).collect(), people }
    }

    /// The points of two people of a pair of cameras.
    pub(super) fn propose_points(
        &self,
        at: usize,
        pair: [usize; 2],
        people: [usize; 2],
    ) -> Option<Points> {
        let [a, b] = [0, 1].map(|i| &self.views[at][pair[i]][people[i]]);
        let point = |i: usize| {
            let views = [(pair[0], a.pixels[i]?, 1.0), (pair[1], b.pixels[i]?, 1.0)];
            triangulate(&self.rig, &views)
        };
        let points: Points = std::array::from_fn(|i| if i < FITTED { point(i) } else { None });
        (points.iter().flatten().count() >= LEAST_POINTS).then_some(points)
    }

    /// The support of a pair by each camera at an instant; `None` of a camera without people. `None`
    /// if the pair itself does not agree.
    fn support(&self, at: usize, pair: [usize; 2], people: [usize; 2]) -> Option<Vec<Option<f64>>> {
        let points = self.propose_points(at, pair, people)?;
        let error = |camera: usize, view| {
            errors(&self.rig.cameras[camera], view, &points).map_or(f64::INFINITY, |found| found.0)
        };
        // Each of the two takes half of their disagreement.
        let own = [0, 1].map(|i| 2.0 * error(pair[i], &self.views[at][pair[i]][people[i]]));
        if own.iter().any(|own| *own > FAR) {
            return None;
        }
        let support = |camera: usize| {
            let least = match pair.iter().position(|member| *member == camera) {
                Some(i) => own[i],
                None => {
                    let views = self.views[at][camera].iter();
                    views.map(|view| error(camera, view)).reduce(f64::min)?
                }
            };
            Some((1.0 - least / FAR).max(0.0))
        };
        Some((0..self.cameras()).map(support).collect())
    }

    /// Number of instants at which no two of the cameras that agree do, and of those at which two see somebody.
    pub(super) fn disagreeing(&self, consensus: &Consensus) -> [usize; 2] {
        let mut counts = [0; 2];
        for (views, people) in self.views.iter().zip(&consensus.people) {
            let seen = views.iter().zip(&consensus.members);
            if seen.filter(|(views, member)| **member && !views.is_empty()).count() >= 2 {
                counts[0] += usize::from(people.iter().all(Option::is_none));
                counts[1] += 1;
            }
        }
        counts
    }

    /// The points of the members at each instant, without one camera if two others are left.
    pub(super) fn points(&self, consensus: &Consensus, without: Option<usize>) -> Vec<Points> {
        let is_member = |i: &usize| consensus.members[*i];
        let mut members: Vec<usize> = (0..self.cameras()).filter(is_member).collect();
        if members.len() > 2 {
            members.retain(|&i| Some(i) != without);
        }
        let at = |(at, people): (usize, &Vec<Option<usize>>)| {
            let views: Vec<(usize, &View)> =
                members.iter().filter_map(|&i| Some((i, &self.views[at][i][people[i]?]))).collect();
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
        let (mut relative, mut px, mut near, mut all) = (Vec::new(), Vec::new(), 0, 0);
        for (time, points) in self.instants.iter().zip(points) {
            let Some((_, best)) = self.nearest(camera, reading, *time, points) else { continue };
            relative.push(best.0);
            px.push(best.1);
            (near, all) = (near + best.2[0], all + best.2[1]);
        }
        let frames = relative.len();
        let mean = capped_mean(relative.iter().copied());
        let (error, px) = median(&mut relative).zip(median(&mut px))?;
        let share = near as f64 / all.max(1) as f64;
        (frames >= LEAST_INSTANTS.min(self.instants.len())).then_some(Fit {
            error,
            px,
            mean,
            share,
        })
    }

    /// The relative error of a camera with a reading at each instant.
    pub(super) fn errors(
        &self,
        camera: usize,
        reading: &Reading,
        points: &[Points],
    ) -> Vec<Option<f64>> {
        let at = |(time, points): (&Timestamp, &Points)| {
            self.nearest(camera, reading, *time, points).map(|(_, found)| found.0)
        };
        self.instants.iter().zip(points).map(at).collect()
    }

    /// Whether a camera sees people while the points should be in its image, but hardly ever at these points.
    pub(super) fn sees_others(&self, camera: usize, points: &[Points]) -> bool {
        let (reading, track) = (&self.readings[camera], &self.footage.tracks[camera]);
        let of = &reading.camera;
        let [width, height] = [of.width, of.height].map(f64::from);
        let is_inside = |point: &&Option<Vector3<f64>>| {
            let pixel = point.and_then(|point| of.project(&point));
            pixel.is_some_and(|at| (0.0..width).contains(&at.x) && (0.0..height).contains(&at.y))
        };
        let [mut there, mut elsewhere] = [0; 2];
        for (time, points) in self.instants.iter().zip(points) {
            if points.iter().filter(is_inside).count() < LEAST_POINTS {
                continue;
            }
            let views = reading.views(track, self.periods[camera], *time);
            let errors = views.iter().filter_map(|view| Some(errors(of, view, points)?.0));
            match errors.reduce(f64::min) {
                Some(error) if error < FAR => there += 1,
                Some(_) => elsewhere += 1,
                None => {}
            }
        }
        elsewhere >= LEAST_INSTANTS && there * HARDLY < elsewhere
    }

    /// The same with the instants of a range alone.
    pub(super) fn part(&self, instants: std::ops::Range<usize>) -> Self {
        Self {
            instants: self.instants[instants.clone()].to_vec(),
            views: self.views[instants].to_vec(),
            ..self.clone()
        }
    }

    /// The person of a camera that is nearest to the points, and the errors.
    fn nearest(
        &self,
        camera: usize,
        reading: &Reading,
        time: Timestamp,
        points: &Points,
    ) -> Option<(View, Errors)> {
        let views = reading.views(&self.footage.tracks[camera], self.periods[camera], time);
        let fits = views.into_iter().filter_map(|view| {
            let errors = errors(&reading.camera, &view, points)?;
            Some((view, errors))
        });
        fits.min_by(|a, b| a.1.0.total_cmp(&b.1.0))
    }

    /// The points of each instant, and where a camera sees them.
    pub(super) fn matches(
        &self,
        camera: usize,
        reading: &Reading,
        points: &[Points],
    ) -> Vec<Match> {
        let at = |(time, points): (&Timestamp, &Points)| {
            let view = self.nearest(camera, reading, *time, points).map(|(view, _)| view);
            let pixels = view.map_or([None; POINTS.len()], |view| view.pixels);
            let both = std::iter::zip(*points, pixels).take(FITTED);
            both.filter_map(|(point, pixel)| Some((point?, pixel?))).collect::<Vec<_>>()
        };
        self.instants.iter().zip(points).flat_map(at).collect()
    }
}

/// The mean of errors; those above [`FAR`] count as that. 0 without errors.
pub(super) fn capped_mean(errors: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = errors.fold((0.0, 0.0), |(sum, n), error| (sum + error.min(FAR), n + 1.0));
    sum / f64::max(count, 1.0)
}

/// The median distance of a view from points, as a fraction of the smaller one's height in the image
/// and in pixels, and the number of near points and of all.
pub(super) type Errors = (f64, f64, [usize; 2]);

/// `None` with fewer points than are enough. A point behind the camera is infinitely far.
pub(super) fn errors(camera: &Camera, view: &View, points: &Points) -> Option<Errors> {
    let projected: [_; FITTED] = std::array::from_fn(|i| camera.project(points[i].as_ref()?));
    let size = extent(projected.iter().flatten().copied()).min(view.extent).max(f64::MIN_POSITIVE);
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
