//! Tuning of a method's weights, on subjects that the evaluation does not use.

use serde_json::json;

use super::arguments::Tune;
use super::output::write;
use super::setup::Setup;
use crate::cli::failure::{Exit, Failure};
use crate::io::report::ReportData;
use crate::research::experiments::sweep::{TUNABLE, axes, table, tune};

/// Varies each weight of a method, at all noise levels.
pub(super) fn run(asked: &Tune) -> Result<(), Failure> {
    let method = &asked.method;
    if axes(method).is_none() {
        let known = TUNABLE.join(", ");
        let message = format!("{method} has no weights to tune; use one of {known}");
        return Err(Failure::new(Exit::Usage, message));
    }
    let setup = Setup::of_others(&asked.motions)?;
    let mut levels = Vec::new();
    for level in &asked.motions.views.noise {
        levels.push((level.as_str(), setup.cases(&setup.view(level)?)));
    }
    let trials = tune(method, |methods| {
        levels.iter().map(|(level, cases)| setup.solve(level, cases, methods)).collect()
    })?;
    let names: Vec<&str> = levels.iter().map(|(level, _)| *level).collect();
    let whose = match asked.motions.motions {
        Some(_) => format!("all subjects but {}", setup.protocol.subjects.join(", ")),
        None => "procedural motion".into(),
    };
    let report = ReportData {
        title: format!("Weights of {method}"),
        subtitle: format!("{} of {whose}", setup.subtitle()),
        leading: vec![table("Best weights first", &names, &trials)],
        ..ReportData::default()
    };
    let results = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "tuned": method,
        "protocol": setup.protocol,
        "levels": names,
        "trials": trials,
    });
    write(&asked.motions.views.output.out, &report, &results)
}
