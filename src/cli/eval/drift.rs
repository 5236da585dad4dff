//! Drift of the error over a long take.

use serde_json::json;

use super::arguments::Drift;
use super::output::write;
use super::setup::Setup;
use crate::cli::failure::{Exit, Failure, within};
use crate::io::report::ReportData;
use crate::research::experiments::{Case, drift, methods, plots};

/// Solves one long take at each noise level.
pub(super) fn run(asked: &Drift, names: &[String]) -> Result<(), Failure> {
    let minutes = within("minutes", asked.minutes, 0.5, 600.0)?;
    let mut setup = Setup::new(&asked.motions)?;
    setup.keep_first_rig();
    setup.keep_first_seed();
    let mut report = ReportData {
        title: format!("Drift over {minutes} minutes"),
        subtitle: setup.subtitle(),
        ..ReportData::default()
    };
    let mut levels = Vec::new();
    for level in &asked.motions.views.noise {
        let view = setup.view(level)?;
        let case = Case::endless(&setup.subjects, &view, 60.0 * minutes).ok_or_else(|| {
            let message = "no motion is long enough; name other subjects with --subjects";
            Failure::new(Exit::NoDetections, message)
        })?;
        let make = || names.iter().filter_map(|name| methods::named(name)).collect();
        let run = setup.solve(level, &[case], &make)?;
        let drifts = drift::drifts(&run);
        if drifts.is_empty() {
            let message = format!("nobody was found at noise {level}; use a lower level");
            return Err(Failure::new(Exit::NobodyFound, message));
        }
        report.leading.push(drift::table(&format!("Noise: {level}"), &drifts));
        let mut plot = plots::long_errors(&run, view.choice.fps);
        plot.note = format!("{} Noise: {level}.", plot.note);
        report.plots.push(plot);
        levels.push(json!({ "level": level, "noise": view.noise, "drift": drifts }));
    }
    let results = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "minutes": minutes,
        "protocol": setup.protocol,
        "levels": levels,
    });
    write(&asked.motions.views.output.out, &report, &results)
}
