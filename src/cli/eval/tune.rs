//! Tuning of a method's weights, on subjects that the evaluation does not use.

use serde_json::json;

use super::arguments::Arguments;
use super::output::write;
use super::setup::Setup;
use crate::cli::failure::{Exit, Failure};
use crate::io::report::ReportData;
use crate::research::experiments::sweep::{TUNABLE, axes, table, tune};

/// Varies each weight of a method, at all noise levels.
pub(super) fn run(arguments: &Arguments, method: &str) -> Result<(), Failure> {
    if axes(method).is_none() {
        let known = TUNABLE.join(", ");
        let message = format!("--tune {method} has no weights to tune; use one of {known}");
        return Err(Failure::new(Exit::Usage, message));
    }
    let setup = Setup::new(arguments)?;
    let mut levels = Vec::new();
    for level in &arguments.noise {
        levels.push((level.as_str(), setup.cases(&setup.view(level)?)));
    }
    let trials = tune(method, |methods| {
        levels.iter().map(|(level, cases)| setup.solve(level, cases, methods)).collect()
    })?;
    let names: Vec<&str> = levels.iter().map(|(level, _)| *level).collect();
    let whose = match arguments.motions {
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
    write(&arguments.out, &report, &results)
}
