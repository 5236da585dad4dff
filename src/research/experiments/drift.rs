//! Whether the error grows over a long take.

use serde::Serialize;

use super::run::Run;
use crate::io::report::Table;
use crate::metrics::{Interval, slope_interval};

/// Length of a block, seconds, whose mean is one value; longer than the variations of a motion.
const BLOCK_S: f64 = 20.0;
/// Minimum number of blocks.
const BLOCKS: usize = 8;

/// The trend of one method's error.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Drift {
    /// The method.
    pub method: String,
    /// Mean error over all frames, millimetres, of all joints or, where only they are compared, of
    /// the limb joints.
    pub error_mm: f64,
    /// Slope in millimetres per minute, from block means; see [`slope_interval`].
    pub slope_mm_per_min: Option<Interval>,
    /// Number of blocks.
    pub blocks: usize,
    /// Number of frames with a pose.
    pub frames: usize,
    /// Share of the frames that have a pose, percent.
    pub covered_percent: f64,
}

/// The trend of each method on the first case; methods that found nobody are omitted.
pub fn drifts(run: &Run) -> Vec<Drift> {
    let of_row = |row: &super::run::Row| {
        let (score, trace) = row.results.first()?.as_ref()?;
        let minutes: Vec<(f64, f64)> =
            trace.error_mm.iter().map(|&(at, error)| (at / 60.0, error)).collect();
        let seconds = trace.error_mm.last().map_or(0.0, |last| last.0);
        let blocks = ((seconds / BLOCK_S).round() as usize).max(BLOCKS);
        Some(Drift {
            method: row.method.clone(),
            error_mm: score.pose.as_ref().map_or(score.limbs.limb_mm, |pose| pose.mpjpe_mm),
            slope_mm_per_min: slope_interval(&minutes, blocks),
            blocks,
            frames: score.compared_frames,
            covered_percent: score.covered_percent,
        })
    };
    run.rows.iter().filter_map(of_row).collect()
}

/// The table of trends.
pub fn table(title: &str, drifts: &[Drift]) -> Table {
    let header = ["method", "frames", "error mm", "slope mm/min", "95 % interval", "grows"];
    let row = |drift: &Drift| {
        let slope = drift.slope_mm_per_min;
        let text = |value: Option<String>| value.unwrap_or_else(|| "–".into());
        vec![
            drift.method.clone(),
            drift.frames.to_string(),
            format!("{:.1}", drift.error_mm),
            text(slope.map(|slope| format!("{:+.3}", slope.value))),
            text(slope.map(|slope| format!("[{:.3}, {:.3}]", slope.low, slope.high))),
            text(slope.map(|slope| if slope.low > 0.0 { "yes" } else { "no" }.into())),
        ]
    };
    Table {
        title: title.into(),
        header: header.map(str::to_owned).into(),
        rows: drifts.iter().map(row).collect(),
    }
}
