//! Ablation: our settings varied one at a time.

use serde_json::json;

use super::arguments::Ablation;
use super::output::write;
use super::setup::Setup;
use crate::cli::failure::{Exit, Failure};
use crate::io::report::ReportData;
use crate::research::experiments::ablation::{FACTORS, Factor, Seen, factor, methods};
use crate::research::experiments::methods::named;
use crate::research::experiments::plots;
use crate::research::experiments::summary::{summaries, table, to_json};

/// One table per factor, at the first noise level.
pub(super) fn run(asked: &Ablation, names: &[String]) -> Result<(), Failure> {
    let factors = factors(&asked.factors)?;
    let setup = Setup::new(&asked.motions)?;
    let level = asked.motions.views.noise.first().map_or("studio", String::as_str);
    let view = setup.view(level)?;
    let mut report = ReportData {
        title: "Ablation of our settings".into(),
        subtitle: format!("{}, noise {level}", setup.subtitle()),
        ..ReportData::default()
    };
    let make = || names.iter().filter_map(|name| named(name)).collect();
    let mut results = Vec::new();
    for (name, factor) in factors {
        let json = match factor {
            Factor::Settings(settings) => {
                let run = setup.solve(name, &setup.cases(&view), &|| methods(&settings))?;
                let rows = summaries(&run, 0);
                report.leading.push(table(&title(name), &rows));
                json!({ "factor": name, "rows": to_json(&run, &rows) })
            }
            Factor::Views(seen, values) => {
                let (mut points, mut json) = (Vec::new(), Vec::new());
                for value in values {
                    let varied = seen.set(&view, value)?;
                    let cases = match seen {
                        Seen::Cameras => setup.cases_of_rig(&varied),
                        _ => setup.cases(&varied),
                    };
                    let run = setup.solve(&format!("{name} {value}"), &cases, &make)?;
                    let rows = summaries(&run, 0);
                    let title = format!("{}: {value}", title(seen.label()));
                    report.leading.push(table(&title, &rows));
                    json.push(json!({ "value": value, "methods": to_json(&run, &rows) }));
                    points.push((value, rows));
                }
                report.plots.extend(plots::over(seen.label(), &points));
                json!({ "factor": name, "values": json })
            }
        };
        results.push(json);
    }
    let results = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "weights": format!("{:016x}", setup.decoder.fingerprint()),
        "protocol": setup.protocol,
        "level": level,
        "factors": results,
    });
    write(&asked.motions.views.output.out, &report, &results)
}

fn factors(names: &[String]) -> Result<Vec<(&str, Factor)>, Failure> {
    let mut found = Vec::new();
    for name in names {
        let asked: Vec<&str> = if name == "all" { FACTORS.to_vec() } else { vec![name] };
        for name in asked {
            let known = factor(name).ok_or_else(|| {
                let known = FACTORS.join(", ");
                let message = format!("ablation {name} is unknown; use all, {known}");
                Failure::new(Exit::Usage, message)
            })?;
            found.push((name, known));
        }
    }
    Ok(found)
}

fn title(name: &str) -> String {
    let (first, rest) = name.split_at(1);
    format!("{}{rest}", first.to_uppercase())
}
