//! The summary of a solve: what `solve --json` prints, and the table.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::first_pass::CameraOffset;
use super::hold_out::HoldOut;
use super::poses::Poses;
use super::reference::Reference;
use super::windows::Windows;
use crate::core::camera::Rig;
use crate::core::stage::Known;
use crate::diagnose::Check;
use crate::io::recording::{RecordError, write_body};
use crate::io::report::Table;
use crate::io::wire;
use crate::metrics::{Coverage, Episode, FootSkate, NotFollowed, PerformerScores, PoseErrors};

/// The measurements of a solve. Field names are part of the interface; docs/json.md documents them.
/// [`Display`](fmt::Display) prints the table.
///
/// Percentiles are exact up to 131,072 values (points, windows), and within 0.05 % beyond; see
/// [`Distribution`](crate::metrics::Distribution). The frame rate comes from the first 4096 poses.
#[derive(Clone, Debug, Serialize)]
#[allow(missing_docs)]
pub struct Summary {
    pub version: &'static str,
    pub recording: String,
    /// Capture time of the first frame that is used, nanoseconds.
    pub first_capture_time_ns: Option<i64>,
    /// Number of frames of the camera that has most.
    pub frames_recorded: usize,
    /// Number of poses.
    pub frames: usize,
    /// Number of flagged poses: not fitted to detections.
    pub frames_lost: usize,
    pub windows: usize,
    /// Number of windows with flagged poses.
    pub lost: usize,
    /// Number of those in which too little of the performer was seen.
    pub hidden: usize,
    pub windows_without_performer: u64,
    pub frame_rate_hz: Option<f64>,
    pub reprojection: Reprojection,
    pub hold_out: Option<HoldOut>,
    /// The same for each held-out camera.
    pub hold_out_cameras: Vec<HoldOut>,
    pub mean_acceleration_m_s2: Option<f64>,
    pub not_followed: Option<NotFollowed>,
    /// Contacts are those of the truth; without one, those of the poses themselves.
    pub foot_skate: Option<FootSkate>,
    /// Median height of standing feet above y = 0, metres; `None` if they hardly stand.
    pub floor_m: Option<f64>,
    /// Standard deviations of the joint centres; `None` where they are not known.
    pub joint_deviation: Option<DeviationPercentiles>,
    /// Distance from the truth of a synthetic recording.
    pub truth: Option<PoseErrors>,
    pub reference: Option<Reference>,
    pub solve_ms: Option<SolveTime>,
    pub frames_per_second: f64,
    /// Number of events of each kind.
    pub events: BTreeMap<&'static str, u64>,
    /// The cameras' time offsets; empty if they were not estimated.
    pub time_offsets: Vec<CameraOffset>,
    /// The cameras judged, see [`check`](fn@super::check).
    pub check: Option<Check>,
    /// What was lost from the recording.
    pub damage: Vec<String>,
    /// Other notes for the user.
    pub notes: Vec<String>,
}

/// Percentiles of the standard deviations of the joint centres along an axis, over all joints and poses.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct DeviationPercentiles {
    /// Their median, millimetres.
    pub median_mm: f64,
    /// Their 95th percentile, millimetres.
    pub p95_mm: f64,
}

/// The measurements of a solve of several performers: what `solve --performers --json` prints, and the
/// table.
#[derive(Clone, Debug, Serialize)]
#[allow(missing_docs)]
pub struct Group {
    /// By number: known people first, then in the order of their first frames.
    pub performers: Vec<PerformerSummary>,
    /// The most people at a time who were seen for a while and not solved.
    pub others: usize,
    /// Who is who, beside the truth of a synthetic recording.
    pub scores: Option<PerformerScores>,
    /// What is known of the performers, for another day.
    #[serde(skip)]
    pub known: Vec<Known>,
}

/// A performer of a group.
#[derive(Clone, Debug, Serialize)]
pub struct PerformerSummary {
    /// Name of the performer: `actor`, or `p1`, `p2` ... with several.
    pub performer: String,
    /// The performer's measurements.
    #[serde(flatten)]
    pub summary: Summary,
}

impl Group {
    /// Writes the bodies of performers with a name to a folder of known bodies, unless they have one there. Returns
    /// their names and files.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write_bodies(&self, folder: &Path) -> Result<Vec<(String, PathBuf)>, RecordError> {
        let mut written = Vec::new();
        for known in self.known.iter().filter(|known| self.was_seen_well(&known.name)) {
            let Some(body) = wire::Skeleton::of_known(known) else { continue };
            let file = write_body(folder, &known.name, &body, false)?;
            written.extend(file.map(|file| (known.name.clone(), file)));
        }
        Ok(written)
    }

    /// Whether the body of a performer can be saved: it was tracked for two seconds or more, and at most a quarter of its
    /// windows were lost.
    pub fn was_seen_well(&self, name: &str) -> bool {
        const LEAST_S: f64 = 2.0;
        const MOST_LOST: f64 = 0.25;
        let one = self.performers.iter().find(|one| one.performer == name);
        one.is_some_and(|PerformerSummary { summary, .. }| {
            let tracked = (summary.frames - summary.frames_lost) as f64;
            tracked >= LEAST_S * summary.frame_rate_hz.unwrap_or(f64::INFINITY)
                && summary.lost as f64 <= MOST_LOST * summary.windows as f64
        })
    }

    /// A row for each performer.
    pub(crate) fn table(&self) -> Table {
        let row = |PerformerSummary { performer, summary }: &PerformerSummary| {
            let compared = match (&summary.truth, &summary.reference) {
                (Some(truth), _) => format!("{:.1} mm from the truth", truth.mpjpe_mm),
                (None, Some(found)) => format!("{:.1} mm from the reference", found.mean_mm),
                (None, None) => "none".to_owned(),
            };
            vec![
                performer.clone(),
                with_part(summary.frames, summary.frames_lost, "flagged"),
                with_part(summary.windows, summary.lost, "lost"),
                px(summary.reprojection.median_px),
                unit(summary.mean_acceleration_m_s2, 1, "m/s²"),
                compared,
            ]
        };
        let header = ["performer", "frames", "windows", "reprojection", "acceleration", "error"];
        Table {
            title: "Performers".into(),
            header: header.map(str::to_owned).into(),
            rows: self.performers.iter().map(row).collect(),
        }
    }

    /// Rows of a name and a value, for people.
    pub fn rows(&self) -> Vec<(String, String)> {
        let Table { rows, .. } = self.table();
        let in_words = |row: Vec<String>| {
            let [name, frames, windows, error, acceleration, compared] = row.try_into().ok()?;
            let mut value =
                format!("{frames} frames, {windows} windows, {error} reprojection, {acceleration}");
            if compared != "none" {
                value += &format!(", {compared}");
            }
            Some((name, value))
        };
        let mut rows: Vec<_> = rows.into_iter().filter_map(in_words).collect();
        // They are the same for all.
        let first = self.performers.first();
        rows.extend(first.into_iter().flat_map(|one| one.summary.offset_rows()));
        if let Some(found) = &self.scores {
            let PerformerScores { recall_percent, precision_percent, id_switches, .. } = found;
            let who = format!("{recall_percent:.2} %, {precision_percent:.2} %, {id_switches}");
            rows.push(("truth: recall, precision, ID switches".into(), who));
            let (mota, pcp) = (found.mota_percent, found.pcp_percent);
            rows.push(("truth: MOTA, PCP".into(), format!("{mota:.2} %, {pcp:.2} %")));
            rows.push(("truth: MPJPE".into(), format!("{:.1} mm", found.mpjpe_mm)));
        }
        let speed: f64 = self.performers.iter().map(|one| one.summary.frames_per_second).sum();
        rows.push(("speed".into(), format!("{speed:.0} poses/s")));
        rows
    }

    /// The most important results, as name and value.
    pub(crate) fn headline(&self) -> Vec<(String, String)> {
        let mut facts = vec![("performers".to_owned(), self.performers.len().to_string())];
        if self.others > 0 {
            facts.push(("others, not solved".to_owned(), self.others.to_string()));
        }
        if let Some(PerformerScores { id_switches, mpjpe_mm, .. }) = &self.scores {
            facts.push(("ID switches".to_owned(), id_switches.to_string()));
            facts.push(("MPJPE".to_owned(), format!("{mpjpe_mm:.1} mm")));
        }
        facts
    }
}

/// Median distance of detected points with confidence above 0.3 from the solved body, pixels.
#[derive(Clone, Debug, Serialize)]
pub struct Reprojection {
    /// Over all points.
    pub median_px: Option<f64>,
    /// By camera.
    pub cameras: BTreeMap<String, Option<f64>>,
}

/// Time to solve a window, milliseconds.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct SolveTime {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rows = self.rows();
        let width = rows.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
        for (index, (name, value)) in rows.iter().enumerate() {
            let end = if index + 1 < rows.len() { "\n" } else { "" };
            write!(f, "{name:<width$}  {value}{end}")?;
        }
        Ok(())
    }
}

impl Summary {
    /// The most important results, as name and value.
    pub(crate) fn headline(&self) -> Vec<(String, String)> {
        let mut facts = vec![
            ("frames".to_owned(), self.frames.to_string()),
            ("lost windows".to_owned(), format!("{} of {}", self.lost, self.windows)),
            ("reprojection, median".to_owned(), px(self.reprojection.median_px)),
            ("joint acceleration".to_owned(), unit(self.mean_acceleration_m_s2, 1, "m/s²")),
        ];
        let mut fact = |name: &str, value: String| facts.push((name.to_owned(), value));
        if let Some(skate) = &self.foot_skate {
            fact("foot skate", format!("{:.0} mm/s", skate.mm_s));
        }
        if let Some(held) = &self.hold_out {
            fact(&format!("hold-out {}", held.camera), px(held.median_px));
        }
        if let Some(truth) = &self.truth {
            fact("MPJPE", format!("{:.1} mm", truth.mpjpe_mm));
        }
        if let Some(reference) = &self.reference {
            fact("from the reference", format!("{:.1} mm", reference.mean_mm));
        }
        if let Some(SolveTime { p50, .. }) = self.solve_ms {
            fact("window solve, median", format!("{p50:.1} ms"));
        }
        facts
    }

    /// Rows of a name and a value, for people.
    pub fn rows(&self) -> Vec<(String, String)> {
        let mut rows = Rows::default();
        let frames = match self.frames_recorded > self.frames {
            true => format!("{} of {}", self.frames, self.frames_recorded),
            false => self.frames.to_string(),
        };
        rows.add("frames", with_part(frames, self.frames_lost, "flagged"));
        rows.add("windows", with_part(self.windows, self.lost, "lost"));
        if self.windows_without_performer > 0 {
            let windows = self.windows_without_performer.to_string();
            rows.add("windows without a performer", windows);
        }
        rows.add("reprojection, median", px(self.reprojection.median_px));
        for (camera, error) in &self.reprojection.cameras {
            rows.add(&format!("  {camera}"), px(*error));
        }
        rows.0.extend(self.offset_rows());
        self.hold_out_cameras.iter().for_each(|held| rows.add_hold_out(held));
        if let Some(all) = self.hold_out.as_ref().filter(|_| self.hold_out_cameras.len() > 1) {
            rows.add("hold-out, mean of the medians", px(all.median_px));
        }
        rows.add("mean joint acceleration", unit(self.mean_acceleration_m_s2, 2, "m/s²"));
        let first = self.first_capture_time_ns.unwrap_or(0);
        self.not_followed.iter().for_each(|found| rows.add_not_followed(found, first));
        self.foot_skate.iter().for_each(|skate| rows.add_foot_skate(skate));
        if let Some(floor) = self.floor_m {
            rows.add("floor", format!("{floor:.2} m"));
        }
        if let Some(DeviationPercentiles { median_mm, p95_mm }) = self.joint_deviation {
            let value = format!("{median_mm:.0} mm, p95 {p95_mm:.0} mm");
            rows.add("joint centres, standard deviation", value);
        }
        self.truth.iter().for_each(|truth| rows.add_truth(truth));
        self.reference.iter().for_each(|reference| rows.add_reference(reference));
        if let Some(SolveTime { p50, p99 }) = self.solve_ms {
            rows.add("solve time, p50, p99", format!("{p50:.1} ms, {p99:.1} ms a window"));
        }
        rows.add("speed", format!("{:.0} frames/s", self.frames_per_second));
        rows.add("events", self.events_in_words());
        for damage in &self.damage {
            rows.add("damage", damage.clone());
        }
        rows.0
    }

    /// A row for each camera whose times were shifted.
    pub(crate) fn offset_rows(&self) -> impl Iterator<Item = (String, String)> {
        let shifted = self.time_offsets.iter().filter(|offset| offset.applied);
        shifted.map(|found| (format!("time offset {}", found.camera), format!("{found}, applied")))
    }

    fn events_in_words(&self) -> String {
        let happened = self.events.iter().filter(|(_, count)| **count > 0);
        let happened: Vec<String> =
            happened.map(|(kind, count)| format!("{kind} {count}")).collect();
        if happened.is_empty() { "none".to_owned() } else { happened.join(", ") }
    }
}

/// The rows of a table.
#[derive(Default)]
struct Rows(Vec<(String, String)>);

impl Rows {
    fn add(&mut self, name: &str, value: String) {
        self.0.push((name.to_owned(), value));
    }

    fn add_hold_out(&mut self, held: &HoldOut) {
        let HoldOut { camera, median_px, points, frames, .. } = held;
        let value = format!("{} ({points} points, {frames} frames)", px(*median_px));
        self.add(&format!("hold-out {camera}, median"), value);
        let without = held.frames_without_performer;
        self.add("  frames without the performer", without.to_string());
    }

    /// The time is since the recording's `first` frame, nanoseconds, as that of `--start`.
    fn add_not_followed(&mut self, found: &NotFollowed, first: i64) {
        let longest = found.longest.first().map_or_else(String::new, |longest| {
            let Episode { keypoint, capture_time_ns, frames, distance_m } = longest;
            let (start, cm) = ((*capture_time_ns - first) as f64 / 1e9, 100.0 * distance_m);
            let s = if *frames == 1 { "" } else { "s" };
            format!(", longest {frames} frame{s}: {keypoint} {cm:.0} cm off at {start:.2} s")
        });
        self.add("seen and not followed", format!("{:.3} % of points{longest}", found.percent));
    }

    fn add_foot_skate(&mut self, skate: &FootSkate) {
        let FootSkate { mm_s, truth_mm_s, contact_percent, .. } = skate;
        let truth =
            truth_mm_s.map_or_else(String::new, |truth| format!(" (truth {truth:.0} mm/s)"));
        let value = format!("{mm_s:.0} mm/s{truth}, {contact_percent:.0} % contact");
        self.add("foot skate", value);
    }

    fn add_truth(&mut self, truth: &PoseErrors) {
        let (all, relative) = (truth.mpjpe_mm, truth.mpjpe_root_relative_mm);
        self.add("truth: MPJPE", format!("{all:.1} mm ({relative:.1} mm root-relative)"));
        self.add("truth: RMSE", format!("{:.1} mm", truth.rmse_mm));
        self.add("truth: MAE", format!("{:.2}° (root {:.2}°)", truth.mae_deg, truth.root_deg));
        let (three, seven) = (truth.pck3_percent, truth.pck7_percent);
        self.add("truth: PCK 3 cm, 7 cm", format!("{three:.1} %, {seven:.1} %"));
        if let Some(Coverage { within_1_percent, within_2_percent, .. }) = truth.coverage {
            let value = format!("{within_1_percent:.0} %, {within_2_percent:.0} %");
            self.add("truth: within 1, 2 standard deviations", value);
        }
    }

    fn add_reference(&mut self, reference: &Reference) {
        let Reference { frames, mean_mm, worst_mid_hip_mm, worst_mid_hip_frame, .. } = reference;
        self.add("reference: mean", format!("{mean_mm:.1} mm ({frames} frames)"));
        if let (Some(mm), Some(frame)) = (worst_mid_hip_mm, worst_mid_hip_frame) {
            self.add("reference: worst mid-hip", format!("{mm:.1} mm (frame {frame})"));
        }
    }
}

impl Reprojection {
    pub(super) fn new(windows: &Windows, rig: &Rig) -> Self {
        let cameras = rig.cameras.iter().zip(&windows.cameras);
        let cameras = cameras.map(|(camera, errors)| (camera.name.clone(), errors.all.median()));
        Self { median_px: windows.errors_px.median(), cameras: cameras.collect() }
    }
}

impl DeviationPercentiles {
    pub(super) fn new(poses: &Poses) -> Option<Self> {
        let all = poses.deviations_mm.percentiles([50.0, 95.0]);
        all.map(|[median_mm, p95_mm]| Self { median_mm, p95_mm })
    }
}

impl SolveTime {
    pub(super) fn new(windows: &Windows) -> Option<Self> {
        windows.solve_ms.percentiles([50.0, 99.0]).map(|[p50, p99]| Self { p50, p99 })
    }
}

fn with_part(all: impl fmt::Display, part: usize, what: &str) -> String {
    format!("{all} ({part} {what})")
}

fn px(value: Option<f64>) -> String {
    unit(value, 1, "px")
}

fn unit(value: Option<f64>, digits: usize, unit: &str) -> String {
    value.map_or_else(|| "none".to_owned(), |value| format!("{value:.digits$} {unit}"))
}
