//! Encoder and decoder with their parameters, and the gradient of one batch.

use std::ops::Range;
use std::thread;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::corpus::{POSE, PoseVector};
use super::latent::{self, CODE, Slerp};
use super::limits::{Limits, draw_codes};
use super::loss::{Tree, Weights, pose_loss};
use super::mlp::{Mlp, Tape, fill_normal};
use super::sampler::{BETWEEN, Sampler};
use crate::core::body::Skeleton;
use crate::core::manifold::LATENT;

/// Number of parts of a batch, independent of the number of threads. So the order of sums is fixed
/// and training gives the same bytes with any number of threads.
const PARTS: usize = 4;

/// Factor on the initial weights of the encoder's last layer that give the means of codes, so that
/// the means start with about unit variance.
const FIRST_SPREAD: f32 = 7.0;
/// Initial log variance of codes.
const FIRST_LOG_VARIANCE: f32 = -4.0;

/// The two networks, with one parameter vector.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Maps a pose (126 values) to mean and log variance of its code.
    pub encoder: Mlp,
    /// Maps a code to a pose (126 values).
    pub decoder: Mlp,
    /// Parameters of both networks.
    pub parameters: Vec<f32>,
}

impl Model {
    /// A model with the given hidden widths; all parameters are zero.
    pub fn new(encoder_hidden: &[usize], decoder_hidden: &[usize]) -> Self {
        let encoder = Mlp::new(&[&[POSE], encoder_hidden, &[CODE]].concat(), 0);
        let decoder = Mlp::new(&[&[LATENT], decoder_hidden, &[POSE]].concat(), encoder.end());
        let parameters = vec![0.0; decoder.end()];
        Self { encoder, decoder, parameters }
    }

    /// Draws the weights. The decoder's last bias is `mean`, so training starts at the mean pose.
    pub fn initialise(&mut self, mean: &PoseVector, rng: &mut ChaCha8Rng) {
        self.encoder.initialise(&mut self.parameters, rng);
        self.decoder.initialise(&mut self.parameters, rng);
        if let Some(last) = self.decoder.layers().last() {
            self.parameters[last.bias.clone()].copy_from_slice(mean);
        }
        if let Some(last) = self.encoder.layers().last() {
            let means = last.weight.start..last.weight.start + LATENT * last.inputs;
            self.parameters[means].iter_mut().for_each(|weight| *weight *= FIRST_SPREAD);
            self.parameters[last.bias.clone()][LATENT..].fill(FIRST_LOG_VARIANCE);
        }
    }

    /// The parameters of the latent dimensions from `latent` on. If they are zero, the encoder
    /// gives N(0, 1) for these dimensions and the decoder ignores them.
    pub fn unused(&self, latent: usize) -> Vec<Range<usize>> {
        let mut ranges = Vec::new();
        if let Some(last) = self.encoder.layers().last() {
            for rows in [latent..LATENT, LATENT + latent..CODE] {
                let weight = |row: usize| last.weight.start + row * last.inputs;
                ranges.push(weight(rows.start)..weight(rows.end));
                ranges.push(last.bias.start + rows.start..last.bias.start + rows.end);
            }
        }
        if let Some(first) = self.decoder.layers().first() {
            let rows = first.weight.clone().step_by(LATENT);
            ranges.extend(rows.map(|row| row + latent..row + LATENT));
        }
        ranges
    }

    /// Number of latent dimensions that the decoder uses.
    pub fn latent(&self) -> usize {
        let Some(first) = self.decoder.layers().first() else { return 0 };
        let weights = &self.parameters[first.weight.clone()];
        let used = |column: &usize| weights[*column..].iter().step_by(LATENT).any(|w| *w != 0.0);
        (0..LATENT).rev().find(used).map_or(0, |last| last + 1)
    }

    /// Takes `parameters` that were trained on whitened poses and folds the whitening into the
    /// encoder's first layer: W' = W diag(scale), b' = b - W' mean.
    pub fn fold(&mut self, parameters: &[f32], whitening: &Whitening) {
        self.parameters.copy_from_slice(parameters);
        let Some(first) = self.encoder.layers().first() else { return };
        for row in 0..first.outputs {
            let start = first.weight.start + row * first.inputs;
            let mut shift = 0.0f64;
            for (index, weight) in
                self.parameters[start..start + first.inputs].iter_mut().enumerate()
            {
                *weight *= whitening.scale[index];
                shift += f64::from(*weight) * f64::from(whitening.mean[index]);
            }
            self.parameters[first.bias.start + row] -= shift as f32;
        }
    }
}

/// Whitens the encoder's input: mean 0 and about unit variance.
#[derive(Clone, Debug)]
pub struct Whitening {
    mean: PoseVector,
    scale: PoseVector,
}

impl Whitening {
    /// Raises standard deviations below 0.1 to 0.1.
    pub fn new(mean: PoseVector, deviation: PoseVector) -> Self {
        Self { mean, scale: deviation.map(|d| 1.0 / d.max(0.1)) }
    }

    fn write(&self, pose: &PoseVector, out: &mut [f32]) {
        for (index, out) in out.iter_mut().enumerate() {
            *out = (pose[index] - self.mean[index]) * self.scale[index];
        }
    }
}

/// Weights of the loss terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Weight of poses decoded from sampled codes.
    pub pose: Weights,
    /// Weight of poses decoded from the slerp of two mean codes.
    pub between: Weights,
    /// Weight of the KL divergence from N(0, I), per nat.
    pub divergence: f32,
    /// Weight of joint rotations outside the corpus, for random codes; see `limits`.
    pub limits: f32,
}

/// Mean losses of a batch, unweighted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Rotation error of sampled codes, radians.
    pub rotation: f32,
    /// Joint centre error of sampled codes, metres.
    pub position: f32,
    /// Rotation error of interpolated codes, radians.
    pub between_rotation: f32,
    /// Joint centre error of interpolated codes, metres.
    pub between_position: f32,
    /// KL divergence from N(0, I), nats.
    pub divergence: f32,
    /// Distance of joints beyond their limits for random codes, standard deviations.
    pub limits: f32,
}

impl Losses {
    /// Adds `other` times `scale`.
    pub fn add(&mut self, other: &Self, scale: f32) {
        self.rotation += scale * other.rotation;
        self.position += scale * other.position;
        self.between_rotation += scale * other.between_rotation;
        self.between_position += scale * other.between_position;
        self.divergence += scale * other.divergence;
        self.limits += scale * other.limits;
    }

    /// The weighted sum.
    pub fn total(&self, weights: &LossWeights) -> f32 {
        weights.pose.rotation * self.rotation
            + weights.pose.position * self.position
            + weights.between.rotation * self.between_rotation
            + weights.between.position * self.between_position
            + weights.divergence * self.divergence
            + weights.limits * self.limits
    }
}

/// Computes the gradient of a batch on several threads.
pub struct Batch {
    parts: Vec<Part>,
    weights: LossWeights,
    whitening: Whitening,
    tree: Tree,
    limits: Limits,
    threads: usize,
}

impl Batch {
    /// Buffers for batches of `size` samples, rounded up to a multiple of four.
    pub fn new(
        model: &Model,
        size: usize,
        weights: LossWeights,
        whitening: Whitening,
        limits: Limits,
        threads: usize,
    ) -> Self {
        let rows = size.div_ceil(PARTS).max(1);
        let tree = Tree::new(&Skeleton::default());
        let parts = (0..PARTS).map(|_| Part::new(model, rows)).collect();
        Self { parts, weights, whitening, tree, limits, threads: threads.clamp(1, PARTS) }
    }

    /// Draws batch `step`, writes the gradient of the mean loss and returns the mean losses.
    pub fn gradient(
        &mut self,
        model: &Model,
        sampler: &Sampler,
        (seed, step): (u64, usize),
        gradient: &mut [f32],
    ) -> Losses {
        let per_thread = PARTS.div_ceil(self.threads);
        let (weights, whitening) = (&self.weights, &self.whitening);
        let (tree, limits) = (&self.tree, &self.limits);
        thread::scope(|scope| {
            for (group, parts) in self.parts.chunks_mut(per_thread).enumerate() {
                scope.spawn(move || {
                    for (index, part) in parts.iter_mut().enumerate() {
                        let mut rng = ChaCha8Rng::seed_from_u64(seed);
                        rng.set_stream((step * PARTS + group * per_thread + index) as u64);
                        part.draw(sampler, whitening, &mut rng);
                        part.run(model, weights, tree, limits);
                    }
                });
            }
        });
        let mut losses = Losses::default();
        gradient.fill(0.0);
        for part in &self.parts {
            losses.add(&part.losses, 1.0);
            gradient.iter_mut().zip(&part.gradient).for_each(|(sum, value)| *sum += value);
        }
        losses
    }
}

/// A part of a batch with `rows` samples. Rows of the encoder's tape: first poses, second poses.
/// Rows of the decoder's tape: sampled codes of the first poses, interpolated codes of each sample,
/// random codes near the origin.
struct Part {
    rows: usize,
    encoder: Tape,
    decoder: Tape,
    truth: Vec<f32>,
    noise: Vec<f32>,
    free: Vec<f32>,
    places: Vec<f64>,
    slerps: Vec<Slerp>,
    gradient: Vec<f32>,
    losses: Losses,
}

impl Part {
    fn new(model: &Model, rows: usize) -> Self {
        Self {
            rows,
            encoder: model.encoder.tape(2 * rows),
            decoder: model.decoder.tape((2 + BETWEEN) * rows),
            truth: vec![0.0; (1 + BETWEEN) * rows * POSE],
            noise: vec![0.0; rows * LATENT],
            free: vec![0.0; rows * LATENT],
            places: vec![0.0; BETWEEN * rows],
            slerps: Vec::with_capacity(BETWEEN * rows),
            gradient: vec![0.0; model.parameters.len()],
            losses: Losses::default(),
        }
    }

    fn draw(&mut self, sampler: &Sampler, whitening: &Whitening, rng: &mut ChaCha8Rng) {
        let (first, second) = self.encoder.input_mut().split_at_mut(self.rows * POSE);
        let (pose, between) = self.truth.split_at_mut(self.rows * POSE);
        for row in 0..self.rows {
            let at = row * POSE..(row + 1) * POSE;
            let sample = sampler.draw(rng);
            whitening.write(&sample.a, &mut first[at.clone()]);
            whitening.write(&sample.b, &mut second[at.clone()]);
            pose[at].copy_from_slice(&sample.a);
            for (index, (pose, place)) in sample.between.iter().enumerate() {
                let row = row * BETWEEN + index;
                between[row * POSE..(row + 1) * POSE].copy_from_slice(pose);
                self.places[row] = *place;
            }
        }
        fill_normal(&mut self.noise, rng);
        draw_codes(&mut self.free, rng);
    }

    /// Gradient and losses of the drawn samples, divided by the rows of the whole batch.
    fn run(&mut self, model: &Model, weights: &LossWeights, tree: &Tree, limits: &Limits) {
        self.gradient.fill(0.0);
        self.losses = Losses::default();
        model.encoder.forward(&model.parameters, &mut self.encoder);
        self.codes();
        model.decoder.forward(&model.parameters, &mut self.decoder);
        self.compare(weights, tree);
        self.limit(weights.limits, limits);
        model.decoder.backward(&model.parameters, &mut self.decoder, &mut self.gradient, true);
        self.codes_backward(weights.divergence);
        model.encoder.backward(&model.parameters, &mut self.encoder, &mut self.gradient, false);
    }

    /// Computes the decoder's input from the encoder's output.
    fn codes(&mut self) {
        let (first, second) = self.encoder.output().split_at(self.rows * CODE);
        let (sampled, rest) = self.decoder.input_mut().split_at_mut(self.rows * LATENT);
        let (between, free) = rest.split_at_mut(BETWEEN * self.rows * LATENT);
        free.copy_from_slice(&self.free);
        self.slerps.clear();
        for row in 0..self.rows {
            let (code, at) = (row * CODE, row * LATENT..(row + 1) * LATENT);
            let (a, b) = (&first[code..code + CODE], &second[code..code + CODE]);
            latent::sample(a, &self.noise[at.clone()], &mut sampled[at]);
            let (a, b) = (&a[..LATENT], &b[..LATENT]);
            for row in row * BETWEEN..(row + 1) * BETWEEN {
                let slerp = Slerp::new(a, b, self.places[row]);
                slerp.mix(a, b, &mut between[row * LATENT..(row + 1) * LATENT]);
                self.slerps.push(slerp);
            }
        }
    }

    /// Losses of the decoder's output, and their derivatives with respect to it.
    fn compare(&mut self, weights: &LossWeights, tree: &Tree) {
        let all = 1.0 / (self.rows * PARTS) as f32;
        let (decoded, by_decoded) = self.decoder.output_and_delta();
        for row in 0..(1 + BETWEEN) * self.rows {
            let at = row * POSE..(row + 1) * POSE;
            let (of, share) = if row < self.rows {
                (weights.pose, all)
            } else {
                (weights.between, all / BETWEEN as f32)
            };
            let scaled = Weights { rotation: of.rotation * share, position: of.position * share };
            let (truth, by) = (&self.truth[at.clone()], &mut by_decoded[at.clone()]);
            let distances = pose_loss(tree, scaled, &decoded[at], truth, by);
            let (rotation, position) = if row < self.rows {
                (&mut self.losses.rotation, &mut self.losses.position)
            } else {
                (&mut self.losses.between_rotation, &mut self.losses.between_position)
            };
            *rotation += share * distances.rotation;
            *position += share * distances.position;
        }
    }

    /// Loss of joints beyond their limits for the random codes, and its derivatives.
    fn limit(&mut self, weight: f32, limits: &Limits) {
        let share = 1.0 / (self.rows * PARTS) as f32;
        let first = (1 + BETWEEN) * self.rows * POSE;
        let (decoded, by_decoded) = self.decoder.output_and_delta();
        by_decoded[first..].fill(0.0);
        let poses = decoded[first..].chunks_exact(POSE);
        for (pose, by_pose) in poses.zip(by_decoded[first..].chunks_exact_mut(POSE)) {
            self.losses.limits += share * limits.cost(weight * share, pose, by_pose);
        }
    }

    /// Backpropagates from the decoder's input to the encoder's output and adds the KL divergence
    /// of both codes.
    fn codes_backward(&mut self, divergence: f32) {
        let share = 0.5 / (self.rows * PARTS) as f32;
        let (by_sampled, by_between) = self.decoder.input_delta().split_at(self.rows * LATENT);
        let (codes, by_codes) = self.encoder.output_and_delta();
        by_codes.fill(0.0);
        let (first, second) = codes.split_at(self.rows * CODE);
        let (by_first, by_second) = by_codes.split_at_mut(self.rows * CODE);
        for row in 0..self.rows {
            let (code, at) = (row * CODE..(row + 1) * CODE, row * LATENT..(row + 1) * LATENT);
            let (a, b) = (&first[code.clone()], &second[code.clone()]);
            let (by_a, by_b) = (&mut by_first[code.clone()], &mut by_second[code]);
            latent::sample_backward(a, &self.noise[at.clone()], &by_sampled[at], by_a);
            for row in row * BETWEEN..(row + 1) * BETWEEN {
                let by = &by_between[row * LATENT..(row + 1) * LATENT];
                self.slerps[row].backward(a, b, by, by_a, by_b);
            }
            let weight = share * divergence;
            let nats = latent::divergence(a, weight, by_a) + latent::divergence(b, weight, by_b);
            self.losses.divergence += share * nats;
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{SMatrix, Vector3};

    use super::super::corpus::{Clip, mirrored, pose_vector};
    use super::super::evaluate::{decode, encode};
    use super::super::sampler::{Config, statistics};
    use super::super::standard::Standard;
    use super::*;
    use crate::core::so3;

    const WEIGHTS: LossWeights = LossWeights {
        pose: Weights { rotation: 1.0, position: 10.0 },
        between: Weights { rotation: 2.0, position: 20.0 },
        divergence: 1e-2,
        limits: 0.1,
    };

    fn clip() -> Clip {
        let turn = |frame: usize, joint: usize| {
            let phase = 0.2 * frame as f64 + joint as f64;
            so3::exp(&Vector3::new(0.5 * phase.sin(), 0.3 * (1.3 * phase).cos(), 0.1))
        };
        let pose = |frame| pose_vector(&std::array::from_fn(|joint| turn(frame, joint)));
        Clip {
            name: "01_01".into(),
            subject: "01".into(),
            skeleton: Skeleton::default(),
            poses: (0..60).map(pose).collect(),
            roots: Vec::new(),
        }
    }

    fn small(clips: &[Clip]) -> (Model, Whitening) {
        let (mean, deviation) = statistics(clips);
        let mut model = Model::new(&[16, 12], &[12, 16]);
        model.initialise(&mean, &mut ChaCha8Rng::seed_from_u64(1));
        (model, Whitening::new(mean, deviation))
    }

    #[test]
    fn the_gradient_of_a_batch_agrees_with_central_differences() {
        let clips = [clip()];
        let (model, whitening) = small(&clips);
        let config = Config {
            mix: 0.5,
            mirror: 0.5,
            restyle: 0.5,
            gains: (0.8, 1.2),
            span: 10,
            spans: (5, 15),
            other_spans: 0.5,
            balance: 0.5,
        };
        let sampler = Sampler::new(&clips, config).unwrap();
        let mut batch = Batch::new(&model, 32, WEIGHTS, whitening, Limits::new(&clips), 2);
        let mut gradient = vec![0.0; model.parameters.len()];
        batch.gradient(&model, &sampler, (7, 1), &mut gradient);
        for seed in 0..8 {
            let mut direction = vec![0.0; gradient.len()];
            fill_normal(&mut direction, &mut ChaCha8Rng::seed_from_u64(seed));
            let analytic: f64 =
                direction.iter().zip(&gradient).map(|(d, g)| f64::from(*d) * f64::from(*g)).sum();
            let mut loss = |step: f32| {
                let mut moved = model.clone();
                moved.parameters.iter_mut().zip(&direction).for_each(|(p, d)| *p += step * d);
                let mut unused = vec![0.0; gradient.len()];
                let losses = batch.gradient(&moved, &sampler, (7, 1), &mut unused);
                f64::from(losses.total(&WEIGHTS))
            };
            let numeric = (loss(1e-3) - loss(-1e-3)) / 2e-3;
            let error = (analytic - numeric).abs();
            assert!(error < 2e-3 + 5e-3 * numeric.abs(), "{analytic} {numeric}");
        }
    }

    #[test]
    fn unused_latent_dimensions_have_no_effect() {
        let clips = [clip()];
        let (mut model, _) = small(&clips);
        assert_eq!(model.latent(), LATENT);
        for range in model.unused(5) {
            model.parameters[range].fill(0.0);
        }
        assert_eq!(model.latent(), 5);
        let mut encoder = model.encoder.tape(1);
        encoder.input_mut().copy_from_slice(&clips[0].poses[7]);
        model.encoder.forward(&model.parameters, &mut encoder);
        let code = encoder.output().to_vec();
        assert!(code[..5].iter().all(|value| *value != 0.0));
        assert!(code[5..LATENT].iter().chain(&code[LATENT + 5..]).all(|value| *value == 0.0));
        let decoded = |code: &[f32]| {
            let mut decoder = model.decoder.tape(1);
            decoder.input_mut().copy_from_slice(code);
            model.decoder.forward(&model.parameters, &mut decoder);
            decoder.output().to_vec()
        };
        let mut other = code[..LATENT].to_vec();
        other[5..].fill(3.0);
        assert_eq!(decoded(&other), decoded(&code[..LATENT]));
    }

    #[test]
    fn new_coordinates_change_the_codes_and_not_the_poses() {
        let clips = [clip()];
        let (model, whitening) = small(&clips);
        let mut before = model.clone();
        before.fold(&model.parameters, &whitening);
        let mut after = before.clone();
        let standard = Standard::of(&before, &clips);
        after.recode(&standard);
        let others: Vec<_> = clips[0].poses.iter().map(mirrored).collect();
        let codes =
            |model: &Model| [encode(model, &clips[0].poses), encode(model, &others)].concat();
        let (old, new) = (codes(&before), codes(&after));
        for i in 0..LATENT {
            let mean = new.iter().map(|code| f64::from(code[i])).sum::<f64>() / new.len() as f64;
            assert!(mean.abs() < 1e-4);
        }
        // T is the inverse square root of the covariance with halved off-diagonal entries.
        let product = |a: usize, b: usize| -> f64 {
            let centred = |code: &[f32; LATENT], i: usize| f64::from(code[i]) - standard.mean[i];
            old.iter().map(|code| centred(code, a) * centred(code, b)).sum::<f64>()
                / old.len() as f64
        };
        let halved = SMatrix::from_fn(|a, b| product(a, b) * if a == b { 1.0 } else { 0.5 });
        let whitened = standard.to_new * halved * standard.to_new;
        assert!((whitened - SMatrix::identity()).amax() < 1e-6);
        assert_ne!(old[0], new[0]);
        let poses = decode(&before, &old).into_iter().zip(decode(&after, &new));
        let apart = poses.flat_map(|(a, b)| a.into_iter().zip(b)).map(|(a, b)| (a - b).amax());
        assert!(apart.fold(0.0, f32::max) < 1e-4);
    }
}
