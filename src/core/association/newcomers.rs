//! People nobody expected, from the detections that are left over.

use nalgebra::Vector3;

use super::pairs::{COMPARED, LEAST_POINTS, Node, is_human, meeting, triangulate};
use super::parts::{Bounds, Points};
use super::{Assigned, Gates, View};

/// Cameras whose detections are compared pair by pair, at a time; the others only confirm.
const PROPOSING: usize = 8;
/// Times that this is done, each with the cameras that have most detections left.
const ROUNDS: usize = 4;
/// Detections of a camera that are compared, the largest first.
const MOST_PEOPLE: usize = 64;
/// Pairs that are tried in vain, at a time.
const MOST_VAIN: usize = 64;
/// Views of a newcomer are chosen anew, from the points triangulated before.
const REFINEMENTS: usize = 2;
/// The points of a pair of views are worse than those of all: factor on the gate.
const OF_A_PAIR: f64 = 2.0;
/// An error counts as this one if it is larger.
const FAR: f64 = 0.3;
/// A newcomer this near to a performer on average is the same person, metres.
const SAME_M: f64 = 0.15;
/// A view should show a person of whom this share of the points lies in the image.
const IN_IMAGE: f64 = 0.8;
/// One of so many views that should show a newcomer must do so; the others may be blocked.
const VIEWS_PER_MEMBER: usize = 3;

/// A person that no performer's expectation fits.
#[derive(Clone, Debug, PartialEq)]
pub struct Newcomer {
    /// Triangulated: nose, shoulders, elbows, wrists, hips, knees and ankles.
    pub points: Points,
    /// By frame.
    pub views: Vec<Assigned>,
    /// Number of views that agree, at least two.
    pub support: usize,
    /// Their mean error as a fraction of the person's size in the image.
    pub error: f64,
}

/// Two detections of different views that may be one person.
struct Pair {
    nodes: [usize; 2],
    /// Views whose detections agree with both.
    support: usize,
    gap: f64,
}

/// The newcomers among the `free` sights of each view, the best supported first; `performers` are the
/// places of the known ones.
pub(super) fn find(
    views: &[View],
    free: Vec<Vec<bool>>,
    performers: &[Points],
    gates: &Gates,
) -> Vec<Newcomer> {
    let mut search = Search { views, gates, nodes: nodes(views, &free), free, found: Vec::new() };
    for _ in 0..ROUNDS {
        let before = search.found.len();
        search.round(performers);
        if search.found.len() == before {
            break;
        }
    }
    let mut found = search.found;
    found.sort_by(|a, b| b.support.cmp(&a.support).then(a.error.total_cmp(&b.error)));
    found
}

/// The largest free detections of each view.
fn nodes(views: &[View], free: &[Vec<bool>]) -> Vec<Node> {
    let of_view = |(index, (view, free)): (usize, (&View, &Vec<bool>))| {
        let mut largest: Vec<usize> = (0..free.len()).filter(|&at| free[at]).collect();
        let extent = |at: &usize| view.sights[*at].bounds.extent();
        largest.sort_by(|a, b| extent(b).total_cmp(&extent(a)));
        largest.truncate(MOST_PEOPLE);
        let node = |at: usize| Node::new(view, index, at, &view.sights[at]);
        largest.into_iter().filter_map(node).collect::<Vec<_>>()
    };
    views.iter().zip(free).enumerate().flat_map(of_view).collect()
}

struct Search<'a> {
    views: &'a [View<'a>],
    gates: &'a Gates,
    nodes: Vec<Node>,
    /// By view and sight.
    free: Vec<Vec<bool>>,
    found: Vec<Newcomer>,
}

impl Search<'_> {
    fn is_free(&self, node: &Node) -> bool {
        self.free[node.view][node.sight]
    }

    /// Accepts people from the pairs of some cameras, until too many pairs were tried in vain.
    fn round(&mut self, performers: &[Points]) {
        let mut vain = 0;
        for pair in self.pairs() {
            if vain >= MOST_VAIN {
                break;
            }
            if !pair.nodes.iter().all(|&node| self.is_free(&self.nodes[node])) {
                continue;
            }
            let Some((newcomer, members)) = self.grow(&pair) else {
                vain += 1;
                continue;
            };
            members.iter().for_each(|&(view, sight)| self.free[view][sight] = false);
            // Two detections of a known performer, for instance.
            let is_known = performers.iter().any(|known| are_same(known, &newcomer.points));
            if !is_known && !self.found.iter().any(|f| are_same(&f.points, &newcomer.points)) {
                self.found.push(newcomer);
            }
        }
    }

    /// Pairs of free detections of the proposing cameras, the best supported first.
    fn pairs(&self) -> Vec<Pair> {
        let views = self.proposing();
        let nodes: Vec<usize> = (0..self.nodes.len())
            .filter(|&at| views.contains(&self.nodes[at].view) && self.is_free(&self.nodes[at]))
            .collect();
        let words = nodes.len().div_ceil(64);
        let mut agree = vec![vec![0_u64; words]; nodes.len()];
        let mut of_view = vec![vec![0_u64; words]; views.len()];
        let mut pairs = Vec::new();
        for (i, &a) in nodes.iter().enumerate() {
            for (slot, view) in views.iter().enumerate() {
                if self.nodes[a].view == *view {
                    of_view[slot][i / 64] |= 1 << (i % 64);
                }
            }
            for (j, &b) in nodes.iter().enumerate().skip(i + 1) {
                if self.nodes[a].view == self.nodes[b].view {
                    continue;
                }
                let Some((gap, _)) = meeting(&self.nodes[a], &self.nodes[b]) else { continue };
                agree[i][j / 64] |= 1 << (j % 64);
                agree[j][i / 64] |= 1 << (i % 64);
                pairs.push(Pair { nodes: [i, j], support: 0, gap });
            }
        }
        for pair in &mut pairs {
            let [i, j] = pair.nodes;
            let shows = |view: &&Vec<u64>| {
                (0..words).any(|word| agree[i][word] & agree[j][word] & view[word] != 0)
            };
            pair.support = of_view.iter().filter(shows).count();
            pair.nodes = [nodes[i], nodes[j]];
        }
        pairs.sort_by(|a, b| b.support.cmp(&a.support).then(a.gap.total_cmp(&b.gap)));
        pairs
    }

    /// The views with many free detections, far from each other.
    fn proposing(&self) -> Vec<usize> {
        let mut counts = vec![0.0; self.views.len()];
        self.nodes.iter().filter(|n| self.is_free(n)).for_each(|n| counts[n.view] += 1.0);
        let centres: Vec<Vector3<f64>> =
            self.views.iter().map(|view| view.camera.centre_in_world()).collect();
        let mut chosen: Vec<usize> = Vec::new();
        let worth = |view: usize, chosen: &[usize]| {
            let distances = chosen.iter().map(|&other| (centres[other] - centres[view]).norm());
            counts[view] * distances.reduce(f64::min).unwrap_or(1.0)
        };
        while chosen.len() < PROPOSING {
            let left = (0..self.views.len()).filter(|v| counts[*v] > 0.0 && !chosen.contains(v));
            let all = left.map(|view| (worth(view, &chosen), view));
            let Some((_, best)) = all.max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1))) else {
                break;
            };
            chosen.push(best);
        }
        chosen
    }

    /// The person of a pair, with all views that agree (view and sight). `None` if that is no person,
    /// or if too many of the views that should show it do not.
    fn grow(&self, pair: &Pair) -> Option<(Newcomer, Vec<(usize, usize)>)> {
        let [a, b] = pair.nodes.map(|node| &self.nodes[node]);
        let (_, mut points) = meeting(a, b)?;
        let mut members: Vec<(&Node, f64)> = Vec::new();
        for pass in 0..=REFINEMENTS {
            let wide = if pass == 0 { OF_A_PAIR } else { 1.0 };
            members = self.members(&points, wide * self.gates.agree);
            if members.len() < 2 {
                return None;
            }
            points = triangulate(&members.iter().map(|member| member.0).collect::<Vec<_>>());
        }
        if !is_human(&points) || points.iter().flatten().count() < LEAST_POINTS {
            return None;
        }
        let support = members.len();
        let is_member = |view: usize| members.iter().any(|(node, _)| node.view == view);
        let others = (0..self.views.len()).filter(|&view| !is_member(view));
        let should: Vec<bool> = others.filter_map(|view| self.is_empty_at(view, &points)).collect();
        let misses = should.iter().filter(|is_empty| **is_empty).count();
        if misses >= support || support + should.len() > VIEWS_PER_MEMBER * support {
            return None;
        }
        let mut views = vec![Assigned::default(); self.views.len()];
        members.iter().for_each(|(node, _)| views[node.view] = Assigned::whole(node.sight));
        let error = members.iter().map(|member| member.1).sum::<f64>() / support as f64;
        let used = members.iter().map(|(node, _)| (node.view, node.sight)).collect();
        Some((Newcomer { points, views, support, error }, used))
    }

    /// The free detection of each view that agrees best with the points.
    fn members(&self, points: &Points, gate: f64) -> Vec<(&Node, f64)> {
        let mut best: Vec<(&Node, f64)> = Vec::new();
        for of_view in self.nodes.chunk_by(|a, b| a.view == b.view) {
            let view = &self.views[of_view[0].view];
            let pixels = view.project(points);
            let Some(bounds) = Bounds::of(&pixels) else { continue };
            let size = bounds.extent().max(1.0);
            let agreeing = of_view.iter().filter_map(|node| {
                let sight = &view.sights[node.sight];
                if !self.is_free(node) || !bounds.is_near(&sight.bounds, gate * size) {
                    return None;
                }
                let pairs = COMPARED.iter().filter_map(|&keypoint| {
                    let at = keypoint as usize;
                    Some((sight.pixels[at]? - pixels[at]?).norm() / size)
                });
                let (sum, count) =
                    pairs.fold((0.0, 0), |(sum, count), error| (sum + error.min(FAR), count + 1));
                let error = sum / f64::from(count.max(1));
                (count as usize >= LEAST_POINTS && error < gate).then_some((node, error))
            });
            best.extend(agreeing.min_by(|a, b| a.1.total_cmp(&b.1)));
        }
        best
    }

    /// Whether a view shows nobody where a person should be, not even somebody in front. `None` if the
    /// person is not in the image.
    fn is_empty_at(&self, view: usize, points: &Points) -> Option<bool> {
        let view = &self.views[view];
        let pixels = view.project(points);
        let inside = pixels.iter().flatten().filter(|pixel| view.camera.contains(pixel)).count();
        let all = points.iter().flatten().count();
        let middle = Bounds::of(&pixels)?.middle();
        let is_inside = inside as f64 >= IN_IMAGE * all as f64;
        is_inside.then(|| !view.sights.iter().any(|sight| sight.bounds.contains(&middle)))
    }
}

/// Whether two bodies are in one place.
fn are_same(a: &Points, b: &Points) -> bool {
    let pairs = a.iter().zip(b).filter_map(|(a, b)| Some((*a)? - (*b)?));
    let (sum, count) = pairs.fold((0.0, 0.0), |(sum, count), off| (sum + off.norm(), count + 1.0));
    count > 0.0 && sum < SAME_M * count
}
