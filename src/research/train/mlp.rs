//! Multi-layer perceptrons with SiLU, forward and backward, over the rows of a batch.
//!
//! h_l = silu(W_l h_{l-1} + b_l), without silu after the last layer. Matrices are row-major. One
//! flat slice holds the parameters of all networks, so the optimiser sees one vector.

use std::ops::Range;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use crate::core::linalg::{self, Accum};
use crate::core::manifold::activation;

/// One linear layer: its widths and the ranges of its parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// Width of an input row.
    pub inputs: usize,
    /// Width of an output row.
    pub outputs: usize,
    /// Weights, `outputs` x `inputs`.
    pub weight: Range<usize>,
    /// Biases, `outputs`.
    pub bias: Range<usize>,
}

/// A network as a list of layers.
#[derive(Clone, Debug, PartialEq)]
pub struct Mlp {
    layers: Vec<Layer>,
}

/// Values that the forward pass keeps for the backward pass.
#[derive(Clone, Debug)]
pub struct Tape {
    rows: usize,
    /// Input of each layer, then the output; `rows` rows each.
    values: Vec<Vec<f32>>,
    /// Derivative of the activation at each hidden value.
    slopes: Vec<Vec<f32>>,
    /// Derivatives of the loss with respect to `values`.
    deltas: Vec<Vec<f32>>,
}

impl Mlp {
    /// A network with the given widths, whose parameters begin at index `first`.
    pub fn new(widths: &[usize], first: usize) -> Self {
        let mut next = first;
        let mut take = |count: usize| {
            next += count;
            next - count..next
        };
        let layers = widths.windows(2).map(|pair| Layer {
            inputs: pair[0],
            outputs: pair[1],
            weight: take(pair[0] * pair[1]),
            bias: take(pair[1]),
        });
        Self { layers: layers.collect() }
    }

    /// The layers, first to last.
    pub fn layers(&self) -> &[Layer] {
        &self.layers
    }

    /// Index after the last parameter.
    pub fn end(&self) -> usize {
        self.layers.last().map_or(0, |layer| layer.bias.end)
    }

    /// Draws weights of variance 2 / inputs (last layer: a hundredth of that) and zeroes biases.
    pub fn initialise(&self, parameters: &mut [f32], rng: &mut ChaCha8Rng) {
        let last = self.layers.len() - 1;
        for (index, layer) in self.layers.iter().enumerate() {
            let scale = if index == last { 0.1 } else { 1.0 };
            let spread = scale * (2.0 / layer.inputs as f32).sqrt();
            fill_normal(&mut parameters[layer.weight.clone()], rng);
            parameters[layer.weight.clone()].iter_mut().for_each(|w| *w *= spread);
            parameters[layer.bias.clone()].fill(0.0);
        }
    }

    /// A tape for `rows` rows.
    pub fn tape(&self, rows: usize) -> Tape {
        let inputs = self.layers.first().map_or(0, |layer| layer.inputs);
        let widths = std::iter::once(inputs).chain(self.layers.iter().map(|layer| layer.outputs));
        let values: Vec<Vec<f32>> = widths.map(|width| vec![0.0; rows * width]).collect();
        let hidden = 1..self.layers.len();
        Tape { rows, slopes: values[hidden].to_vec(), deltas: values.clone(), values }
    }

    /// Forward pass: fills the tape from its input.
    pub fn forward(&self, parameters: &[f32], tape: &mut Tape) {
        let rows = tape.rows;
        for (index, layer) in self.layers.iter().enumerate() {
            let (before, after) = tape.values.split_at_mut(index + 1);
            let out = &mut after[0];
            for row in out.chunks_exact_mut(layer.outputs) {
                row.copy_from_slice(&parameters[layer.bias.clone()]);
            }
            let weight = &parameters[layer.weight.clone()];
            let sizes = [rows, layer.inputs, layer.outputs];
            linalg::product_with_transpose(sizes, &before[index], weight, Accum::Add, out);
            if let Some(slopes) = tape.slopes.get_mut(index) {
                activation::silu(out, slopes);
            }
        }
    }

    /// Backward pass: adds the derivatives with respect to the parameters to `gradient` and, if
    /// `to_input`, computes those with respect to the input. Overwrites hidden derivatives.
    pub fn backward(
        &self,
        parameters: &[f32],
        tape: &mut Tape,
        gradient: &mut [f32],
        to_input: bool,
    ) {
        let rows = tape.rows;
        for (index, layer) in self.layers.iter().enumerate().rev() {
            let (before, after) = tape.deltas.split_at_mut(index + 1);
            let (inner, delta) = (&mut before[index], &mut after[0]);
            if let Some(slopes) = tape.slopes.get(index) {
                delta.iter_mut().zip(slopes).for_each(|(d, slope)| *d *= slope);
            }
            add_row_sums(delta, &mut gradient[layer.bias.clone()]);
            let by_weight = &mut gradient[layer.weight.clone()];
            let sizes = [layer.outputs, rows, layer.inputs];
            linalg::product_of_transpose(sizes, delta, &tape.values[index], Accum::Add, by_weight);
            if index == 0 && !to_input {
                continue;
            }
            let weight = &parameters[layer.weight.clone()];
            let sizes = [rows, layer.outputs, layer.inputs];
            linalg::product(sizes, delta, weight, Accum::Replace, inner);
        }
    }
}

impl Tape {
    /// The input rows.
    pub fn input_mut(&mut self) -> &mut [f32] {
        &mut self.values[0]
    }

    /// The output rows.
    pub fn output(&self) -> &[f32] {
        &self.values[self.values.len() - 1]
    }

    /// The output rows, and the buffer for the derivatives with respect to them.
    pub fn output_and_delta(&mut self) -> (&[f32], &mut [f32]) {
        let last = self.values.len() - 1;
        (&self.values[last], &mut self.deltas[last])
    }

    /// Derivatives with respect to the input, after the backward pass.
    pub fn input_delta(&self) -> &[f32] {
        &self.deltas[0]
    }
}

fn add_row_sums(rows: &[f32], sums: &mut [f32]) {
    for row in rows.chunks_exact(sums.len()) {
        sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
    }
}

/// Standard normal numbers by the Box-Muller transform.
pub fn fill_normal(out: &mut [f32], rng: &mut ChaCha8Rng) {
    for pair in out.chunks_mut(2) {
        let radius = (-2.0 * (1.0 - rng.random::<f32>()).ln()).sqrt();
        let (sin, cos) = (std::f32::consts::TAU * rng.random::<f32>()).sin_cos();
        for (value, factor) in pair.iter_mut().zip([cos, sin]) {
            *value = radius * factor;
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn normal_numbers_have_mean_zero_and_variance_one() {
        let mut values = vec![0.0; 20_001];
        fill_normal(&mut values, &mut ChaCha8Rng::seed_from_u64(1));
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        let square = values.iter().map(|v| v * v).sum::<f32>() / values.len() as f32;
        assert!(mean.abs() < 0.03 && (square - 1.0).abs() < 0.04, "{mean} {square}");
    }

    /// Loss = sum of output * weight; its derivative with respect to the output is `weight`.
    fn loss(mlp: &Mlp, parameters: &[f32], input: &[f32], weight: &[f32]) -> f64 {
        let mut tape = mlp.tape(input.len() / mlp.layers()[0].inputs);
        tape.input_mut().copy_from_slice(input);
        mlp.forward(parameters, &mut tape);
        tape.output().iter().zip(weight).map(|(o, w)| f64::from(o * w)).sum()
    }

    #[test]
    fn few_rows_give_the_same_as_many() {
        let mlp = Mlp::new(&[7, 9, 3, 6], 0);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut parameters, mut input) = (vec![0.0; mlp.end()], vec![0.0; 7 * 12]);
        mlp.initialise(&mut parameters, &mut rng);
        fill_normal(&mut input, &mut rng);
        let output = |rows: usize| {
            let mut tape = mlp.tape(rows);
            tape.input_mut().copy_from_slice(&input[..7 * rows]);
            mlp.forward(&parameters, &mut tape);
            tape.output().to_vec()
        };
        let many = output(12);
        for rows in 1..12 {
            let few = output(rows);
            assert!(few.iter().zip(&many).all(|(a, b)| (a - b).abs() < 1e-5), "{rows}");
        }
    }

    #[test]
    fn backward_agrees_with_central_differences() {
        let mlp = Mlp::new(&[7, 9, 8, 6], 3);
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut parameters = vec![0.0; mlp.end()];
        mlp.initialise(&mut parameters, &mut rng);
        let (mut input, mut weight) = (vec![0.0; 7 * 8], vec![0.0; 6 * 8]);
        fill_normal(&mut input, &mut rng);
        fill_normal(&mut weight, &mut rng);

        let mut tape = mlp.tape(8);
        tape.input_mut().copy_from_slice(&input);
        mlp.forward(&parameters, &mut tape);
        tape.output_and_delta().1.copy_from_slice(&weight);
        let mut gradient = vec![0.0; mlp.end()];
        mlp.backward(&parameters, &mut tape, &mut gradient, true);

        let step = 1e-2;
        let check = |analytic: f32, high: f64, low: f64| {
            let numeric = (high - low) / f64::from(2.0 * step);
            assert!((f64::from(analytic) - numeric).abs() < 2e-3, "{analytic} {numeric}");
        };
        for index in 3..mlp.end() {
            let shifted = |by: f32| {
                let mut moved = parameters.clone();
                moved[index] += by;
                loss(&mlp, &moved, &input, &weight)
            };
            check(gradient[index], shifted(step), shifted(-step));
        }
        for index in 0..input.len() {
            let shifted = |by: f32| {
                let mut moved = input.clone();
                moved[index] += by;
                loss(&mlp, &parameters, &moved, &weight)
            };
            check(tape.input_delta()[index], shifted(step), shifted(-step));
        }
    }
}
