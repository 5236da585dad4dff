//! Errors of the live tracker against its latency.

use super::summary::Summary;
use crate::io::report::{Plot, Series};

/// The plotted metrics: key of the mean, title and label of the axis.
const PLOTTED: [(&str, &str, &str); 4] = [
    ("mpjpe_mm", "Error by latency", "MPJPE (mm)"),
    ("limb_mm", "Error of the limb joints by latency", "error (mm)"),
    ("limb_acceleration_error_m_s2", "Acceleration error by latency", "acceleration error (m/s²)"),
    (
        "velocity_jump_excess_m_s",
        "Velocity jump at borders by latency",
        "excess over the truth (m/s)",
    ),
];

/// A plot of each metric against the latency, in milliseconds. A level is its name and summaries: one
/// of provisional poses, at latency 0, then one of each latency.
pub fn plots(latencies_ms: &[f64], levels: &[(&str, Vec<Summary>)]) -> Vec<Plot> {
    let curve = |key: &str, (colour, (name, rows)): (usize, &(&str, Vec<Summary>))| {
        let at = std::iter::once(0.0).chain(latencies_ms.iter().copied());
        let mut points: Vec<(f64, f64)> =
            at.zip(rows).filter_map(|(ms, row)| Some((ms, *row.mean.get(key)?))).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        Series { name: (*name).to_owned(), points, colour, ..Series::default() }
    };
    let plot = |(key, title, label): (&str, &str, &str)| Plot {
        title: title.into(),
        note: "Mean over the sequences; at 0 the provisional poses.".into(),
        x_label: "declared latency (ms)".into(),
        y_label: label.into(),
        series: levels.iter().enumerate().map(|level| curve(key, level)).collect(),
        ..Plot::default()
    };
    PLOTTED
        .map(plot)
        .into_iter()
        .filter(|plot| plot.series.iter().any(|s| !s.points.is_empty()))
        .collect()
}
