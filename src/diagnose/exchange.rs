//! Cameras whose calibrations have changed places.

use std::cmp::Reverse;

use super::consensus::{FAR, MEMBER, Points, Scene, errors};

/// Orders that are checked with all cameras. The best one for a pair of cameras may be wrong.
const MOST_ORDERS: usize = 6;

impl Scene<'_> {
    /// For each camera the index of a calibration, if all change places: the orders in which most cameras seem to agree, the
    /// best first.
    pub(super) fn orders(&self) -> Vec<Vec<usize>> {
        let n = self.cameras();
        let seen = |camera: usize| self.views.iter().filter(|at| !at[camera].is_empty()).count();
        let mut busiest: Vec<usize> = (0..n).collect();
        busiest.sort_by_key(|&camera| Reverse(seen(camera)));
        let &[first, second, ..] = &busiest[..] else { return Vec::new() };
        let given = (0..n).flat_map(|i| (0..n).map(move |j| [i, j])).filter(|[i, j]| i != j);
        let tried = given.filter_map(|given| self.complete([first, second], given));
        let mut tried: Vec<(Vec<usize>, f64)> = tried.collect();
        tried.sort_by(|a, b| b.1.total_cmp(&a.1));
        tried.into_iter().take(MOST_ORDERS).map(|(order, _)| order).collect()
    }

    /// The best calibrations of the other cameras, given those of a pair.
    fn complete(&self, pair: [usize; 2], given: [usize; 2]) -> Option<(Vec<usize>, f64)> {
        let n = self.cameras();
        let mut scene = self.clone();
        for (camera, k) in pair.into_iter().zip(given) {
            scene.rig.cameras[camera] = self.rig.cameras[k].clone();
        }
        let proposal = scene.propose(pair);
        let own = proposal.support[pair[0]] + proposal.support[pair[1]];
        if own < 2.0 * MEMBER {
            return None;
        }
        let people = proposal.people.iter().enumerate();
        let points: Vec<(usize, Points)> = people
            .filter_map(|(at, people)| Some((at, scene.propose_points(at, pair, (*people)?.0)?)))
            .collect();
        let mut candidates = Vec::new();
        for camera in (0..n).filter(|camera| !pair.contains(camera)) {
            let free = (0..n).filter(|k| !given.contains(k));
            candidates.extend(free.map(|k| (self.support_of(camera, k, &points), camera, k)));
        }
        candidates.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut found: Vec<Option<usize>> = vec![None; n];
        pair.into_iter().zip(given).for_each(|(camera, k)| found[camera] = Some(k));
        let mut total = own;
        for (support, camera, k) in candidates {
            if found[camera].is_none() && !found.contains(&Some(k)) {
                found[camera] = Some(k);
                total += support;
            }
        }
        Some((found.into_iter().collect::<Option<_>>()?, total))
    }

    /// Mean support of points by a camera with the calibration of camera `k`.
    fn support_of(&self, camera: usize, k: usize, points: &[(usize, Points)]) -> f64 {
        let seen = points.iter().filter(|(at, _)| !self.views[*at][camera].is_empty());
        let support = seen.map(|(at, points)| {
            let views = self.views[*at][camera].iter();
            let all = views.filter_map(|view| Some(errors(&self.rig.cameras[k], view, points)?.0));
            (1.0 - all.fold(f64::INFINITY, f64::min) / FAR).max(0.0)
        });
        let (sum, count) = support.fold((0.0, 0_usize), |(sum, n), one| (sum + one, n + 1));
        sum / count.max(1) as f64
    }
}
