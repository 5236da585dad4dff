//! `bundlemocap eval`

mod ablation;
mod arguments;
mod compare;
mod drift;
mod latency;
mod output;
mod performers;
mod recording;
mod setup;
mod tune;

use crate::cli::Ended;
use crate::cli::failure::{Exit, Failure};
use crate::research::experiments::methods;
pub(super) use arguments::Arguments;
use compare::compare;

pub(super) fn run(arguments: &Arguments) -> Ended {
    for file in output::FILES {
        arguments.overwrite.check(&arguments.out.join(file))?;
    }
    if arguments.recording.is_some() {
        let names = match &arguments.latencies[..] {
            [] => method_names(&arguments.methods, &methods::OURS)?,
            latencies => latency::names(latencies)?,
        };
        recording::run(arguments, &names)?;
    } else if !arguments.performers.is_empty() {
        performers::run(arguments, &arguments.performers)?;
    } else if let Some(minutes) = arguments.drift_minutes {
        let names = method_names(&arguments.methods, &["live"])?;
        drift::run(arguments, &names, minutes)?;
    } else if !arguments.latencies.is_empty() {
        latency::run(arguments)?;
    } else if !arguments.ablation.is_empty() {
        ablation::run(arguments)?;
    } else if let Some(method) = &arguments.tune {
        tune::run(arguments, method)?;
    } else {
        compare(arguments, &method_names(&arguments.methods, &["all"])?)?;
    }
    Ok(Exit::Done)
}

/// The requested method names, checked and without duplicates.
fn method_names(asked: &[String], otherwise: &[&str]) -> Result<Vec<String>, Failure> {
    let asked: Vec<&str> = asked.iter().map(String::as_str).collect();
    let mut names: Vec<String> = Vec::new();
    for name in if asked.is_empty() { otherwise } else { &asked[..] } {
        let of_name = match *name {
            "all" => methods::NAMES,
            "ladder" => methods::LADDER,
            _ => std::slice::from_ref(name),
        };
        for &name in of_name {
            if methods::named(name).is_none() {
                let known = methods::known().join(", ");
                let message = format!("--methods {name} is unknown; use all, ladder, {known}");
                return Err(Failure::new(Exit::Usage, message));
            }
            if !names.iter().any(|known| known == name) {
                names.push(name.to_owned());
            }
        }
    }
    Ok(names)
}
