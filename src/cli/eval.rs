//! `bundlemocap eval`

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::Ended;
use super::eval_output::write;
use super::eval_views::{at_level, motions, rig};
use super::failure::{Exit, Failure, frame_rate_option};
use super::solve::decoder;
use super::terminal::progress;
use crate::baseline::{Method, Windows};
use crate::export::ReportData;
use crate::manifold::Decoder;
use crate::study::summary::{Summary, differences, summaries, table, to_json};
use crate::study::true_heights;
use crate::study::{Case, Methods, Run, Subject, View, methods, plots, run as solve_all};

/// Measure methods against each other, on motions with a known truth or on a recording.
#[derive(Debug, Args)]
#[command(after_help = "\
Each motion is seen by the cameras of a rig, with detectors that err; every method solves it from
the same detections. No method is told the true body, pose or first frame. The folder DIR gets
table.md, results.json (every figure, each sequence, all settings and seeds) and report.html.
Everything follows from --seed: two runs give the same figures, but for the times.

Examples:
  bundlemocap eval --motions motions/ --out eval
  bundlemocap eval --motions motions/ --noise sparse --methods paper,default --every 3 --out eval
  bundlemocap eval --methods default --seconds 5 --out eval")]
pub(super) struct Arguments {
    /// Folder of BVH clips with the motions; our own procedural motion if not given.
    #[arg(long, value_name = "DIR")]
    motions: Option<PathBuf>,
    /// The folder to write to; it is made if it is not there.
    #[arg(long, value_name = "DIR", default_value = "eval")]
    out: PathBuf,
    /// Subjects whose clips are used.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "07,10")]
    subjects: Vec<String>,
    /// Use every so manieth clip.
    #[arg(long, value_name = "N", default_value_t = 1)]
    every: usize,
    /// Longest part of a clip, from its middle, seconds.
    #[arg(long, default_value_t = 8.0, allow_negative_numbers = true)]
    seconds: f64,
    /// Frames a second of the cameras, 1 to 1000.
    #[arg(long, value_name = "HZ", default_value_t = 50.0, allow_negative_numbers = true)]
    fps: f64,
    /// The cameras: ring2 to ring32.
    #[arg(long, value_name = "NAME", default_value = "ring4")]
    rig: String,
    /// How the detectors err: none, clean, studio, sparse; may be given several times.
    #[arg(long, value_name = "LEVEL", value_delimiter = ',', default_values = ["studio", "sparse"])]
    noise: Vec<String>,
    /// Methods by name, or all.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "all")]
    methods: Vec<String>,
    /// Of everything random.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Sequences solved at the same time; times are fair with 1 only.
    #[arg(long, value_name = "N", default_value_t = 1)]
    jobs: usize,
    /// Weights of a manifold, from `bundlemocap train`; the embedded ones if not given.
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
}

pub(super) fn run(arguments: &Arguments) -> Ended {
    let decoder = decoder(arguments.weights.as_deref())?;
    let names = method_names(&arguments.methods)?;
    let subjects = motions(arguments.motions.as_deref(), &arguments.subjects, arguments.every)?;
    let view = view(arguments)?;
    let levels: Vec<View> =
        arguments.noise.iter().map(|level| at_level(&view, level)).collect::<Result<_, _>>()?;
    let make = || names.iter().filter_map(|name| methods::named(name)).collect();
    let setup = Setup { decoder: &decoder, methods: &make, subjects: &subjects };
    compare(arguments, &setup, &levels)?;
    Ok(Exit::Done)
}

/// What all levels share.
struct Setup<'a> {
    decoder: &'a Decoder,
    methods: &'a Methods<'a>,
    subjects: &'a [Subject],
}

/// The names of methods that are asked for, each checked.
fn method_names(asked: &[String]) -> Result<Vec<String>, Failure> {
    let known = methods::names();
    let mut names = Vec::new();
    for name in asked {
        match name.as_str() {
            "all" => names.extend(known.clone()),
            _ if known.contains(name) => names.push(name.clone()),
            _ => {
                let message =
                    format!("--methods {name} is not known; use all, {}", known.join(", "));
                return Err(Failure::new(Exit::Usage, message));
            }
        }
    }
    let mut once = Vec::new();
    names.retain(|name| {
        !once.contains(name) && {
            once.push(name.clone());
            true
        }
    });
    Ok(names)
}

/// The view without its level.
fn view(arguments: &Arguments) -> Result<View, Failure> {
    let Arguments { seconds, seed, jobs, .. } = *arguments;
    let wrong = |option: &str, value: String, allowed: &str| {
        Failure::new(Exit::Usage, format!("{option} is {value}, but must be {allowed}"))
    };
    if !(0.5..=36_000.0).contains(&seconds) {
        return Err(wrong("--seconds", seconds.to_string(), "0.5 to 36000"));
    }
    if !(1..=64).contains(&jobs) {
        return Err(wrong("--jobs", jobs.to_string(), "1 to 64"));
    }
    Ok(View {
        name: String::new(),
        rig: rig(&arguments.rig)?,
        noise: crate::synth::Noise::none(),
        fps: frame_rate_option(arguments.fps)?,
        seconds,
        seed,
    })
}

/// The table of all methods at each level.
fn compare(arguments: &Arguments, setup: &Setup, levels: &[View]) -> Result<(), Failure> {
    let mut done: Vec<(&View, Run, Vec<Summary>)> = Vec::new();
    for view in levels {
        let run = solve_level(setup, view, arguments.jobs);
        let against = run.row(&Windows::default_settings().name()).unwrap_or(0);
        let summaries = summaries(&run, against);
        done.push((view, run, summaries));
    }
    let mut report = ReportData {
        title: "Methods compared".into(),
        subtitle: subtitle(arguments, setup),
        ..ReportData::default()
    };
    for (view, run, summaries) in &done {
        let ours = Windows::default_settings().name();
        report.leading.push(table(&format!("Noise: {}", view.name), summaries));
        if run.rows.len() > 1 && run.row(&ours).is_some() {
            let mut table = differences(&ours, summaries);
            table.title = format!("{}, noise: {}", table.title, view.name);
            report.leading.push(table);
        }
    }
    add_plots(&mut report, setup, &done);
    let levels = done.iter().map(|(view, run, summaries)| {
        json!({
            "level": view.name,
            "noise": view.noise,
            "methods": to_json(run, summaries),
        })
    });
    let results = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "weights": format!("{:016x}", setup.decoder.fingerprint()),
        "settings": {
            "subjects": if arguments.motions.is_some() { &arguments.subjects[..] } else { &[] },
            "every": arguments.every,
            "seconds": arguments.seconds,
            "fps": arguments.fps,
            "rig": arguments.rig,
            "seed": arguments.seed,
        },
        "levels": levels.collect::<Vec<_>>(),
    });
    write(&arguments.out, &report, &results)
}

fn solve_level(setup: &Setup, view: &View, jobs: usize) -> Run {
    let cases: Vec<Case> = setup
        .subjects
        .iter()
        .map(|subject| Case { subject: subject.clone(), view: view.clone() })
        .collect();
    let bar = progress((cases.len() * (setup.methods)().len()) as u64, "solves");
    bar.set_message(view.name.clone());
    let run = solve_all(&cases, setup.methods, setup.decoder, jobs, &|| bar.inc(1));
    bar.finish_and_clear();
    run
}

fn subtitle(arguments: &Arguments, setup: &Setup) -> String {
    let Arguments { fps, seed, rig, seconds, .. } = arguments;
    let count = setup.subjects.len();
    let source = match arguments.motions {
        Some(_) => format!("{count} clips of subjects {}", arguments.subjects.join(", ")),
        None => format!("{count} procedural motions"),
    };
    format!("{source}, up to {seconds} s at {fps} fps, rig {rig}, seed {seed}")
}

fn add_plots(report: &mut ReportData, setup: &Setup, done: &[(&View, Run, Vec<Summary>)]) {
    let levels: Vec<(&str, &[Summary])> =
        done.iter().map(|(view, _, summaries)| (view.name.as_str(), &summaries[..])).collect();
    report.bars = vec![
        plots::bars("MPJPE by method", "MPJPE (mm)", "mpjpe_mm", &levels),
        plots::bars(
            "Acceleration error by method",
            "acceleration error (m/s²)",
            "acceleration_error_m_s2",
            &levels,
        ),
    ];
    let Some((view, run, _)) = done.last() else { return };
    let Some(case) = liveliest(run) else { return };
    let truth = Case { subject: setup.subjects[case].clone(), view: View::clone(view) }.make();
    let shown: Vec<&str> = run.rows.iter().map(|row| row.method.as_str()).collect();
    report.plots = vec![
        plots::errors(run, case),
        plots::borders(run),
        plots::path(run, case, &true_heights(&truth), &few(&shown)),
    ];
    let level = &view.name;
    for plot in &mut report.plots {
        plot.note = format!("{} Noise: {level}.", plot.note);
    }
}

/// The first, which is MuVS where it is there, and the last, which is ours.
fn few<'a>(methods: &[&'a str]) -> Vec<&'a str> {
    let mut few: Vec<&str> = methods.first().into_iter().chain(methods.last()).copied().collect();
    few.dedup();
    few
}

/// A case in the middle by the first method's error, so that it is neither easy nor a failure.
fn liveliest(run: &Run) -> Option<usize> {
    let row = run.rows.first()?;
    let mut errors: Vec<(f64, usize)> = (row.results.iter().enumerate())
        .filter_map(|(case, result)| Some((result.as_ref()?.0.mpjpe_mm, case)))
        .collect();
    errors.sort_by(|a, b| a.0.total_cmp(&b.0));
    errors.get(errors.len() / 2).map(|(_, case)| *case)
}
