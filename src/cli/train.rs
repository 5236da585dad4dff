//! `bundlemocap train`

use std::path::PathBuf;

use clap::Args;

use super::Ended;
use super::failure::{Exit, failures};
use super::overwrite::Overwrite;
use super::terminal::{progress, say};
use crate::io::file_name;
use crate::research::train::{
    HeldOutErrors, Options, TrainError, TransitionScores, evaluate, evaluate_transition,
    run as train, train_transition,
};

/// Options that do not apply to a transition model.
const MANIFOLD_ONLY: [&str; 9] = [
    "latent",
    "encoder_hidden",
    "kl",
    "limits",
    "position",
    "between",
    "mix",
    "restyle",
    "threads",
];

/// Train a pose manifold or a transition model on a folder of BVH clips, or evaluate one.
#[derive(Debug, Args)]
#[command(after_help = "\
The clips are from the CMU motion capture database, with either of its two BVH skeletons. NN_MM.bvh
is a clip of subject NN. Training is seeded: the same data, options and build give the same file.

Examples:
  bundlemocap train motions/ --out weights.safetensors --test-subjects 07,10
  bundlemocap train motions/ --evaluate weights.safetensors --test-subjects 07,10
  bundlemocap train motions/ --transition --out transition.safetensors --test-subjects 07,10")]
pub(super) struct Arguments {
    /// Folder of BVH clips; subfolders are read too.
    motions: PathBuf,
    /// Weights file to write.
    #[arg(long, value_name = "FILE", required_unless_present = "evaluate")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Do not train; report the metrics of these weights on the clips of --test-subjects.
    #[arg(long, value_name = "FILE", conflicts_with = "out", requires = "test_subjects")]
    evaluate: Option<PathBuf>,
    /// Train or evaluate a transition model (a motion prior on the codes of a manifold).
    #[arg(long, conflicts_with_all = MANIFOLD_ONLY)]
    transition: bool,
    /// Manifold weights whose codes `--transition` uses; default: the embedded weights.
    #[arg(long, value_name = "FILE", requires = "transition")]
    manifold: Option<PathBuf>,
    #[command(flatten)]
    options: Options,
}

failures! {
    TrainError {
        TrainError::Read { .. } => Unreadable,
        TrainError::NoClips { .. } => NoDetections,
        TrainError::Bvh { .. } | TrainError::Joint { .. } => Malformed,
        TrainError::Subject { .. } | TrainError::NothingLeft { .. } | TrainError::Option { .. } => Usage,
        TrainError::Weights { .. } => Weights,
        TrainError::Write { .. } | TrainError::Diverged { .. } => Unexpected,
    }
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    if let Some(out) = &arguments.out {
        arguments.overwrite.check(out)?;
    }
    if arguments.transition {
        return run_transition(arguments);
    }
    if let Some(weights) = &arguments.evaluate {
        say_errors(&evaluate(weights, &arguments.motions, &arguments.options.test_subjects)?);
        return Ok(Exit::Done);
    }
    let options = options(arguments);
    let bar = progress(options.steps as u64, "steps");
    let report = train(&options, &mut |at| {
        bar.set_position(at.step as u64);
        bar.set_message(format!("loss {:.4}", at.loss));
    })?;
    bar.finish_and_clear();
    let (clips, frames) = (report.clips, report.frames);
    let seconds = report.duration.as_secs_f64();
    say(&format!("trained on {clips} clips, {frames} frames, in {seconds:.0} s"));
    say(&format!("{}: {} parameters", options.out.display(), report.parameters));
    say_errors(&report.held_out);
    say(&format!("to reproduce: {}", report.command));
    Ok(Exit::Done)
}

fn run_transition(arguments: &Arguments) -> Ended {
    let manifold = arguments.manifold.as_deref();
    if let Some(weights) = &arguments.evaluate {
        let (motions, subjects) = (&arguments.motions, &arguments.options.test_subjects);
        say_transition(&evaluate_transition(weights, manifold, motions, subjects)?);
        return Ok(Exit::Done);
    }
    let options = options(arguments);
    let bar = progress(options.steps as u64, "steps");
    let report = train_transition(&options, manifold, &mut |step, loss| {
        bar.set_position(step as u64);
        bar.set_message(format!("loss {loss:.4}"));
    })?;
    bar.finish_and_clear();
    let seconds = report.duration.as_secs_f64();
    say(&format!("trained on {} transitions in {seconds:.0} s", report.transitions));
    say(&format!("{}: {} parameters", options.out.display(), report.parameters));
    say_transition(&report.held_out);
    let manifold =
        manifold.map_or_else(String::new, |path| format!(" --manifold {}", file_name(path)));
    say(&format!("to reproduce: {}{manifold}", report.command));
    Ok(Exit::Done)
}

fn options(arguments: &Arguments) -> Options {
    Options {
        motions: arguments.motions.clone(),
        out: arguments.out.clone().unwrap_or_default(),
        ..arguments.options.clone()
    }
}

/// Prints one line per subject.
fn say_errors(rows: &[HeldOutErrors]) {
    if rows.is_empty() {
        return;
    }
    say("held out     frames  rotation   joints  between  true slerp  mean z^2");
    for row in rows {
        say(&format!(
            "{:<12}{:>7}{:>6.2} deg{:>6.2} mm{:>6.2} mm{:>9.2} mm{:>10.3}",
            row.subject,
            row.frames,
            row.rotation_deg,
            row.joint_mm,
            row.between_mm,
            row.true_slerp_mm,
            row.latent_square
        ));
    }
}

/// Prints one line per frame rate.
fn say_transition(rows: &[TransitionScores]) {
    if rows.is_empty() {
        return;
    }
    say("held-out negative log likelihood, nats per component; share of the moves predicted");
    say(
        "fps  transitions   model  constant velocity no motion   code  position  rotation  in 1 sd",
    );
    for row in rows {
        let [code, position, rotation] = row.predicted.map(|share| 100.0 * share);
        say(&format!(
            "{:<5}{:>11}{:>8.3}{:>19.3}{:>10.3}{code:>6.1}%{position:>9.1}%{rotation:>9.1}%{:>8.1}%",
            row.fps,
            row.transitions,
            row.model,
            row.constant_velocity,
            row.stay_put,
            100.0 * row.within
        ));
    }
}
