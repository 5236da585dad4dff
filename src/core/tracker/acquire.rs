//! Finding the performer in one frame set without a known pose: association across views,
//! triangulation, the root from the torso, then a fit from several starts.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::association::usable;
use super::config::Config;
use crate::core::body::{Attachment, BodyPoint, Joint, Pose, Skeleton};
use crate::core::camera::{Rig, triangulate_robust};
use crate::core::cost::{
    self, FrameObservations, FreeBody, Observation, PathKeyframe, PathProblem, Scene, Workspace,
};
use crate::core::detections::{Detections, Keypoint, Person};
use crate::core::manifold::{Correction, Keyframe, LATENT, Latent, TimedKeyframe};
use crate::core::optimise::Optimiser;
use crate::core::points::{TRUNK_LENGTH, extent, median};
use crate::core::time::Timestamp;

/// People with fewer points are ignored.
const MIN_POINTS: usize = 6;
/// Only this many people of a view are tried.
const MOST_PEOPLE: usize = 8;
/// Only this many pairs of people in two views are tried.
const MOST_PAIRS: usize = 1000;
/// Factor of the loss's scale and of the prior in the first stage.
const FIRST_STAGE: f64 = 5.0;
/// Number of samples of the prior that a fit starts from.
const NEAREST: usize = 2;
/// A point of the body this far from its triangulated point is not found, metres.
const FAR: f64 = 0.4;

/// The performer in one frame set: the observations of all views, and the triangulated points.
#[derive(Clone, Debug)]
pub(super) struct SeenPerformer {
    observations: Vec<Observation>,
    /// A point per fitted keypoint, in the world.
    points: Vec<Option<Vector3<f64>>>,
    score: f64,
}

/// One person in one view: a pixel and a confidence per fitted keypoint.
struct Candidate {
    camera: usize,
    seen: Vec<Option<(Vector2<f64>, f64)>>,
    extent: f64,
}

impl Candidate {
    fn of(camera: usize, person: &Person, points: &[BodyPoint], config: &Config) -> Option<Self> {
        let seen: Vec<_> = points
            .iter()
            .map(|point| usable(person, point, config).map(|d| (d.pixel.coords, d.confidence)))
            .collect();
        let extent = extent(seen.iter().flatten().map(|(pixel, _)| *pixel));
        (seen.iter().flatten().count() >= MIN_POINTS).then_some(Self { camera, seen, extent })
    }

    /// The fit of the projected `points` to this person: the median error as a fraction of the
    /// person's height, and the number of points within `gate` times that height, pixels.
    fn agreement(
        &self,
        rig: &Rig,
        points: &[Option<Vector3<f64>>],
        gate: f64,
    ) -> Option<(f64, f64)> {
        let (mut errors, mut support) = (Vec::new(), 0.0);
        for (seen, point) in self.seen.iter().zip(points) {
            let (Some((pixel, _)), Some(point)) = (seen, point) else { continue };
            let error = rig.cameras[self.camera]
                .project(point)
                .map_or(f64::INFINITY, |projected| (projected - pixel).norm() / self.extent);
            if error <= gate {
                support += self.extent;
            }
            errors.push(error);
        }
        median(&mut errors).filter(|_| errors.len() >= MIN_POINTS).map(|error| (error, support))
    }
}

/// The best-supported person of a frame set, seen by at least two cameras.
///
/// Every pair of detections in two views proposes points in space. A proposal's score is the number
/// of points that agree, over all views, from the detection of each view that agrees best. Views
/// are weighted by its height in pixels: the performer fills the image, and bystanders are small.
/// Confidence is not used, since it differs between people.
pub(super) fn find_performer(
    frames: &[&Detections],
    rig: &Rig,
    points: &[BodyPoint],
    config: &Config,
) -> Option<SeenPerformer> {
    let candidates: Vec<Candidate> =
        frames.iter().flat_map(|frame| largest(frame, points, config)).collect();
    let mut best: Option<SeenPerformer> = None;
    for [a, b] in pairs(&candidates) {
        let proposal = triangulate(&[a, b], rig, points.len(), config);
        if proposal.iter().flatten().count() < MIN_POINTS {
            continue;
        }
        let least = best.as_ref().map_or(0.0, |best| best.score);
        best = support(&proposal, &candidates, rig, points, config, least).or(best);
    }
    best
}

/// Pairs of people in two views; if there are many, those where both are large.
fn pairs(candidates: &[Candidate]) -> Vec<[&Candidate; 2]> {
    let all = candidates.iter().enumerate().flat_map(|(i, a)| {
        let others = candidates[i + 1..].iter().filter(|b| a.camera != b.camera);
        others.map(move |b| [a, b])
    });
    let mut pairs: Vec<[&Candidate; 2]> = all.collect();
    if pairs.len() > MOST_PAIRS {
        let smaller = |[a, b]: &[&Candidate; 2]| a.extent.min(b.extent);
        pairs.sort_by(|a, b| smaller(b).total_cmp(&smaller(a)));
        pairs.truncate(MOST_PAIRS);
    }
    pairs
}

/// The largest people of a frame.
fn largest(frame: &Detections, points: &[BodyPoint], config: &Config) -> Vec<Candidate> {
    let people = frame.people.iter();
    let mut found: Vec<Candidate> =
        people.filter_map(|person| Candidate::of(frame.camera, person, points, config)).collect();
    if found.len() > MOST_PEOPLE {
        found.sort_by(|a, b| b.extent.total_cmp(&a.extent));
        found.truncate(MOST_PEOPLE);
    }
    found
}

/// The views that agree with a proposal, and the points triangulated from all of them; `None` if the
/// score is not above `least`.
fn support(
    proposal: &[Option<Vector3<f64>>],
    candidates: &[Candidate],
    rig: &Rig,
    points: &[BodyPoint],
    config: &Config,
    least: f64,
) -> Option<SeenPerformer> {
    let mut views: Vec<(&Candidate, f64)> = Vec::new();
    for candidate in candidates {
        let Some((error, support)) = candidate.agreement(rig, proposal, config.gate.agree) else {
            continue;
        };
        if error > config.gate.agree {
            continue;
        }
        match views.iter_mut().find(|(other, _)| other.camera == candidate.camera) {
            Some(other) if other.1 < support => *other = (candidate, support),
            Some(_) => {}
            None => views.push((candidate, support)),
        }
    }
    let members: Vec<&Candidate> = views.iter().map(|(candidate, _)| *candidate).collect();
    let score = views.iter().map(|(_, support)| support).sum();
    if score <= least {
        return None;
    }
    let triangulated = triangulate(&members, rig, points.len(), config);
    let torso = Torso::of(points, &triangulated)?;
    (members.len() >= 2 && TRUNK_LENGTH.contains(&torso.up.norm())).then(|| SeenPerformer {
        observations: members.iter().flat_map(|member| observations(member)).collect(),
        points: triangulated,
        score,
    })
}

fn observations(candidate: &Candidate) -> impl Iterator<Item = Observation> + '_ {
    candidate.seen.iter().enumerate().filter_map(|(point, seen)| {
        let (pixel, confidence) = (*seen)?;
        Some(Observation { point, camera: candidate.camera, pixel, confidence, scale_factor: 1.0 })
    })
}

fn triangulate(
    members: &[&Candidate],
    rig: &Rig,
    points: usize,
    config: &Config,
) -> Vec<Option<Vector3<f64>>> {
    let largest = members.iter().map(|m| m.extent).fold(0.0, f64::max);
    (0..points)
        .map(|point| {
            let views: Vec<(usize, Vector2<f64>, f64)> = members
                .iter()
                .filter_map(|m| {
                    m.seen[point].map(|(pixel, confidence)| (m.camera, pixel, confidence))
                })
                .collect();
            triangulate_robust(rig, &views, config.gate.agree * largest, point as u64)
                .map(|found| found.point)
        })
        .collect()
}

/// The directions of the torso, from triangulated shoulders and hips.
struct Torso {
    mid_hip: Vector3<f64>,
    up: Vector3<f64>,
    left: Vector3<f64>,
}

impl Torso {
    fn of(points: &[BodyPoint], triangulated: &[Option<Vector3<f64>>]) -> Option<Self> {
        let at = |keypoint| {
            let index = points.iter().position(|point| point.keypoint == keypoint)?;
            triangulated[index]
        };
        let (ls, rs) = (at(Keypoint::LShoulder)?, at(Keypoint::RShoulder)?);
        let (lh, rh) = (at(Keypoint::LHip)?, at(Keypoint::RHip)?);
        let mid_hip = (lh + rh) / 2.0;
        Some(Self { mid_hip, up: (ls + rs) / 2.0 - mid_hip, left: (ls - rs) + (lh - rh) })
    }

    /// The pelvis frame: y along the trunk, x to the left, hips as detected.
    fn root(&self, body: &Skeleton) -> Option<(Matrix3<f64>, Vector3<f64>)> {
        let y = self.up.try_normalize(1e-6)?;
        let x = (self.left - y * y.dot(&self.left)).try_normalize(1e-6)?;
        let rotation = Matrix3::from_columns(&[x, y, x.cross(&y)]);
        let mut hip = body.offset(Joint::LHip) + Attachment::of(Keypoint::LHip).offset(body);
        hip.x = 0.0;
        Some((rotation, self.mid_hip - rotation * hip))
    }
}

/// Fits a keyframe, and the `free` coefficients of the body, to one frame set: roughly from several
/// [`starts`], then from the best of these fits with a wide loss and at last with the cost itself.
/// `None` if the torso is not triangulated.
pub(super) fn fit(
    seen: &SeenPerformer,
    scene: Scene,
    skeleton: &Skeleton,
    free: FreeBody,
    config: &Config,
    optimiser: &mut dyn Optimiser,
    work: &mut Workspace,
) -> Option<(Keyframe, Skeleton)> {
    let observations = [FrameObservations::new(Timestamp::default(), seen.observations.clone())];
    let loose = cost::Config {
        scale_px: scene.config.scale_px * FIRST_STAGE,
        prior: scene.config.prior * FIRST_STAGE,
        ..*scene.config
    };
    let mut solve = |stage: &cost::Config, start: Keyframe, skeleton: &Skeleton, iterations| {
        let at = TimedKeyframe::new(Timestamp::default(), start);
        let path = vec![PathKeyframe::free(at, 1.0)];
        let scene = Scene { config: stage, ..scene };
        let mut problem = PathProblem::new(scene, path, skeleton, free, &observations, work);
        let mut x = problem.start();
        let cost = optimiser.minimise(&mut problem, &mut x, iterations).final_cost;
        let (mut keyframes, fitted) = problem.solution(&x);
        Some((cost, keyframes.pop()?, fitted))
    };
    let most = config.acquisition_iterations;
    let roughly = starts(seen, scene, skeleton)?
        .into_iter()
        .filter_map(|start| solve(&loose, start, skeleton, most.div_ceil(3)));
    let (_, rough, _) = roughly.min_by(|a, b| a.0.total_cmp(&b.0))?;
    let (_, keyframe, fitted) = solve(&loose, rough, skeleton, most)?;
    let (_, keyframe, fitted) = solve(scene.config, keyframe, &fitted, most)?;
    Some((keyframe, fitted))
}

/// Keyframes to start from, with the root from the torso: the mean pose, the same with the other
/// facing (left and right may be swapped), and the poses among the samples of the prior that are
/// nearest to the triangulated points, such as crouched or seated ones. `None` if the torso is not
/// triangulated.
fn starts(seen: &SeenPerformer, scene: Scene, skeleton: &Skeleton) -> Option<Vec<Keyframe>> {
    let torso = Torso::of(scene.points, &seen.points)?;
    let (root_rotation, root_position) = torso.root(skeleton)?;
    let start = |z| Keyframe { z, root_rotation, root_position, correction: Correction::default() };
    let mean = start([0.0; LATENT]);
    let turn = Matrix3::from_diagonal(&Vector3::new(-1.0, 1.0, -1.0));
    let turned = Keyframe { root_rotation: root_rotation * turn, ..mean.clone() };
    let distances = scene.decoder.samples().iter().map(|(code, pose)| {
        let posture = Pose { root_rotation, root_position, ..pose.clone() }.posture(skeleton);
        let distance = |(point, seen): (&BodyPoint, &Option<Vector3<f64>>)| {
            let body = point.attachment.position(&posture, skeleton);
            seen.map_or(0.0, |seen| (seen - body).norm().min(FAR))
        };
        (scene.points.iter().zip(&seen.points).map(distance).sum::<f64>(), code)
    });
    let mut nearest: Vec<(f64, &Latent)> = distances.collect();
    nearest.sort_by(|a, b| a.0.total_cmp(&b.0));
    let nearest = nearest.into_iter().take(NEAREST).map(|(_, code)| start(*code));
    Some([mean, turned].into_iter().chain(nearest).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::fitted_points;
    use crate::core::camera::Rig;
    use crate::core::detections::KeypointFormat;
    use crate::core::manifold::Decoder;

    /// The triangulated points of a pose, with the starts for them.
    fn starts_of(pose: &Pose) -> Vec<Keyframe> {
        let (decoder, body) = (Decoder::embedded().unwrap(), Skeleton::default());
        let points = fitted_points(KeypointFormat::Body25);
        let posture = pose.posture(&body);
        let seen = points.iter().map(|p| Some(p.attachment.position(&posture, &body))).collect();
        let seen = SeenPerformer { observations: Vec::new(), points: seen, score: 0.0 };
        let (rig, config) = (Rig { version: 0, cameras: Vec::new() }, cost::Config::default());
        let scene = Scene { decoder: &decoder, rig: &rig, points: &points, config: &config };
        starts(&seen, scene, &body).unwrap()
    }

    /// Bent poses: the codes are three times as long as usual ones.
    #[test]
    fn a_start_is_near_an_unusual_pose() {
        let (decoder, body) = (Decoder::embedded().unwrap(), Skeleton::default());
        let posture = |at: &Keyframe| decoder.pose(at).posture(&body);
        let (mut mean, mut nearest) = (0.0, 0.0);
        for (code, _) in &decoder.samples()[490..510] {
            let z = code.map(|z| 3.0 * z);
            let at = Keyframe { z, ..starts_of(&Pose::rest()).swap_remove(0) };
            let far = |start: &Keyframe| {
                let pairs = posture(start).positions.into_iter().zip(posture(&at).positions);
                pairs.map(|(a, b)| (a - b).norm()).sum::<f64>()
            };
            let starts = starts_of(&decoder.pose(&at));
            assert_eq!(starts.len(), 2 + NEAREST);
            mean += far(&starts[0]);
            nearest += far(&starts[2]);
        }
        assert!(nearest < 0.9 * mean, "{nearest} {mean}");
    }

    #[test]
    fn one_start_faces_the_other_way() {
        let found = starts_of(&Pose::rest());
        let [facing, turned] = [0, 1].map(|k| found[k].root_rotation);
        assert!((facing - Matrix3::identity()).norm() < 0.2, "{facing}");
        assert!((facing.column(1) - turned.column(1)).norm() < 1e-12);
        assert!((facing.column(2) + turned.column(2)).norm() < 1e-12);
    }
}
