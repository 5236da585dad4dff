//! The methods by name.

use super::{Dct, Dmmr, Etc, Method, MuVs, Slahmr, SlahmrWeights, Windows};
use crate::core::manifold::Transition;

/// The names that [`named`] accepts, in table order.
pub const NAMES: &[&str] =
    &["muvs", "dct", "etc", "dmmr", "slahmr", "paper", "paper-lm", "default"];

/// Every method with its default weights, in the order of [`NAMES`].
pub fn all() -> Vec<Box<dyn Method>> {
    NAMES.iter().filter_map(|name| named(name)).collect()
}

/// The method of that name with its default weights; `None` if the name is unknown.
pub fn named(name: &str) -> Option<Box<dyn Method>> {
    Some(match name {
        "muvs" => Box::new(MuVs::default()),
        "dct" => Box::new(Dct::default()),
        "etc" => Box::new(Etc::default()),
        "dmmr" => Box::new(Dmmr::default()),
        "slahmr" => Box::new(Slahmr::new(SlahmrWeights::default(), Transition::embedded().ok()?)),
        "paper" => Box::new(Windows::paper()),
        "paper-lm" => Box::new(Windows::paper_with_our_optimiser()),
        "default" => Box::new(Windows::default_settings()),
        _ => return None,
    })
}
