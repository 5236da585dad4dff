//! Means over sequences, and the significance of differences between methods.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use serde_json::{Value, json};

use super::run::{Row, Run, Scored};
use super::score::Score;
use crate::io::report::Table;
use crate::metrics::statistics::mean;
use crate::metrics::{Interval, PoseErrors, SEGMENTS, mean_interval};
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

/// A metric of all joints, which only results with a body of ours have.
fn pose(score: &Score, of: fn(&PoseErrors) -> f64) -> Option<f64> {
    score.pose.as_ref().map(of)
}

const fn metric(
    key: &'static str,
    title: &'static str,
    digits: usize,
    of: fn(&Score) -> Option<f64>,
) -> Metric {
    Metric { key, title, digits, of }
}

/// The metrics, in the order of the columns.
pub const METRICS: [Metric; 22] = [
    metric("limb_mm", "limb joints mm", 1, |s| Some(s.limbs.limb_mm)),
    metric("held_out_px", "held out px", 2, |s| s.held_out_px),
    metric("mpjpe_mm", "MPJPE mm", 1, |s| pose(s, |pose| pose.mpjpe_mm)),
    metric("rmse_mm", "RMSE mm", 1, |s| pose(s, |pose| pose.rmse_mm)),
    metric("mae_deg", "MAE °", 2, |s| pose(s, |pose| pose.mae_deg)),
    metric("pck3_percent", "PCK@3 %", 1, |s| pose(s, |pose| pose.pck3_percent)),
    metric("pck7_percent", "PCK@7 %", 1, |s| pose(s, |pose| pose.pck7_percent)),
    metric("limb_acceleration_error_m_s2", "accel. err. m/s²", 1, |s| {
        s.limbs.limb_acceleration_error_m_s2
    }),
    metric("velocity_jump_excess_m_s", "border excess m/s", 3, |s| {
        s.velocity_jump.map(|jump| jump.excess_m_s)
    }),
    metric("limb_slow_mm", "slow mm", 1, |s| s.limbs.limb_by_speed_mm[0]),
    metric("limb_medium_mm", "medium mm", 1, |s| s.limbs.limb_by_speed_mm[1]),
    metric("limb_fast_mm", "fast mm", 1, |s| s.limbs.limb_by_speed_mm[2]),
    metric("foot_skate_mm_s", "skate mm/s", 0, |s| s.foot_skate.map(|skate| skate.mm_s)),
    metric("true_foot_skate_mm_s", "true skate mm/s", 0, |s| s.foot_skate?.truth_mm_s),
    metric("mpjpe_root_relative_mm", "root-rel. mm", 1, |s| {
        pose(s, |pose| pose.mpjpe_root_relative_mm)
    }),
    metric("within_1_percent", "in 1 sd %", 0, |s| {
        Some(s.pose.as_ref()?.coverage?.within_1_percent)
    }),
    metric("within_2_percent", "in 2 sd %", 0, |s| {
        Some(s.pose.as_ref()?.coverage?.within_2_percent)
    }),
    metric("not_followed_percent", "not followed %", 3, |s| Some(s.not_followed.as_ref()?.percent)),
    metric("not_followed_frames", "longest, frames", 1, |s| {
        Some(s.not_followed.as_ref()?.longest_frames as f64)
    }),
    metric("limb_less_offset_mm", "limbs less offset mm", 1, |s| s.limb_less_offset_mm),
    metric("segment_error_mm", "bones mm", 1, |s| {
        let lengths = s.segments_mm?;
        mean(&lengths.map(f64::abs))
    }),
    metric("ms_per_frame", "ms/frame", 2, |s| Some(s.ms_per_frame)),
];

/// The first metrics, which have differences: limb joints, held-out cameras, the five of the paper's
/// table, and the acceleration error.
const COMPARED: usize = 8;

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
    /// Mean difference from the reference method over the same sequences, with the 95 % interval of
    /// the paired t test over the means of the subjects: sequences of one subject are alike. Empty
    /// for one subject.
    pub difference: BTreeMap<&'static str, Interval>,
}

/// The means of all methods, and their differences from method `against`, by index.
pub fn summaries(run: &Run, against: usize) -> Vec<Summary> {
    let common = run.common();
    let reference = common.get(against).cloned().unwrap_or_default();
    let each = run.rows.iter().zip(&common);
    each.map(|(row, scores)| summary(row, scores, &reference)).collect()
}

/// The interval of paired differences, over the means of the subjects.
fn over_subjects<'a>(values: impl Iterator<Item = (&'a str, f64)>) -> Option<Interval> {
    let mut subjects = BTreeMap::<&str, Vec<f64>>::new();
    values.for_each(|(subject, value)| subjects.entry(subject).or_default().push(value));
    let means: Vec<f64> = subjects.values().filter_map(|values| mean(values)).collect();
    mean_interval(&means)
}

fn summary(row: &Row, scores: &[Scored], reference: &[Scored]) -> Summary {
    let mut means = BTreeMap::new();
    for metric in &METRICS {
        let values: Vec<f64> = scores.iter().filter_map(|(_, score)| (metric.of)(score)).collect();
        means.extend(mean(&values).map(|mean| (metric.key, mean)));
    }
    let difference = |metric: &Metric| {
        let pairs = scores.iter().zip(reference);
        let values = pairs.filter_map(|((subject, a), (_, b))| {
            Some((*subject, (metric.of)(a)? - (metric.of)(b)?))
        });
        Some((metric.key, over_subjects(values)?))
    };
    Summary {
        method: row.method.clone(),
        delay_frames: match row.delay {
            Delay::Frames(frames) => Some(frames),
            Delay::Recording => None,
        },
        failed: row.failed(),
        difference: METRICS[..COMPARED].iter().filter_map(difference).collect(),
        mean: means,
    }
}

/// The table of means.
pub fn table(title: &str, summaries: &[Summary]) -> Table {
    let mut header = vec!["method".to_owned(), "delay".to_owned()];
    header.extend(METRICS.iter().map(|metric| metric.title.to_owned()));
    let failed = summaries.iter().any(|summary| summary.failed > 0);
    if failed {
        header.push("failed".into());
    }
    let row = |summary: &Summary| {
        let delay = summary.delay_frames.map_or("all".into(), |frames| frames.to_string());
        let mut cells = vec![summary.method.clone(), delay];
        let mean = |metric: &Metric| number(summary.mean.get(metric.key).copied(), metric.digits);
        cells.extend(METRICS.iter().map(mean));
        if failed {
            cells.push(summary.failed.to_string());
        }
        cells
    };
    Table { title: title.into(), header, rows: summaries.iter().map(row).collect() }
}

/// Lengths of bones of each true body that has a name, less the true ones: mean over the body's cases,
/// and half of the range. `None` without such a body.
pub fn segments(title: &str, run: &Run) -> Option<Table> {
    let bodies: BTreeSet<&String> =
        run.cases.iter().filter_map(|case| case.body.as_ref()).collect();
    let mut header = vec!["body".to_owned(), "cases".to_owned(), "method".to_owned()];
    header.extend(SEGMENTS.map(|(segment, _)| format!("{segment} mm")));
    let mut rows = Vec::new();
    for body in &bodies {
        for row in &run.rows {
            let cases = run.cases.iter().zip(&row.results);
            let of_body = cases.filter(|(case, _)| case.body.as_ref() == Some(body));
            let errors = of_body.filter_map(|(_, result)| result.as_ref()?.0.segments_mm);
            let errors: Vec<[f64; SEGMENTS.len()]> = errors.collect();
            let mut cells = vec![body.to_string(), errors.len().to_string(), row.method.clone()];
            cells.extend((0..SEGMENTS.len()).map(|segment| {
                let errors: Vec<f64> = errors.iter().map(|errors| errors[segment]).collect();
                let low = errors.iter().copied().fold(f64::MAX, f64::min);
                let high = errors.iter().copied().fold(f64::MIN, f64::max);
                mean(&errors)
                    .map_or("–".into(), |mean| format!("{mean:+.0} ± {:.0}", (high - low) / 2.0))
            }));
            rows.push(cells);
        }
    }
    (!rows.is_empty()).then(|| Table { title: title.into(), header, rows })
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
        title: format!(
            "Difference from {against}, with its 95 % interval (paired, over the means of the subjects)"
        ),
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
                    "subject": case.subject,
                    "body": case.body,
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
    use crate::metrics::LimbErrors;
    use crate::research::experiments::case::CaseName;
    use crate::research::experiments::score::Trace;

    fn score(mpjpe_mm: f64) -> Score {
        Score {
            not_followed: None,
            limbs: LimbErrors::default(),
            limb_less_offset_mm: None,
            segments_mm: None,
            held_out_px: None,
            pose: Some(PoseErrors { frames: 10, mpjpe_mm, ..PoseErrors::default() }),
            compared_frames: 10,
            covered_percent: 100.0,
            acceleration_error_m_s2: None,
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
        // The difference of a subject with two sequences counts once.
        let case = |index: u64| CaseName {
            sequence: index.to_string(),
            body: None,
            subject: ["x", "y", "y", "y"][index as usize].into(),
            seed: index,
        };
        let run = Run { cases: (0..4).map(case).collect(), rows };
        let summaries = summaries(&run, 0);
        assert_eq!(summaries[0].mean["mpjpe_mm"], 20.0);
        assert_eq!((summaries[0].failed, summaries[1].failed), (0, 1));
        let difference = summaries[1].difference["mpjpe_mm"];
        // 1 of x, the mean of 2 and 3 of y; s = 1.5 / sqrt(2), t(1) = 12.706.
        assert!((difference.value - 1.75).abs() < 1e-12);
        assert!((difference.high - 1.75 - 12.706 * 0.75).abs() < 1e-2);
        let text = text(&table("t", &summaries));
        assert!(text.lines().nth(1).is_some_and(|line| line.ends_with("failed")), "{text}");
        assert!(markdown(&differences("a", &summaries)).contains("| +1.8 [-7.8, 11.3] |"));
    }
}
