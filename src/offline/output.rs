//! The files of a solve: poses.mcap and poses.bvh are written during the solve, poses.states.csv
//! and report.html at the end.
//!
//! Each is written to a temporary file and renamed, so that a failure leaves no partial file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::Error;
use super::camera_states::CameraStates;
use super::collected::Collected;
use super::compact_pose::CompactPose;
use super::options::Options;
use super::poses::Poses;
use super::series::{Mean, Series};
use super::summary::{Group, Summary};
use super::windows::{WindowSummary, Windows};
use crate::core::body::{Posture, Skeleton};
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::stage::Performers;
use crate::core::time::Timestamp;
use crate::core::tracker::Output;
use crate::diagnose::{CameraCheck, Check, Finding};
use crate::io::new_file;
use crate::io::recording::{Provenance, TAKE, Writer};
use crate::io::report::{
    self, AngleTrack, BENT, CameraErrors, Moment, MomentKind, Picture, Player, Plot, ReportData,
    StickFigures, Table, Track, WindowRow, stick_figures, write_report,
};
use crate::io::timecode::House;
use crate::io::wire::{self, Topics};
use crate::metrics::Episode;

/// Most of the worst moments in the report.
const MOMENTS: usize = 10;
/// Number of stick figures in the report.
const STICK_FIGURES: usize = 9;

/// The name of a performer's file: `poses.bvh`, or `poses.p1.bvh` where there can be several.
pub(crate) fn of_performer(name: &str, performers: Performers, suffix: &str) -> String {
    match performers.limit() {
        1 => format!("poses.{suffix}"),
        _ => format!("poses.{name}.{suffix}"),
    }
}

/// A folder for outputs. If it was created here and stays empty, it is removed on drop.
pub(crate) struct OutputFolder {
    path: PathBuf,
    made: bool,
}

impl OutputFolder {
    pub(crate) fn make(path: &Path) -> Result<Self, Error> {
        if path.is_file() {
            return Err(Error::NoFolder { path: path.to_owned() });
        }
        let made = !path.exists();
        std::fs::create_dir_all(path)
            .map_err(|source| Error::Write { path: path.to_owned(), source })?;
        Ok(Self { path: path.to_owned(), made })
    }

    /// Fails if one of these files exists.
    pub(crate) fn refuse_existing(path: &Path, files: &[impl AsRef<Path>]) -> Result<(), Error> {
        let there = files.iter().map(|name| path.join(name)).find(|path| path.exists());
        there.map_or(Ok(()), |path| Err(Error::Exists { path }))
    }

    /// Fails if the folder has files of performers, whatever their names.
    pub(crate) fn refuse_performers(path: &Path) -> Result<(), Error> {
        let entries = std::fs::read_dir(path).into_iter().flatten().flatten();
        let mut files: Vec<PathBuf> = entries.map(|entry| entry.file_name().into()).collect();
        files.sort();
        let is_of_performer = |file: &&PathBuf| {
            let name = file.to_string_lossy();
            let mut endings = [".bvh", ".states.csv", ".timecode.txt"].iter();
            name.starts_with("poses.") && endings.any(|ending| name.ends_with(ending))
        };
        Self::refuse_existing(path, &files.iter().filter(is_of_performer).collect::<Vec<_>>())
    }

    pub(crate) fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        if self.made {
            // Fails if the folder is not empty, as intended.
            let _ = std::fs::remove_dir(&self.path);
        }
    }
}

/// Writes the stage's outputs to poses.mcap one by one.
pub(crate) struct PoseFile {
    writer: Writer,
    rig: Arc<Rig>,
    cameras: Vec<String>,
    performers: Vec<Performer>,
    states: CameraStates,
    has_rig: bool,
    weights: String,
    timecode: Option<House>,
}

/// A performer in poses.mcap.
struct Performer {
    topics: Topics,
    skeleton: Option<Arc<Skeleton>>,
    has_skeleton: bool,
}

impl PoseFile {
    /// `rig` is that of the recording, `solved` that of the trackers; `check` judges its cameras.
    pub(crate) fn create(
        path: &Path,
        rig: &Arc<Rig>,
        (solved, check): (&Rig, Option<&Check>),
        provenance: &Provenance,
        performers: &[String],
        Options { timecode, companion, .. }: &Options,
    ) -> Result<Self, Error> {
        let performer = |name: &String| Performer {
            topics: Topics { actor: name.clone(), ..Topics::default() },
            skeleton: None,
            has_skeleton: false,
        };
        Ok(Self {
            weights: provenance.weights.clone(),
            writer: Writer::create(path, Topics::default(), provenance)?
                .with_companion(companion.map(|new| new())),
            rig: Arc::clone(rig),
            cameras: solved.cameras.iter().map(|camera| camera.name.clone()).collect(),
            performers: performers.iter().map(performer).collect(),
            states: CameraStates::new(solved, check),
            has_rig: false,
            timecode: *timecode,
        })
    }

    /// Takes a frame, and writes the state of the cameras once a second.
    pub(crate) fn frame(&mut self, frame: &Detections) -> Result<(), Error> {
        let Some(status) = self.states.frame(frame) else { return Ok(()) };
        let at = Timestamp::from_ns(status.capture_time_ns);
        Ok(self.writer.write(&Topics::default().status(), at, &status)?)
    }

    /// Writes one output of a performer.
    pub(crate) fn write(&mut self, performer: usize, output: &Output) -> Result<(), Error> {
        let Self { writer, rig, cameras, performers, states, has_rig, weights, timecode } = self;
        let Some(Performer { topics, skeleton, has_skeleton }) = performers.get_mut(performer)
        else {
            return Ok(());
        };
        match output {
            Output::Skeleton(new) => {
                *skeleton = Some(Arc::clone(new));
                *has_skeleton = false;
            }
            Output::Pose(pose) => {
                let Some(skeleton) = skeleton else { return Ok(()) };
                if !*has_rig {
                    writer.rig(rig, pose.capture)?;
                    *has_rig = true;
                }
                if !*has_skeleton {
                    let body = wire::Skeleton::from_core(skeleton);
                    writer.write(&topics.skeleton(), pose.capture, &body)?;
                    *has_skeleton = true;
                }
                let message = wire::Pose::from_core(pose, skeleton, None).labelled(*timecode);
                writer.write(&topics.pose(), pose.capture, &message)?;
            }
            Output::Keyframe(keyframe) => {
                let message = wire::Keyframe::from_core(keyframe, weights);
                writer.write(&topics.keyframe(), keyframe.capture, &message)?;
            }
            Output::Event(event) => {
                states.event(event);
                let camera = event.camera.and_then(|camera| cameras.get(camera));
                let message = wire::Event::from_core(event, camera.map(String::as_str));
                writer.write(&topics.events(event.kind), event.capture, &message)?;
            }
            Output::Window(report) => states.window(report),
            Output::Solve(_) | Output::HandOver(_) | Output::Placed { .. } => {}
        }
        Ok(())
    }

    /// Moves the file to its place. `start`: the capture time of the take's first frame.
    pub(crate) fn finish(mut self, start: Option<Timestamp>) -> Result<(), Error> {
        if let Some(start) = start {
            let entry = ("first_capture_time_ns".to_owned(), start.ns().to_string());
            self.writer.metadata(TAKE, BTreeMap::from([entry]))?;
        }
        Ok(self.writer.finish()?)
    }
}

/// Writes a text file, completely or not at all.
pub(crate) fn text(path: &Path, text: &str) -> Result<(), Error> {
    new_file::write(path, text.as_bytes())
        .map_err(|source| Error::Write { path: path.to_owned(), source })
}

/// Writes report.html: a performer's page, or one with all of them.
pub(super) fn report(
    path: &Path,
    mut pages: Vec<ReportData>,
    group: &Group,
    performers: Performers,
) -> Result<(), Error> {
    let Some(first) = pages.first_mut() else { return Ok(()) };
    if performers.limit() == 1 {
        return Ok(write_report(path, first)?);
    }
    let data = ReportData {
        title: first.title.clone(),
        subtitle: first.subtitle.clone(),
        facts: group.headline(),
        leading: std::iter::once(group.table()).chain(std::mem::take(&mut first.leading)).collect(),
        ..ReportData::default()
    };
    let mut player: Option<Player> = None;
    for (page, performer) in pages.iter_mut().zip(&group.performers) {
        match (&mut player, page.player.take()) {
            (Some(all), Some(Player { start, tracks, moments, .. })) => {
                all.start = all.start.min(start);
                all.tracks.extend(tracks);
                all.moments = worst([std::mem::take(&mut all.moments), moments].concat());
            }
            (all, first) => *all = first,
        }
        page.leading.clear();
        page.title.clone_from(&performer.performer);
        page.subtitle.clear();
    }
    Ok(write_report(path, &ReportData { player, parts: pages, ..data })?)
}

/// A performer's page.
pub(super) fn page(
    Collected { name, poses, windows, .. }: &Collected,
    rig: &Rig,
    skeleton: &Skeleton,
    summary: &Summary,
) -> ReportData {
    let shown = poses.shown.bins();
    // As in the figures, and the same for all performers.
    let start = Timestamp::from_ns(summary.first_capture_time_ns.unwrap_or_default());
    let recording = Path::new(&summary.recording).file_name().unwrap_or_default();
    ReportData {
        title: recording.to_string_lossy().into_owned(),
        subtitle: format!("Solved by bundlemocap {}", summary.version),
        facts: summary.headline(),
        leading: summary.check.iter().map(verdicts).collect(),
        tables: vec![Table {
            title: "Figures".into(),
            header: vec!["figure".into(), "value".into()],
            rows: summary.rows().into_iter().map(|(name, value)| vec![name, value]).collect(),
        }],
        pictures: vec![Picture {
            title: "Poses".into(),
            svg: strip(shown, skeleton, STICK_FIGURES, start),
        }],
        player: Some(Player {
            rig: rig.clone(),
            start,
            tracks: vec![Track {
                name: name.clone(),
                body: skeleton.clone(),
                poses: poses.played.bins().to_vec(),
            }],
            moments: moments(windows, summary, name),
        }),
        cameras: camera_errors(windows, rig, start),
        angles: angles(poses, start),
        plots: deviations(poses, start).into_iter().collect(),
        windows: windows.series.bins().iter().map(|window| row(window, start)).collect(),
        ..ReportData::default()
    }
}

/// Begin and end of what is lost.
fn lost_stretches(all: &[WindowSummary]) -> Vec<[Timestamp; 2]> {
    let is_one = |a: &WindowSummary, b: &WindowSummary| match (a.lost, b.lost) {
        (None, None) => true,
        (Some([_, to]), Some([from, _])) => to == a.end && from == b.start,
        _ => false,
    };
    let runs: Vec<&[WindowSummary]> = all.chunk_by(is_one).collect();
    let stretch = |(k, run): (usize, &&[WindowSummary])| {
        let last = &run[run.len() - 1];
        let ([from, _], [_, to]) = (run[0].lost?, last.lost?);
        // While somebody is searched there are no windows.
        let next = runs.get(k + 1).filter(|_| to == last.end);
        Some([from, next.map_or(to, |next| next[0].start)])
    };
    runs.iter().enumerate().filter_map(stretch).collect()
}

/// The bad moments of a performer: points that were not followed, lost stretches, and the windows of the highest
/// cost, at least a second apart.
fn moments(windows: &Windows, summary: &Summary, name: &str) -> Vec<Moment> {
    let moment =
        |at, kind, size, what: String| Moment { at, what: format!("{name}: {what}"), kind, size };
    let followed = summary.not_followed.iter().flat_map(|found| &found.longest).map(|episode| {
        let Episode { keypoint, capture_time_ns, frames, distance_m } = episode;
        let (at, cm) = (Timestamp::from_ns(*capture_time_ns), 100.0 * distance_m);
        let what = format!("{keypoint} {cm:.0} cm from where the cameras see it, {frames} frames");
        moment(at, MomentKind::NotFollowed, *frames as f64, what)
    });
    let all = windows.series.bins();
    let lost = lost_stretches(all).into_iter().map(|[from, to]| {
        let seconds = to.seconds_since(from);
        let what = format!("lost or extrapolated for {seconds:.2} s");
        moment(from, MomentKind::Lost, seconds, what)
    });
    let mut costly: Vec<_> = all.iter().filter(|window| window.cost.is_finite()).collect();
    costly.sort_by(|a, b| b.cost.total_cmp(&a.cost));
    let mut apart: Vec<&WindowSummary> = Vec::new();
    for window in costly {
        let is_apart = |one: &&WindowSummary| one.start.seconds_since(window.start).abs() > 1.0;
        if apart.len() < MOMENTS && apart.iter().all(is_apart) {
            apart.push(window);
        }
    }
    let costly = apart.into_iter().map(|window| {
        let what = format!("window cost {:.0}, among the highest", window.cost);
        moment(window.start, MomentKind::Costly, window.cost, what)
    });
    worst(followed.chain(lost).chain(costly).collect())
}

/// The worst of these moments: those of each kind, the worst first.
fn worst(mut moments: Vec<Moment>) -> Vec<Moment> {
    moments.sort_by(|a, b| a.kind.cmp(&b.kind).then(b.size.total_cmp(&a.size)));
    let of = |kind| moments.iter().filter(move |moment| moment.kind == kind);
    let followed = of(MomentKind::NotFollowed).take(MOMENTS / 2);
    let lost = of(MomentKind::Lost).take(MOMENTS / 4);
    followed.chain(lost).chain(of(MomentKind::Costly)).take(MOMENTS).cloned().collect()
}

/// The cameras judged, and what is wrong with all of them.
fn verdicts(check: &Check) -> Table {
    let number =
        |value: Option<f64>| value.map_or("none".to_owned(), |value| format!("{value:.0}"));
    let row = |camera: &CameraCheck| {
        let [share, error] = [camera.agreeing_percent, camera.error_px].map(number);
        vec![camera.camera.clone(), share, error, camera.verdict()]
    };
    let all = check.findings.iter().map(|Finding { what, fix, .. }| {
        vec!["all".to_owned(), String::new(), String::new(), format!("{what}; {fix}")]
    });
    Table {
        title: "Cameras beside each other".into(),
        header: ["camera", "points that agree (%)", "error (px)", "verdict"]
            .map(str::to_owned)
            .into(),
        rows: check.cameras.iter().map(row).chain(all).collect(),
    }
}

/// Stick figures at `count` times, evenly spaced, with the seconds since `start`.
pub(crate) fn strip(
    poses: &[CompactPose],
    skeleton: &Skeleton,
    count: usize,
    start: Timestamp,
) -> String {
    let (last, count) = (poses.len().saturating_sub(1), count.min(poses.len()));
    let chosen = (0..count).map(|i| &poses[i * last / (count - 1).max(1)]);
    let figures: Vec<(Posture, String)> = chosen
        .map(|pose| {
            let caption = format!("{:.2} s", pose.capture.seconds_since(start));
            (pose.pose().posture(skeleton), caption)
        })
        .collect();
    let figures = figures.iter().map(|(posture, caption)| (posture, caption.as_str()));
    stick_figures(figures, &StickFigures::default())
}

fn camera_errors(windows: &Windows, rig: &Rig, start: Timestamp) -> Vec<CameraErrors> {
    let cameras = rig.cameras.iter().zip(&windows.cameras).map(|(camera, errors)| {
        let frames = errors.frames.bins().iter();
        let frames = frames.map(|bin| (bin.at.seconds_since(start), bin.values()));
        CameraErrors { name: camera.name.clone(), frames: frames.collect() }
    });
    cameras.collect()
}

fn angles(poses: &Poses, start: Timestamp) -> Vec<AngleTrack> {
    let tracks = BENT.into_iter().zip(&poses.angles);
    let tracks = tracks.map(|(joint, series): (_, &Series<_>)| {
        let degrees = series.bins().iter();
        let degrees = degrees.map(|bin| (bin.at.seconds_since(start), bin.values()[0]));
        AngleTrack { joint, degrees: degrees.collect() }
    });
    tracks.collect()
}

/// The standard deviations of the joint centres over time.
fn deviations(poses: &Poses, start: Timestamp) -> Option<Plot> {
    let curve = |name: &str, index: usize| {
        let of =
            |bin: &Mean<Timestamp, 2>| (bin.at.seconds_since(start), 1e3 * bin.values()[index]);
        let points = poses.deviations.bins().iter().map(of).collect();
        report::Series { name: name.into(), points, colour: index, ..Default::default() }
    };
    (!poses.deviations.bins().is_empty()).then(|| Plot {
        title: "How certain the joint centres are".into(),
        note: "Standard deviation along each axis.".into(),
        x_label: "time (s)".into(),
        y_label: "mm".into(),
        series: vec![curve("mean of the joints", 0), curve("least certain joint", 1)],
        ..Plot::default()
    })
}

fn row(window: &WindowSummary, start: Timestamp) -> WindowRow {
    WindowRow {
        start_s: window.start.seconds_since(start),
        end_s: window.end.seconds_since(start),
        latent_norm: window.latent_norm,
        iterations: window.iterations,
        cost: window.cost,
        solve_ms: window.solve_ms,
        lost_s: window.lost.map(|lost| lost.map(|at| at.seconds_since(start))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Pose, TrackingState};
    use crate::core::time::Nanos;
    use crate::io::report::PlayerPose;
    use crate::offline::poses::PLAYED;

    #[test]
    fn the_worst_moments_of_all_performers_are_the_worst_first() {
        let moment = |kind, size: usize| Moment {
            at: Timestamp::default(),
            what: format!("{size}"),
            kind,
            size: size as f64,
        };
        let of = |first: usize| {
            let costly = (0..MOMENTS).map(move |k| moment(MomentKind::Costly, first + 2 * k));
            costly.chain([moment(MomentKind::Lost, first), moment(MomentKind::NotFollowed, first)])
        };
        let found = worst(of(0).chain(of(1)).collect());
        let words: Vec<&str> = found.iter().map(|moment| &*moment.what).collect();
        assert_eq!(words, ["1", "0", "1", "0", "19", "18", "17", "16", "15", "14"]);
    }

    #[test]
    fn lost_stretches_keep_their_length_in_a_long_take() {
        let at = |seconds: usize| Timestamp::default() + Nanos::SECOND * seconds as i64;
        let window = |second: usize| WindowSummary {
            start: at(second),
            end: at(second + 1),
            latent_norm: 1.0,
            iterations: 1,
            cost: 1.0,
            // Somebody is searched after the second of them.
            lost: [3, 8, 9].contains(&second).then_some([at(second), at(second + 1)]),
            solve_ms: 1.0,
        };
        let windows = || (0..10).chain(15..20).map(window);
        let lost = |limit: usize| {
            let mut series = Series::up_to(limit);
            windows().for_each(|window| series.push(window));
            lost_stretches(series.bins())
        };
        assert_eq!(lost(100), [[at(3), at(4)], [at(8), at(15)]]);
        assert_eq!(lost(8), [[at(3), at(4)], [at(8), at(15)]]);
    }

    #[test]
    fn the_report_of_the_longest_take_is_below_50_mb() {
        const PERFORMERS: usize = 10;
        let track = |number: usize| {
            let pose = |k: usize| {
                let capture = Timestamp::from_ns(16_666_667 * k as i64);
                PlayerPose::new(capture, TrackingState::Tracking, &Pose::rest())
            };
            let poses = (0..PLAYED / PERFORMERS).map(pose).collect();
            Track { name: format!("p{number}"), body: Skeleton::default(), poses }
        };
        let tracks = (0..PERFORMERS).map(track).collect();
        let rig = Rig { version: 1, cameras: Vec::new() };
        let player = Player { rig, start: Timestamp::default(), tracks, moments: Vec::new() };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("report.html");
        write_report(&path, &ReportData { player: Some(player), ..ReportData::default() }).unwrap();
        let bytes = std::fs::metadata(path).unwrap().len();
        assert!((1_000_000..50_000_000).contains(&bytes), "{bytes} bytes");
    }
}
