//! Tunes the weights of all methods by the same rule.
//!
//! The weights of a method are axes (see [`axes`]) that start at its defaults. Coordinate search:
//! for one axis after the other, each factor is tried with the other axes fixed, and the best is
//! kept. Two rounds. The score uses MPJPE and MAE on motions that the evaluation does not use.

use serde::Serialize;

use super::named::Named;
use super::run::{Methods, Run};
use super::summary::number;
use crate::core::cost::Stiffness;
use crate::core::tracker::Config;
use crate::io::report::Table;
use crate::metrics::PoseErrors;
use crate::metrics::statistics::mean;
use crate::research::methods::{
    Dct, DctWeights, Dmmr, DmmrWeights, Etc, EtcWeights, Filter, Method, MuVs, MuVsWeights, Slahmr,
    SlahmrWeights, Triangulation, Windows,
};
use crate::research::transition::Transition;

/// Number of passes over all axes.
const ROUNDS: usize = 2;
/// Millimetres per degree of MAE in the score.
const MM_PER_DEGREE: f64 = 2.0;
/// Score of a motion in which nobody was found.
const FAILED: f64 = 200.0;

/// A weight of a method.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    /// The name in tables.
    pub name: &'static str,
    /// The method's default.
    pub start: f64,
    /// Factors of the best value so far.
    pub factors: &'static [f64],
}

/// The methods with weights to tune.
pub const TUNABLE: [&str; 9] =
    ["triangulation", "muvs", "dct", "etc", "dmmr", "slahmr", "paper", "tuned", "default"];

const WIDE: &[f64] = &[0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0];
const NARROW: &[f64] = &[0.1, 0.3, 1.0, 3.0];
const SCALE: &[f64] = &[0.5, 1.0, 2.0, 4.0];

/// The tuned weights of a method; `None` for an unknown name.
pub fn axes(method: &str) -> Option<Vec<Axis>> {
    let all = |smoothness: Option<(&'static str, f64)>, prior: f64, scale: f64| {
        let smoothness = smoothness.map(|(name, start)| Axis { name, start, factors: WIDE });
        let prior = Axis { name: "prior", start: prior, factors: NARROW };
        let scale = Axis { name: "scale px", start: scale, factors: SCALE };
        Some(smoothness.into_iter().chain([prior, scale]).collect())
    };
    let windows = |method: &Windows| {
        let cost = method.config().cost;
        all(None, cost.prior, cost.scale_px)
    };
    let ours = |method: &Windows| {
        let robust_scale = method.config().cost.stiffness.robust_scale_px;
        let factor = |name| Axis { name, start: 1.0, factors: NARROW };
        let (latent, root) = (factor("stiffness"), factor("root stiffness"));
        let robust_scale = Axis {
            name: "robust scale px",
            start: robust_scale,
            factors: &[0.2, 0.5, 1.0, 2.0, 10.0],
        };
        windows(method).map(|plain| [latent, root, robust_scale].into_iter().chain(plain).collect())
    };
    match method {
        "triangulation" => Some(vec![
            Axis { name: "cut-off Hz", start: 6.0, factors: &[0.5, 1.0, 1.5] },
            Axis { name: "views within px", start: 15.0, factors: SCALE },
        ]),
        "muvs" => {
            let MuVsWeights { prior, scale_px, .. } = MuVsWeights::default();
            all(None, prior, scale_px)
        }
        "dct" => {
            let DctWeights { smoothness, prior, scale_px, .. } = DctWeights::default();
            all(Some(("smoothness", smoothness)), prior, scale_px)
        }
        "etc" => {
            let EtcWeights { smoothness, prior, scale_px, .. } = EtcWeights::default();
            all(Some(("smoothness", smoothness)), prior, scale_px)
        }
        "dmmr" => {
            let DmmrWeights { prior, scale_px, .. } = DmmrWeights::default();
            all(Some(("ties", 1.0)), prior, scale_px)
        }
        "slahmr" => {
            let SlahmrWeights { transition, prior, scale_px, .. } = SlahmrWeights::default();
            all(Some(("transition", transition)), prior, scale_px)
        }
        "paper" => windows(&Windows::paper()),
        "tuned" => windows(&Windows::tuned()),
        "default" => ours(&Windows::default_settings()),
        _ => None,
    }
}

/// The method with values for its [`axes`], in their order, and a name made from them.
fn with(method: &str, axes: &[Axis], values: &[f64]) -> Option<Box<dyn Method>> {
    let of = |name: &str| {
        let index = axes.iter().position(|axis| axis.name == name);
        index.and_then(|index| values.get(index)).copied().unwrap_or(1.0)
    };
    let (smoothness, prior, scale_px) = (of("smoothness"), of("prior"), of("scale px"));
    let windows = |method: Windows| {
        let config = method.config();
        let (plain, robust_scale) = (config.cost.stiffness, of("robust scale px"));
        let stiffness = Stiffness {
            robust_scale_px: if robust_scale == 1.0 { plain.robust_scale_px } else { robust_scale },
            latent: plain.latent * of("stiffness"),
            ..plain.times(of("root stiffness"))
        };
        let cost = crate::core::cost::Config { prior, scale_px, stiffness, ..config.cost };
        Box::new(method.with_config(Config { cost, ..config }))
    };
    let made: Box<dyn Method> = match method {
        "triangulation" => {
            let filter = Filter::Butterworth { cutoff_hz: of("cut-off Hz") };
            Box::new(Triangulation::new(filter, of("views within px")))
        }
        "muvs" => Box::new(MuVs::new(MuVsWeights { prior, scale_px, ..Default::default() })),
        "dct" => {
            Box::new(Dct::new(DctWeights { smoothness, prior, scale_px, ..Default::default() }))
        }
        "etc" => {
            Box::new(Etc::new(EtcWeights { smoothness, prior, scale_px, ..Default::default() }))
        }
        "dmmr" => {
            let (ties, plain) = (of("ties"), DmmrWeights::default());
            Box::new(Dmmr::new(DmmrWeights {
                latent: plain.latent * ties,
                rotation: plain.rotation * ties,
                position: plain.position * ties,
                prior,
                scale_px,
                ..plain
            }))
        }
        "slahmr" => {
            let weights = SlahmrWeights {
                transition: of("transition"),
                prior,
                scale_px,
                ..Default::default()
            };
            Box::new(Slahmr::new(weights, Transition::embedded().ok()?))
        }
        "paper" => windows(Windows::paper()),
        "tuned" => windows(Windows::tuned()),
        "default" => windows(Windows::default_settings()),
        _ => return None,
    };
    Some(Named::boxed(label(axes, values), made))
}

fn label(axes: &[Axis], values: &[f64]) -> String {
    let parts: Vec<String> =
        axes.iter().zip(values).map(|(axis, value)| format!("{} {value}", axis.name)).collect();
    parts.join(", ")
}

/// One choice of weights.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Trial {
    /// In the order of the axes.
    pub values: Vec<f64>,
    /// The name of the tuned method.
    pub name: String,
    /// The score; lower is better.
    pub judged: f64,
    /// Mean MPJPE, millimetres, by run.
    pub mpjpe_mm: Vec<Option<f64>>,
    /// Mean MAE, degrees, by run.
    pub mae_deg: Vec<Option<f64>>,
}

/// Tunes a method: `solve` solves with some methods and returns their runs, one for each noise
/// level. Returns all trials, the best first; none for an unknown name.
///
/// # Errors
/// Those of `solve`.
pub fn tune<E>(
    method: &str,
    mut solve: impl FnMut(&Methods) -> Result<Vec<Run>, E>,
) -> Result<Vec<Trial>, E> {
    let Some(axes) = axes(method) else { return Ok(Vec::new()) };
    let mut trials: Vec<Trial> = Vec::new();
    let mut best: Vec<f64> = axes.iter().map(|axis| axis.start).collect();
    for _ in 0..ROUNDS {
        for (index, axis) in axes.iter().enumerate() {
            let moved = |factor: &f64| {
                let mut values = best.clone();
                values[index] *= factor;
                values
            };
            let known = |values: &Vec<f64>| trials.iter().any(|trial| trial.values == *values);
            let new: Vec<Vec<f64>> =
                axis.factors.iter().map(moved).filter(|values| !known(values)).collect();
            let make = || new.iter().filter_map(|values| with(method, &axes, values)).collect();
            let runs = solve(&make)?;
            let judged = new.into_iter().enumerate();
            trials.extend(judged.map(|(row, values)| trial(&axes, values, row, &runs)));
            trials.sort_by(|a, b| a.judged.total_cmp(&b.judged));
            if let Some(first) = trials.first() {
                best.clone_from(&first.values);
            }
        }
    }
    Ok(trials)
}

fn trial(axes: &[Axis], values: Vec<f64>, row: usize, runs: &[Run]) -> Trial {
    let scores = |run: &Run, of: fn(&PoseErrors) -> f64| {
        let found = run.rows[row].results.iter().flatten();
        let found: Vec<f64> =
            found.filter_map(|(score, _)| Some(of(score.pose.as_ref()?))).collect();
        mean(&found)
    };
    Trial {
        name: label(axes, &values),
        values,
        judged: judge(runs, row),
        mpjpe_mm: runs.iter().map(|run| scores(run, |pose| pose.mpjpe_mm)).collect(),
        mae_deg: runs.iter().map(|run| scores(run, |pose| pose.mae_deg)).collect(),
    }
}

/// The score of a row: the mean over motions and levels of MPJPE in mm plus 2 mm per degree of MAE,
/// so that neither position nor rotation is traded for the other; the error of the limb joints in mm
/// without a body; 200 if nobody was found.
fn judge(runs: &[Run], row: usize) -> f64 {
    let results = runs.iter().flat_map(|run| &run.rows[row].results);
    let of = |result: &Option<(super::Score, super::Trace)>| {
        result.as_ref().map_or(FAILED, |(score, _)| match &score.pose {
            Some(pose) => pose.mpjpe_mm + MM_PER_DEGREE * pose.mae_deg,
            None => score.limbs.limb_mm,
        })
    };
    mean(&results.map(of).collect::<Vec<_>>()).unwrap_or(FAILED)
}

/// The table of trials.
pub fn table(title: &str, levels: &[&str], trials: &[Trial]) -> Table {
    let mut header = vec!["weights".to_owned(), "MPJPE + 2 MAE".to_owned()];
    for level in levels {
        header.extend([format!("{level}: MPJPE mm"), "MAE °".to_owned()]);
    }
    let row = |trial: &Trial| {
        let mut cells = vec![trial.name.clone(), format!("{:.2}", trial.judged)];
        for (mpjpe, mae) in trial.mpjpe_mm.iter().zip(&trial.mae_deg) {
            cells.extend([number(*mpjpe, 2), number(*mae, 2)]);
        }
        cells
    };
    Table { title: title.into(), header, rows: trials.iter().map(row).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_method_of_ours_has_axes_and_can_be_made() {
        for name in TUNABLE {
            let axes = axes(name).unwrap();
            let values: Vec<f64> = axes.iter().map(|axis| axis.start).collect();
            let made = with(name, &axes, &values).unwrap();
            assert!(made.name().contains(axes[0].name), "{}", made.name());
        }
        assert_eq!(axes("guess"), None);
    }
}
