//! Errors of the live tracker at declared latencies.

use serde_json::json;

use super::arguments::Latencies;
use super::output::write;
use super::setup::Setup;
use crate::cli::failure::{Failure, within};
use crate::core::tracker::Latency;
use crate::io::report::ReportData;
use crate::research::experiments::summary::{summaries, table, to_json};
use crate::research::experiments::{latency, methods};

/// The methods of the latencies, in milliseconds: provisional poses, then final ones.
pub(super) fn names(latencies: &[f64]) -> Result<Vec<String>, Failure> {
    let of = |&ms: &f64| {
        within("a latency", ms, Latency::LEAST.ms(), 6e4)?;
        Ok(format!("live-{ms}"))
    };
    std::iter::once(Ok("provisional".into())).chain(latencies.iter().map(of)).collect()
}

/// Solves with each latency at each noise level.
pub(super) fn run(asked: &Latencies) -> Result<(), Failure> {
    let names = names(&asked.latencies)?;
    let make = || names.iter().filter_map(|name| methods::named(name)).collect();
    let setup = Setup::new(&asked.motions)?;
    let mut report = ReportData {
        title: "Live poses by latency".into(),
        subtitle: setup.subtitle(),
        ..ReportData::default()
    };
    let (mut levels, mut curves) = (Vec::new(), Vec::new());
    for level in &asked.motions.views.noise {
        let view = setup.view(level)?;
        let run = setup.solve(level, &setup.cases(&view), &make)?;
        let summaries = summaries(&run, run.rows.len() - 1);
        report.leading.push(table(&format!("Noise: {level}"), &summaries));
        levels.push(
            json!({ "level": level, "noise": view.noise, "methods": to_json(&run, &summaries) }),
        );
        curves.push((level.as_str(), summaries));
    }
    report.plots = latency::plots(&asked.latencies, &curves);
    let results = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "latencies_ms": asked.latencies,
        "protocol": setup.protocol,
        "levels": levels,
    });
    write(&asked.motions.views.output.out, &report, &results)
}
