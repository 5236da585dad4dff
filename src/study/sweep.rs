//! Grids of weights by method, so that each is tuned by the same rule.

use super::run::Run;
use super::score::Score;
use super::summary::number;
use crate::baseline::{Method, Windows};
use crate::export::Table;
use crate::track::Config;

/// Weights of the prior and scales of the loss, pixels, that every method is tried with.
const PRIORS: [f64; 5] = [10.0, 30.0, 100.0, 300.0, 1000.0];
const SCALES_PX: [f64; 4] = [15.0, 30.0, 50.0, 100.0];

/// A method with each of the weights of its grid, named by them; `None` for a name without a
/// grid.
pub fn grid(method: &str) -> Option<Vec<Box<dyn Method>>> {
    let base = match method {
        "paper" => Windows::paper(),
        "default" => Windows::default_settings(),
        _ => return None,
    };
    let config = base.config();
    let all = PRIORS.into_iter().flat_map(|prior| SCALES_PX.map(|scale| (prior, scale)));
    let row = |(prior, scale_px): (f64, f64)| {
        let cost = crate::cost::Config { prior, scale_px, ..config.cost };
        let name = format!("prior {prior}, scale {scale_px} px");
        Box::new(Windows::new(&name, Config { cost, ..config })) as Box<dyn Method>
    };
    Some(all.map(row).collect())
}

/// The names that [`grid`] knows.
pub const TUNED: [&str; 2] = ["paper", "default"];

/// What a choice of weights is judged by: the mean over the runs of MPJPE in mm plus 2 mm a
/// degree of MAE, so that neither places nor twists are bought with the other; and a failure
/// counts as 200. One value for each method.
pub fn judged(runs: &[Run]) -> Vec<f64> {
    let of = |result: Option<&Score>| result.map_or(200.0, |s| s.mpjpe_mm + 2.0 * s.mae_deg);
    let count = runs.first().map_or(0, |run| run.rows.len());
    let judge = |method: usize| {
        let results = runs.iter().flat_map(|run| &run.rows[method].results);
        let values: Vec<f64> =
            results.map(|result| of(result.as_ref().map(|(score, _)| score))).collect();
        values.iter().sum::<f64>() / values.len().max(1) as f64
    };
    (0..count).map(judge).collect()
}

/// The table, the best first: the judgement, then the mean MPJPE and MAE of each run.
pub fn table(title: &str, levels: &[&str], runs: &[Run]) -> Table {
    let judged = judged(runs);
    let mut order: Vec<usize> = (0..judged.len()).collect();
    order.sort_by(|&a, &b| judged[a].total_cmp(&judged[b]));
    let mut header = vec!["weights".to_owned(), "MPJPE + 2 MAE".to_owned()];
    for level in levels {
        header.push(format!("{level}: MPJPE mm"));
        header.push("MAE °".to_owned());
    }
    let row = |method: usize| {
        let name = runs.first().map_or_else(String::new, |run| run.rows[method].method.clone());
        let mut cells = vec![name, format!("{:.2}", judged[method])];
        for run in runs {
            let mean = |of: fn(&Score) -> f64| {
                let found = run.rows[method].results.iter().flatten();
                let values: Vec<f64> = found.map(|(score, _)| of(score)).collect();
                crate::eval::statistics::mean(&values)
            };
            cells.push(number(mean(|s| s.mpjpe_mm), 2));
            cells.push(number(mean(|s| s.mae_deg), 2));
        }
        cells
    };
    Table { title: title.into(), header, rows: order.into_iter().map(row).collect() }
}
