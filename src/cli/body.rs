//! `bundlemocap body`

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::Ended;
use super::failure::{Exit, Failure, json};
use super::overwrite::{Overwrite, check_ending, is_same_file};
use super::solve::{Progress, decoder, lost};
use super::terminal::{complain, say, table};
use crate::config::Config;
use crate::io::recording::write_body_file;
use crate::io::wire::{Skeleton, Topics};
use crate::metrics::{SEGMENTS, segment_lengths};
use crate::offline::{Options, Recording, TakeBody, estimate_body};

/// Estimate the body of a person from several takes, for `solve --body` and `run --body`.
#[derive(Debug, Args)]
#[command(after_help = "\
All takes must show the same person. This person must be the largest one in the images. The bones
fit all takes together. A solve with --body keeps them, and estimates again where its detector marks
the keypoints. So the person has the same bones in all takes.

Prints the lengths of the bones (mean of left and right) that each take alone gives, and those of the
body. A take whose limbs are more than 8 % longer or shorter than in most of the other takes may show
another person. It is named, and left out if two takes or more agree. Another person of about the
same size is not noticed.

The file is only for --body. To recognise people, the node needs other files: see [stage] bodies.

Exit code 6: a take is damaged, or could not be used. Exit code 15: with --strict, a take may show
another person.

Examples:
  bundlemocap body takes/lead-*.mcap --out lead.mcap
  bundlemocap solve takes/lead-*.mcap --out out --body lead.mcap")]
pub(super) struct Arguments {
    /// MCAP recordings with keypoints and a calibrated rig.
    #[arg(required = true, value_name = "RECORDING")]
    files: Vec<PathBuf>,
    /// The recording that holds the body afterwards.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Settings file; config/default.toml lists every setting.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Manifold weights of `bundlemocap train`; default: the embedded weights.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    /// Use only these cameras.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    cameras: Vec<String>,
    /// Use the capture times as they are; default: correct those of cameras that are shifted.
    #[arg(long)]
    no_sync: bool,
    /// Write no body and fail if a take may show another person.
    #[arg(long)]
    strict: bool,
    /// Print one JSON object instead of the table.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    check_ending(&arguments.out, "mcap")?;
    arguments.overwrite.check(&arguments.out)?;
    if let Some(take) = arguments.files.iter().find(|take| is_same_file(take, &arguments.out)) {
        let message = format!("{} is one of the takes; choose another --out", take.display());
        return Err(Failure::new(Exit::Usage, message));
    }
    let config = arguments.config.as_deref().map(Config::load).transpose()?.unwrap_or_default();
    let options = Options {
        config: config.tracker,
        choice: config.stage.choice(),
        decoder: Some(decoder(arguments.weights.as_deref())?),
        cameras: arguments.cameras.clone(),
        no_sync: arguments.no_sync,
        ..Options::default()
    };
    let (mut recordings, mut unread) = (Vec::new(), Vec::new());
    for file in &arguments.files {
        match Recording::open(file) {
            Ok(recording) => recordings.push(recording),
            Err(error) => unread.push((file, Failure::from(error))),
        }
    }
    if recordings.is_empty() && !unread.is_empty() {
        return Err(unread.swap_remove(0).1);
    }
    let messages = recordings.iter().map(Recording::messages).sum();
    let mut progress = Progress::over(messages);
    let (body, mut takes) = estimate_body(&mut recordings, &options, &mut progress)?;
    progress.bar.finish_and_clear();
    takes.extend(unread.into_iter().map(|(file, failure)| {
        let (recording, problem) = (file.clone(), Some(failure.line()));
        TakeBody { recording, problem, ..TakeBody::default() }
    }));
    let body_mm = segment_lengths(&body).map(|length| 1e3 * length);
    if arguments.json {
        say(&json(&json!({ "body_mm": body_mm, "takes": takes }))?);
    } else {
        let alone = |take: &TakeBody| {
            let without = if take.problem.is_some() { "not used" } else { "too short" };
            let alone = take.alone_mm.map_or(without.to_owned(), |mm| lengths(&mm));
            (take.recording.display().to_string(), alone)
        };
        let mut rows: Vec<_> = takes.iter().map(alone).collect();
        rows.push(("the body".to_owned(), lengths(&body_mm)));
        say(&table(&rows));
    }
    if arguments.cameras.is_empty() {
        for recording in &recordings {
            let note = recording.silent_note();
            let note = note.map(|note| format!("{}: {note}", recording.path().display()));
            note.iter().for_each(|note| complain("note", note));
        }
    }
    let mut exit = Exit::Done;
    for problem in takes.iter().filter_map(|take| take.problem.as_ref()) {
        complain("warning", &format!("{problem}; the take is left out"));
        exit = Exit::InPart;
    }
    for recording in &recordings {
        if lost(recording) != Exit::Done {
            exit = Exit::InPart;
        }
    }
    for take in takes.iter().filter(|take| take.may_be_another_person) {
        let text = "has limbs of another length than the other takes: is it another person?";
        complain("warning", &format!("{} {text}", take.recording.display()));
    }
    if arguments.strict && takes.iter().any(|take| take.may_be_another_person) {
        complain("note", "no body is written");
        return Ok(Exit::Suspicious);
    }
    write_body_file(&arguments.out, &Topics::default().actor, &Skeleton::from_core(&body))?;
    if !arguments.json {
        say(&format!("the body is written to {}", arguments.out.display()));
    }
    Ok(exit)
}

/// As `thigh 343 mm, shank 378 mm, ...`.
fn lengths(mm: &[f64; SEGMENTS.len()]) -> String {
    let of = |((name, _), mm): (&(&str, _), &f64)| format!("{name} {mm:.0} mm");
    SEGMENTS.iter().zip(mm).map(of).collect::<Vec<_>>().join(", ")
}
