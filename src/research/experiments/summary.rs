//! Means over sequences, and the significance of differences between methods.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::{Value, json};

use super::run::{Row, Run};
use super::score::Score;
use crate::io::report::Table;
use crate::metrics::{Interval, mean_interval};
use crate::research::methods::Delay;

/// A column of the table.
pub struct Metric {
    /// Field in results.json.
    pub key: &'static str,
    /// Heading, with the unit.
    pub title: &'static str,
    /// Digits after the point.
    pub digits: usize,
    /// The value for a sequence.
    pub of: fn(&Score) -> Option<f64>,
}

/// The metrics, in the order of the columns.
pub const METRICS: [Metric; 11] = [
    Metric { key: "mpjpe_mm", title: "MPJPE mm", digits: 1, of: |s| Some(s.pose.mpjpe_mm) },
    Metric {
        key: "mpjpe_root_relative_mm",
        title: "root-rel. mm",
        digits: 1,
        of: |s| Some(s.pose.mpjpe_root_relative_mm),
    },
    Metric { key: "rmse_mm", title: "RMSE mm", digits: 1, of: |s| Some(s.pose.rmse_mm) },
    Metric { key: "mae_deg", title: "MAE °", digits: 2, of: |s| Some(s.pose.mae_deg) },
    Metric { key: "pck3_percent", title: "PCK@3 %", digits: 1, of: |s| Some(s.pose.pck3_percent) },
    Metric { key: "pck7_percent", title: "PCK@7 %", digits: 1, of: |s| Some(s.pose.pck7_percent) },
    Metric {
        key: "acceleration_error_m_s2",
        title: "accel. err. m/s²",
        digits: 1,
        of: |s| Some(s.acceleration_error_m_s2),
    },
    Metric {
        key: "velocity_jump_border_m_s",
        title: "jump at border m/s",
        digits: 3,
        of: |s| s.velocity_jump.map(|jump| jump.border_m_s),
    },
    Metric {
        key: "velocity_jump_inside_m_s",
        title: "inside m/s",
        digits: 3,
        of: |s| s.velocity_jump.map(|jump| jump.inside_m_s),
    },
    Metric {
        key: "foot_skate_mm_s",
        title: "skate mm/s",
        digits: 0,
        of: |s| s.foot_skate.map(|skate| skate.mm_s),
    },
    Metric { key: "ms_per_frame", title: "ms/frame", digits: 2, of: |s| Some(s.ms_per_frame) },
];

/// The metrics with differences: the five of the paper's table, root-relative MPJPE and the
/// acceleration error.
const COMPARED: usize = 7;

/// The means of one method.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// The method.
    pub method: String,
    /// Delay of a pose in frames; `None` until the recording's end.
    pub delay_frames: Option<usize>,
    /// Number of sequences in which nobody was found; all means leave these out.
    pub failed: usize,
    /// Mean over the sequences, by [`Metric::key`].
    pub mean: BTreeMap<&'static str, f64>,
    /// Mean jump at borders divided by that elsewhere.
    pub velocity_jump_ratio: Option<f64>,
    /// Mean difference from the reference method over the same sequences, with the 95 % interval of
    /// the paired t test.
    pub difference: BTreeMap<&'static str, Interval>,
}

/// The means of all methods, and their differences from method `against`, by index.
pub fn summaries(run: &Run, against: usize) -> Vec<Summary> {
    let common = run.common();
    let reference = common.get(against).cloned().unwrap_or_default();
    let each = run.rows.iter().zip(&common);
    each.map(|(row, scores)| summary(row, scores, &reference)).collect()
}

fn summary(row: &Row, scores: &[&Score], reference: &[&Score]) -> Summary {
    let mut mean = BTreeMap::new();
    for metric in &METRICS {
        let values: Vec<f64> = scores.iter().copied().filter_map(metric.of).collect();
        if !values.is_empty() {
            mean.insert(metric.key, values.iter().sum::<f64>() / values.len() as f64);
        }
    }
    let difference = |metric: &Metric| {
        let pairs = scores.iter().zip(reference);
        let values: Vec<f64> =
            pairs.filter_map(|(a, b)| Some((metric.of)(a)? - (metric.of)(b)?)).collect();
        Some((metric.key, mean_interval(&values)?))
    };
    let jump = |key| mean.get(key).copied();
    Summary {
        method: row.method.clone(),
        delay_frames: match row.delay {
            Delay::Frames(frames) => Some(frames),
            Delay::Recording => None,
        },
        failed: row.failed(),
        velocity_jump_ratio: jump("velocity_jump_border_m_s")
            .zip(jump("velocity_jump_inside_m_s"))
            .map(|(at, inside)| at / inside),
        difference: METRICS[..COMPARED].iter().filter_map(difference).collect(),
        mean,
    }
}

/// The table of means.
pub fn table(title: &str, summaries: &[Summary]) -> Table {
    let shown: Vec<&Metric> =
        METRICS.iter().filter(|metric| !metric.key.starts_with("velocity_jump")).collect();
    let mut header = vec!["method".to_owned(), "delay".to_owned()];
    header.extend(shown.iter().map(|metric| metric.title.to_owned()));
    header.push("jump ratio".into());
    let failed = summaries.iter().any(|summary| summary.failed > 0);
    if failed {
        header.push("failed".into());
    }
    let row = |summary: &Summary| {
        let delay = summary.delay_frames.map_or("all".into(), |frames| frames.to_string());
        let mut cells = vec![summary.method.clone(), delay];
        let mean = |metric: &&Metric| number(summary.mean.get(metric.key).copied(), metric.digits);
        cells.extend(shown.iter().map(mean));
        cells.push(number(summary.velocity_jump_ratio, 2));
        if failed {
            cells.push(summary.failed.to_string());
        }
        cells
    };
    Table { title: title.into(), header, rows: summaries.iter().map(row).collect() }
}

/// The table of differences from one method.
pub fn differences(against: &str, summaries: &[Summary]) -> Table {
    let shown = &METRICS[..COMPARED];
    let mut header = vec!["method".to_owned()];
    header.extend(shown.iter().map(|metric| metric.title.to_owned()));
    let row = |summary: &Summary| {
        let mut cells = vec![summary.method.clone()];
        cells.extend(shown.iter().map(|metric| {
            let interval = summary.difference.get(metric.key);
            interval.map_or("–".into(), |interval| with_interval(interval, metric.digits))
        }));
        cells
    };
    let others = summaries.iter().filter(|summary| summary.method != against);
    Table {
        title: format!("Difference from {against}, with its 95 % interval (paired over sequences)"),
        header,
        rows: others.map(row).collect(),
    }
}

/// A value and its interval, such as `+1.2 [0.8, 1.6]`.
pub fn with_interval(interval: &Interval, digits: usize) -> String {
    let Interval { value, low, high } = interval;
    format!("{value:+.digits$} [{low:.digits$}, {high:.digits$}]")
}

/// A number, or a dash.
pub fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("–".into(), |value| format!("{value:.digits$}"))
}

/// All results: means, differences and each sequence.
pub fn to_json(run: &Run, summaries: &[Summary]) -> Value {
    let methods: Vec<Value> = run
        .rows
        .iter()
        .zip(summaries)
        .map(|(row, summary)| {
            let sequences = run.cases.iter().zip(&row.results).map(|(case, result)| {
                json!({
                    "sequence": case.sequence,
                    "seed": case.seed,
                    "score": result.as_ref().map(|(score, _)| score),
                })
            });
            let sequences: Vec<Value> = sequences.collect();
            json!({ "summary": summary, "sequences": sequences })
        })
        .collect();
    Value::from(methods)
}

/// A table as Markdown, with its heading.
pub fn markdown(table: &Table) -> String {
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let rule: String =
        (0..table.header.len()).map(|column| if column == 0 { "|---" } else { "|---:" }).collect();
    let rows: String = table.rows.iter().map(|row| line(row)).collect();
    format!("## {}\n\n{}{rule}|\n{rows}", table.title, line(&table.header))
}

/// A table as text in columns; the first is left-aligned.
pub fn text(table: &Table) -> String {
    let all = || std::iter::once(&table.header).chain(&table.rows);
    let width = |column: usize| {
        all().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..table.header.len()).map(width).collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().zip(&widths).enumerate().map(|(column, (cell, &width))| {
            let gap = " ".repeat(width - cell.chars().count());
            if column == 0 { format!("{cell}{gap}") } else { format!("{gap}{cell}") }
        });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    };
    let lines: Vec<String> = all().map(line).collect();
    format!("{}\n{}", table.title, lines.join("\n"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::PoseErrors;
    use crate::research::experiments::case::CaseName;
    use crate::research::experiments::score::Trace;

    fn score(mpjpe_mm: f64) -> Score {
        Score {
            pose: PoseErrors { frames: 10, mpjpe_mm, ..PoseErrors::default() },
            covered_percent: 100.0,
            acceleration_error_m_s2: 0.0,
            velocity_jump: None,
            foot_skate: None,
            ms_per_frame: 1.0,
        }
    }

    fn row(method: &str, results: [Option<f64>; 4]) -> Row {
        let results = results.map(|mpjpe| mpjpe.map(|mpjpe| (score(mpjpe), Trace::default())));
        Row { method: method.into(), delay: Delay::Frames(10), results: results.into() }
    }

    #[test]
    fn means_are_over_what_all_solved_and_differences_are_paired() {
        let rows = vec![
            row("a", [Some(10.0), Some(20.0), Some(90.0), Some(30.0)]),
            row("b", [Some(11.0), Some(22.0), None, Some(33.0)]),
        ];
        let case = |index: u64| CaseName { sequence: index.to_string(), seed: index };
        let run = Run { cases: (0..4).map(case).collect(), rows };
        let summaries = summaries(&run, 0);
        assert_eq!(summaries[0].mean["mpjpe_mm"], 20.0);
        assert_eq!((summaries[0].failed, summaries[1].failed), (0, 1));
        let difference = summaries[1].difference["mpjpe_mm"];
        assert!((difference.value - 2.0).abs() < 1e-12);
        // s = 1 for the differences 1, 2, 3; t(2) = 4.3027.
        assert!((difference.high - 2.0 - 4.3027 / 3f64.sqrt()).abs() < 1e-3);
        let text = text(&table("t", &summaries));
        assert!(text.lines().nth(1).is_some_and(|line| line.ends_with("failed")), "{text}");
        assert!(markdown(&differences("a", &summaries)).contains("| b | +2.0 [-0.5, 4.5] |"));
    }
}
