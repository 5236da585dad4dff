//! A Prometheus endpoint, `GET /metrics`, that shows the last status of the core.
//! `docs/monitoring.md` lists the metrics.

use std::fmt;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, text};
use prometheus_client::metrics::MetricType;
use prometheus_client::registry::Registry;

use super::process::Usage;
use crate::io::wire::{
    CameraCounters, EffortStatus, PlayoutCounters, StagePerformer, StageStatus, Status,
    WindowCounters,
};

/// Input of one page of metrics.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// The last status of the core, if there is one.
    pub status: Option<Status>,
    /// Who is there, if that is known.
    pub stage: Option<StageStatus>,
    /// Messages that could not be published.
    pub failures: u64,
    /// Resources of this process, if the system reports them.
    pub usage: Option<Usage>,
}

impl Snapshot {
    /// As OpenMetrics text.
    ///
    /// # Errors
    /// In practice none: writing into a string cannot fail.
    pub fn render(self) -> Result<String, fmt::Error> {
        let mut registry = Registry::default();
        registry.register_collector(Box::new(self));
        let mut out = String::new();
        text::encode(&mut out, &registry)?;
        Ok(out)
    }
}

impl Collector for Snapshot {
    fn encode(&self, encoder: DescriptorEncoder) -> fmt::Result {
        let mut sheet = Sheet(encoder);
        let version = ("version", env!("CARGO_PKG_VERSION"));
        sheet.gauges("bundlemocap_info", "The program", &[(vec![version], 1.0)])?;
        sheet.counter(
            "bundlemocap_publish_failures",
            "Messages that could not be published",
            self.failures,
        )?;
        if let Some(usage) = self.usage {
            let help = "User and system time";
            sheet.counters("process_cpu_seconds", help, &[(vec![], usage.cpu_s)])?;
            let bytes = usage.resident_bytes as f64;
            sheet.gauge("process_resident_memory_bytes", "Resident memory", bytes)?;
        }
        self.status.as_ref().map_or(Ok(()), |status| sheet.status(status))?;
        self.stage.as_ref().map_or(Ok(()), |stage| sheet.stage(stage))
    }
}

/// Rows of a metric: labels and a value.
type Rows<'a> = [(Vec<(&'a str, &'a str)>, f64)];

struct Sheet<'a>(DescriptorEncoder<'a>);

impl Sheet<'_> {
    fn status(&mut self, status: &Status) -> fmt::Result {
        let state = ("state", status.tracker_state.as_str());
        self.gauges("bundlemocap_tracker_state", "State of the tracker", &[(vec![state], 1.0)])?;
        let latency = status.declared_latency_ns as f64 / 1e9;
        self.gauge("bundlemocap_declared_latency_seconds", "Declared latency", latency)?;
        let help = "Messages dropped by the full queue";
        self.counter("bundlemocap_queue_dropped", help, status.queue_dropped)?;
        let events: Vec<_> = (status.events.iter())
            .map(|event| (vec![("kind", event.kind.as_str())], event.count as f64))
            .collect();
        self.counters("bundlemocap_events", "Events by kind", &events)?;
        self.cameras(&status.cameras)?;
        self.windows(&status.windows.clone().unwrap_or_default())?;
        self.playout(&status.playout.clone().unwrap_or_default())?;
        self.effort(&status.effort.unwrap_or_default())
    }

    fn cameras(&mut self, cameras: &[CameraCounters]) -> fmt::Result {
        let frames: Vec<_> = (cameras.iter())
            .flat_map(|camera| {
                let outcomes = [
                    ("used", camera.used),
                    ("late", camera.late),
                    ("duplicate", camera.duplicate),
                    ("out_of_order", camera.out_of_order),
                    ("missing", camera.missing),
                    ("unusable", camera.unusable),
                    ("dropped", camera.dropped),
                ];
                outcomes.map(|(outcome, count)| {
                    (vec![("camera", camera.camera.as_str()), ("outcome", outcome)], count as f64)
                })
            })
            .collect();
        self.counters("bundlemocap_camera_frames", "Frames by outcome", &frames)?;
        let mut each = |name: &str, help: &str, value: fn(&CameraCounters) -> f64| {
            let rows: Vec<_> = (cameras.iter())
                .map(|camera| (vec![("camera", camera.camera.as_str())], value(camera)))
                .collect();
            self.gauges(name, help, &rows)
        };
        each("bundlemocap_camera_rate_hertz", "Frames a second", |c| c.rate_hz)?;
        each("bundlemocap_camera_age_seconds", "Time since the last frame", |c| c.age_s)?;
        each("bundlemocap_camera_offset_seconds", "Offset of its clock from the node's", |c| {
            c.offset_s
        })?;
        each("bundlemocap_camera_drift_ppm", "Drift of the offset", |c| c.drift_ppm)?;
        let help = "What is added to its capture times";
        each("bundlemocap_camera_time_correction_seconds", help, |c| c.time_correction_s)?;
        each("bundlemocap_camera_usual_pixels", "Usual residual", |c| c.usual_px)?;
        let help = "Share of points near the body";
        each("bundlemocap_camera_near_ratio", help, |c| c.near)?;
        let help = "1 if it was moved and `mend` can correct it";
        each("bundlemocap_camera_moved", help, |c| f64::from(u8::from(!c.moved.is_empty())))?;
        each("bundlemocap_camera_residual_pixels", "Median residual of the last window", |c| {
            c.residual_px
        })?;
        each("bundlemocap_camera_waited_for", "1 if windows wait for it", |c| {
            f64::from(u8::from(c.waited_for))
        })
    }

    fn stage(&mut self, stage: &StageStatus) -> fmt::Result {
        let all = &stage.performers;
        let life = |one| {
            let StagePerformer { name, life, .. }: &StagePerformer = one;
            (vec![("performer", name.as_str()), ("life", life.as_str())], 1.0)
        };
        let lives: Vec<_> = all.iter().map(life).collect();
        self.gauges("bundlemocap_performer_life", "How far the performer is here", &lives)?;
        let mut each = |name: &str, help: &str, value: fn(&StagePerformer) -> f64| {
            let rows: Vec<_> = all
                .iter()
                .map(|one| (vec![("performer", one.name.as_str())], value(one)))
                .collect();
            self.gauges(name, help, &rows)
        };
        each("bundlemocap_performer_unseen_seconds", "Time since the performer was seen", |one| {
            one.unseen_s
        })?;
        each("bundlemocap_performer_views", "Cameras that saw the performer then", |one| {
            f64::from(one.views)
        })?;
        let help = "Median residual of the last window";
        each("bundlemocap_performer_residual_pixels", help, |one| one.residual_px)?;
        let people = [("tentative", stage.tentative), ("other", stage.others)];
        let rows = people.map(|(role, count)| (vec![("role", role)], f64::from(count)));
        self.gauges("bundlemocap_people", "People who are seen and are not performers", &rows)
    }

    fn windows(&mut self, windows: &WindowCounters) -> fmt::Result {
        let outcomes =
            [("tracked", windows.tracked), ("coasted", windows.coasted), ("lost", windows.lost)];
        let rows = outcomes.map(|(name, count)| (vec![("outcome", name)], count as f64));
        self.counters("bundlemocap_windows", "Windows by outcome", &rows)?;
        let help = "Windows closed by their deadline";
        self.counter("bundlemocap_windows_incomplete", help, windows.incomplete)?;
        let help = "Median iterations of the last windows";
        self.gauge("bundlemocap_window_iterations", help, windows.iterations)?;
        let quantiles = [("0.5", windows.solve_p50_ms), ("0.99", windows.solve_p99_ms)];
        let rows = quantiles.map(|(quantile, ms)| (vec![("quantile", quantile)], ms / 1e3));
        self.gauges("bundlemocap_window_solve_seconds", "Solve time of the last windows", &rows)?;
        let quantiles = [("0.5", windows.age_p50_ms), ("0.99", windows.age_p99_ms)];
        let rows = quantiles.map(|(quantile, ms)| (vec![("quantile", quantile)], ms / 1e3));
        let help = "Age of the first pose of the last windows when given to the solvers";
        self.gauges("bundlemocap_window_age_seconds", help, &rows)?;
        self.gauge("bundlemocap_window_cost", "Median cost of the last windows", windows.cost_p50)
    }

    fn playout(&mut self, playout: &PlayoutCounters) -> fmt::Result {
        let outcomes = [
            ("published", playout.published),
            ("coasted", playout.coasted),
            ("missed", playout.missed),
            ("live", playout.provisional),
        ];
        let rows = outcomes.map(|(name, count)| (vec![("outcome", name)], count as f64));
        self.counters("bundlemocap_poses", "Poses by outcome", &rows)?;
        self.histogram(
            "bundlemocap_publish_deviation_seconds",
            "Publish time minus due time",
            (&playout.deviation_bins_us, &playout.deviation_counts),
        )?;
        self.histogram(
            "bundlemocap_live_latency_seconds",
            "From the last message of a frame set to its provisional pose",
            (&playout.provisional_bins_us, &playout.provisional_counts),
        )
    }

    fn effort(&mut self, effort: &EffortStatus) -> fmt::Result {
        let level = f64::from(effort.level);
        self.gauge("bundlemocap_effort_level", "0 is the full effort of the settings", level)?;
        self.counter(
            "bundlemocap_degradation_steps",
            "How often the level rose",
            effort.degradation_steps,
        )
    }

    /// The encoder adds `_total` to the name.
    fn counter(&mut self, name: &str, help: &str, count: u64) -> fmt::Result {
        self.counters(name, help, &[(vec![], count as f64)])
    }

    fn gauge(&mut self, name: &str, help: &str, value: f64) -> fmt::Result {
        self.gauges(name, help, &[(vec![], value)])
    }

    fn counters(&mut self, name: &str, help: &str, rows: &Rows) -> fmt::Result {
        let mut metric = self.0.encode_descriptor(name, help, None, MetricType::Counter)?;
        for (labels, value) in rows {
            match labels.is_empty() {
                true => metric.encode_counter::<NoExemplar, f64, f64>(value, None)?,
                false => metric
                    .encode_family(&escaped(labels))?
                    .encode_counter::<NoExemplar, f64, f64>(value, None)?,
            }
        }
        Ok(())
    }

    fn gauges(&mut self, name: &str, help: &str, rows: &Rows) -> fmt::Result {
        let mut metric = self.0.encode_descriptor(name, help, None, MetricType::Gauge)?;
        for (labels, value) in rows {
            match labels.is_empty() {
                true => metric.encode_gauge(value)?,
                false => metric.encode_family(&escaped(labels))?.encode_gauge(value)?,
            }
        }
        Ok(())
    }

    /// Bins by their upper ends, microseconds; there is one more count than upper ends.
    fn histogram(&mut self, name: &str, help: &str, bins: (&[u32], &[u64])) -> fmt::Result {
        let mut metric = self.0.encode_descriptor(name, help, None, MetricType::Histogram)?;
        let (ends, counts) = bins;
        let upper = ends.iter().map(|us| f64::from(*us) / 1e6).chain([f64::MAX]);
        let buckets: Vec<(f64, u64)> = upper.zip(counts.iter().copied()).collect();
        let last = ends.last().map_or(0.0, |us| f64::from(*us) / 1e6);
        let lower = std::iter::once(0.0).chain(buckets.iter().map(|(end, _)| *end));
        let sum = (buckets.iter().zip(lower))
            .map(|((end, count), start)| 0.5 * (start + end.min(last)) * *count as f64)
            .fold(0.0, |sum, part| sum + part);
        metric.encode_histogram::<NoExemplar>(sum, counts.iter().sum(), &buckets, None)
    }
}

/// Escapes label values, since names of cameras may hold any character.
fn escaped<'a>(labels: &[(&'a str, &str)]) -> Vec<(&'a str, String)> {
    let escape = |value: &str| {
        value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n").replace('\r', " ")
    };
    labels.iter().map(|(name, value)| (*name, escape(value))).collect()
}

/// Labels of exemplars, of which there are none.
type NoExemplar = [(&'static str, &'static str); 0];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::wire::EventCount;

    fn status() -> Status {
        Status {
            tracker_state: "tracking".into(),
            declared_latency_ns: 180_000_000,
            cameras: vec![CameraCounters {
                camera: "cam \"01\"\n".into(),
                used: 600,
                late: 3,
                offset_s: -0.25,
                waited_for: true,
                near: 0.75,
                usual_px: 4.5,
                moved: "turned by about 3 degrees".into(),
                ..CameraCounters::default()
            }],
            windows: Some(WindowCounters {
                tracked: 7,
                solve_p99_ms: 4.0,
                age_p50_ms: 150.0,
                cost_p50: 12.5,
                ..WindowCounters::default()
            }),
            playout: Some(PlayoutCounters {
                published: 12,
                deviation_bins_us: vec![100, 1000],
                deviation_counts: vec![5, 2, 1],
                ..PlayoutCounters::default()
            }),
            events: vec![EventCount { kind: "late".into(), count: 3 }],
            ..Status::default()
        }
    }

    fn text() -> String {
        let usage = Some(Usage { cpu_s: 1.5, resident_bytes: 4096 });
        let one = StagePerformer {
            name: "lead".into(),
            life: "coasting".into(),
            unseen_s: 0.5,
            ..StagePerformer::default()
        };
        let stage = StageStatus { performers: vec![one], others: 3, ..StageStatus::default() };
        let snapshot = Snapshot { status: Some(status()), stage: Some(stage), failures: 2, usage };
        snapshot.render().unwrap()
    }

    #[test]
    fn the_text_holds_every_figure() {
        let text = text();
        let expected = [
            "bundlemocap_tracker_state{state=\"tracking\"} 1.0",
            "bundlemocap_camera_frames_total{camera=\"cam \\\"01\\\"\\n\",outcome=\"late\"} 3.0",
            "bundlemocap_camera_offset_seconds{camera=\"cam \\\"01\\\"\\n\"} -0.25",
            "bundlemocap_windows_total{outcome=\"tracked\"} 7.0",
            "bundlemocap_window_solve_seconds{quantile=\"0.99\"} 0.004",
            "bundlemocap_declared_latency_seconds 0.18",
            "bundlemocap_publish_deviation_seconds_count 8",
            "bundlemocap_publish_deviation_seconds_bucket{le=\"0.0001\"} 5",
            "bundlemocap_publish_deviation_seconds_bucket{le=\"0.001\"} 7",
            "bundlemocap_publish_deviation_seconds_bucket{le=\"+Inf\"} 8",
            "bundlemocap_events_total{kind=\"late\"} 3.0",
            "bundlemocap_publish_failures_total 2.0",
            "bundlemocap_performer_life{performer=\"lead\",life=\"coasting\"} 1.0",
            "bundlemocap_performer_unseen_seconds{performer=\"lead\"} 0.5",
            "bundlemocap_people{role=\"other\"} 3.0",
            "bundlemocap_camera_near_ratio{camera=\"cam \\\"01\\\"\\n\"} 0.75",
            "bundlemocap_camera_usual_pixels{camera=\"cam \\\"01\\\"\\n\"} 4.5",
            "bundlemocap_camera_moved{camera=\"cam \\\"01\\\"\\n\"} 1.0",
            "bundlemocap_window_age_seconds{quantile=\"0.5\"} 0.15",
            "bundlemocap_window_cost 12.5",
            "process_cpu_seconds_total 1.5",
            "process_resident_memory_bytes 4096.0",
        ];
        for line in expected {
            assert!(text.lines().any(|l| l == line), "{line} is not in\n{text}");
        }
        assert!(text.ends_with("# EOF\n"));
    }

    #[test]
    fn every_metric_is_in_the_docs_and_the_other_way_round() {
        let text = text();
        let mut given: Vec<String> = (text.lines())
            .filter_map(|line| line.strip_prefix("# TYPE ")?.rsplit_once(' '))
            .map(|(name, kind)| match kind {
                "counter" => format!("{name}_total"),
                _ => name.to_owned(),
            })
            .collect();
        let mut documented: Vec<String> = (include_str!("../../../docs/monitoring.md").lines())
            .filter_map(|line| line.strip_prefix("| `")?.split('`').next())
            .filter(|name| ["bundlemocap_", "process_"].iter().any(|begin| name.starts_with(begin)))
            .map(str::to_owned)
            .collect();
        given.sort();
        documented.sort();
        assert_eq!(given, documented);
    }
}
