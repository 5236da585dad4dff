//! Held-out metrics of a model, by subject.

use super::corpus::{Clip, POSE, PoseVector, subjects};
use super::latent::{CODE, Slerp};
use super::loss::{Locals, Tree, locals_of};
use super::model::Model;
use crate::core::body::{BODY_JOINTS, JOINTS, Skeleton};
use crate::core::manifold::LATENT;
use crate::core::so3;

/// Frames between the two poses whose codes are interpolated.
pub const SPAN: usize = 10;

/// Number of poses that the networks process at once.
const GROUP: usize = 512;

/// Metrics on one subject's clips, means over frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HeldOutErrors {
    /// The subject; `all` for the mean over all frames.
    pub subject: String,
    /// Number of frames.
    pub frames: usize,
    /// Angle between true and decoded local rotations, over 21 joints, degrees.
    pub rotation_deg: f64,
    /// Distance of joint centres with aligned pelvis, over 22 joints, millimetres.
    pub joint_mm: f64,
    /// The same for the decoded slerp of the codes of frames [`SPAN`] apart, against the true
    /// frames between.
    pub between_mm: f64,
    /// The same for the slerp of each true rotation, for comparison.
    pub true_slerp_mm: f64,
    /// Mean square over the used latent dimensions; 1 for a standard normal distribution.
    pub latent_square: f64,
    /// Smallest and largest standard deviation of a used latent dimension.
    pub latent_spread: (f64, f64),
}

/// Metrics of every subject in `clips`, sorted, then of all together.
pub fn held_out_errors(model: &Model, clips: &[Clip]) -> Vec<HeldOutErrors> {
    let tree = Tree::new(&Skeleton::default());
    let mut all = Sums::default();
    let mut rows = Vec::new();
    for name in subjects(clips) {
        let mut sums = Sums::default();
        for clip in clips.iter().filter(|clip| clip.subject == name) {
            add_clip(model, &tree, clip, &mut sums);
        }
        rows.push(sums.errors(name, model.latent()));
        all.add(&sums);
    }
    rows.push(all.errors("all", model.latent()));
    rows
}

/// The metrics as a text table with a header line.
pub fn table(rows: &[HeldOutErrors]) -> String {
    let mut text = format!(
        "{:<8} {:>7} {:>12} {:>10} {:>11} {:>14} {:>9} {:>13}\n",
        "subject",
        "frames",
        "rotation deg",
        "joints mm",
        "between mm",
        "true slerp mm",
        "mean z^2",
        "std of z",
    );
    for row in rows {
        text += &format!(
            "{:<8} {:>7} {:>12.2} {:>10.2} {:>11.2} {:>14.2} {:>9.2} {:>5.2} to {:>4.2}\n",
            row.subject,
            row.frames,
            row.rotation_deg,
            row.joint_mm,
            row.between_mm,
            row.true_slerp_mm,
            row.latent_square,
            row.latent_spread.0,
            row.latent_spread.1,
        );
    }
    text
}

#[derive(Clone, Default)]
struct Sums {
    frames: usize,
    rotation: f64,
    position: f64,
    pairs: usize,
    between: f64,
    true_slerp: f64,
    code: [f64; LATENT],
    code_square: [f64; LATENT],
}

impl Sums {
    fn add(&mut self, other: &Self) {
        self.frames += other.frames;
        self.rotation += other.rotation;
        self.position += other.position;
        self.pairs += other.pairs;
        self.between += other.between;
        self.true_slerp += other.true_slerp;
        for index in 0..LATENT {
            self.code[index] += other.code[index];
            self.code_square[index] += other.code_square[index];
        }
    }

    fn errors(&self, subject: &str, latent: usize) -> HeldOutErrors {
        let frames = self.frames.max(1) as f64;
        let pairs = self.pairs.max(1) as f64;
        let spreads = (0..latent).map(|index| {
            let mean = self.code[index] / frames;
            (self.code_square[index] / frames - mean * mean).max(0.0).sqrt()
        });
        HeldOutErrors {
            subject: subject.to_owned(),
            frames: self.frames,
            rotation_deg: (self.rotation / frames).to_degrees(),
            joint_mm: 1e3 * self.position / frames,
            between_mm: 1e3 * self.between / pairs,
            true_slerp_mm: 1e3 * self.true_slerp / pairs,
            latent_square: self.code_square.iter().sum::<f64>() / frames / latent.max(1) as f64,
            latent_spread: spreads
                .fold((f64::INFINITY, 0.0), |(low, high), s| (low.min(s), high.max(s))),
        }
    }
}

fn add_clip(model: &Model, tree: &Tree, clip: &Clip, sums: &mut Sums) {
    let codes = encode(model, &clip.poses);
    let truth: Vec<Locals> = clip.poses.iter().map(|pose| locals_of(pose)).collect();
    let decoded = decode(model, &codes);
    for ((truth, decoded), code) in truth.iter().zip(&decoded).zip(&codes) {
        sums.frames += 1;
        sums.rotation += rotation_distance(truth, decoded);
        sums.position += joint_distance(tree, truth, decoded);
        for (index, value) in code.iter().enumerate() {
            sums.code[index] += f64::from(*value);
            sums.code_square[index] += f64::from(*value) * f64::from(*value);
        }
    }
    for step in 1..SPAN {
        let s = step as f64 / SPAN as f64;
        let ends = codes.iter().zip(codes.iter().skip(SPAN));
        let between: Vec<_> = ends.map(|(a, b)| slerp(a, b, s)).collect();
        for (first, decoded) in decode(model, &between).iter().enumerate() {
            let straight = slerp_locals(&truth[first], &truth[first + SPAN], s);
            sums.pairs += 1;
            sums.between += joint_distance(tree, &truth[first + step], decoded);
            sums.true_slerp += joint_distance(tree, &truth[first + step], &straight);
        }
    }
}

fn slerp(a: &[f32; LATENT], b: &[f32; LATENT], s: f64) -> [f32; LATENT] {
    let mut z = [0.0; LATENT];
    Slerp::new(a, b, s).mix(a, b, &mut z);
    z
}

fn slerp_locals(a: &Locals, b: &Locals, s: f64) -> Locals {
    std::array::from_fn(|joint| {
        so3::slerp(&a[joint].map(f64::from), &b[joint].map(f64::from), s).map(|v| v as f32)
    })
}

/// Mean angle over the joints, radians.
fn rotation_distance(a: &Locals, b: &Locals) -> f64 {
    let angles =
        a.iter().zip(b).map(|(a, b)| so3::angle_between(&a.map(f64::from), &b.map(f64::from)));
    angles.sum::<f64>() / BODY_JOINTS as f64
}

/// Mean distance over the joints, metres.
fn joint_distance(tree: &Tree, a: &Locals, b: &Locals) -> f64 {
    let (a, b) = (tree.place(a), tree.place(b));
    let distances = a.positions.iter().zip(&b.positions).map(|(a, b)| f64::from((a - b).norm()));
    distances.sum::<f64>() / JOINTS as f64
}

/// Mean codes of poses.
pub fn encode(model: &Model, poses: &[PoseVector]) -> Vec<[f32; LATENT]> {
    let mut codes = Vec::with_capacity(poses.len());
    for group in poses.chunks(GROUP) {
        let mut tape = model.encoder.tape(group.len());
        tape.input_mut().copy_from_slice(group.as_flattened());
        model.encoder.forward(&model.parameters, &mut tape);
        for row in tape.output().chunks_exact(CODE) {
            codes.push(std::array::from_fn(|index| row[index]));
        }
    }
    codes
}

/// Local rotations of codes.
pub fn decode(model: &Model, codes: &[[f32; LATENT]]) -> Vec<Locals> {
    let mut poses = Vec::with_capacity(codes.len());
    for group in codes.chunks(GROUP) {
        let mut tape = model.decoder.tape(group.len());
        tape.input_mut().copy_from_slice(group.as_flattened());
        model.decoder.forward(&model.parameters, &mut tape);
        poses.extend(tape.output().chunks_exact(POSE).map(locals_of));
    }
    poses
}
