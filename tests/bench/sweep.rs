//! The sweep behind the defaults: error of the whole solve over a grid of settings.
//!
//! `cargo bench --bench sweep -- [WEIGHTS]` solves synthetic recordings (default detector noise,
//! four cameras on a ring, a body shape per recording that the solver is not told) of our own
//! procedural motion and, where the motion corpus is there, of the clips of two subjects that the
//! weights were not trained on, with a made-up root motion; and prints one row per setting.

use std::path::PathBuf;
use std::sync::Arc;

use bundlemocap::body::{BODY_JOINTS, Pose, Posture, Shape, Skeleton, StampedPose, TrackingState};
use bundlemocap::eval;
use bundlemocap::manifold::Decoder;
use bundlemocap::so3;
use bundlemocap::synth::{Motion, Recording, ring_rig, through};
use bundlemocap::track::{Config, Input, Output, Solver, Track};
use bundlemocap::train;
use nalgebra::{Matrix3, Vector3};

const FPS: f64 = 60.0;
const HELD_OUT: [&str; 2] = ["07", "10"];
/// Every so manieth clip, and this many frames from its middle.
const EVERY: usize = 2;
const FRAMES: usize = 181;

const PRIORS: [f64; 5] = [10.0, 30.0, 100.0, 300.0, 1000.0];
const SCALES_PX: [f64; 4] = [15.0, 30.0, 50.0, 100.0];

/// Mean figures over all recordings.
#[derive(Default)]
struct Row {
    mpjpe_mm: f64,
    root_relative_mm: f64,
    rmse_mm: f64,
    mae_deg: f64,
    acceleration_error: f64,
    lost: usize,
}

fn main() {
    let decoder = match std::env::args().skip(1).find(|a| !a.starts_with("--")) {
        Some(path) => {
            let bytes = std::fs::read(&path).expect("a readable weights file");
            Decoder::from_bytes(&bytes).expect("a weights file")
        }
        None => Decoder::embedded().expect("embedded weights"),
    };
    let sequences: Vec<Vec<Pose>> = [walk()].into_iter().chain(clips()).collect();
    println!("{} recordings", sequences.len());
    println!(
        "prior  scale px  MPJPE mm  root-relative  RMSE mm  MAE deg  accel. error  frames lost"
    );
    for prior in PRIORS {
        for scale_px in SCALES_PX {
            let mut config = Config { frame_rate_hz: FPS, ..Config::default() };
            (config.cost.prior, config.cost.scale_px) = (prior, scale_px);
            let row =
                mean(sequences.iter().enumerate().map(|(i, s)| solve(i, s, &config, &decoder)));
            println!(
                "{prior:5}  {scale_px:8}  {:8.2}  {:13.2}  {:7.2}  {:7.2}  {:12.2}  {:11}",
                row.mpjpe_mm,
                row.root_relative_mm,
                row.rmse_mm,
                row.mae_deg,
                row.acceleration_error,
                row.lost
            );
        }
    }
}

fn walk() -> Vec<Pose> {
    let motion = Motion::new(&Skeleton::default(), Default::default());
    (0..780).map(|frame| motion.pose(f64::from(frame) / FPS)).collect()
}

/// Clips of the held-out subjects; none where the corpus is absent.
fn clips() -> Vec<Vec<Pose>> {
    let root = std::env::var_os("BUNDLEMOCAP_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let Ok(clips) = train::read_folder(&root.join("motions")) else {
        println!("skipped: no motion corpus in {}", root.display());
        return Vec::new();
    };
    let held_out = clips.iter().filter(|clip| HELD_OUT.contains(&clip.subject.as_str()));
    held_out.step_by(EVERY).map(poses).collect()
}

/// The middle of a clip, moved about and turned.
fn poses(clip: &train::Clip) -> Vec<Pose> {
    let frames = FRAMES.min(clip.poses.len());
    let first = (clip.poses.len() - frames) / 2;
    let pose = |frame: usize| {
        let (t, numbers) = (frame as f64 / FPS, &clip.poses[first + frame]);
        let local: [Matrix3<f64>; BODY_JOINTS] = std::array::from_fn(|joint| {
            let at = |k: usize| f64::from(numbers[6 * joint + k]);
            let a = Vector3::new(at(0), at(1), at(2)).normalize();
            let b = Vector3::new(at(3), at(4), at(5));
            let b = (b - a * a.dot(&b)).normalize();
            Matrix3::from_columns(&[a, b, a.cross(&b)])
        });
        let sway = 0.05 * (3.0 * t).sin();
        Pose {
            root_rotation: so3::exp(&Vector3::new(sway, 0.8 * t, 0.05 * (5.0 * t).sin())),
            root_position: Vector3::new(
                0.6 * (1.1 * t).sin(),
                0.93 + 0.03 * (9.0 * t).sin(),
                0.6 * (0.9 * t).cos(),
            ),
            local,
        }
    };
    (0..frames).map(pose).collect()
}

fn solve(index: usize, poses: &[Pose], config: &Config, decoder: &Decoder) -> Option<Row> {
    let shape = |i: usize| 0.9 * ((i + 1) as f64 * (index as f64 + 1.3) * 1.7).sin();
    let skeleton = Skeleton::new(Shape(std::array::from_fn(shape)));
    let rig = ring_rig(4, 4.0, 1.6).expect("a valid ring");
    let motion = through(poses.to_vec(), FPS);
    let mut recording = Recording::new(rig.clone(), skeleton.clone(), motion);
    (recording.frames, recording.seed) = (poses.len() as u64, index as u64 + 1);

    let (solved, body) = track(&recording.detections().collect::<Vec<_>>(), rig, config, decoder)?;
    let truth: Vec<StampedPose> = recording.poses().collect();
    let (estimates, truths): (Vec<Posture>, Vec<Posture>) = solved
        .iter()
        .filter_map(|pose| {
            let same = |t: &&StampedPose| (t.capture - pose.capture).abs() < 1_000_000;
            let truth = truth.iter().find(same)?;
            Some((pose.pose.posture(&body), truth.pose.posture(&skeleton)))
        })
        .unzip();
    let errors = eval::pose_errors(estimates.iter().zip(&truths))?;
    Some(Row {
        mpjpe_mm: errors.mpjpe_mm,
        root_relative_mm: errors.mpjpe_root_relative_mm,
        rmse_mm: errors.rmse_mm,
        mae_deg: errors.mae_deg,
        acceleration_error: eval::acceleration_error(&estimates, &truths, FPS)?,
        lost: solved.iter().filter(|pose| pose.state == TrackingState::Lost).count(),
    })
}

fn track(
    frames: &[bundlemocap::detect::Detections],
    rig: bundlemocap::camera::Rig,
    config: &Config,
    decoder: &Decoder,
) -> Option<(Vec<StampedPose>, Arc<Skeleton>)> {
    let mut track = Track::new(*config, Arc::new(rig));
    let mut solver = Solver::new(decoder.clone(), *config);
    let (mut poses, mut body) = (Vec::new(), None);
    for input in frames.iter().cloned().map(Input::Detections).chain([Input::End]) {
        track.handle(input);
        while let Some(output) = track.poll() {
            match output {
                Output::Solve(job) => track.handle(Input::Solved(solver.solve(&job))),
                Output::Pose(pose) => poses.push(*pose),
                Output::Skeleton(skeleton) => body = Some(skeleton),
                _ => {}
            }
        }
    }
    Some((poses, body?))
}

fn mean(rows: impl Iterator<Item = Option<Row>>) -> Row {
    let (mut sum, mut count) = (Row::default(), 0.0);
    for row in rows.flatten() {
        sum.mpjpe_mm += row.mpjpe_mm;
        sum.root_relative_mm += row.root_relative_mm;
        sum.rmse_mm += row.rmse_mm;
        sum.mae_deg += row.mae_deg;
        sum.acceleration_error += row.acceleration_error;
        sum.lost += row.lost;
        count += 1.0;
    }
    let share = 1.0 / f64::max(count, 1.0);
    Row {
        mpjpe_mm: sum.mpjpe_mm * share,
        root_relative_mm: sum.root_relative_mm * share,
        rmse_mm: sum.rmse_mm * share,
        mae_deg: sum.mae_deg * share,
        acceleration_error: sum.acceleration_error * share,
        lost: sum.lost,
    }
}
