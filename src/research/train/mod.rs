//! Training the pose manifold: a variational auto-encoder of local rotations
//! \[Kingma 2014, Pavlakos 2019, sec. 3.3\].
//!
//! The loss has four parts:
//! - errors of rotations and joint centres of poses decoded from sampled codes;
//! - the same errors of decode(slerp(encode(a), encode(b), s)) against the true pose between a and
//!   b, because the solver relies on this interpolation;
//! - the KL divergence of the codes from N(0, I);
//! - a penalty on joint rotations outside the corpus, for random codes (`limits`).
//!
//! Augmentation makes few clips cover many people: samples are mirrored, some join one clip's legs
//! with another's upper body, and some move about another clip's mean pose. After training, a
//! linear map brings the codes of the clips nearer to N(0, I) (`standard`).
//!
//! Everything is seeded: the same data, options and build give the same bytes with any number of
//! threads, on processors with the same vector instructions.

mod corpus;
mod evaluate;
mod file;
mod latent;
mod limits;
mod loss;
mod mlp;
mod model;
mod optimiser;
mod options;
mod restyle;
mod rotation;
mod sampler;
mod standard;
mod transition;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

pub use corpus::{Clip, FPS, POSE, PoseVector, Root, mirrored, pose_vector, read_folder, subjects};
pub use evaluate::{HeldOutErrors, SPAN, table};
pub use model::Losses;
pub use options::Options;
pub use transition::{
    TransitionReport, TransitionScores, evaluate as evaluate_transition,
    keyframes as transition_keyframes, run as train_transition,
};

use crate::io::formats::bvh::BvhError;
use limits::Limits;
use model::{Batch, LossWeights, Model, Whitening};
use optimiser::Optimiser;
use options::{check, command, loss_weights, optimiser_config, sampler_config};
use sampler::Sampler;
use standard::Standard;

/// Steps between two [`Progress`] reports.
const REPORT_EVERY: usize = 50;

/// Why training or evaluation failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum TrainError {
    #[error("{}: cannot be read: {source}; check the path and its permissions", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{}: cannot be written: {source}; check that its folder exists", path.display())]
    Write { path: PathBuf, source: std::io::Error },
    #[error("{}: contains no .bvh file; give a folder of motion clips", path.display())]
    NoClips { path: PathBuf },
    #[error("{}: {source}", path.display())]
    Bvh { path: PathBuf, source: BvhError },
    #[error(
        "{}: has no joint `{joint}`; only the two CMU skeletons (roots `hip` and `Hips`) can be \
         read",
        path.display()
    )]
    Joint { path: PathBuf, joint: String },
    #[error("no clip of subject `{subject}`; the clips' subjects are {known}")]
    Subject { subject: String, known: String },
    #[error("no training clip is longer than {frames} frames; hold out fewer subjects")]
    NothingLeft { frames: usize },
    #[error("option `{option}` is {found}; it must be {allowed}")]
    Option { option: &'static str, found: String, allowed: String },
    #[error("the loss is no longer finite at step {step}; lower the learning rate")]
    Diverged { step: usize },
    #[error("{}: {problem}; this version cannot use it as a weights file", path.display())]
    Weights { path: PathBuf, problem: String },
}

/// Progress of a training run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Steps done.
    pub step: usize,
    /// Total number of steps.
    pub steps: usize,
    /// Mean losses since the last report.
    pub losses: Losses,
    /// Their weighted sum.
    pub loss: f32,
    /// Steps per second since the start.
    pub steps_per_second: f64,
    /// Estimated time left.
    pub eta: Duration,
}

/// Result of a training run.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Held-out metrics by subject, then `all`; empty without test subjects.
    pub held_out: Vec<HeldOutErrors>,
    /// Number of training frames.
    pub frames: usize,
    /// Number of training clips.
    pub clips: usize,
    /// Number of trained parameters.
    pub parameters: usize,
    /// The command that reproduces the run.
    pub command: String,
    /// Wall-clock time of the run.
    pub duration: Duration,
}

/// Trains, writes the weights and reports the metrics on the test subjects. Calls `progress` every
/// 50 steps and after the last.
///
/// # Errors
/// Options out of range, unusable clips or subjects, a diverging loss, an unwritable file.
pub fn run(options: &Options, progress: &mut dyn FnMut(Progress)) -> Result<Report, TrainError> {
    check(options)?;
    let start = Instant::now();
    let clips = read_folder(&options.motions)?;
    let (held_out, training) = split(clips, &options.test_subjects)?;
    let model = fit(options, &training, progress)?;
    let held_out =
        if held_out.is_empty() { Vec::new() } else { evaluate::held_out_errors(&model, &held_out) };
    let command = command(options, "bundlemocap train");
    file::write(&options.out, &model, &metadata(options, &training, &held_out, &command))?;
    Ok(Report {
        held_out,
        frames: training.iter().map(|clip| clip.poses.len()).sum(),
        clips: training.len(),
        parameters: model.parameters.len(),
        command,
        duration: start.elapsed(),
    })
}

/// Metrics of a weights file on `subjects` of a folder (all, if `subjects` is empty), by subject,
/// then `all`.
///
/// # Errors
/// Unusable weights, clips or subjects.
pub fn evaluate(
    weights: &Path,
    motions: &Path,
    subjects: &[String],
) -> Result<Vec<HeldOutErrors>, TrainError> {
    let model = file::read(weights)?;
    let (chosen, rest) = split(read_folder(motions)?, subjects)?;
    Ok(evaluate::held_out_errors(&model, if subjects.is_empty() { &rest } else { &chosen }))
}

/// Splits clips into those of `subjects` and the others.
fn split(clips: Vec<Clip>, subjects: &[String]) -> Result<(Vec<Clip>, Vec<Clip>), TrainError> {
    for subject in subjects {
        if !clips.iter().any(|clip| clip.subject == *subject) {
            let known = corpus::subjects(&clips).join(", ");
            return Err(TrainError::Subject { subject: subject.clone(), known });
        }
    }
    Ok(clips.into_iter().partition(|clip| subjects.contains(&clip.subject)))
}

/// The training loop.
fn fit(
    options: &Options,
    clips: &[Clip],
    progress: &mut dyn FnMut(Progress),
) -> Result<Model, TrainError> {
    let draws = sampler_config(options);
    let sampler = Sampler::new(clips, draws)
        .ok_or(TrainError::NothingLeft { frames: draws.span.max(draws.spans.1) })?;
    let (mean, deviation) = sampler::statistics(clips);
    let whitening = Whitening::new(mean, deviation);
    let weights = loss_weights(options);
    let mut model = Model::new(
        &vec![options.encoder_hidden; options.layers],
        &vec![options.hidden; options.layers],
    );
    model.initialise(&mean, &mut ChaCha8Rng::seed_from_u64(options.seed));
    let unused = model.unused(options.latent);
    let clear = |values: &mut [f32]| unused.iter().for_each(|at| values[at.clone()].fill(0.0));
    clear(&mut model.parameters);
    let mut optimiser = Optimiser::new(optimiser_config(options), &model.parameters);
    let limits = Limits::new(clips);
    let mut batch =
        Batch::new(&model, options.batch, weights, whitening.clone(), limits, options.threads);
    let mut gradient = vec![0.0; model.parameters.len()];
    let mut reporter = Reporter::new(options.steps, weights);
    for step in 1..=options.steps {
        let losses = batch.gradient(&model, &sampler, (options.seed, step), &mut gradient);
        clear(&mut gradient);
        optimiser.step(&mut model.parameters, &gradient);
        if let Some(report) = reporter.add(step, &losses) {
            if !report.loss.is_finite() {
                return Err(TrainError::Diverged { step });
            }
            progress(report);
        }
    }
    model.fold(optimiser.averaged(), &whitening);
    model.recode(&Standard::of(&model, clips));
    Ok(model)
}

/// Averages losses between reports.
struct Reporter {
    start: Instant,
    steps: usize,
    weights: LossWeights,
    sum: Losses,
    count: usize,
}

impl Reporter {
    fn new(steps: usize, weights: LossWeights) -> Self {
        Self { start: Instant::now(), steps, weights, sum: Losses::default(), count: 0 }
    }

    fn add(&mut self, step: usize, losses: &Losses) -> Option<Progress> {
        self.sum.add(losses, 1.0);
        self.count += 1;
        if !step.is_multiple_of(REPORT_EVERY) && step != self.steps {
            return None;
        }
        let mut mean = Losses::default();
        mean.add(&self.sum, 1.0 / self.count as f32);
        (self.sum, self.count) = (Losses::default(), 0);
        let pace = step as f64 / self.start.elapsed().as_secs_f64().max(1e-6);
        Some(Progress {
            step,
            steps: self.steps,
            losses: mean,
            loss: mean.total(&self.weights),
            steps_per_second: pace,
            eta: Duration::from_secs_f64((self.steps - step) as f64 / pace),
        })
    }
}

fn metadata(
    options: &Options,
    training: &[Clip],
    held_out: &[HeldOutErrors],
    command: &str,
) -> BTreeMap<&'static str, String> {
    let mut metadata = BTreeMap::from([
        ("seed", options.seed.to_string()),
        ("command", command.to_owned()),
        ("subjects", corpus::subjects(training).join(",")),
        ("test_subjects", options.test_subjects.join(",")),
    ]);
    if let Some(all) = held_out.last() {
        metadata.insert("held_out_rotation_deg", format!("{:.3}", all.rotation_deg));
        metadata.insert("held_out_joint_mm", format!("{:.2}", all.joint_mm));
        metadata.insert("held_out_between_mm", format!("{:.2}", all.between_mm));
        metadata.insert("held_out_latent_square", format!("{:.3}", all.latent_square));
    }
    metadata
}
