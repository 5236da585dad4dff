//! The plots of a run.

use super::run::{Row, Run};
use super::score::{Heights, REACH, Trace};
use super::summary::Summary;
use crate::io::report::{Bars, Plot, Series};
use crate::metrics::{ConfidenceBin, DetectorStatistics};

/// The limb joint of the path plot: the left wrist.
const SHOWN: usize = 4;
/// Length of the shown path, seconds.
const SHOWN_S: f64 = 2.0;
/// Number of frames in the moving mean of the error.
const SMOOTHED: usize = 5;

/// Bars of a mean by method, one series for each level, given as name and means.
pub fn bars(title: &str, label: &str, key: &str, levels: &[(&str, &[Summary])]) -> Bars {
    let Some((_, first)) = levels.first() else { return Bars::default() };
    let value = |summaries: &[Summary], index: usize| {
        summaries.get(index).and_then(|s| s.mean.get(key)).copied().unwrap_or(f64::NAN)
    };
    let mut groups: Vec<(String, Vec<f64>)> = first
        .iter()
        .enumerate()
        .map(|(index, summary)| {
            let values = levels.iter().map(|(_, summaries)| value(summaries, index));
            (summary.method.clone(), values.collect())
        })
        .collect();
    let last = |values: &[f64]| values.last().copied().unwrap_or(f64::NAN);
    groups.sort_by(|a, b| last(&b.1).total_cmp(&last(&a.1)));
    Bars {
        title: title.into(),
        note: "Mean over the sequences; the worst of the last level first.".into(),
        label: label.into(),
        series: levels.iter().map(|(name, _)| (*name).to_owned()).collect(),
        groups,
    }
}

/// Error over time of every method on one case.
pub fn errors(run: &Run, case: usize) -> Plot {
    let series = traces(run, case).map(|(index, row, trace)| {
        let points = trace.error_mm.chunks(SMOOTHED).map(mean_point).collect();
        curve(&row.method, index, points)
    });
    Plot {
        title: "Error over time".into(),
        note: format!("Mean over the joints, {SMOOTHED} frames averaged; {}.", name(run, case)),
        x_label: "time (s)".into(),
        y_label: "error (mm)".into(),
        series: series.collect(),
        ..Plot::default()
    }
}

/// Velocity jumps near borders, over all cases.
pub fn borders(run: &Run) -> Plot {
    let series = run.rows.iter().enumerate().filter_map(|(index, row)| {
        let mut sums = [(0.0, 0usize); 2 * REACH + 1];
        for (_, trace) in row.results.iter().flatten() {
            for (sum, more) in sums.iter_mut().zip(&trace.around_borders) {
                *sum = (sum.0 + more.0, sum.1 + more.1);
            }
        }
        let point = |(slot, (sum, count)): (usize, &(f64, usize))| {
            (*count > 0).then(|| (slot as f64 - REACH as f64, sum / *count as f64))
        };
        let points: Vec<(f64, f64)> = sums.iter().enumerate().filter_map(point).collect();
        (!points.is_empty()).then(|| curve(&row.method, index, points))
    });
    Plot {
        title: "Velocity jump around borders".into(),
        note: "Mean |v(t+) - v(t-)| of the joints by frames from a border; a peak at 0 is a kink."
            .into(),
        x_label: "frames from the border".into(),
        y_label: "jump (m/s)".into(),
        series: series.collect(),
        ..Plot::default()
    }
}

/// The height of a wrist on one case: the truth and the named methods.
pub fn path(run: &Run, case: usize, truth: &[(f64, Heights)], methods: &[&str]) -> Plot {
    let (from, to) = liveliest(truth);
    let part = |points: &[(f64, Heights)]| -> Vec<(f64, f64)> {
        let inside = points.iter().filter(|(at, _)| (from..=to).contains(at));
        inside.filter_map(|(at, heights)| Some((*at, f64::from(heights[SHOWN]?)))).collect()
    };
    let mut series = vec![Series {
        name: "truth".into(),
        points: part(truth),
        dashed: true,
        colour: 6,
        ..Series::default()
    }];
    let chosen = traces(run, case).filter(|(_, row, _)| methods.contains(&row.method.as_str()));
    series
        .extend(chosen.map(|(index, row, trace)| curve(&row.method, index, part(&trace.heights))));
    Plot {
        title: "Height of the left wrist".into(),
        note: format!("The {SHOWN_S} s with the most movement in {}.", name(run, case)),
        x_label: "time (s)".into(),
        y_label: "height (m)".into(),
        series,
        ..Plot::default()
    }
}

/// The section in which the joint's height changes most.
fn liveliest(truth: &[(f64, Heights)]) -> (f64, f64) {
    let (mut best, mut start) = (f32::NEG_INFINITY, 0);
    let mut end = 0;
    for first in 0..truth.len() {
        while end < truth.len() && truth[end].0 <= truth[first].0 + SHOWN_S {
            end += 1;
        }
        let step = |p: &[(f64, Heights)]| Some((p[1].1[SHOWN]? - p[0].1[SHOWN]?).abs());
        let travel: f32 = truth[first..end].windows(2).filter_map(step).sum();
        if travel > best {
            (best, start) = (travel, first);
        }
    }
    truth.get(start).map_or((0.0, 0.0), |(at, _)| (*at, at + SHOWN_S))
}

fn traces(run: &Run, case: usize) -> impl Iterator<Item = (usize, &Row, &Trace)> {
    run.rows.iter().enumerate().filter_map(move |(index, row)| {
        let (_, trace) = row.results.get(case)?.as_ref()?;
        Some((index, row, trace))
    })
}

fn curve(name: &str, colour: usize, points: Vec<(f64, f64)>) -> Series {
    Series { name: name.into(), points, colour, ..Series::default() }
}

fn name(run: &Run, case: usize) -> &str {
    run.cases.get(case).map_or("", |case| &case.sequence)
}

/// Spectrum of the detectors' errors by level.
pub fn detector_spectrum(levels: &[(&str, &DetectorStatistics)]) -> Plot {
    let series = levels.iter().enumerate().map(|(index, (name, statistics))| {
        let spectrum = statistics.spectrum.iter().filter(|(hz, _)| *hz > 0.0);
        curve(name, index, spectrum.copied().collect())
    });
    Plot {
        title: "Jitter of the detectors".into(),
        note: "Power of the distances from the body's points, as fractions of its height.".into(),
        x_label: "frequency (Hz)".into(),
        y_label: "power (1/Hz)".into(),
        series: series.collect(),
        log: true,
        ..Plot::default()
    }
}

/// Error of the detectors by confidence, by level.
pub fn detector_confidence(levels: &[(&str, &DetectorStatistics)]) -> Plot {
    let series = levels.iter().enumerate().map(|(index, (name, statistics))| {
        let bins = statistics.by_confidence.iter().filter(|bin| bin.share > 1e-3);
        let point =
            |bin: &ConfidenceBin| (0.5 * (bin.range[0] + bin.range[1]), 100.0 * bin.median_error);
        curve(name, index, bins.map(point).collect())
    });
    Plot {
        title: "Error of the detectors by confidence".into(),
        note: "Median distance from the body's point, in bins with over 0.1 % of the points."
            .into(),
        x_label: "confidence".into(),
        y_label: "error (% of height)".into(),
        series: series.collect(),
        ..Plot::default()
    }
}

/// Error over a long take, means over one second, of every method.
pub fn long_errors(run: &Run, fps: f64) -> Plot {
    let second = fps.round().max(1.0) as usize;
    let series = traces(run, 0).map(|(index, row, trace)| {
        curve(&row.method, index, trace.error_mm.chunks(second).map(mean_point).collect())
    });
    Plot {
        title: "Error over a long take".into(),
        note: "Mean over the joints, averaged over one second.".into(),
        x_label: "time (min)".into(),
        y_label: "error (mm)".into(),
        series: series
            .map(|mut series| {
                series.points.iter_mut().for_each(|point| point.0 /= 60.0);
                series
            })
            .collect(),
        ..Plot::default()
    }
}

/// Means of every method over a value that is varied: the limb joints, and held-out cameras.
pub fn over(x_label: &str, points: &[(f64, Vec<Summary>)]) -> Vec<Plot> {
    let Some((_, methods)) = points.first() else { return Vec::new() };
    let plot = |title: &str, y_label: &str, key: &str| Plot {
        title: format!("{title} by {x_label}"),
        note: "Mean over the sequences.".into(),
        x_label: x_label.into(),
        y_label: y_label.into(),
        series: (methods.iter().enumerate())
            .map(|(index, summary)| {
                let mean = |rows: &[Summary]| rows[index].mean.get(key).copied();
                let point = |(x, rows): &(f64, Vec<Summary>)| (*x, mean(rows).unwrap_or(f64::NAN));
                curve(&summary.method, index, points.iter().map(point).collect())
            })
            .collect(),
        ..Plot::default()
    };
    vec![
        plot("Error of the limb joints", "error (mm)", "limb_mm"),
        plot("Error in held-out cameras", "error (px)", "held_out_px"),
    ]
}

fn mean_point(group: &[(f64, f64)]) -> (f64, f64) {
    let n = group.len() as f64;
    let sum = group.iter().fold((0.0, 0.0), |sum, point| (sum.0 + point.0, sum.1 + point.1));
    (sum.0 / n, sum.1 / n)
}
