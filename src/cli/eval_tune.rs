//! A method's weights, tried on the subjects that the evaluation does not use.

use serde_json::json;

use super::eval::Arguments;
use super::eval_output::write;
use super::eval_setup::Setup;
use super::failure::{Exit, Failure};
use crate::export::ReportData;
use crate::study::summary::{summaries, to_json};
use crate::study::sweep::{TUNED, grid, table};

/// Solves by a method with each of the weights of its grid, at each level of noise.
pub(super) fn run(arguments: &Arguments, method: &str) -> Result<(), Failure> {
    if grid(method).is_none() {
        let message = format!("--tune {method} is not known; use {}", TUNED.join(", "));
        return Err(Failure::new(Exit::Usage, message));
    }
    let setup = Setup::new(arguments)?;
    let mut runs = Vec::new();
    for level in &arguments.noise {
        let cases = setup.cases(&setup.view(level)?);
        runs.push(setup.solve(level, &cases, &|| grid(method).unwrap_or_default())?);
    }
    let levels: Vec<&str> = arguments.noise.iter().map(String::as_str).collect();
    let report = ReportData {
        title: format!("Weights of {method}"),
        subtitle: format!("{}, on all subjects but those", setup.subtitle()),
        leading: vec![table("The best first", &levels, &runs)],
        ..ReportData::default()
    };
    let levels = levels.iter().zip(&runs).map(
        |(level, run)| json!({ "level": level, "methods": to_json(run, &summaries(run, 0)) }),
    );
    let results = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "tuned": method,
        "protocol": setup.protocol,
        "levels": levels.collect::<Vec<_>>(),
    });
    write(&arguments.out, &report, &results)
}
