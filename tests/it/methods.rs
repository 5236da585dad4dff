//! The compared methods: derivatives of their terms, their solver, and each method on a recording.

use std::sync::Arc;

use bundlemocap::core::body::{BodyPoint, Posture, Skeleton, fitted_points};
use bundlemocap::core::camera::Rig;
use bundlemocap::core::cost::{self, FrameObservations, Observation, Scene};
use bundlemocap::core::detections::KeypointFormat;
use bundlemocap::core::manifold::{Decoder, Keyframe};
use bundlemocap::core::optimise::{
    Layout, LevenbergMarquardt, NormalEquations, Optimiser, Problem,
};
use bundlemocap::core::time::Nanos;
use bundlemocap::metrics;
use bundlemocap::research::methods::{
    self, Delay, Filter, FramePath, JointSteps, KeyframeSteps, LowFrequency, Method,
    Motion as Solution, MuVs, Solved, Take, Term, Triangulation, UNKNOWNS,
};
use bundlemocap::research::synth::{Motion, MotionStyle, Noise, Recording, position, ring_rig};
use nalgebra::{DMatrix, Vector2};

use crate::jacobians::{assert_jacobian, numeric_jacobian};
use crate::solve::{dense, frame, keyframe, observe, ring};
use crate::support::pinned;

/// A few frames with detection errors.
struct Case {
    decoder: Decoder,
    rig: Rig,
    points: Vec<BodyPoint>,
    skeleton: Skeleton,
    config: cost::Config,
    initial: Vec<Keyframe>,
    observations: Vec<Vec<FrameObservations>>,
}

impl Case {
    fn new(frames: usize) -> Self {
        let (decoder, skeleton) = (Decoder::embedded().unwrap(), Skeleton::default());
        let (rig, points) = (ring(), fitted_points(KeypointFormat::Body25));
        let truth = |i: usize| keyframe(0.7 + 0.01 * i as f64, 0.8);
        let observations = (0..frames).map(|i| {
            let posture = decoder.pose(&truth(i)).posture(&skeleton);
            let seen = observe(&rig, &points, &posture, &skeleton);
            let moved = seen.into_iter().enumerate().map(|(n, seen)| {
                let n = (n + 131 * i) as f64;
                let off = Vector2::new((n * 1.3).sin(), (n * 2.1).cos()) * 6.0;
                Observation { pixel: seen.pixel + off, ..seen }
            });
            vec![FrameObservations::new(frame(i), moved.collect())]
        });
        let observations = observations.collect();
        let initial = (0..frames).map(truth).collect();
        Self {
            decoder,
            rig,
            points,
            skeleton,
            config: cost::Config::default(),
            initial,
            observations,
        }
    }

    fn path<'a>(
        &'a self,
        observations: &'a [Vec<FrameObservations>],
        initial: &'a [Keyframe],
        terms: &'a [Box<dyn Term + 'a>],
    ) -> FramePath<'a> {
        let (decoder, rig, points) = (&self.decoder, &self.rig, &self.points[..]);
        let scene = Scene { decoder, rig, points, config: &self.config };
        FramePath::new(scene, &self.skeleton, observations, initial, terms)
    }
}

fn every_term(frames: usize) -> [Box<dyn Term>; 3] {
    [
        Box::new(JointSteps { weight: 1e5 }),
        Box::new(KeyframeSteps { latent: 300.0, rotation: 1e5, position: 1e6 }),
        Box::new(LowFrequency::new(1e5, frames, 2)),
    ]
}

fn moved(x: &[f64]) -> Vec<f64> {
    x.iter().enumerate().map(|(i, v)| v + 0.05 * (i as f64).sin()).collect()
}

#[test]
fn gradients_of_terms_between_frames_match_central_differences() {
    let case = Case::new(4);
    for term in every_term(4) {
        let (terms, unseen) = ([term], vec![Vec::new(); 4]);
        for observations in [&unseen, &case.observations] {
            let mut path = case.path(observations, &case.initial, &terms);
            let x = moved(&path.start());
            let mut equations = NormalEquations::zeros(path.layout());
            let cost = path.linearise(&x, &mut equations);
            assert!((path.cost(&x) - cost).abs() < 1e-9 * cost);
            let path = std::cell::RefCell::new(path);
            let numeric = numeric_jacobian(&x, 4e-3, |x| vec![path.borrow_mut().cost(x)]);
            let gradient = DMatrix::from_row_slice(1, x.len(), &equations.gradient);
            assert_jacobian(&gradient, &numeric, 5e-5);
        }
    }
}

#[test]
fn hessians_of_steps_are_exact_at_rest() {
    let mut case = Case::new(3);
    case.config.prior = 0.0;
    let (still, unseen) = (vec![keyframe(0.7, 0.8); 3], vec![Vec::new(); 3]);
    for term in every_term(3).into_iter().take(2) {
        let terms = [term];
        let mut path = case.path(&unseen, &still, &terms);
        let x = path.start();
        let mut equations = NormalEquations::zeros(path.layout());
        path.linearise(&x, &mut equations);
        let path = std::cell::RefCell::new(path);
        let numeric = numeric_jacobian(&x, 3e-3, |x| {
            let mut equations = NormalEquations::zeros(path.borrow().layout());
            path.borrow_mut().linearise(x, &mut equations);
            equations.gradient
        });
        assert_jacobian(&dense(&equations), &numeric, 1e-4);
    }
}

#[test]
fn fixed_unknowns_stay_and_free_ones_move() {
    let case = Case::new(3);
    let terms = every_term(3);
    for free in [[false, true], [true, false]] {
        let mut path = case.path(&case.observations, &case.initial, &terms);
        path.free = free;
        let start = path.start();
        let mut x = start.clone();
        LevenbergMarquardt::default().minimise(&mut path, &mut x, 5);
        for (i, (x, start)) in x.iter().zip(&start).enumerate() {
            let is_free = free[usize::from(i % UNKNOWNS >= UNKNOWNS - 6)];
            assert_eq!(x != start, is_free, "unknown {i}");
        }
    }
}

/// A banded problem as a problem of one block.
struct Dense<'a>(FramePath<'a>);

impl Problem for Dense<'_> {
    fn layout(&self) -> Layout {
        Layout::dense(self.0.layout().dimension())
    }

    fn cost(&mut self, x: &[f64]) -> f64 {
        self.0.cost(x)
    }

    fn linearise(&mut self, x: &[f64], equations: &mut NormalEquations) -> f64 {
        let mut banded = NormalEquations::zeros(self.0.layout());
        let cost = self.0.linearise(x, &mut banded);
        equations.gradient.copy_from_slice(&banded.gradient);
        for (j, column) in dense(&banded).column_iter().enumerate() {
            equations.hessian.column_mut(0..column.len(), j).copy_from_slice(column.as_slice());
        }
        cost
    }

    fn gradient(&mut self, x: &[f64], gradient: &mut [f64]) -> f64 {
        self.0.gradient(x, gradient)
    }
}

#[test]
fn banded_and_dense_normal_equations_give_the_same_steps() {
    let case = Case::new(5);
    let terms = every_term(5);
    let path = || case.path(&case.observations, &case.initial, &terms);
    let (mut banded, mut x) = (path(), moved(&path().start()));
    let mut y = x.clone();
    let summary = LevenbergMarquardt::default().minimise(&mut banded, &mut x, 30);
    let expected = LevenbergMarquardt::default().minimise(&mut Dense(path()), &mut y, 30);
    assert_eq!(summary.iterations, expected.iterations);
    assert!(summary.final_cost < 0.5 * summary.initial_cost, "{summary:?}");
    let apart = (summary.final_cost - expected.final_cost).abs();
    assert!(apart < 1e-6 * expected.final_cost, "{summary:?} {expected:?}");
    let apart = x.iter().zip(&y).map(|(x, y)| (x - y).abs()).fold(0.0, f64::max);
    assert!(apart < 1e-3, "{apart}");
}

/// One and a half seconds of a walk seen by four cameras, with the true postures.
fn recording() -> (Take, Vec<Posture>) {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut recording = Recording::new(rig.clone(), skeleton.clone(), |s| motion.pose(s));
    recording.frames = 75;
    let truth = recording.poses().map(|pose| pose.pose.posture(&skeleton)).collect();
    let frames = recording.detections().collect();
    let format = KeypointFormat::Body25;
    (Take::new(Arc::new(rig), format, recording.fps, frames), truth)
}

/// MPJPE in mm and acceleration error in m/s^2.
fn errors(take: &Take, truth: &[Posture], solved: &Solved) -> (f64, f64) {
    let frames = solved.motion.times().len();
    let first = truth.len() - frames;
    let bodies = (0..frames).filter_map(|frame| solved.motion.frame(frame));
    let found: Vec<_> = bodies.filter_map(|body| body.posture().cloned()).collect();
    let errors = metrics::pose_errors(found.iter().zip(&truth[first..])).unwrap();
    (errors.mpjpe_mm, metrics::acceleration_error(&found, &truth[first..], take.fps).unwrap())
}

/// MPJPE on that walk.
const MEASURED_MM: [(&str, f64); 10] = [
    ("muvs", 14.41),
    ("dct", 13.66),
    ("etc", 13.59),
    ("dmmr", 13.60),
    ("slahmr", 15.49),
    ("paper", 18.40),
    ("paper-converged", 17.02),
    ("paper-body", 17.02),
    ("fixed", 14.16),
    ("default", 13.23),
];

#[test]
fn every_method_solves_a_recording_and_temporal_ones_are_smoother() {
    let (take, truth) = recording();
    let decoder = Decoder::embedded().unwrap();
    let (mut alone, mut found) = (f64::INFINITY, Vec::new());
    let with_body = methods::NAMES.iter().filter(|name| !name.starts_with("triangulation"));
    for name in with_body {
        let mut method = methods::named(name).unwrap();
        let solved = method.solve(&take, &decoder).unwrap();
        let (mpjpe, acceleration) = errors(&take, &truth, &solved);
        println!("{name}: {mpjpe:.2} mm, {acceleration:.1} m/s^2");
        found.push((name, mpjpe));
        let times = solved.motion.times();
        let steps = times.windows(2).map(|pair| pair[1] - pair[0]);
        assert!(
            steps.into_iter().all(|step| (step - Nanos::of_frames(1, 60.0)).abs() < Nanos::new(10)),
            "{name}"
        );
        match *name {
            "muvs" => alone = acceleration,
            "slahmr" => assert!(acceleration < 0.5 * alone, "{acceleration}, muvs: {alone}"),
            _ => assert!(acceleration < alone, "{name}: {acceleration}, muvs: {alone}"),
        }
    }
    assert_eq!(found.len(), MEASURED_MM.len());
    for ((name, mpjpe), (of, measured)) in found.into_iter().zip(MEASURED_MM) {
        assert_eq!(*name, of);
        pinned(name, mpjpe, measured);
    }
    assert!(methods::named("nobody").is_none());
}

#[test]
fn triangulation_recovers_exact_points() {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut recording = Recording::new(rig.clone(), skeleton.clone(), |s| motion.pose(s));
    (recording.frames, recording.noise) = (40, Noise::none());
    let frames = recording.detections().collect();
    let take = Take::new(Arc::new(rig), KeypointFormat::Body25, recording.fps, frames);
    // Hardly a filter at 60 frames/s.
    let all_pass = Filter::Butterworth { cutoff_hz: 29.0 };
    let mut method = Triangulation::new(all_pass, 15.0);
    let solved = method.solve(&take, &Decoder::embedded().unwrap()).unwrap();
    let times = solved.motion.times();
    assert!(times.len() > 30, "{}", times.len());
    for (frame, at) in times.into_iter().enumerate() {
        let body = solved.motion.frame(frame).unwrap();
        let truth = recording.poses().find(|pose| pose.capture == at).unwrap();
        let posture = truth.pose.posture(&skeleton);
        for (keypoint, found) in metrics::COMPARED.into_iter().zip(body.limb_joints()) {
            let off = (found.unwrap() - position(keypoint, &skeleton, &posture)).norm();
            assert!(off < 5e-4, "frame {frame}, {keypoint:?}: {off} m");
        }
    }
}

#[test]
fn a_frame_with_too_few_detections_keeps_the_previous_pose() {
    let (mut take, _) = recording();
    let hidden = 50..53;
    let is_hidden = |frame: &u64| hidden.contains(frame);
    let frame_of =
        |capture: bundlemocap::core::time::Timestamp| (capture.ns() as f64 * 6e-8).round();
    take.frames.retain(|seen| seen.camera == 0 || !is_hidden(&(frame_of(seen.capture) as u64)));
    let mut method = MuVs::default();
    assert_eq!(method.delay(take.fps), Delay::Frames(0));
    let solved = method.solve(&take, &Decoder::embedded().unwrap()).unwrap();
    let Solution::Poses(_, poses) = solved.motion else { panic!("no poses") };
    for pair in poses.windows(2) {
        let frame = frame_of(pair[1].0) as u64;
        assert_eq!(pair[0].1 == pair[1].1, is_hidden(&frame), "frame {frame}");
    }
}
