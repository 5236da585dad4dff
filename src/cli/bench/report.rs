//! The metrics of `bench latency`, from the messages of the node.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::Serialize;

use crate::core::time::{Nanos, Timestamp};
use crate::io::bus::{Bus, BusError, Guard, Sample};
use crate::io::wire::{Event, Pose, Status, Topics, decode};
use crate::live::{Usage, WallClock};
use crate::metrics::statistics::{Line, percentiles};

/// A received pose.
#[derive(Clone, Copy, Debug)]
struct Arrival {
    capture: Timestamp,
    latency: Nanos,
    at: Timestamp,
}

/// The messages received from the node.
#[derive(Clone, Default)]
pub(super) struct Heard(Arc<Mutex<Notes>>);

#[derive(Default)]
struct Notes {
    poses: Vec<Arrival>,
    provisional: Vec<Arrival>,
    status: Option<Status>,
    events: Vec<Event>,
}

impl Heard {
    /// Subscribes to the node.
    pub(super) fn listen(
        &self,
        bus: &dyn Bus,
        topics: &Topics,
        clock: WallClock,
    ) -> Result<Vec<Box<dyn Guard>>, BusError> {
        let on = |topic: String, note: fn(&mut Notes, &Sample, Timestamp)| {
            let heard = self.clone();
            let sink = move |sample: Sample| {
                let at = clock.now();
                note(&mut heard.lock(), &sample, at);
            };
            bus.subscribe(&topic, Box::new(sink))
        };
        Ok(vec![
            on(topics.pose(), |notes, sample, at| notes.poses.extend(arrival(sample, at)))?,
            on(topics.provisional(), |notes, sample, at| {
                notes.provisional.extend(arrival(sample, at))
            })?,
            on(topics.status(), |notes, sample, _| {
                notes.status = decode(&sample.payload).ok().or(notes.status.take());
            })?,
            on(topics.actor_events(), note_event)?,
            on(topics.stage_events(), note_event)?,
        ])
    }

    /// Whether a status has arrived.
    pub(super) fn has_status(&self) -> bool {
        self.lock().status.is_some()
    }

    /// Time of arrival of the first pose.
    pub(super) fn first_pose(&self) -> Option<Timestamp> {
        self.lock().poses.first().map(|arrival| arrival.at)
    }

    /// The declared latency of the node.
    pub(super) fn latency(&self) -> Nanos {
        self.lock().poses.last().map_or(Nanos::ZERO, |arrival| arrival.latency)
    }

    fn lock(&self) -> MutexGuard<'_, Notes> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn note_event(notes: &mut Notes, sample: &Sample, _: Timestamp) {
    notes.events.extend(decode::<Event>(&sample.payload));
}

fn arrival(sample: &Sample, at: Timestamp) -> Option<Arrival> {
    let pose: Pose = decode(&sample.payload).ok()?;
    let latency = Nanos::new(i64::try_from(pose.declared_latency_ns).ok()?);
    Some(Arrival { capture: Timestamp::from_ns(pose.capture_time_ns), latency, at })
}

/// The load of the benchmark.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Load {
    pub(super) bus: String,
    pub(super) cameras: u8,
    pub(super) fps: f64,
    pub(super) stagger: f64,
    pub(super) jitter_ms: f64,
    pub(super) seconds: f64,
    pub(super) message_bytes: f64,
    pub(super) window_span_ms: f64,
}

/// All metrics. Field names are part of the interface.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Report {
    #[serde(flatten)]
    pub(super) load: Load,
    /// From the first keypoints to the first pose, without the declared latency.
    pub(super) acquisition_s: Option<f64>,
    pub(super) declared_latency_ms: Option<f64>,
    /// Whether the declared latency never changed.
    pub(super) latency_constant: bool,
    pub(super) poses: Poses,
    /// Absolute difference of arrival and due time, milliseconds.
    pub(super) arrival_deviation_ms: Option<Spread>,
    /// The same, measured by the node when it publishes: upper edges of the histogram's bins.
    pub(super) publish_deviation_ms: Option<Spread>,
    /// From the last camera's message to the provisional pose, after acquisition, milliseconds.
    pub(super) provisional_ms: Option<Spread>,
    pub(super) provisional_poses: usize,
    /// Mean number of runnable processes over a minute; above the number of cores the node had to
    /// wait.
    pub(super) machine_load: Option<f64>,
    /// Percent of one core.
    pub(super) cpu_percent: Option<f64>,
    pub(super) memory: Option<Memory>,
    pub(super) solve_ms: Option<[f64; 2]>,
    pub(super) dropped: u64,
    pub(super) effort_level: u32,
    pub(super) degradation_steps: u64,
    pub(super) events: BTreeMap<String, u64>,
}

/// Received and expected poses.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Poses {
    pub(super) expected: usize,
    pub(super) published: usize,
    pub(super) percent: Option<f64>,
    pub(super) duplicate: usize,
    pub(super) out_of_order: usize,
}

/// Percentiles.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Spread {
    pub(super) p50: f64,
    pub(super) p99: f64,
    pub(super) p99_9: f64,
    pub(super) max: f64,
}

/// Resident memory of the node, MB.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Memory {
    pub(super) start: f64,
    pub(super) middle: f64,
    pub(super) end: f64,
    /// Slope of a line through the second half, kB per minute.
    pub(super) slope_kb_min: f64,
}

/// Resource usage of the node at a time.
pub(super) type UsageAt = (Timestamp, Usage);

/// The metrics of the received messages.
pub(super) fn report(
    load: Load,
    heard: &Heard,
    sent: &[(Timestamp, Timestamp)],
    usage: &[UsageAt],
) -> Report {
    let notes = heard.lock();
    let status = notes.status.clone().unwrap_or_default();
    let playout = status.playout.clone().unwrap_or_default();
    let effort = status.effort.unwrap_or_default();
    let first = notes.poses.first();
    let deviation = |a: &Arrival| (a.at - a.capture - a.latency).ms().abs();
    let mut events = BTreeMap::new();
    // Ignore events after the last frame, when the cameras are silent.
    let end = sent.last().map_or(0, |last| last.0.ns());
    for event in notes.events.iter().filter(|event| event.capture_time_ns < end) {
        *events.entry(event.kind.clone()).or_default() += event.count;
    }
    let windows = status.windows.unwrap_or_default();
    Report {
        acquisition_s: first
            .zip(sent.first())
            .map(|(pose, sent)| (pose.at - sent.0 - pose.latency).seconds()),
        declared_latency_ms: first.map(|pose| pose.latency.ms()),
        latency_constant: notes.poses.windows(2).all(|p| p[0].latency == p[1].latency),
        poses: poses(&notes.poses, sent, &load),
        arrival_deviation_ms: spread(notes.poses.iter().map(deviation)),
        publish_deviation_ms: of_bins(&playout.deviation_bins_us, &playout.deviation_counts),
        provisional_ms: spread(provisional(&notes.provisional, first.map(|pose| pose.at), sent)),
        provisional_poses: notes.provisional.len(),
        machine_load: machine_load(),
        cpu_percent: cpu_percent(usage),
        memory: memory(usage),
        solve_ms: (windows.tracked > 0).then_some([windows.solve_p50_ms, windows.solve_p99_ms]),
        dropped: status.queue_dropped,
        effort_level: effort.level,
        degradation_steps: effort.degradation_steps,
        events,
        load,
    }
}

/// One pose per frame is expected from the first pose on, except for the last two windows, which the
/// end may cut.
fn poses(all: &[Arrival], sent: &[(Timestamp, Timestamp)], load: &Load) -> Poses {
    let end = sent.last().map(|sent| sent.0 - Nanos::new((2e6 * load.window_span_ms) as i64));
    let range = all.first().map(|pose| pose.capture).zip(end);
    let inside = |at: Timestamp| range.is_some_and(|(first, end)| first <= at && at < end);
    let expected = sent.iter().filter(|sent| inside(sent.0)).count();
    let captures: BTreeSet<Timestamp> =
        all.iter().map(|pose| pose.capture).filter(|at| inside(*at)).collect();
    let distinct: BTreeSet<Timestamp> = all.iter().map(|pose| pose.capture).collect();
    Poses {
        expected,
        published: captures.len(),
        percent: (expected > 0).then(|| 100.0 * captures.len() as f64 / expected as f64),
        duplicate: all.len() - distinct.len(),
        out_of_order: all.windows(2).filter(|p| p[1].capture < p[0].capture).count(),
    }
}

/// Latency of each provisional pose after acquisition, from the last message of its frame set, ms: the
/// frame set nearest to the pose.
fn provisional(
    all: &[Arrival],
    from: Option<Timestamp>,
    sent: &[(Timestamp, Timestamp)],
) -> impl Iterator<Item = f64> {
    all.iter().filter(move |pose| from.is_some_and(|from| pose.at >= from)).filter_map(|pose| {
        let after = sent.partition_point(|sent| sent.0 < pose.capture);
        let near = sent.get(after.saturating_sub(1)..(after + 1).min(sent.len()))?;
        let nearest = near.iter().min_by_key(|sent| (sent.0 - pose.capture).abs())?;
        Some((pose.at - nearest.1).ms())
    })
}

/// Load average of the last minute (Linux).
fn machine_load() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/loadavg").ok()?;
    text.split_whitespace().next()?.parse().ok()
}

fn spread(values: impl Iterator<Item = f64>) -> Option<Spread> {
    let values: Vec<f64> = values.collect();
    let [p50, p99, p99_9, max] = percentiles(&values, [50.0, 99.0, 99.9, 100.0])?;
    Some(Spread { p50, p99, p99_9, max })
}

/// Percentiles as upper edges of their bins, milliseconds; infinite for the open bin.
fn of_bins(ends_us: &[u32], counts: &[u64]) -> Option<Spread> {
    let total: u64 = counts.iter().sum();
    let at = |percent: f64| {
        let wanted = (total as f64 * percent / 100.0).ceil().max(1.0) as u64;
        let mut below = 0;
        let bin = counts.iter().position(|count| {
            below += count;
            below >= wanted
        });
        bin.and_then(|bin| ends_us.get(bin)).map_or(f64::INFINITY, |us| f64::from(*us) * 1e-3)
    };
    (total > 0).then(|| Spread { p50: at(50.0), p99: at(99.0), p99_9: at(99.9), max: at(100.0) })
}

fn cpu_percent(usage: &[UsageAt]) -> Option<f64> {
    let (first, last) = (usage.first()?, usage.last()?);
    let seconds = last.0.seconds_since(first.0);
    (seconds > 0.0).then(|| 100.0 * (last.1.cpu_s - first.1.cpu_s) / seconds)
}

fn memory(usage: &[UsageAt]) -> Option<Memory> {
    let mb = |(_, usage): &UsageAt| usage.resident_bytes as f64 * 1e-6;
    let half = &usage[usage.len() / 2..];
    Some(Memory {
        start: mb(usage.first()?),
        middle: mb(half.first()?),
        end: mb(usage.last()?),
        slope_kb_min: slope(half) * 60.0 * 1e-3,
    })
}

/// Slope by least squares, bytes per second.
fn slope(usage: &[UsageAt]) -> f64 {
    let Some(first) = usage.first() else { return 0.0 };
    let points = usage.iter().map(|(at, u)| (at.seconds_since(first.0), u.resident_bytes as f64));
    Line::fit(points).map_or(0.0, |line| line.slope)
}

impl Report {
    /// Rows of a table.
    pub(super) fn rows(&self) -> Vec<(String, String)> {
        let none = || "none".to_owned();
        let number = |value: Option<f64>, unit: &str| {
            value.map_or_else(none, |value| format!("{value:.1} {unit}"))
        };
        let spread = |spread: Option<Spread>| {
            spread.map_or_else(none, |Spread { p50, p99, p99_9, max }| {
                format!("p50 {p50:.3}, p99 {p99:.3}, p99.9 {p99_9:.3}, max {max:.3} ms")
            })
        };
        let Self { load, poses, .. } = self;
        let Load { bus, cameras, fps, stagger, jitter_ms, seconds, .. } = load;
        let Load { message_bytes, window_span_ms, .. } = load;
        let constant = if self.latency_constant { "constant" } else { "NOT constant" };
        let events: Vec<String> =
            self.events.iter().map(|(kind, count)| format!("{kind} {count}")).collect();
        let row = |name: &str, value: String| (name.to_owned(), value);
        vec![
            row(
                "load",
                format!(
                    "{bus}, {cameras} cameras, {fps} fps, stagger {stagger}, jitter {jitter_ms} ms, \
                     {seconds} s, {message_bytes:.0} bytes"
                ),
            ),
            row("acquisition", number(self.acquisition_s, "s")),
            row(
                "poses published",
                format!(
                    "{} of {}, {}; {} twice, {} out of order",
                    poses.published,
                    poses.expected,
                    poses.percent.map_or_else(none, |p| format!("{p:.2} %")),
                    poses.duplicate,
                    poses.out_of_order
                ),
            ),
            row(
                "declared latency",
                format!(
                    "{}, {constant}; window span {window_span_ms:.1} ms",
                    number(self.declared_latency_ms, "ms")
                ),
            ),
            row("arrival, deviation from due time", spread(self.arrival_deviation_ms)),
            row("publishing, deviation from due time", spread(self.publish_deviation_ms)),
            row("provisional pose, latency", spread(self.provisional_ms)),
            row("provisional poses", self.provisional_poses.to_string()),
            row("load average", number(self.machine_load, "processes")),
            row("CPU of the node", number(self.cpu_percent, "% of one core")),
            row("memory of the node", self.memory.map_or_else(none, Memory::text)),
            row(
                "window solve",
                self.solve_ms
                    .map_or_else(none, |[p50, p99]| format!("p50 {p50:.2}, p99 {p99:.2} ms")),
            ),
            row("dropped by the queue", self.dropped.to_string()),
            row(
                "effort level",
                format!("{}, increased {} times", self.effort_level, self.degradation_steps),
            ),
            row("events", if events.is_empty() { none() } else { events.join(", ") }),
        ]
    }
}

impl Memory {
    fn text(self) -> String {
        let Self { start, middle, end, slope_kb_min } = self;
        format!("{start:.1}, {middle:.1}, {end:.1} MB; {slope_kb_min:+.1} kB/min at the end")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: i64) -> Timestamp {
        Timestamp::from_ns(ms * 1_000_000)
    }

    fn load() -> Load {
        Load {
            bus: "memory".into(),
            cameras: 4,
            fps: 100.0,
            stagger: 0.0,
            jitter_ms: 0.0,
            seconds: 1.0,
            message_bytes: 100.0,
            window_span_ms: 20.0,
        }
    }

    fn usage(at_s: i64, cpu_s: f64, resident_bytes: u64) -> UsageAt {
        (ms(1000 * at_s), Usage { cpu_s, resident_bytes })
    }

    #[test]
    fn poses_before_the_first_and_in_the_last_windows_are_not_expected() {
        let sent: Vec<_> = (0..100).map(|i| (ms(10 * i), ms(10 * i + 1))).collect();
        let pose = |i: i64| Arrival {
            capture: ms(10 * i),
            latency: Nanos::from_ms(30),
            at: ms(10 * i + 31),
        };
        let heard = Heard::default();
        let order = (20..90).filter(|i| *i != 50).chain([60]);
        heard.lock().poses.extend(order.map(pose));
        heard
            .lock()
            .provisional
            .extend((30..40).map(|i| Arrival { at: ms(10 * i + 5), ..pose(i) }));
        let report = report(load(), &heard, &sent, &[usage(0, 1.0, 0), usage(10, 2.0, 0)]);
        let Poses { expected, published, duplicate, out_of_order, .. } = report.poses;
        assert_eq!((expected, published, duplicate, out_of_order), (75, 69, 1, 1));
        assert_eq!(report.declared_latency_ms, Some(30.0));
        assert!(report.latency_constant);
        assert!((report.acquisition_s.unwrap() - 0.201).abs() < 1e-9);
        assert!((report.arrival_deviation_ms.unwrap().p99_9 - 1.0).abs() < 1e-9);
        assert!((report.provisional_ms.unwrap().max - 4.0).abs() < 1e-9);
        assert_eq!(report.cpu_percent, Some(10.0));
        assert!(report.rows().iter().any(|(_, value)| value.contains("69 of 75")));
    }

    #[test]
    fn percentiles_of_bins_are_their_upper_ends() {
        let spread = of_bins(&[100, 1000, 2000], &[990, 8, 2, 0]).unwrap();
        assert_eq!([spread.p50, spread.p99, spread.p99_9, spread.max], [0.1, 0.1, 2.0, 2.0]);
        assert_eq!(of_bins(&[100], &[1, 1]).unwrap().max, f64::INFINITY);
        assert!(of_bins(&[100], &[0, 0]).is_none());
    }

    #[test]
    fn growth_is_seen() {
        let flat: Vec<_> = (0..20).map(|i| usage(i, 0.0, 5_000_000)).collect();
        let growing: Vec<_> = (0..20).map(|i| usage(i, 0.0, 5_000_000 + 1000 * i as u64)).collect();
        assert_eq!(memory(&flat).unwrap().slope_kb_min, 0.0);
        assert!((memory(&growing).unwrap().slope_kb_min - 60.0).abs() < 1e-6);
        assert!(memory(&[]).is_none());
    }
}
