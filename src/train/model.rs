//! Encoder and decoder with their parameters, and one batch's gradient.

use std::thread;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::corpus::{POSE, PoseVector};
use super::latent::{self, CODE, Slerp};
use super::loss::{Tree, Weights, pose_loss};
use super::mlp::{Mlp, Tape, fill_normal};
use super::sampler::Sampler;
use crate::body::Skeleton;
use crate::manifold::LATENT;

/// A batch is cut into this many parts whatever the number of threads, so that sums have one
/// order and training gives the same bytes on any number of threads.
const PARTS: usize = 4;

/// What the last layer's first weights are multiplied by where they give means of codes, so that
/// these begin at about unit variance.
const FIRST_SPREAD: f32 = 7.0;
/// First log variance of codes.
const FIRST_LOG_VARIANCE: f32 = -4.0;

/// The two networks, over one vector of parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// 126 numbers of a pose to mean and log variance of its code.
    pub encoder: Mlp,
    /// A code to 126 numbers.
    pub decoder: Mlp,
    /// Parameters of both.
    pub parameters: Vec<f32>,
}

impl Model {
    /// With those hidden widths and parameters all zero.
    pub fn new(encoder_hidden: &[usize], decoder_hidden: &[usize]) -> Self {
        let encoder = Mlp::new(&[&[POSE], encoder_hidden, &[CODE]].concat(), 0);
        let decoder = Mlp::new(&[&[LATENT], decoder_hidden, &[POSE]].concat(), encoder.end());
        let parameters = vec![0.0; decoder.end()];
        Self { encoder, decoder, parameters }
    }

    /// Draws the weights; the last bias is `mean`, so that training begins at the mean pose.
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

    /// Makes all codes `factor` times as long: the encoder's means and deviations grow, and the
    /// decoder's first layer shrinks. Slerp and lerp commute with it, so nothing else changes.
    pub fn stretch(&mut self, factor: f32) {
        if let Some(last) = self.encoder.layers().last() {
            let means = last.weight.start..last.weight.start + LATENT * last.inputs;
            self.parameters[means].iter_mut().for_each(|weight| *weight *= factor);
            let (means, log_variances) = self.parameters[last.bias.clone()].split_at_mut(LATENT);
            means.iter_mut().for_each(|bias| *bias *= factor);
            log_variances.iter_mut().for_each(|bias| *bias += 2.0 * factor.ln());
        }
        if let Some(first) = self.decoder.layers().first() {
            self.parameters[first.weight.clone()].iter_mut().for_each(|weight| *weight /= factor);
        }
    }

    /// Takes over `parameters` that were trained on whitened poses: the first layer then does
    /// the whitening, W' = W diag(scale), b' = b - W' mean.
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

/// Brings the encoder's input to mean 0 and about unit variance.
#[derive(Clone, Debug)]
pub struct Whitening {
    mean: PoseVector,
    scale: PoseVector,
}

impl Whitening {
    /// Deviations below 0.1 count as 0.1.
    pub fn new(mean: PoseVector, deviation: PoseVector) -> Self {
        Self { mean, scale: deviation.map(|d| 1.0 / d.max(0.1)) }
    }

    fn write(&self, pose: &PoseVector, out: &mut [f32]) {
        for (index, out) in out.iter_mut().enumerate() {
            *out = (pose[index] - self.mean[index]) * self.scale[index];
        }
    }
}

/// Weights of the parts of the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Of the poses decoded from sampled codes.
    pub pose: Weights,
    /// Of the poses decoded from the slerp of two mean codes.
    pub between: Weights,
    /// Per nat of the divergence from N(0, I).
    pub divergence: f32,
}

/// Mean losses of a batch, unweighted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Rotations of sampled codes, radians.
    pub rotation: f32,
    /// Joint centres of sampled codes, metres.
    pub position: f32,
    /// Rotations between, radians.
    pub between_rotation: f32,
    /// Joint centres between, metres.
    pub between_position: f32,
    /// Divergence from N(0, I), nats.
    pub divergence: f32,
}

impl Losses {
    /// Adds `other` times `scale`.
    pub fn add(&mut self, other: &Self, scale: f32) {
        self.rotation += scale * other.rotation;
        self.position += scale * other.position;
        self.between_rotation += scale * other.between_rotation;
        self.between_position += scale * other.between_position;
        self.divergence += scale * other.divergence;
    }

    /// The weighted sum.
    pub fn total(&self, weights: &LossWeights) -> f32 {
        weights.pose.rotation * self.rotation
            + weights.pose.position * self.position
            + weights.between.rotation * self.between_rotation
            + weights.between.position * self.between_position
            + weights.divergence * self.divergence
    }
}

/// Computes the gradient of a batch on several threads.
pub struct Batch {
    parts: Vec<Part>,
    weights: LossWeights,
    whitening: Whitening,
    tree: Tree,
    threads: usize,
}

impl Batch {
    /// Room for batches of `size` samples, rounded up to a multiple of four.
    pub fn new(
        model: &Model,
        size: usize,
        weights: LossWeights,
        whitening: Whitening,
        threads: usize,
    ) -> Self {
        let rows = size.div_ceil(PARTS).max(1);
        let tree = Tree::new(&Skeleton::default());
        let parts = (0..PARTS).map(|_| Part::new(model, rows)).collect();
        Self { parts, weights, whitening, tree, threads: threads.clamp(1, PARTS) }
    }

    /// Draws batch number `step` and writes the gradient of the mean loss.
    pub fn gradient(
        &mut self,
        model: &Model,
        sampler: &Sampler,
        (seed, step): (u64, usize),
        gradient: &mut [f32],
    ) -> Losses {
        let per_thread = PARTS.div_ceil(self.threads);
        let (weights, whitening, tree) = (&self.weights, &self.whitening, &self.tree);
        thread::scope(|scope| {
            for (group, parts) in self.parts.chunks_mut(per_thread).enumerate() {
                scope.spawn(move || {
                    for (index, part) in parts.iter_mut().enumerate() {
                        let mut rng = ChaCha8Rng::seed_from_u64(seed);
                        rng.set_stream((step * PARTS + group * per_thread + index) as u64);
                        part.draw(sampler, whitening, &mut rng);
                        part.run(model, weights, tree);
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

/// A part of a batch: `rows` samples. Tapes hold 2 `rows` rows: in the encoder the first poses,
/// then the second; in the decoder the sampled codes of the first, then the codes between.
struct Part {
    rows: usize,
    encoder: Tape,
    decoder: Tape,
    truth: Vec<f32>,
    noise: Vec<f32>,
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
            decoder: model.decoder.tape(2 * rows),
            truth: vec![0.0; 2 * rows * POSE],
            noise: vec![0.0; rows * LATENT],
            places: vec![0.0; rows],
            slerps: Vec::with_capacity(rows),
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
            pose[at.clone()].copy_from_slice(&sample.a);
            between[at].copy_from_slice(&sample.between);
            self.places[row] = sample.s;
        }
        fill_normal(&mut self.noise, rng);
    }

    /// Gradient and losses of what was drawn, each divided by the rows of the whole batch.
    fn run(&mut self, model: &Model, weights: &LossWeights, tree: &Tree) {
        self.gradient.fill(0.0);
        self.losses = Losses::default();
        model.encoder.forward(&model.parameters, &mut self.encoder);
        self.codes();
        model.decoder.forward(&model.parameters, &mut self.decoder);
        self.compare(weights, tree);
        model.decoder.backward(&model.parameters, &mut self.decoder, &mut self.gradient, true);
        self.codes_backward(weights.divergence);
        model.encoder.backward(&model.parameters, &mut self.encoder, &mut self.gradient, false);
    }

    /// From the encoder's output to the decoder's input.
    fn codes(&mut self) {
        let (first, second) = self.encoder.output().split_at(self.rows * CODE);
        let (sampled, between) = self.decoder.input_mut().split_at_mut(self.rows * LATENT);
        self.slerps.clear();
        for row in 0..self.rows {
            let (code, at) = (row * CODE, row * LATENT..(row + 1) * LATENT);
            let (a, b) = (&first[code..code + CODE], &second[code..code + CODE]);
            latent::sample(a, &self.noise[at.clone()], &mut sampled[at.clone()]);
            let slerp = Slerp::new(&a[..LATENT], &b[..LATENT], self.places[row]);
            slerp.mix(&a[..LATENT], &b[..LATENT], &mut between[at]);
            self.slerps.push(slerp);
        }
    }

    /// Losses of the decoder's output, and their derivatives by it.
    fn compare(&mut self, weights: &LossWeights, tree: &Tree) {
        let share = 1.0 / (self.rows * PARTS) as f32;
        let (decoded, by_decoded) = self.decoder.output_and_delta();
        for row in 0..2 * self.rows {
            let at = row * POSE..(row + 1) * POSE;
            let of = if row < self.rows { weights.pose } else { weights.between };
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

    /// From the derivatives by the decoder's input to those by the encoder's output, with the
    /// divergence of both codes.
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
            latent::sample_backward(a, &self.noise[at.clone()], &by_sampled[at.clone()], by_a);
            self.slerps[row].backward(a, b, &by_between[at], by_a, by_b);
            let weight = share * divergence;
            let nats = latent::divergence(a, weight, by_a) + latent::divergence(b, weight, by_b);
            self.losses.divergence += share * nats;
        }
    }
}
