//! Ablation: our settings varied one at a time.

use serde_json::{Value, json};

use super::arguments::Ablation;
use super::output::write;
use super::setup::Setup;
use crate::cli::failure::{Exit, Failure};
use crate::io::report::ReportData;
use crate::research::experiments::ablation::{FACTORS, Factor, Seen, both, factor, methods, seen};
use crate::research::experiments::summary::{Summary, summaries, table, to_json};
use crate::research::experiments::{Run, View};

/// One table per factor, at the first noise level.
pub(super) fn run(asked: &Ablation) -> Result<(), Failure> {
    let factors = factors(&asked.factors)?;
    let setup = Setup::new(&asked.motions)?;
    let level = asked.motions.views.noise.first().map_or("studio", String::as_str);
    let view = setup.view(level)?;
    let mut report = ReportData {
        title: "Ablation of our settings".into(),
        subtitle: format!("{}, noise {level}", setup.subtitle()),
        ..ReportData::default()
    };
    let mut results = Vec::new();
    for (name, factor) in factors {
        let (rows, json) = measure(&setup, &view, name, &factor)?;
        report.leading.push(table(&title(name), &rows));
        results.push(json!({ "factor": name, "rows": json }));
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

fn measure(
    setup: &Setup,
    view: &View,
    name: &str,
    factor: &Factor,
) -> Result<(Vec<Summary>, Value), Failure> {
    match factor {
        Factor::Settings(settings) => {
            let run = setup.solve(name, &setup.cases(view), &|| methods(settings))?;
            let rows = summaries(&run, 0);
            let json = to_json(&run, &rows);
            Ok((rows, json))
        }
        Factor::Views(views) => {
            let (mut rows, mut json) = (Vec::new(), Vec::new());
            for (label, how) in views {
                let run = seen_so(setup, view, label, how)?;
                let summaries = summaries(&run, 1);
                json.push(to_json(&run, &summaries));
                rows.extend(summaries);
            }
            Ok((rows, json.into()))
        }
    }
}

fn seen_so(setup: &Setup, view: &View, label: &str, how: &Seen) -> Result<Run, Failure> {
    let varied = match how {
        Seen::Noise(level) => setup.view(level)?,
        _ => seen(view, how)?,
    };
    let cases = match how {
        Seen::Cameras(_) => setup.cases_of_rig(&varied),
        _ => setup.cases(&varied),
    };
    setup.solve(label, &cases, &|| both(label))
}
