//! Speed of one window: four cameras, 25 points, ten frames; one thread unless stated otherwise.

use std::fmt;
use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bundlemocap::core::body::{BodyPoint, Skeleton, fitted_points};
use bundlemocap::core::camera::Rig;
use bundlemocap::core::cost::{
    self, Counts, FrameObservations, FreeBody, Observation, PathKeyframe, PathProblem, Scene,
    Workspace,
};
use bundlemocap::core::detections::{Detection, Detections, KeypointFormat, Person};
use bundlemocap::core::linalg::{Accum, product};
use bundlemocap::core::manifold::{
    Decoder, Interpolation, Jacobians, Keyframe, LATENT, TimedKeyframe,
};
use bundlemocap::core::optimise::{
    Cholesky, NormalEquations, Optimiser, OptimiserKind, Problem, Summary,
};
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::core::tracker::{self, BodyEstimator, Effort, Job, Noise, Solver, Task};
use bundlemocap::research::synth;
use divan::Bencher;
use nalgebra::{Point2, Vector2, Vector3};

/// A window of a moving performer with disturbed detections.
struct Case {
    decoder: Decoder,
    rig: Rig,
    points: Vec<BodyPoint>,
    skeleton: Skeleton,
    config: cost::Config,
    observations: Vec<FrameObservations>,
    /// The true value of each frame, from the one before the window.
    truth: Vec<Keyframe>,
}

fn keyframe(step: f64) -> Keyframe {
    Keyframe {
        z: std::array::from_fn(|i| {
            (0.8 + 0.1 * step) * ((i + 1) as f64 * (0.7 + 0.05 * step)).sin()
        }),
        root_rotation: bundlemocap::core::so3::exp(&Vector3::new(0.0, 0.2 * step, 0.05 * step)),
        root_position: Vector3::new(0.2 * step, 1.0, 0.05 * step),
        correction: Default::default(),
    }
}

/// Size of a window.
#[derive(Clone, Copy)]
struct Size {
    cameras: usize,
    format: KeypointFormat,
    frames: u64,
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Size { cameras, format, frames } = self;
        write!(f, "{cameras} cameras, {}, {frames} frames", format.name())
    }
}

const USUAL: Size = Size { cameras: 4, format: KeypointFormat::Body25, frames: 10 };

fn time(frame: u64) -> Timestamp {
    Timestamp::of_frame(frame + 1, 60.0)
}

fn case(Size { cameras, format, frames }: Size) -> Case {
    let decoder = Decoder::embedded().expect("embedded weights");
    let rig = synth::ring_rig(cameras, 4.0, 1.5).expect("a valid ring");
    let points = fitted_points(format);
    let skeleton = Skeleton::default();
    let truth: Vec<Keyframe> = (0..=frames + 1)
        .map(|frame| {
            let s = (frame as f64 - 1.0) / 10.0;
            // Back and forth, so that long windows move like short ones.
            let s = if s > 1.0 { 1.0 - (s.rem_euclid(2.0) - 1.0).abs() } else { s };
            Interpolation::Slerp.keyframe(&keyframe(0.0), &keyframe(1.0), s)
        })
        .collect();
    let mut count = 0.0_f64;
    let observations = (1..=frames)
        .map(|frame| {
            let posture = decoder.pose(&truth[frame as usize + 1]).posture(&skeleton);
            let mut seen = Vec::new();
            for (camera, view) in rig.cameras.iter().enumerate() {
                for (point, body_point) in points.iter().enumerate() {
                    let world = body_point.attachment.position(&posture, &skeleton);
                    let Some(pixel) = view.project(&world) else { continue };
                    count += 1.0;
                    let size = if (count as usize).is_multiple_of(23) { 90.0 } else { 4.0 };
                    let pixel =
                        pixel + Vector2::new((count * 1.3).sin(), (count * 2.1).cos()) * size;
                    seen.push(Observation {
                        point,
                        camera,
                        pixel,
                        confidence: 0.8,
                        scale_factor: 1.0,
                    });
                }
            }
            FrameObservations::new(time(frame), seen)
        })
        .collect();
    Case { decoder, rig, points, skeleton, config: cost::Config::default(), observations, truth }
}

impl Case {
    /// The window with a keyframe every N frames, starting from the last known one.
    fn problem<'a>(&'a self, spacing: u64, work: &'a mut Workspace) -> PathProblem<'a> {
        let scene = Scene {
            decoder: &self.decoder,
            rig: &self.rig,
            points: &self.points,
            config: &self.config,
        };
        let frames = self.observations.len() as u64;
        let past = [0, 1].map(|k| {
            let keyframe = self.truth[k as usize].clone();
            PathKeyframe::fixed(TimedKeyframe::new(Timestamp::of_frame(k, 60.0), keyframe))
        });
        let free = (1..=frames).filter(|frame| frame % spacing == 0).map(|frame| {
            let at = TimedKeyframe::new(time(frame), self.truth[1].clone());
            PathKeyframe::free(at, spacing as f64)
        });
        let path = past.into_iter().chain(free).collect();
        PathProblem::new(scene, path, &self.skeleton, FreeBody::Fixed, &self.observations, work)
    }

    fn solve(&self, spacing: u64, optimiser: &mut dyn Optimiser, work: &mut Workspace) -> Summary {
        let mut problem = self.problem(spacing, work);
        let mut x = problem.start();
        optimiser.minimise(&mut problem, &mut x, 30)
    }

    /// Four iterations with a keyframe each frame, each started from two frames earlier.
    fn iterate(&self, optimiser: &mut dyn Optimiser, work: &mut Workspace) -> Summary {
        let mut problem = self.problem(1, work);
        let mut x = problem.start_at(|k, _| self.truth[k - 2].clone());
        optimiser.minimise(&mut problem, &mut x, 4)
    }
}

/// The window as in a stream: the keyframes of its first half were solved in the previous window.
fn job(case: &Case, config: &tracker::Config) -> Job {
    let frames = case.observations.len() as u64;
    let timed = |frame: u64| {
        TimedKeyframe::new(Timestamp::of_frame(frame, 60.0), case.truth[frame as usize].clone())
    };
    let detections = |frame: &FrameObservations, camera: usize| {
        let mut points = vec![None; USUAL.format.len()];
        for seen in frame.observations().iter().filter(|seen| seen.camera == camera) {
            let (pixel, confidence) = (Point2::from(seen.pixel), seen.confidence);
            points[case.points[seen.point].index] = Some(Detection { pixel, confidence });
        }
        let (capture, people) = (frame.capture, vec![Person { id: None, points }]);
        Arc::new(Detections { camera, frame: 0, capture, format: USUAL.format, people })
    };
    let cameras = 0..case.rig.cameras.len();
    let of_moment = |frame| cameras.clone().map(move |camera| detections(frame, camera));
    Job {
        number: 0,
        window: 1,
        start: time(0),
        end: time(frames),
        publish: time(frames / 2),
        keyframe_times: (1..=frames).map(time).collect(),
        pose_times: (1..=frames / 2).map(time).collect(),
        frames: case.observations.iter().flat_map(of_moment).collect(),
        format: USUAL.format,
        rig: Arc::new(case.rig.clone()),
        frame_period: Nanos::new(16_666_666),
        effort: Effort::full(config),
        noise: Noise::default(),
        task: Task::Track {
            past: vec![timed(0), timed(1)],
            ahead: (2..=1 + frames / 2).map(timed).collect(),
            skeleton: Arc::new(case.skeleton.clone()),
            estimator: Arc::new(BodyEstimator::default()),
            coasted: 0,
        },
    }
}

/// A whole job of the solver: association, keyframes, poses, residuals.
#[divan::bench(name = "solver's job, by threads", args = [1, 2])]
fn jobs(bencher: Bencher, threads: usize) {
    let case = case(USUAL);
    let config = tracker::Config { threads, ..tracker::Config::default() };
    let (job, mut solver) = (job(&case, &config), Solver::new(case.decoder.clone(), config));
    bencher.bench_local(|| solver.solve(&job));
}

fn solves(bencher: Bencher, spacing: u64, method: OptimiserKind) {
    let case = case(USUAL);
    let (mut optimiser, mut work) = (method.optimiser(1e-3), Workspace::default());
    bencher.bench_local(|| case.solve(spacing, &mut *optimiser, &mut work));
}

#[divan::bench(name = "window solve")]
fn window_solve(bencher: Bencher) {
    solves(bencher, 1, OptimiserKind::LevenbergMarquardt);
}

#[divan::bench(name = "paper's window solve, lm")]
fn papers_solve_lm(bencher: Bencher) {
    solves(bencher, 10, OptimiserKind::LevenbergMarquardt);
}

#[divan::bench(name = "paper's window solve, lbfgs")]
fn papers_solve_lbfgs(bencher: Bencher) {
    solves(bencher, 10, OptimiserKind::Lbfgs);
}

#[divan::bench(name = "window cost")]
fn window_cost(bencher: Bencher) {
    let (case, mut work) = (case(USUAL), Workspace::default());
    let mut problem = case.problem(1, &mut work);
    let x = problem.start();
    bencher.bench_local(|| problem.cost(&x));
}

#[divan::bench(name = "window gradient")]
fn window_gradient(bencher: Bencher) {
    let (case, mut work) = (case(USUAL), Workspace::default());
    let mut problem = case.problem(1, &mut work);
    let x = problem.start();
    let mut gradient = vec![0.0; x.len()];
    bencher.bench_local(|| problem.gradient(&x, &mut gradient));
}

#[divan::bench(name = "window normal equations")]
fn window_normal_equations(bencher: Bencher) {
    let (case, mut work) = (case(USUAL), Workspace::default());
    let mut problem = case.problem(1, &mut work);
    let x = problem.start();
    let mut equations = NormalEquations::zeros(problem.layout());
    bencher.bench_local(|| problem.linearise(&x, &mut equations));
}

#[divan::bench(name = "window factorisation")]
fn window_factorisation(bencher: Bencher) {
    let (case, mut work) = (case(USUAL), Workspace::default());
    let mut problem = case.problem(1, &mut work);
    let x = problem.start();
    let mut equations = NormalEquations::zeros(problem.layout());
    problem.linearise(&x, &mut equations);
    let mut factor = Cholesky::like(&equations.hessian);
    bencher.bench_local(|| factor.factorise(&equations.hessian, |_| 1.0));
}

/// The measured sizes: cameras, frames, points.
fn sizes() -> impl Iterator<Item = Size> {
    let cameras = [2, 4, 8, 16, 32].map(|cameras| Size { cameras, ..USUAL });
    let frames = [5, 20, 40].map(|frames| Size { frames, ..USUAL });
    let whole_body = Size { format: KeypointFormat::CocoWholebody133, ..USUAL };
    cameras.into_iter().chain(frames).chain([whole_body])
}

/// Time of four iterations by the number of observations.
#[divan::bench(name = "four iterations by size", args = sizes())]
fn four_iterations(bencher: Bencher, size: Size) {
    let case = case(size);
    let mut optimiser = OptimiserKind::LevenbergMarquardt.optimiser(0.0);
    let mut work = Workspace::default();
    bencher.bench_local(|| case.iterate(&mut *optimiser, &mut work));
}

#[divan::bench(name = "decode 10 codes")]
fn decode(bencher: Bencher) {
    let case = case(USUAL);
    let codes = [case.truth[0].z; 10];
    let mut work = Jacobians::default();
    bencher.bench_local(|| case.decoder.values(&codes, &mut work));
}

#[divan::bench(name = "decode 10 codes with tangents")]
fn decode_with_tangents(bencher: Bencher) {
    let case = case(USUAL);
    let codes = [case.truth[0].z; 10];
    let mut work = Jacobians::default();
    bencher.bench_local(|| {
        case.decoder.values(&codes, &mut work);
        case.decoder.tangents(&mut work);
    });
}

/// Floating-point operations of a window solve from its counts, only matrix products, all in f32; a
/// multiplication and an addition are two. Each Hessian counts as factorised once.
fn operations(counts: Counts, points: usize) -> f64 {
    const HIDDEN: usize = 256;
    const OUTPUTS: usize = 126;
    const ROTATIONS: usize = OUTPUTS / 2;
    const UNKNOWNS: usize = LATENT + 6;
    let deep = HIDDEN * HIDDEN + HIDDEN * OUTPUTS;
    let tangents = LATENT * deep;
    let map = LATENT * ROTATIONS * 6;
    let pass = LATENT * HIDDEN + deep;
    let joints = ROTATIONS * (3 * LATENT + 2 * UNKNOWNS);
    let rows = 3 * points * (6 * UNKNOWNS + UNKNOWNS * UNKNOWNS);
    // Each block column of the banded factor: half of four products, two triangular solves, one factor.
    let factor = 3 * UNKNOWNS.pow(3) + UNKNOWNS.pow(3) / 6;
    let products = counts.linearised * (tangents + map)
        + (counts.decoded + counts.gradients) * pass
        + counts.frames * (joints + rows + factor);
    2.0 * products as f64
}

/// The peak rate of operations per second of one thread in a large product.
fn peak() -> f64 {
    const SIZE: usize = 768;
    let ones = vec![1.0_f32; SIZE * SIZE];
    let mut out = ones.clone();
    let runs = (0..20).map(|_| {
        let start = Instant::now();
        product([SIZE; 3], black_box(&ones), &ones, Accum::Replace, &mut out);
        black_box(&out);
        start.elapsed().as_secs_f64()
    });
    2.0 * (SIZE as f64).powi(3) / runs.fold(f64::INFINITY, f64::min)
}

/// The fraction of the processor's peak that a window solve reaches: its time at the peak over its
/// time.
fn arithmetic() {
    let case = case(USUAL);
    let mut optimiser = OptimiserKind::LevenbergMarquardt.optimiser(1e-3);
    let mut work = Workspace::default();
    let mut runs: Vec<(f64, Counts, Summary)> = (0..200)
        .map(|_| {
            let (before, start) = (work.counts(), Instant::now());
            let summary = case.solve(1, &mut *optimiser, &mut work);
            (start.elapsed().as_secs_f64(), work.counts().since(before), summary)
        })
        .collect();
    runs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (time, counts, summary) = runs[runs.len() / 2];
    let (operations, peak) = (operations(counts, case.points.len()), peak());
    println!("window solve: {:.2} ms, {} iterations, {counts:?}", time * 1e3, summary.iterations);
    println!("  {:.1} MFLOP in f32", operations / 1e6);
    println!("  peak: {:.1} GFLOP/s", peak / 1e9);
    println!("  {:.0} % of the peak", 100.0 * operations / peak / time);
}

fn main() {
    arithmetic();
    divan::Divan::default()
        .sample_count(50)
        .min_time(Duration::from_secs(3))
        .config_with_args()
        .main();
}
