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
use crate::offline::output::OutputFolder;
use crate::research::experiments::methods;
pub(super) use arguments::Arguments;
use arguments::{Named, What};
use compare::compare;

pub(super) fn run(arguments: &Arguments) -> Ended {
    let out = &arguments.what.output().out;
    let _folder = OutputFolder::make(out)?;
    for file in output::FILES {
        arguments.what.output().overwrite.check(&out.join(file))?;
    }
    match &arguments.what {
        What::Methods(asked) => compare(asked, &method_names(&asked.named, &["all"])?),
        What::Recording(asked) if asked.latencies.is_empty() => {
            recording::run(asked, &method_names(&asked.named, &methods::OURS)?)
        }
        What::Recording(asked) => recording::run(asked, &latency::names(&asked.latencies)?),
        What::Performers(asked) => performers::run(asked),
        What::Drift(asked) => drift::run(asked, &method_names(&asked.named, &["live"])?),
        What::Latencies(asked) => latency::run(asked),
        What::Ablation(asked) => {
            ablation::run(asked, &method_names(&asked.named, &["paper", "default"])?)
        }
        What::Tune(asked) => tune::run(asked),
    }?;
    Ok(Exit::Done)
}

/// The requested method names, checked and without duplicates.
fn method_names(asked: &Named, otherwise: &[&str]) -> Result<Vec<String>, Failure> {
    let asked: Vec<&str> = asked.methods.iter().map(String::as_str).collect();
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
