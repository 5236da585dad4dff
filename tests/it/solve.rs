//! The window problem: its derivatives, its two optimisers, and exact recovery.

use bundlemocap::core::body::{
    BODY_COEFFICIENTS, BodyPoint, Joint, OFFSETS, Posture, Shape, Skeleton, fitted_points,
};
use bundlemocap::core::camera::{Camera, Lens, Rig};
use bundlemocap::core::cost::{
    self, CorrectionProblem, FrameObservations, FreeBody, Observation, PathKeyframe, PathProblem,
    Scene, Workspace,
};
use bundlemocap::core::detections::KeypointFormat;
use bundlemocap::core::manifold::{
    CORRECTION, Correction, Decoder, Interpolation, Keyframe, TimedKeyframe,
};
use bundlemocap::core::optimise::{NormalEquations, OptimiserKind, Problem};
use bundlemocap::core::so3;
use bundlemocap::core::time::Timestamp;
use nalgebra::{DMatrix, DVector, Matrix3, Vector2, Vector3};

use crate::jacobians::{assert_jacobian, numeric_jacobian};

/// Four cameras on a ring of 4 m, 1.5 m high, that look at the middle.
pub fn ring() -> Rig {
    let camera = |i: usize| {
        let angle = i as f64 * std::f64::consts::FRAC_PI_2 + 0.4;
        let centre = Vector3::new(4.0 * angle.sin(), 1.5, 4.0 * angle.cos());
        let forward = (Vector3::new(0.0, 0.9, 0.0) - centre).normalize();
        let right = forward.cross(&Vector3::y()).normalize();
        let rows = [right.transpose(), forward.cross(&right).transpose(), forward.transpose()];
        let rotation = Matrix3::from_rows(&rows);
        Camera::new(
            format!("cam{i}"),
            [1280, 1024],
            &Matrix3::new(1100.0, 0.0, 640.0, 0.0, 1100.0, 512.0, 0.0, 0.0, 1.0),
            Lens::brown_conrady(&[-0.05, 0.01, 1e-4, -2e-4]).unwrap(),
            rotation,
            -(rotation * centre),
        )
        .unwrap()
    };
    Rig::new(1, (0..4).map(camera).collect()).unwrap()
}

/// A constructed keyframe; `size` scales its code.
pub fn keyframe(seed: f64, size: f64) -> Keyframe {
    let wave = |i: usize| ((i as f64 + 1.0) * seed).sin();
    Keyframe {
        z: std::array::from_fn(|i| size * wave(i)),
        root_rotation: so3::exp(&Vector3::new(0.1 * wave(1), 1.5 * seed, 0.1 * wave(2))),
        root_position: Vector3::new(0.3 * wave(3), 1.0, 0.3 * wave(4)),
        correction: Correction::default(),
    }
}

pub fn frame(i: usize) -> Timestamp {
    Timestamp::of_frame(i as u64, 60.0)
}

/// Exact observations of a posture, all with full confidence.
pub fn observe(
    rig: &Rig,
    points: &[BodyPoint],
    posture: &Posture,
    body: &Skeleton,
) -> Vec<Observation> {
    let seen = |camera: usize, point: usize| {
        let world = points[point].attachment.position(posture, body);
        let pixel = rig.cameras[camera].project(&world)?;
        Some(Observation { point, camera, pixel, confidence: 1.0, scale_factor: 1.0 })
    };
    (0..rig.cameras.len())
        .flat_map(|camera| (0..points.len()).filter_map(move |point| seen(camera, point)))
        .collect()
}

/// The full matrix from its lower half.
pub fn dense(equations: &NormalEquations) -> DMatrix<f64> {
    let n = equations.hessian.dimension();
    DMatrix::from_fn(n, n, |i, j| equations.hessian.entry(i, j))
}

struct Case {
    decoder: Decoder,
    rig: Rig,
    points: Vec<BodyPoint>,
    skeleton: Skeleton,
    truth: Vec<Keyframe>,
    observations: Vec<FrameObservations>,
}

impl Case {
    /// Keyframes ten frames apart with exact observations of every frame.
    fn new(keyframes: usize) -> Self {
        let decoder = Decoder::embedded().unwrap();
        let skeleton =
            Skeleton::new(Shape::symmetric(std::array::from_fn(|i| 0.5 * (i as f64).cos())));
        let (rig, points) = (ring(), fitted_points(KeypointFormat::Body25));
        let truth: Vec<_> = (0..keyframes).map(|k| keyframe(0.7 + 0.02 * k as f64, 0.8)).collect();
        let observations = (1..=10 * (keyframes - 1).max(1))
            .map(|i| {
                let (k, s) = ((i - 1) / 10, ((i - 1) % 10 + 1) as f64 / 10.0);
                let next = &truth[(k + 1).min(keyframes - 1)];
                let at = Interpolation::Slerp.keyframe(&truth[k.min(keyframes - 1)], next, s);
                let posture = decoder.pose(&at).posture(&skeleton);
                FrameObservations::new(frame(i), observe(&rig, &points, &posture, &skeleton))
            })
            .collect();
        Self { decoder, rig, points, skeleton, truth, observations }
    }

    fn disturb(&mut self) {
        let mut n = 0.0_f64;
        for frame in &mut self.observations {
            let moved = frame.observations().iter().map(|seen| {
                n += 1.0;
                let outlier = if (n as usize).is_multiple_of(17) { 80.0 } else { 4.0 };
                let pixel = seen.pixel + Vector2::new((n * 1.3).sin(), (n * 2.1).cos()) * outlier;
                Observation { pixel, confidence: 0.6 + 0.3 * (n * 0.7).sin(), ..*seen }
            });
            *frame = FrameObservations::new(frame.capture, moved.collect());
        }
    }

    fn scene<'a>(&'a self, config: &'a cost::Config) -> Scene<'a> {
        Scene { decoder: &self.decoder, rig: &self.rig, points: &self.points, config }
    }

    /// The problem of the first window, from the true first keyframe and from `start` for the
    /// second.
    fn window<'a>(
        &'a self,
        config: &'a cost::Config,
        start: &Keyframe,
        work: &'a mut Workspace,
    ) -> PathProblem<'a> {
        let path = self.path(&[false, true], start);
        PathProblem::new(
            self.scene(config),
            path,
            &self.skeleton,
            FreeBody::Fixed,
            &self.observations,
            work,
        )
    }

    fn path(&self, free: &[bool], start: &Keyframe) -> Vec<PathKeyframe> {
        let value = |k: usize| if free[k] { start.clone() } else { self.truth[k].clone() };
        (0..free.len())
            .map(|k| {
                let (capture, keyframe) = (frame(10 * k), value(k));
                PathKeyframe {
                    timed: TimedKeyframe { capture, keyframe },
                    free: free[k],
                    frames: 10.0,
                }
            })
            .collect()
    }
}

#[test]
fn gradients_of_all_kinds_of_paths_match_central_differences() {
    let mut case = Case::new(4);
    case.disturb();
    let config = cost::Config { prior: 5.0, ..cost::Config::default() };
    let kinds: [(&[bool], FreeBody); 6] = [
        (&[true], FreeBody::Shape),
        (&[true], FreeBody::ShapeAndOffsets),
        (&[false, true], FreeBody::Fixed),
        (&[true, true], FreeBody::Fixed),
        (&[true, true, true], FreeBody::ShapeAndOffsets),
        (&[false, false, true, true], FreeBody::Fixed),
    ];
    for (free, body) in kinds {
        let mut work = Workspace::default();
        let observations = &case.observations[..(10 * (free.len() - 1)).max(1)];
        let path = case.path(free, &keyframe(0.73, 0.8));
        let mut problem = PathProblem::new(
            case.scene(&config),
            path,
            &case.skeleton,
            body,
            observations,
            &mut work,
        );
        let x: Vec<f64> =
            problem.start().iter().enumerate().map(|(i, v)| v + 0.05 * (i as f64).sin()).collect();
        let mut gradient = vec![0.0; x.len()];
        let cost = problem.gradient(&x, &mut gradient);
        assert!((problem.cost(&x) - cost).abs() < 1e-9 * cost);
        let problem = std::cell::RefCell::new(problem);
        let numeric = numeric_jacobian(&x, 5e-3, |x| vec![problem.borrow_mut().cost(x)]);
        assert_jacobian(&DMatrix::from_row_slice(1, x.len(), &gradient), &numeric, 5e-5);
    }
}

/// Checks the Gauss-Newton Hessian at the start against differences of the gradient.
fn assert_hessian(mut problem: PathProblem, step: f64) {
    let x = problem.start();
    let mut equations = NormalEquations::zeros(problem.layout());
    problem.linearise(&x, &mut equations);
    let problem = std::cell::RefCell::new(problem);
    let numeric = numeric_jacobian(&x, step, |x| {
        let mut gradient = vec![0.0; x.len()];
        problem.borrow_mut().gradient(x, &mut gradient);
        gradient
    });
    assert_jacobian(&dense(&equations), &numeric, 1e-4);
}

#[test]
fn the_hessian_is_exact_where_residuals_vanish() {
    let case = Case::new(2);
    let config = cost::Config { prior: 0.0, jacobian_reuse_radius: 0.0, ..cost::Config::default() };
    let mut work = Workspace::default();
    let problem = case.window(&config, &case.truth[1], &mut work);
    assert_hessian(problem, 3e-3);
}

#[test]
fn the_hessian_of_stiffness_is_exact_at_rest() {
    let case = Case::new(1);
    let (config, still) = (cost::Config::default(), case.truth[0].clone());
    let mut work = Workspace::default();
    let path = (0..5).map(|k| {
        let (capture, keyframe) = (frame([0, 1, 2, 4, 5][k]), still.clone());
        PathKeyframe { timed: TimedKeyframe { capture, keyframe }, free: k > 1, frames: 1.0 }
    });
    let scene = case.scene(&config);
    let problem =
        PathProblem::new(scene, path.collect(), &case.skeleton, FreeBody::Fixed, &[], &mut work);
    assert_hessian(problem, 1e-5);
}

/// Of a path with a fixed keyframe, and frames on and between keyframes.
#[test]
fn the_gradient_of_corrections_matches_central_differences() {
    let mut case = Case::new(4);
    case.disturb();
    let config = cost::Config::default();
    let path = case.path(&[false, true, true, true], &case.truth[1]);
    let observations = &case.observations;
    let poses = observations.iter().map(|_| case.decoder.pose(&case.truth[1])).collect();
    let stand = path.iter().map(|_| case.decoder.pose(&case.truth[1])).collect();
    let problem = CorrectionProblem::new(
        case.scene(&config),
        path,
        &case.skeleton,
        observations,
        poses,
        stand,
    );
    let x: Vec<f64> = (0..3 * CORRECTION).map(|i| 0.1 * (1.3 * i as f64).sin()).collect();
    let mut equations = NormalEquations::zeros(problem.layout());
    let problem = std::cell::RefCell::new(problem);
    problem.borrow_mut().linearise(&x, &mut equations);
    let numeric = numeric_jacobian(&x, 1e-4, |x| {
        vec![problem.borrow_mut().linearise(x, &mut equations.clone())]
    });
    assert_jacobian(&DMatrix::from_row_slice(1, x.len(), &equations.gradient), &numeric, 1e-6);
}

/// The speed of each foot in m/s after corrections without observations; the whole body moves at
/// `speed`.
fn foot_speeds(speed: f64, foot_contact: f64) -> [f64; 2] {
    let case = Case::new(1);
    let config = cost::Config { foot_contact, ..cost::Config::default() };
    let path: Vec<PathKeyframe> = (0..10)
        .map(|k| {
            let mut keyframe = case.truth[0].clone();
            keyframe.root_position.x += speed * k as f64 / 60.0;
            PathKeyframe { timed: TimedKeyframe::new(frame(k), keyframe), free: k > 1, frames: 1.0 }
        })
        .collect();
    let stand = path.iter().map(|at| case.decoder.pose(&at.timed.keyframe)).collect();
    let scene = case.scene(&config);
    let problem = CorrectionProblem::new(scene, path, &case.skeleton, &[], Vec::new(), stand);
    let solved = problem.solve();
    let postures: Vec<Posture> =
        solved.iter().map(|at| case.decoder.pose(&at.keyframe).posture(&case.skeleton)).collect();
    [Joint::LFoot, Joint::RFoot].map(|foot| {
        let [a, b] = [4, 5].map(|k: usize| postures[k].positions[foot.index()]);
        60.0 * (b - a).norm()
    })
}

#[test]
fn slow_feet_stand_and_fast_feet_move() {
    for speed in foot_speeds(0.1, 1e4) {
        assert!(speed < 0.01, "{speed}");
    }
    for (speed, foot_contact) in [(0.1, 0.0), (0.5, 1e4)] {
        for found in foot_speeds(speed, foot_contact) {
            assert!((found - speed).abs() < 1e-3, "{found} is not {speed}");
        }
    }
}

#[test]
fn the_marginal_step_of_the_keypoint_offsets_is_that_of_all_unknowns() {
    let mut case = Case::new(2);
    case.disturb();
    let config = cost::Config::default();
    let mut work = Workspace::default();
    let path = case.path(&[false, true], &case.truth[1]);
    let free = FreeBody::ShapeAndOffsets;
    let scene = case.scene(&config);
    let mut problem =
        PathProblem::new(scene, path, &case.skeleton, free, &case.observations, &mut work);
    let x = problem.start();
    let marginal = problem.marginal(&x, OFFSETS).unwrap();
    let step = marginal.hessian.cholesky().unwrap().solve(&marginal.gradient);

    let mut equations = NormalEquations::zeros(problem.layout());
    problem.linearise(&x, &mut equations);
    // The shape is fixed.
    let keyframe = x.len() - BODY_COEFFICIENTS;
    let is_free = |i: &usize| *i < keyframe || *i >= x.len() - OFFSETS;
    let kept: Vec<usize> = (0..x.len()).filter(is_free).collect();
    let all = dense(&equations).select_rows(&kept).select_columns(&kept);
    let gradient = DVector::from_iterator(kept.len(), kept.iter().map(|&i| equations.gradient[i]));
    let whole = all.cholesky().unwrap().solve(&gradient);
    let off = (whole.rows(keyframe, OFFSETS) - &step).norm();
    assert!(off < 1e-6 * step.norm() && step.norm() > 0.1, "{off} {}", step.norm());
}

#[test]
fn both_optimisers_reach_the_same_minimum() {
    let mut case = Case::new(2);
    case.disturb();
    let config = cost::Config::default();
    let minimum = |method: OptimiserKind| {
        let mut work = Workspace::default();
        let mut problem = case.window(&config, &case.truth[0], &mut work);
        let mut x = problem.start();
        let summary = method.optimiser(1e-9).minimise(&mut problem, &mut x, 500);
        let (keyframes, _) = problem.solution(&x);
        (summary, keyframes[1].clone())
    };
    let (lm, a) = minimum(OptimiserKind::LevenbergMarquardt);
    let (lbfgs, b) = minimum(OptimiserKind::Lbfgs);
    assert!(lm.final_cost < 0.9 * lm.initial_cost);
    let difference = (lm.final_cost - lbfgs.final_cost).abs() / lm.final_cost;
    assert!(difference < 1e-4, "{lm:?} {lbfgs:?}");
    let position = (a.root_position - b.root_position).norm();
    assert!(position < 1e-3, "{position}");
}

/// Carried Jacobians only set the direction of a step: fewer are computed, and the minimum is the
/// same.
#[test]
fn carried_jacobians_give_the_same_minimum() {
    let mut case = Case::new(2);
    case.disturb();
    let minimum = |jacobian_reuse_radius: f64| {
        let config = cost::Config { jacobian_reuse_radius, ..cost::Config::default() };
        let mut work = Workspace::default();
        let mut problem = case.window(&config, &case.truth[0], &mut work);
        let mut x = problem.start();
        let mut optimiser = OptimiserKind::LevenbergMarquardt.optimiser(1e-5);
        let summary = optimiser.minimise(&mut problem, &mut x, 500);
        (summary, work.counts().linearised)
    };
    let ((exact, all), (carried, few)) = (minimum(0.0), minimum(0.7));
    let difference = (exact.final_cost - carried.final_cost).abs() / exact.final_cost;
    assert!(difference < 1e-3, "{exact:?} {carried:?}");
    let (all, few) = (all as f64 / exact.iterations as f64, few as f64 / carried.iterations as f64);
    assert!(few < 0.7 * all, "{few} of {all} an iteration");
}

#[test]
fn a_window_is_recovered_from_exact_observations() {
    let case = Case::new(2);
    let config =
        cost::Config { prior: 1e-3, jacobian_reuse_radius: 0.0, ..cost::Config::default() };
    let mut work = Workspace::default();
    let mut problem = case.window(&config, &case.truth[0], &mut work);
    let mut x = problem.start();
    OptimiserKind::LevenbergMarquardt.optimiser(1e-9).minimise(&mut problem, &mut x, 100);
    let (keyframes, _) = problem.solution(&x);
    let (found, truth) = (case.decoder.pose(&keyframes[1]), case.decoder.pose(&case.truth[1]));
    let (a, b) = (found.posture(&case.skeleton), truth.posture(&case.skeleton));
    for j in 0..a.positions.len() {
        assert!((a.positions[j] - b.positions[j]).norm() < 1e-3);
    }
}

#[test]
fn a_warm_window_is_solved_without_allocating() {
    let mut case = Case::new(2);
    case.disturb();
    let config = cost::Config::default();
    let mut work = Workspace::default();
    let mut optimiser = OptimiserKind::LevenbergMarquardt.optimiser(1e-4);
    let mut problem = case.window(&config, &case.truth[0], &mut work);
    let start = problem.start();
    let mut x = start.clone();
    let first = optimiser.minimise(&mut problem, &mut x, 30);
    let mut problem = case.window(&config, &case.truth[0], &mut work);
    x.copy_from_slice(&start);
    let mut second = None;
    let counted = allocation_counter::measure(|| {
        second = Some(optimiser.minimise(&mut problem, &mut x, 30));
    });
    assert_eq!(second, Some(first));
    assert_eq!(counted.count_total, 0, "{counted:?}");
}
