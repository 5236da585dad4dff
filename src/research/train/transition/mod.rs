//! Trains the transition model `crate::research::transition::Transition` on the corpus, in the codes of a
//! trained manifold. The loss is the negative log likelihood.

mod samples;
mod scores;

use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::corpus::{self, Clip};
use super::file::{self, Content};
use super::mlp::{Mlp, Tape};
use super::model::Model;
use super::optimiser::Optimiser;
use super::options::{Options, check, command, optimiser_config};
use super::{REPORT_EVERY, TrainError, read_folder, split};
use crate::core::manifold::{Decoder, EMBEDDED, Keyframe};
use crate::research::transition::{MOVE, STATE, Transition};
use samples::{RATES, Samples};

pub use scores::TransitionScores;

/// Name of the format in the metadata.
const FORMAT: &str = "bundlemocap-transition";
/// Largest magnitude of the log variance; the same as in `crate::research::transition::Transition`.
const WIDEST: f32 = 5.0;

/// Result of a training run.
#[derive(Clone, Debug, PartialEq)]
pub struct TransitionReport {
    /// Held-out metrics by frame rate; empty without test subjects.
    pub held_out: Vec<TransitionScores>,
    /// Number of training transitions, with mirror images and all frame rates.
    pub transitions: usize,
    /// Number of trained parameters.
    pub parameters: usize,
    /// The command that reproduces the run.
    pub command: String,
    /// Wall-clock time of the run.
    pub duration: Duration,
}

/// Trains on codes of the weights file `manifold` (default: the embedded one), writes the weights
/// and reports metrics of the test subjects. Ignores `threads` and the options of the manifold's
/// own loss. `progress` gets the step and the loss, nats per component.
///
/// # Errors
/// As for [`train::run`](super::run); also unusable manifold weights.
pub fn run(
    options: &Options,
    manifold: Option<&Path>,
    progress: &mut dyn FnMut(usize, f32),
) -> Result<TransitionReport, TrainError> {
    check(options)?;
    let start = Instant::now();
    let (model, fingerprint) = read_manifold(manifold)?;
    let (held_out, training) = split(read_folder(&options.motions)?, &options.test_subjects)?;
    let samples = RATES.map(|fps| Samples::of(&model, &training, fps, true));
    let transitions = samples.iter().map(Samples::len).sum();
    if transitions == 0 {
        return Err(TrainError::NothingLeft { frames: 4 });
    }
    let network = fit(options, &samples, progress)?;
    let command = command(options, "bundlemocap train --transition");
    let metadata = BTreeMap::from([
        ("seed", options.seed.to_string()),
        ("command", command.clone()),
        ("manifold", fingerprint),
        ("subjects", corpus::subjects(&training).join(",")),
        ("test_subjects", options.test_subjects.join(",")),
    ]);
    let bytes = network.bytes(&metadata);
    let trained = Transition::from_bytes(&bytes).map_err(|error| malformed(&options.out, error))?;
    file::write_bytes(&options.out, &bytes)?;
    Ok(TransitionReport {
        held_out: figures_of(&trained, &model, &training, &held_out),
        transitions,
        parameters: network.parameters.len(),
        command,
        duration: start.elapsed(),
    })
}

/// Metrics of a weights file on `subjects` of a folder, by frame rate. The baselines are fitted to
/// the other subjects.
///
/// # Errors
/// Unusable weights, clips or subjects.
pub fn evaluate(
    weights: &Path,
    manifold: Option<&Path>,
    motions: &Path,
    subjects: &[String],
) -> Result<Vec<TransitionScores>, TrainError> {
    let read = |source| TrainError::Read { path: weights.to_owned(), source };
    let bytes = std::fs::read(weights).map_err(read)?;
    let trained = Transition::from_bytes(&bytes).map_err(|error| malformed(weights, error))?;
    let (model, _) = read_manifold(manifold)?;
    let (held_out, training) = split(read_folder(motions)?, subjects)?;
    Ok(figures_of(&trained, &model, &training, &held_out))
}

/// A clip at `fps` in the codes of the weights file `manifold` (default: the embedded one).
///
/// # Errors
/// Unusable manifold weights.
pub fn keyframes(
    manifold: Option<&Path>,
    clip: &Clip,
    fps: f64,
) -> Result<Vec<Keyframe>, TrainError> {
    Ok(samples::keyframes(&read_manifold(manifold)?.0, clip, fps, false))
}

fn malformed(path: &Path, error: impl ToString) -> TrainError {
    TrainError::Weights { path: path.to_owned(), problem: error.to_string() }
}

/// Encoder and decoder, and the fingerprint of their file.
fn read_manifold(path: Option<&Path>) -> Result<(Model, String), TrainError> {
    let shown = path.unwrap_or(Path::new("the embedded weights"));
    let read = |source| TrainError::Read { path: shown.to_owned(), source };
    let bytes = path.map_or_else(|| Ok(EMBEDDED.to_vec()), |p| std::fs::read(p).map_err(read))?;
    let model = file::parse(&bytes).map_err(|problem| malformed(shown, problem))?;
    let decoder = Decoder::from_bytes(&bytes).map_err(|error| malformed(shown, error))?;
    Ok((model, format!("{:016x}", decoder.fingerprint())))
}

fn figures_of(
    trained: &Transition,
    model: &Model,
    training: &[Clip],
    held_out: &[Clip],
) -> Vec<TransitionScores> {
    if held_out.is_empty() {
        return Vec::new();
    }
    let rows = RATES.iter().map(|&fps| {
        let known = Samples::of(model, training, fps, true);
        TransitionScores::of(trained, fps, &known, &Samples::of(model, held_out, fps, false))
    });
    rows.collect()
}

/// The trained network; its inputs are not whitened.
struct Network {
    mlp: Mlp,
    parameters: Vec<f32>,
    scale: [f32; MOVE],
}

impl Network {
    fn bytes(&self, metadata: &BTreeMap<&'static str, String>) -> Vec<u8> {
        file::bytes(&Content {
            format: FORMAT,
            networks: &[("transition", &self.mlp)],
            parameters: &self.parameters,
            vectors: &[("scale", &self.scale)],
            metadata,
        })
    }

    /// Folds the whitening into the first layer: W' = W diag(1 / deviation), b' = b - W' mean.
    fn fold(&mut self, mean: &[f32], deviation: &[f32]) {
        let Some(first) = self.mlp.layers().first() else { return };
        for row in 0..first.outputs {
            let start = first.weight.start + row * first.inputs;
            let weights = &mut self.parameters[start..start + first.inputs];
            let mut shift = 0.0f64;
            for ((weight, mean), deviation) in weights.iter_mut().zip(mean).zip(deviation) {
                *weight /= deviation;
                shift += f64::from(*weight) * f64::from(*mean);
            }
            self.parameters[first.bias.start + row] -= shift as f32;
        }
    }
}

/// The training loop. Draws from the frame rates in proportion to their transitions.
fn fit(
    options: &Options,
    samples: &[Samples],
    progress: &mut dyn FnMut(usize, f32),
) -> Result<Network, TrainError> {
    let states: Vec<&[f32]> = samples.iter().flat_map(|s| s.states.chunks_exact(STATE)).collect();
    let moves: Vec<&[f32]> = samples.iter().flat_map(|s| s.moves.chunks_exact(MOVE)).collect();
    let (mean, deviation) = statistics(&states);
    let deviation: Vec<f32> = deviation.iter().map(|d| d.max(1e-3)).collect();
    let (zero, spread) = statistics(&moves);
    let scale = std::array::from_fn(|i| spread[i].hypot(zero[i]).max(1e-3));
    let mlp =
        Mlp::new(&[&[STATE], &vec![options.hidden; options.layers][..], &[2 * MOVE]].concat(), 0);
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let mut network = Network { parameters: vec![0.0; mlp.end()], mlp, scale };
    network.mlp.initialise(&mut network.parameters, &mut rng);
    let mut optimiser = Optimiser::new(optimiser_config(options), &network.parameters);
    let mut tape = network.mlp.tape(options.batch);
    let mut gradient = vec![0.0; network.parameters.len()];
    let mut chosen = vec![0; options.batch];
    let (mut sum, mut count) = (0.0, 0);
    for step in 1..=options.steps {
        chosen.iter_mut().for_each(|index| *index = rng.random_range(0..states.len()));
        for (row, &index) in tape.input_mut().chunks_exact_mut(STATE).zip(&chosen) {
            for (i, out) in row.iter_mut().enumerate() {
                *out = (states[index][i] - mean[i]) / deviation[i];
            }
        }
        network.mlp.forward(&network.parameters, &mut tape);
        sum += loss(&mut tape, &scale, chosen.iter().map(|&index| moves[index]));
        count += 1;
        gradient.fill(0.0);
        network.mlp.backward(&network.parameters, &mut tape, &mut gradient, false);
        optimiser.step(&mut network.parameters, &gradient);
        if step.is_multiple_of(REPORT_EVERY) || step == options.steps {
            if !sum.is_finite() {
                return Err(TrainError::Diverged { step });
            }
            progress(step, sum / count as f32);
            (sum, count) = (0.0, 0);
        }
    }
    network.parameters.copy_from_slice(optimiser.averaged());
    network.fold(&mean, &deviation);
    Ok(network)
}

/// Mean of (y - m)^2 e^-v / 2 + v / 2 over rows and components, where y is the move divided by its
/// scale, m the predicted mean and v = 5 tanh(o / 5). Writes its derivatives with respect to the
/// output to the tape.
fn loss<'a>(
    tape: &mut Tape,
    scale: &[f32; MOVE],
    moves: impl ExactSizeIterator<Item = &'a [f32]>,
) -> f32 {
    let share = 1.0 / (moves.len() * MOVE) as f32;
    let (out, delta) = tape.output_and_delta();
    let rows = out.chunks_exact(2 * MOVE).zip(delta.chunks_exact_mut(2 * MOVE));
    let mut sum = 0.0f64;
    for ((out, delta), found) in rows.zip(moves) {
        for i in 0..MOVE {
            let bent = (out[MOVE + i] / WIDEST).tanh();
            let (log_variance, off) = (WIDEST * bent, out[i] - found[i] / scale[i]);
            let precision = (-log_variance).exp();
            sum += f64::from(0.5 * (off * off * precision + log_variance));
            delta[i] = share * off * precision;
            delta[MOVE + i] = share * 0.5 * (1.0 - off * off * precision) * (1.0 - bent * bent);
        }
    }
    (sum * f64::from(share)) as f32
}

/// Mean and standard deviation of each column.
fn statistics(rows: &[&[f32]]) -> (Vec<f32>, Vec<f32>) {
    let width = rows.first().map_or(0, |row| row.len());
    let (mut sum, mut square) = (vec![0.0f64; width], vec![0.0f64; width]);
    for row in rows {
        for (i, &value) in row.iter().enumerate() {
            sum[i] += f64::from(value);
            square[i] += f64::from(value) * f64::from(value);
        }
    }
    let count = rows.len().max(1) as f64;
    let mean: Vec<f64> = sum.iter().map(|sum| sum / count).collect();
    let spread = |(square, mean): (&f64, &f64)| (square / count - mean * mean).max(0.0).sqrt();
    let deviation = square.iter().zip(&mean).map(|pair| spread(pair) as f32).collect();
    (mean.iter().map(|&mean| mean as f32).collect(), deviation)
}
