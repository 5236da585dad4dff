//! The methods by name.

use super::{
    Dct, DctWeights, Dmmr, Etc, LiveTracker, Method, MuVs, Slahmr, SlahmrWeights, Triangulation,
    Windows,
};
use crate::research::transition::Transition;

/// The compared methods, in table order.
pub const NAMES: &[&str] = &[
    "triangulation",
    "triangulation-kalman",
    "muvs",
    "dct",
    "etc",
    "dmmr",
    "slahmr",
    "paper",
    "paper-converged",
    "paper-body",
    "fixed",
    "default",
];

/// The steps from the paper's path to the default settings, each with one more change.
pub const LADDER: &[&str] = &[
    "paper",
    "paper-converged",
    "paper-body",
    "tuned",
    "frames",
    "overlapping",
    "fixed",
    "weighted",
    "on-manifold",
    "feet-slide",
    "default",
    "live",
];

/// The method of that name with its default weights; `None` if the name is unknown. `dct-300` is DCT
/// with ten times its iterations, `live-50` the live tracker at a latency of 50 ms.
pub fn named(name: &str) -> Option<Box<dyn Method>> {
    Some(match name {
        "triangulation" => Box::new(Triangulation::butterworth()),
        "triangulation-kalman" => Box::new(Triangulation::kalman()),
        "muvs" => Box::new(MuVs::default()),
        "dct" => Box::new(Dct::default()),
        "dct-300" => Box::new(Dct::new(DctWeights { iterations: 300, ..DctWeights::default() })),
        "etc" => Box::new(Etc::default()),
        "dmmr" => Box::new(Dmmr::default()),
        "slahmr" => Box::new(Slahmr::new(SlahmrWeights::default(), Transition::embedded().ok()?)),
        "paper" => Box::new(Windows::paper()),
        "paper-converged" => Box::new(Windows::paper_converged()),
        "paper-body" => Box::new(Windows::paper_with_body()),
        "tuned" => Box::new(Windows::tuned()),
        "frames" => Box::new(Windows::frames()),
        "overlapping" => Box::new(Windows::overlapping()),
        "fixed" => Box::new(Windows::fixed()),
        "weighted" => Box::new(Windows::weighted()),
        "on-manifold" => Box::new(Windows::on_manifold()),
        "feet-slide" => Box::new(Windows::feet_slide()),
        "default" => Box::new(Windows::default_settings()),
        "live" => Box::new(Windows::live()),
        "provisional" => Box::new(LiveTracker::Provisional),
        _ => Box::new(LiveTracker::at(name.strip_prefix("live-")?)?),
    })
}
