//! Speed of one window: four cameras, 25 points, ten frames, one thread.

use bundlemocap::body::{BodyPoint, Skeleton, fitted_points};
use bundlemocap::camera::Rig;
use bundlemocap::cost::{self, Knot, Moment, Observation, PathProblem, Scene, Workspace};
use bundlemocap::detect::KeypointFormat;
use bundlemocap::manifold::{Decoder, Interpolation, Jacobians, Keyframe};
use bundlemocap::solve::{Method, Normal, Problem};
use bundlemocap::synth;
use bundlemocap::time::Timestamp;
use criterion::{Criterion, criterion_group, criterion_main};
use nalgebra::{Vector2, Vector3};

/// A window of a moving performer with disturbed detections.
struct Case {
    decoder: Decoder,
    rig: Rig,
    points: Vec<BodyPoint>,
    skeleton: Skeleton,
    config: cost::Config,
    moments: Vec<Moment>,
    from: Keyframe,
}

fn keyframe(step: f64) -> Keyframe {
    Keyframe {
        z: std::array::from_fn(|i| {
            (0.8 + 0.1 * step) * ((i + 1) as f64 * (0.7 + 0.05 * step)).sin()
        }),
        root_rotation: bundlemocap::so3::exp(&Vector3::new(0.0, 0.2 * step, 0.05 * step)),
        root_position: Vector3::new(0.2 * step, 1.0, 0.05 * step),
    }
}

fn case() -> Case {
    let decoder = Decoder::embedded().expect("embedded weights");
    let rig = synth::ring_rig(4, 4.0, 1.5).expect("a valid ring");
    let points = fitted_points(KeypointFormat::Body25);
    let skeleton = Skeleton::default();
    let (from, to) = (keyframe(0.0), keyframe(1.0));
    let mut count = 0.0_f64;
    let moments = (1..=10)
        .map(|i| {
            let at = Interpolation::Slerp.keyframe(&from, &to, f64::from(i) / 10.0);
            let posture = decoder.pose(&at).posture(&skeleton);
            let mut seen = Vec::new();
            for (camera, view) in rig.cameras.iter().enumerate() {
                for (point, body_point) in points.iter().enumerate() {
                    let world = body_point.attachment.position(&posture, skeleton.shape());
                    let Some(pixel) = view.project(&world) else { continue };
                    count += 1.0;
                    let size = if (count as usize).is_multiple_of(23) { 90.0 } else { 4.0 };
                    let pixel =
                        pixel + Vector2::new((count * 1.3).sin(), (count * 2.1).cos()) * size;
                    seen.push(Observation { point, camera, pixel, confidence: 0.8 });
                }
            }
            Moment::new(Timestamp::of_frame(i as u64, 60.0), seen)
        })
        .collect();
    Case { decoder, rig, points, skeleton, config: cost::Config::default(), moments, from }
}

impl Case {
    fn problem<'a>(&'a self, work: &'a mut Workspace) -> PathProblem<'a> {
        let scene = Scene {
            decoder: &self.decoder,
            rig: &self.rig,
            points: &self.points,
            config: &self.config,
        };
        let knot = |frame, free| Knot {
            capture: Timestamp::of_frame(frame, 60.0),
            keyframe: self.from.clone(),
            free,
            frames: 10.0,
        };
        let knots = vec![knot(0, false), knot(10, true)];
        PathProblem::new(scene, knots, &self.skeleton, false, &self.moments, work)
    }
}

fn window(c: &mut Criterion) {
    let case = case();
    for (name, method) in [("lm", Method::LevenbergMarquardt), ("lbfgs", Method::Lbfgs)] {
        let (mut optimiser, mut work) = (method.optimiser(1e-4), Workspace::default());
        c.bench_function(&format!("window solve, {name}"), |b| {
            b.iter(|| {
                let mut problem = case.problem(&mut work);
                let mut x = problem.start();
                optimiser.minimise(&mut problem, &mut x, 30)
            });
        });
    }
    let mut work = Workspace::default();
    let mut problem = case.problem(&mut work);
    let x = problem.start();
    let mut gradient = vec![0.0; x.len()];
    let mut normal = Normal::zeros(problem.layout());
    c.bench_function("window cost", |b| b.iter(|| problem.cost(&x)));
    c.bench_function("window gradient", |b| b.iter(|| problem.gradient(&x, &mut gradient)));
    c.bench_function("window normal equations", |b| {
        b.iter(|| problem.linearise(&x, &mut gradient, &mut hessian));
    });
}

fn decoder(c: &mut Criterion) {
    let case = case();
    let codes = [case.from.z; 10];
    let mut work = Jacobians::default();
    c.bench_function("decode 10 codes", |b| b.iter(|| case.decoder.values(&codes, &mut work)));
    c.bench_function("decode 10 codes with tangents", |b| {
        b.iter(|| {
            case.decoder.values(&codes, &mut work);
            case.decoder.tangents(&mut work);
        });
    });
}

criterion_group! {
    name = benches;
    config = Criterion::default().without_plots();
    targets = window, decoder
}
criterion_main!(benches);
