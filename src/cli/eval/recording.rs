//! Methods compared on a real recording.

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

use serde_json::json;

use super::arguments;
use super::output::write;
use crate::cli::failure::{Exit, Failure, within};
use crate::cli::solve::{decoder, lost};
use crate::cli::terminal::{complain, progress};
use crate::core::detections::KeypointFormat;
use crate::core::time::Nanos;
use crate::io::file_name;
use crate::io::formats::{MarkerMap, read_trajectories};
use crate::io::report::{Bars, ReportData};
use crate::offline::recording::Item;
use crate::offline::{FrameClock, HoldOut, Recording, Reference};
use crate::research::experiments::methods;
use crate::research::experiments::real::{
    HeldOutCamera, Markers, RealScore, degraded, frame_rate, measure, table, table_of_points,
};
use crate::research::methods::{Take, Windows};

/// A recording in memory.
pub(super) struct Loaded {
    pub(super) take: Take,
    /// Cameras that no method sees.
    held_out: Vec<HeldOutCamera>,
    /// The frames of the first camera.
    frames: Vec<FrameClock>,
}

impl Loaded {
    /// The named cameras (all with keypoints if there are none), and those that are held out.
    pub(super) fn read(path: &Path, only: &[String], hold_out: &[String]) -> Result<Self, Failure> {
        let mut recording = Recording::open(path)?;
        let (mut rig, mut cameras) = recording.chosen(only, hold_out)?;
        let (mut frames, mut clocks) = (Vec::new(), Vec::new());
        let clock = recording.clock_camera(&rig);
        let mut seen = vec![Vec::new(); cameras.len()];
        recording.stream(
            &rig,
            &cameras,
            || ControlFlow::Continue(()),
            |item| {
                match item {
                    Item::Detections(mut detections, _) => {
                        // The methods get corrected times.
                        let offset = rig.cameras[detections.camera].time_offset;
                        detections.capture = detections.capture + offset;
                        if detections.camera == clock {
                            clocks.push(FrameClock::of(&detections));
                        }
                        frames.push(detections);
                    }
                    Item::HeldOut(mut detections, _) => {
                        let offset = cameras[detections.camera].time_offset;
                        detections.capture = detections.capture + offset;
                        seen[detections.camera].push(detections);
                    }
                    Item::TrueBody(..) | Item::TruePose(..) => {}
                }
                Ok(())
            },
        )?;
        lost(&recording);
        let all = rig.cameras.iter_mut().chain(&mut cameras);
        all.for_each(|camera| camera.time_offset = Nanos::ZERO);
        let short = || {
            let message = format!("{}: fewer than two frames of a camera", path.display());
            Failure::new(Exit::NoDetections, format!("{message}; give a longer recording"))
        };
        let format = KeypointFormat::from_name(recording.format()).ok_or_else(short)?;
        let fps = frame_rate(&frames).ok_or_else(short)?;
        Ok(Self {
            take: Take::new(Arc::new(rig), format, fps, frames),
            held_out: cameras.into_iter().zip(seen).collect(),
            frames: clocks,
        })
    }
}

/// Solves with every method; without named hold-outs, also without each camera in turn.
pub(super) fn run(asked: &arguments::Recording, names: &[String]) -> Result<(), Failure> {
    let path = &asked.file;
    let decoder = decoder(asked.output.weights.as_deref())?;
    let map = asked.markers.as_deref().map(MarkerMap::read).transpose()?;
    let read = |path: &Path| read_trajectories(path, map.as_ref());
    let trajectories = asked.reference.as_deref().map(read).transpose()?;
    let Loaded { take, held_out, frames } = Loaded::read(path, &asked.cameras, &asked.hold_out)?;
    let jitter_px = within("--jitter", asked.jitter, 0.0, 1000.0)?;
    let fps = take.fps;
    let take = degraded(take, asked.every.into(), jitter_px).with_body(&decoder);
    let cameras = take.rig.cameras.len();
    let solves = if held_out.is_empty() { cameras + 1 } else { 1 };
    let bar = progress((names.len() * solves) as u64, "solves");
    let mut scores = Vec::new();
    for name in names {
        let make = || methods::named(name).unwrap_or_else(|| Box::new(Windows::default_settings()));
        let markers = trajectories.as_ref();
        let markers = markers.map(|trajectories| Markers {
            trajectories,
            frames: &frames,
            fps,
            align: asked.align,
        });
        match measure(&take, &held_out, &make, &decoder, markers, &|| bar.inc(1))? {
            Some(score) => scores.push(score),
            None => complain("warning", &format!("{}: {name} found nobody", path.display())),
        }
    }
    bar.finish_and_clear();
    warn_of_uncounted(&scores);
    if scores.is_empty() {
        let message = format!("{}: nobody was found; check the calibration", path.display());
        return Err(Failure::new(Exit::NobodyFound, message));
    }
    // A wrong reference is far from every method.
    let distance = |score: &&RealScore| score.reference.as_ref().map_or(f64::MAX, |r| r.mean_mm);
    let nearest = scores.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    let nearest = nearest.filter(|_| trajectories.is_some());
    if let Some(text) =
        nearest.and_then(|score| Reference::note(score.reference.as_ref(), asked.align))
    {
        complain("warning", &text);
    }
    let name = file_name(path);
    let report = ReportData {
        title: format!("Methods compared on {name}"),
        subtitle: format!("{cameras} cameras at {:.1} fps", take.fps),
        leading: [table("Medians over detected points; distance to the reference", &scores)]
            .into_iter()
            .chain(table_of_points(&scores))
            .collect(),
        bars: vec![bars(&scores)],
        ..ReportData::default()
    };
    let results = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "weights": format!("{:016x}", decoder.fingerprint()),
        "recording": path.display().to_string(),
        "reference": asked.reference.as_ref().map(|path| path.display().to_string()),
        "markers": asked.markers.as_ref().map(|path| path.display().to_string()),
        "align": asked.align,
        "frame_rate_hz": take.fps,
        "every": asked.every,
        "jitter_px": jitter_px,
        "methods": scores,
    });
    write(&asked.output.out, &report, &results)
}

/// Warns of methods that have no error in more held-out frames than others, because nobody is near their body.
fn warn_of_uncounted(scores: &[RealScore]) {
    /// Smaller differences of the shares are no matter.
    const MORE: f64 = 0.02;
    let share = |score: &RealScore| {
        let all = HoldOut::of_all(&score.hold_out)?;
        let without = all.frames_without_performer;
        Some(without as f64 / (all.frames + without).max(1) as f64)
    };
    let least = scores.iter().filter_map(share).fold(1.0, f64::min);
    for score in scores {
        if let Some(share) = share(score).filter(|share| *share > least + MORE) {
            let percent = 100.0 * share;
            let what = "of the held-out frames show nobody near its body, and do not count";
            complain("warning", &format!("{}: {percent:.0} % {what}", score.method));
        }
    }
}

/// The error in each held-out camera.
fn bars(scores: &[RealScore]) -> Bars {
    let Some(first) = scores.first() else { return Bars::default() };
    let group = |camera: &str| {
        let of = |score: &RealScore| {
            let held = score.hold_out.iter().find(|held| held.camera == camera);
            held.and_then(|held| held.median_px).unwrap_or(f64::NAN)
        };
        (camera.to_owned(), scores.iter().map(of).collect())
    };
    Bars {
        title: "Held-out cameras".into(),
        note: "Median distance of the limbs' points in a camera that was not used in the solve."
            .into(),
        label: "error (px)".into(),
        series: scores.iter().map(|score| score.method.clone()).collect(),
        groups: first.hold_out.iter().map(|held| group(&held.camera)).collect(),
    }
}
