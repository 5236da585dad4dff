//! Rays of detections, and pairs of detections whose rays meet in a human body.

use std::ops::Range;

use nalgebra::{Matrix3, Vector3};

use super::parts::Points;
use super::{Sight, View};
use crate::core::detections::Keypoint as K;
use crate::core::points::TRUNK_LENGTH;

/// The points that are compared; every format has them.
pub(super) const COMPARED: [K; 13] = [
    K::LShoulder,
    K::RShoulder,
    K::LHip,
    K::RHip,
    K::Nose,
    K::LKnee,
    K::RKnee,
    K::LAnkle,
    K::RAnkle,
    K::LElbow,
    K::RElbow,
    K::LWrist,
    K::RWrist,
];
/// The first of them, on the trunk.
const TRUNK: usize = 4;
/// Detections with fewer compared points are not used.
pub(super) const LEAST_POINTS: usize = 6;
/// Rays of one point pass each other within this distance on average, metres. A larger distance counts
/// as the second.
const GAP_M: f64 = 0.10;
const FAR_M: f64 = 0.25;
/// Rays that meet at less than 3 degrees fix no depth: the square of the sine.
const MIN_PARALLAX: f64 = 0.00274;
/// Lengths of people, metres, with room for errors of two views.
const BONES: [(K, K, Range<f64>); 10] = [
    (K::LShoulder, K::RShoulder, 0.10..0.60),
    (K::LHip, K::RHip, 0.06..0.50),
    (K::LShoulder, K::LElbow, 0.12..0.50),
    (K::RShoulder, K::RElbow, 0.12..0.50),
    (K::LElbow, K::LWrist, 0.10..0.45),
    (K::RElbow, K::RWrist, 0.10..0.45),
    (K::LHip, K::LKnee, 0.20..0.65),
    (K::RHip, K::RKnee, 0.20..0.65),
    (K::LKnee, K::LAnkle, 0.20..0.65),
    (K::RKnee, K::RAnkle, 0.20..0.65),
];
/// The shoulders, which are the first, have a human width if they are seen. Of the other bones that are seen,
/// this share has a human length.
const HUMAN: f64 = 0.7;
/// Scale of the loss of a triangulation, metres, and its iterations.
const SCALE_M: f64 = 0.06;
const ITERATIONS: usize = 4;

/// A detection with its rays.
#[derive(Clone, Debug)]
pub(super) struct Node {
    /// Index of the view, and of the sight in it.
    pub(super) view: usize,
    pub(super) sight: usize,
    centre: Vector3<f64>,
    /// Unit directions, in the order of [`COMPARED`].
    rays: [Option<Vector3<f64>>; COMPARED.len()],
}

impl Node {
    /// `None` with too few points.
    pub(super) fn new(view: &View, index: usize, at: usize, sight: &Sight) -> Option<Self> {
        let rays = COMPARED.map(|keypoint| view.camera.ray(&sight.pixels[keypoint as usize]?));
        let enough = rays.iter().flatten().count() >= LEAST_POINTS;
        let centre = view.camera.centre_in_world();
        enough.then_some(Self { view: index, sight: at, centre, rays })
    }

    /// Distance of two rays where they pass each other, metres, and the point in the middle. `None` if
    /// they are nearly parallel or pass behind a camera.
    fn meet(&self, other: &Self, at: usize) -> Option<(f64, Vector3<f64>)> {
        let (a, b) = (self.rays[at]?, other.rays[at]?);
        let (between, cosine) = (other.centre - self.centre, a.dot(&b));
        let parallax = 1.0 - cosine * cosine;
        if parallax < MIN_PARALLAX {
            return None;
        }
        let (along_a, along_b) = (between.dot(&a), between.dot(&b));
        let s = (along_a - cosine * along_b) / parallax;
        let t = (cosine * along_a - along_b) / parallax;
        if s <= 0.0 || t <= 0.0 {
            return None;
        }
        let (first, second) = (self.centre + a * s, other.centre + b * t);
        Some(((first - second).norm(), (first + second) / 2.0))
    }
}

/// The mean distance of the rays of two detections, metres, and the points where they meet. `None` if
/// they are not of one person.
pub(super) fn meeting(a: &Node, b: &Node) -> Option<(f64, Points)> {
    let mut points = [None; super::KEYPOINTS];
    let (mut sum, mut count) = (0.0, 0.0);
    for (at, keypoint) in COMPARED.into_iter().enumerate() {
        if a.rays[at].is_some() && b.rays[at].is_some() {
            let met = a.meet(b, at);
            sum += met.map_or(FAR_M, |(gap, _)| gap.min(FAR_M));
            count += 1.0;
            points[keypoint as usize] = met.map(|(_, point)| point);
        }
        // Most pairs are told apart by the trunk.
        if at + 1 == TRUNK && sum > GAP_M * 1.5 * count {
            return None;
        }
    }
    let gap = sum / count;
    let enough = points.iter().flatten().count() >= LEAST_POINTS;
    (enough && gap < GAP_M && is_human(&points)).then_some((gap, points))
}

/// Whether a side of the trunk is seen, and it, the shoulders and most other bones are as long as a person's.
pub(super) fn is_human(points: &Points) -> bool {
    let at = |keypoint: K| points[keypoint as usize];
    let side = |shoulder: K, hip: K| Some((at(shoulder)? - at(hip)?).norm());
    let sides = [side(K::LShoulder, K::LHip), side(K::RShoulder, K::RHip)];
    let seen = sides.iter().flatten().count() as f64;
    if !TRUNK_LENGTH.contains(&(sides.iter().flatten().sum::<f64>() / seen)) {
        return false;
    }
    let has_human_length =
        |(a, b, lengths): &(K, K, Range<f64>)| Some(lengths.contains(&(at(*a)? - at(*b)?).norm()));
    let [shoulders, others @ ..] = &BONES;
    let others: Vec<bool> = others.iter().filter_map(has_human_length).collect();
    let human = others.iter().filter(|is_human| **is_human).count();
    has_human_length(shoulders).unwrap_or(true) && human as f64 >= HUMAN * others.len() as f64
}

/// The points that are nearest to the rays of all nodes, by the Geman-McClure loss: at least two rays
/// a point, the start is the mean.
pub(super) fn triangulate(nodes: &[&Node]) -> Points {
    let mut points = [None; super::KEYPOINTS];
    for (at, keypoint) in COMPARED.into_iter().enumerate() {
        let rays = nodes.iter().filter_map(|node| Some((node.centre, node.rays[at]?)));
        points[keypoint as usize] = nearest(&rays.collect::<Vec<_>>());
    }
    points
}

fn nearest(rays: &[(Vector3<f64>, Vector3<f64>)]) -> Option<Vector3<f64>> {
    let across = |ray: &Vector3<f64>| Matrix3::identity() - ray * ray.transpose();
    let mut point: Option<Vector3<f64>> = None;
    for _ in 0..ITERATIONS {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (centre, ray) in rays {
            let across = across(ray);
            let off = point.map_or(0.0, |point| (across * (point - centre)).norm() / SCALE_M);
            let weight = 1.0 / ((1.0 + off * off) * (1.0 + off * off));
            normal += across * weight;
            right += across * centre * weight;
        }
        // With one ray, or parallel ones, the determinant is 0.
        let sum = normal.trace() / 2.0;
        if rays.len() < 2 || normal.determinant() < 0.5 * MIN_PARALLAX * sum * sum * sum {
            return None;
        }
        point = Some(normal.cholesky()?.solve(&right));
    }
    point
}
