//! Training options, and the command line that reproduces a run.

use std::path::PathBuf;

use super::evaluate::SPAN;
use super::loss::Weights;
use super::model::LossWeights;
use super::{TrainError, optimiser, sampler};
use crate::core::manifold::LATENT;
use crate::io::file_name;

/// Training options. The defaults produced the embedded weights. With the feature `cli`, they are options of the command
/// `train`.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "cli", derive(clap::Args))]
pub struct Options {
    /// Folder of BVH clips; subfolders are read too.
    #[cfg_attr(feature = "cli", arg(skip = Options::default().motions))]
    pub motions: PathBuf,
    /// Weights file to write.
    #[cfg_attr(feature = "cli", arg(skip = Options::default().out))]
    pub out: PathBuf,
    /// Held-out subjects, used only for evaluation.
    #[cfg_attr(feature = "cli", arg(long, value_name = "NAMES", value_delimiter = ','))]
    pub test_subjects: Vec<String>,
    /// Seed of all random draws.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().seed))]
    pub seed: u64,
    /// Optimiser steps.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().steps))]
    pub steps: usize,
    /// Samples per step; a sample is two poses of a clip and two between them.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().batch))]
    pub batch: usize,
    /// Latent dimensions in use, 1 to 32; the others have no effect.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().latent))]
    pub latent: usize,
    /// Hidden units per layer of the decoder, or of the transition model.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().hidden))]
    pub hidden: usize,
    /// Hidden units per layer of the encoder.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().encoder_hidden))]
    pub encoder_hidden: usize,
    /// Hidden layers of each network.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().layers))]
    pub layers: usize,
    /// Peak learning rate.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().learning_rate))]
    pub learning_rate: f32,
    /// Weight decay per step and unit of learning rate.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().weight_decay))]
    pub weight_decay: f32,
    /// Weight of the KL divergence from a standard normal, per nat.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().kl))]
    pub kl: f32,
    /// Weight of joint rotations outside the corpus, for random codes.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().limits))]
    pub limits: f32,
    /// Weight of joint centres, per metre; the weight of rotations is 1 per radian.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().position))]
    pub position: f32,
    /// Weight of interpolated poses relative to single poses.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().between))]
    pub between: f32,
    /// Share of samples whose legs come from another clip.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().mix))]
    pub mix: f64,
    /// Share of samples that are moved to another clip's mean pose.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().restyle))]
    pub restyle: f64,
    /// Threads, 1 to 4; the result does not depend on it.
    #[cfg_attr(feature = "cli", arg(long, default_value_t = Options::default().threads))]
    pub threads: usize,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            motions: PathBuf::from("motions"),
            out: PathBuf::from("weights.safetensors"),
            test_subjects: Vec::new(),
            seed: 1,
            steps: 20_000,
            batch: 512,
            latent: LATENT,
            hidden: 256,
            encoder_hidden: 512,
            layers: 2,
            learning_rate: 3e-3,
            weight_decay: 0.01,
            kl: 1e-2,
            limits: 1.0,
            position: 20.0,
            between: 3.0,
            mix: 0.4,
            restyle: 0.5,
            threads: std::thread::available_parallelism().map_or(1, usize::from).min(4),
        }
    }
}

/// Fails on the first option that is out of range.
pub fn check(options: &Options) -> Result<(), TrainError> {
    let counts = [
        ("steps", options.steps, 1, 10_000_000),
        ("batch", options.batch, 1, 65_536),
        ("latent", options.latent, 1, LATENT),
        ("hidden", options.hidden, 8, 4096),
        ("encoder_hidden", options.encoder_hidden, 8, 4096),
        ("layers", options.layers, 1, 8),
        ("threads", options.threads, 1, 1024),
    ];
    for (option, found, low, high) in counts {
        if !(low..=high).contains(&found) {
            let found = found.to_string();
            let allowed = format!("from {low} to {high}");
            return Err(TrainError::Option { option, found, allowed });
        }
    }
    let weights = [
        ("learning_rate", options.learning_rate),
        ("weight_decay", options.weight_decay),
        ("kl", options.kl),
        ("limits", options.limits),
        ("position", options.position),
        ("between", options.between),
    ];
    for (option, found) in weights {
        if !(found.is_finite() && found >= 0.0) {
            let found = found.to_string();
            return Err(TrainError::Option { option, found, allowed: "0 or more".to_owned() });
        }
    }
    for (option, found) in [("mix", options.mix), ("restyle", options.restyle)] {
        if !(0.0..=1.0).contains(&found) {
            let found = found.to_string();
            return Err(TrainError::Option { option, found, allowed: "from 0 to 1".to_owned() });
        }
    }
    Ok(())
}

/// The sampler's settings.
pub fn sampler_config(options: &Options) -> sampler::Config {
    sampler::Config {
        mix: options.mix,
        mirror: 0.5,
        restyle: options.restyle,
        gains: (0.8, 1.25),
        span: SPAN,
        spans: (5, 16),
        other_spans: 0.5,
        balance: 0.6,
    }
}

/// The weights of the loss.
pub fn loss_weights(options: &Options) -> LossWeights {
    let pose = Weights { rotation: 1.0, position: options.position };
    let between = Weights {
        rotation: options.between * pose.rotation,
        position: options.between * pose.position,
    };
    LossWeights { pose, between, divergence: options.kl, limits: options.limits }
}

/// The optimiser's settings.
pub fn optimiser_config(options: &Options) -> optimiser::Config {
    optimiser::Config {
        learning_rate: options.learning_rate,
        warm_up: (options.steps / 20).min(500),
        steps: options.steps,
        longest_gradient: 1.0,
        weight_decay: options.weight_decay,
        averaging: 0.999,
    }
}

/// The command line of `program` that reproduces a run: last path components of folder and file, and all options that
/// differ from the default.
pub fn command(options: &Options, program: &str) -> String {
    let default = Options::default();
    let mut command = format!("{program} {}/", file_name(&options.motions));
    if !options.test_subjects.is_empty() {
        command += &format!(" --test-subjects {}", options.test_subjects.join(","));
    }
    command += &format!(" --out {}", file_name(&options.out));
    let settings = |o: &Options| {
        [
            ("seed", o.seed.to_string()),
            ("steps", o.steps.to_string()),
            ("batch", o.batch.to_string()),
            ("latent", o.latent.to_string()),
            ("hidden", o.hidden.to_string()),
            ("encoder-hidden", o.encoder_hidden.to_string()),
            ("layers", o.layers.to_string()),
            ("learning-rate", o.learning_rate.to_string()),
            ("weight-decay", o.weight_decay.to_string()),
            ("kl", o.kl.to_string()),
            ("limits", o.limits.to_string()),
            ("position", o.position.to_string()),
            ("between", o.between.to_string()),
            ("mix", o.mix.to_string()),
            ("restyle", o.restyle.to_string()),
        ]
    };
    for ((name, value), (_, usual)) in settings(options).into_iter().zip(settings(&default)) {
        if value != usual {
            command += &format!(" --{name} {value}");
        }
    }
    command
}
