//! Methods compared on synthetic recordings with ground truth.

use serde_json::{Value, json};

use super::arguments::Methods;
use super::output::write;
use super::recording::Loaded;
use super::setup::Setup;
use crate::cli::failure::Failure;
use crate::core::manifold::Decoder;
use crate::io::report::{Bars, ReportData, Table};
use crate::metrics::DetectorStatistics;
use crate::research::experiments::real::detectors;
use crate::research::experiments::summary::{
    Summary, differences, number, segments, summaries, table, to_json,
};
use crate::research::experiments::{Case, Run, View, methods, plots, true_heights};
use crate::research::methods::{Method, Take, Windows};

/// The results of a noise level.
struct Level {
    view: View,
    cases: Vec<Case>,
    run: Run,
    summaries: Vec<Summary>,
    detector: Option<DetectorStatistics>,
}

/// Solves with every method at each noise level; prints and writes the tables.
pub(super) fn compare(asked: &Methods, names: &[String]) -> Result<(), Failure> {
    let setup = Setup::new(&asked.motions)?;
    let beside = asked.beside.as_deref().map(|path| Loaded::read(path, &[], &[])).transpose()?;
    let mut levels = Vec::new();
    for level in &asked.motions.views.noise {
        levels.push(solve(&setup, setup.view(level)?, names)?);
    }
    let mut report = ReportData {
        title: "Methods compared".into(),
        subtitle: setup.subtitle(),
        ..ReportData::default()
    };
    let ours = Windows::default_settings().name();
    for Level { view, run, summaries, .. } in &levels {
        report.leading.push(table(&format!("Noise: {}", view.name), summaries));
        let title = format!(
            "Noise: {}. Bones by body, less the true ones: mean ± half of the range",
            view.name
        );
        report.leading.extend(segments(&title, run));
        if run.rows.len() > 1 && run.row(&ours).is_some() {
            let mut table = differences(&ours, summaries);
            table.title = format!("Noise: {}. {}", view.name, table.title);
            report.leading.push(table);
        }
    }
    report.bars = bars(&levels);
    if let Some(level) = levels.last() {
        add_curves(&mut report, level);
    }
    let real = beside.and_then(|beside| of_detectors(&beside.take, &setup.decoder));
    let detectors: Vec<(&str, &DetectorStatistics)> = levels
        .iter()
        .filter_map(|level| Some((level.view.name.as_str(), level.detector.as_ref()?)))
        .chain(real.as_ref().map(|real| ("the recording", real)))
        .collect();
    report.plots.push(plots::detector_spectrum(&detectors));
    report.plots.push(plots::detector_confidence(&detectors));
    report.tables.push(detector_table(&detectors));
    write(&asked.motions.views.output.out, &report, &results(&setup, &levels))
}

fn solve(setup: &Setup, view: View, names: &[String]) -> Result<Level, Failure> {
    let cases = setup.cases(&view);
    let make = || names.iter().filter_map(|name| methods::named(name)).collect();
    let run = setup.solve(&view.name, &cases, &make)?;
    let against = run.row(&Windows::default_settings().name()).unwrap_or(0);
    let summaries = summaries(&run, against);
    let detector = cases.first().and_then(|case| of_detectors(&case.make().take, &setup.decoder));
    Ok(Level { view, cases, run, summaries, detector })
}

/// Errors of the detectors relative to our solution; `None` if nobody is found.
fn of_detectors(take: &Take, decoder: &Decoder) -> Option<DetectorStatistics> {
    detectors(take, &Windows::default_settings().solve(take, decoder)?)
}

fn bars(levels: &[Level]) -> Vec<Bars> {
    let named: Vec<(&str, &[Summary])> =
        levels.iter().map(|level| (level.view.name.as_str(), &level.summaries[..])).collect();
    let bars = |title: &str, label: &str, key: &str| plots::bars(title, label, key, &named);
    vec![
        bars("Error of the limb joints by method", "error (mm)", "limb_mm"),
        bars("Error in held-out cameras by method", "error (px)", "held_out_px"),
        bars(
            "Acceleration error by method",
            "acceleration error (m/s²)",
            "limb_acceleration_error_m_s2",
        ),
    ]
}

/// Adds the curves of one case of a level.
fn add_curves(report: &mut ReportData, level: &Level) {
    let Level { view, cases, run, .. } = level;
    let Some(case) = middling(run) else { return };
    let truth = true_heights(&cases[case].make());
    let first = run.rows.first().map(|row| row.method.as_str());
    let shown: Vec<&str> =
        first.into_iter().chain(run.rows.iter().skip(1).last().map(|r| &*r.method)).collect();
    report.plots =
        vec![plots::errors(run, case), plots::borders(run), plots::path(run, case, &truth, &shown)];
    for plot in &mut report.plots {
        plot.note = format!("{} Noise: {}.", plot.note, view.name);
    }
}

/// The case with the median error of the first method.
fn middling(run: &Run) -> Option<usize> {
    let row = run.rows.first()?;
    let mut errors: Vec<(f64, usize)> = (row.results.iter().enumerate())
        .filter_map(|(case, result)| Some((result.as_ref()?.0.limbs.limb_mm, case)))
        .collect();
    errors.sort_by(|a, b| a.0.total_cmp(&b.0));
    errors.get(errors.len() / 2).map(|(_, case)| *case)
}

fn detector_table(levels: &[(&str, &DetectorStatistics)]) -> Table {
    type Row = (&'static str, fn(&DetectorStatistics) -> f64);
    const ROWS: [Row; 11] = [
        ("residual, median (% of height)", |s| 100.0 * s.residual_median),
        ("residual, 95th percentile (%)", |s| 100.0 * s.residual_p95),
        ("residual of the best view, median (%)", |s| 100.0 * s.by_camera.first().unwrap_or(&0.0)),
        ("residual of the worst view, median (%)", |s| 100.0 * s.by_camera.last().unwrap_or(&0.0)),
        ("constant part, median (%)", |s| 100.0 * s.systematic),
        ("varying part, median (%)", |s| 100.0 * s.varying),
        ("second difference, median (%)", |s| 100.0 * s.second_difference),
        ("points missing (%)", |s| 100.0 * s.missing),
        ("mean gap (s)", |s| s.missing_run_s),
        ("frames without the performer (%)", |s| 100.0 * s.without_performer),
        ("limb pairs inverted (%)", |s| 100.0 * s.inverted),
    ];
    let mut header = vec!["detector".to_owned()];
    header.extend(levels.iter().map(|(name, _)| (*name).to_owned()));
    let rows = ROWS.iter().map(|(name, of)| {
        let values = levels.iter().map(|(_, statistics)| number(Some(of(statistics)), 2));
        std::iter::once((*name).to_owned()).chain(values).collect()
    });
    Table { title: "Errors of the detectors".into(), header, rows: rows.collect() }
}

fn results(setup: &Setup, levels: &[Level]) -> Value {
    let levels = levels.iter().map(|level| {
        json!({
            "level": level.view.name,
            "noise": level.view.noise,
            "methods": to_json(&level.run, &level.summaries),
        })
    });
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "weights": format!("{:016x}", setup.decoder.fingerprint()),
        "protocol": setup.protocol,
        "levels": levels.collect::<Vec<_>>(),
    })
}
