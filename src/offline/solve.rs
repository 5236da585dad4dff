//! The pipeline: streams a recording through the tracker; writes, compares and summarises the
//! outputs.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use super::Error;
use super::check::check_rig;
use super::driver::Driver;
use super::first_pass::{CameraOffset, FirstPass};
use super::hold_out::{HeldOut, HoldOut};
use super::options::{Observer, Options};
use super::output::{self, FILES, OutputFolder, PoseFile};
use super::poses::{Comparisons, PoseSummary, Poses};
use super::recording::{Item, Recording};
use super::reference::{FrameClock, Reference, ReferenceComparison};
use super::summary::{Reprojection, SolveTime, Summary};
use super::windows::Windows;
use crate::core::body::Skeleton;
use crate::core::camera::{Camera, Rig};
use crate::core::check::Check;
use crate::core::manifold::Decoder;
use crate::core::tracker::{EventKind, FramePeriod, Input, Output, Solver, Tracker};
use crate::io::recording::{Provenance, Report};

/// Solves a recording in memory that does not grow with its length. The files appear only if the
/// whole solve succeeds.
///
/// # Errors
/// See [`Error`], for instance a recording without a performer.
pub fn solve(
    recording: &mut Recording,
    options: &Options,
    observer: &mut dyn Observer,
) -> Result<Summary, Error> {
    let decoder = options.decoder()?;
    let folder = options.out.as_deref().map(|path| output_folder(path, options.overwrite));
    let folder = folder.transpose()?;
    let begin = Instant::now();
    let Prepared { rig, period, held_out, body, offsets, is_body_wrong } =
        prepare(recording, options, observer)?;
    let judged =
        Rig { cameras: rig.cameras.iter().chain(&held_out).cloned().collect(), ..Rig::clone(&rig) };
    let check = check_rig(recording, &judged, &mut ())?;
    let all = Arc::new(with_solved(recording.rig(), &rig.cameras, &held_out));
    let outputs = folder.map(|folder| Outputs::create(folder, &all, options, &rig, &decoder));
    let mut outputs = outputs.transpose()?;
    let solver = Solver::new(decoder, options.config);
    let bvh = outputs.as_ref().map(|outputs| outputs.folder.file("poses.bvh"));
    let tracker = Tracker::new(options.config, Arc::clone(&rig)).with_frame_period(period);
    let tracker = tracker.with_body(body);
    let mut run = Run {
        driver: Driver::new(tracker, solver),
        collected: Collected {
            poses: Poses::new(bvh),
            windows: Windows::of_cameras(rig.cameras.len()),
            events: BTreeMap::new(),
            comparisons: Comparisons {
                held_out: held_out.iter().cloned().map(HeldOut::new).collect(),
                reference: options.reference.as_ref().map(ReferenceComparison::new),
                ..Comparisons::default()
            },
        },
        file: outputs.as_mut().map(|outputs| &mut outputs.file),
    };
    let report = run.stream(recording, &rig, &held_out, observer)?;
    let Run { driver, mut collected, .. } = run;
    let skeleton = driver.skeleton().filter(|_| collected.poses.found_somebody());
    let Some(skeleton) = skeleton else { return Err(collected.nobody(recording, &rig, &check)) };
    let poses = collected.poses.finish(&skeleton, &mut collected.comparisons)?;
    let states = poses.states.csv();
    let seconds = begin.elapsed().as_secs_f64();
    let (collected, summary) =
        collected.summarise(recording, &rig, &skeleton, poses, &report, seconds);
    let mut summary = Summary { time_offsets: offsets, ..summary };
    summary.notes.extend(check.warnings());
    if options.reference.is_some() {
        summary.notes.extend(Reference::note(summary.reference.as_ref()));
    }
    summary.check = Some(check);
    if is_body_wrong {
        summary.notes.push(BODY_IS_WRONG.to_owned());
    }
    if let Some(outputs) = outputs {
        let Collected { poses, windows, .. } = &collected;
        output::text(&outputs.folder.file("poses.states.csv"), &states)?;
        let page = outputs.folder.file("report.html");
        output::report(&page, poses, windows, &rig, &skeleton, &summary)?;
        outputs.file.finish()?;
    }
    Ok(summary)
}

/// A note for the user.
const BODY_IS_WRONG: &str =
    "the given body fits worse than one from these detections; it was estimated anew";

fn output_folder(path: &Path, overwrite: bool) -> Result<OutputFolder, Error> {
    if !overwrite {
        OutputFolder::refuse_existing(path, &FILES)?;
    }
    OutputFolder::make(path)
}

/// What is known before the second pass.
struct Prepared {
    rig: Arc<Rig>,
    period: Option<FramePeriod>,
    held_out: Vec<Camera>,
    body: Option<Arc<Skeleton>>,
    offsets: Vec<CameraOffset>,
    is_body_wrong: bool,
}

/// The first pass, if it is not switched off: estimates the body and the time offsets.
fn prepare(
    recording: &mut Recording,
    options: &Options,
    observer: &mut dyn Observer,
) -> Result<Prepared, Error> {
    let held_out = options.hold_out.iter().map(|name| recording.camera(name).cloned());
    let mut held_out: Vec<Camera> = held_out.collect::<Result<_, _>>()?;
    let mut rig = recording.chosen(&options.cameras, &held_out)?;
    let period = recording.frame_period(&rig)?;
    let (mut body, mut offsets, mut is_body_wrong) = (options.body.clone(), Vec::new(), false);
    if options.passes() > 1 {
        let first = FirstPass::run(recording, options, &mut rig, period, &mut held_out, observer)?;
        is_body_wrong = first.is_body_wrong && options.body.is_some();
        (body, offsets) = (first.body(), first.offsets);
    }
    Ok(Prepared { rig: Arc::new(rig), period, held_out, body, offsets, is_body_wrong })
}

/// The rig with the cameras of a solve in place of its own.
fn with_solved(rig: &Rig, solved: &[Camera], held_out: &[Camera]) -> Rig {
    let mut rig = rig.clone();
    for solved in solved.iter().chain(held_out) {
        let own = rig.cameras.iter_mut().filter(|camera| camera.name == solved.name);
        own.for_each(|camera| camera.clone_from(solved));
    }
    rig
}

struct Outputs {
    file: PoseFile,
    // Dropped last: it goes only if it is empty.
    folder: OutputFolder,
}

impl Outputs {
    fn create(
        folder: OutputFolder,
        all: &Arc<Rig>,
        options: &Options,
        rig: &Rig,
        decoder: &Decoder,
    ) -> Result<Self, Error> {
        let own = || toml::to_string(&options.config).unwrap_or_default();
        let provenance = Provenance {
            config: options.config_toml.clone().unwrap_or_else(own),
            weights: format!("{:016x}", decoder.fingerprint()),
            ..Provenance::default()
        };
        let path = folder.file("poses.mcap");
        let file = PoseFile::create(&path, all, rig, &provenance)?;
        Ok(Self { folder, file })
    }
}

/// A solve in progress.
struct Run<'reference, 'file> {
    driver: Driver,
    collected: Collected<'reference>,
    file: Option<&'file mut PoseFile>,
}

impl Run<'_, '_> {
    fn stream(
        &mut self,
        recording: &mut Recording,
        rig: &Rig,
        held_out: &[Camera],
        observer: &mut dyn Observer,
    ) -> Result<Report, Error> {
        // Both closures use the observer.
        let observer = std::cell::RefCell::new(observer);
        let report = recording.stream(
            rig,
            held_out,
            || observer.borrow_mut().message(),
            |item| self.take(item, *observer.borrow_mut()),
        )?;
        self.feed(Input::End, *observer.borrow_mut())?;
        Ok(report)
    }

    fn take(&mut self, item: Item, observer: &mut dyn Observer) -> Result<(), Error> {
        let Collected { poses, comparisons, .. } = &mut self.collected;
        match item {
            Item::Detections(detections) => {
                if detections.camera == 0 {
                    comparisons.clock.get_or_insert(FrameClock::of(&detections));
                }
                if poses.count == 0 {
                    let capture = detections.capture;
                    poses.start = Some(poses.start.map_or(capture, |start| start.min(capture)));
                }
                self.feed(Input::Detections(detections), observer)?;
            }
            Item::HeldOut(detections) => {
                if let Some(held_out) = comparisons.held_out.get_mut(detections.camera) {
                    held_out.add_frame(detections);
                }
            }
            Item::TrueBody(body) => comparisons.truth.set_body(*body),
            Item::TruePose(pose) => comparisons.truth.add_truth(pose.as_ref().into()),
        }
        Ok(())
    }

    fn feed(&mut self, input: Input, observer: &mut dyn Observer) -> Result<(), Error> {
        let Self { driver, collected, file } = self;
        driver.feed(input, |driver, output| {
            collected.add(driver, output, observer)?;
            file.as_mut().map_or(Ok(()), |file| file.write(output))
        })
    }
}

/// The results of a solve.
struct Collected<'a> {
    poses: Poses,
    windows: Windows,
    events: BTreeMap<EventKind, u64>,
    comparisons: Comparisons<'a>,
}

impl Collected<'_> {
    fn add(
        &mut self,
        driver: &Driver,
        output: &Output,
        observer: &mut dyn Observer,
    ) -> Result<(), Error> {
        match output {
            Output::Pose(pose) => {
                let Some(skeleton) = driver.skeleton() else { return Ok(()) };
                observer.pose(pose, &skeleton);
                self.poses.add(pose.as_ref().into(), &skeleton, &mut self.comparisons)?;
            }
            Output::Event(event) => *self.events.entry(event.kind).or_default() += event.count,
            Output::Window(report) => self.windows.add(report, driver.window_solve),
            Output::Skeleton(_) | Output::Keyframe(_) | Output::Solve(_) => {}
        }
        Ok(())
    }

    fn count(&self, kind: EventKind) -> u64 {
        self.events.get(&kind).copied().unwrap_or(0)
    }

    fn summarise(
        mut self,
        recording: &Recording,
        rig: &Rig,
        skeleton: &Skeleton,
        poses: PoseSummary,
        report: &Report,
        seconds: f64,
    ) -> (Self, Summary) {
        let comparisons = std::mem::take(&mut self.comparisons);
        let held_out: Vec<HoldOut> =
            comparisons.held_out.into_iter().map(HeldOut::finish).collect();
        let frames = self.poses.count;
        let truth = poses.fps.and_then(|fps| comparisons.truth.finish(skeleton, fps));
        let (truth, true_skate) = truth.unzip();
        let summary = Summary {
            version: env!("CARGO_PKG_VERSION"),
            recording: recording.path().display().to_string(),
            frames,
            frames_lost: self.poses.flagged,
            windows: self.windows.count,
            lost: self.windows.lost,
            windows_without_performer: self.count(EventKind::NobodyFound),
            frame_rate_hz: poses.fps,
            reprojection: Reprojection::new(&self.windows, rig),
            hold_out: HoldOut::of_all(&held_out),
            hold_out_cameras: held_out,
            mean_acceleration_m_s2: poses.acceleration,
            foot_skate: true_skate.unwrap_or(poses.feet),
            floor_m: poses.floor,
            truth,
            reference: comparisons.reference.and_then(|reference| reference.finish()),
            solve_ms: SolveTime::new(&self.windows),
            frames_per_second: frames as f64 / seconds.max(1e-9),
            events: EventKind::ALL.map(|kind| (kind.name(), self.count(kind))).into(),
            damage: report.losses(),
            time_offsets: Vec::new(),
            check: None,
            notes: poses.note.into_iter().collect(),
        };
        (self, summary)
    }

    fn nobody(&self, recording: &Recording, rig: &Rig, check: &Check) -> Error {
        let unusable = match self.count(EventKind::Unusable) {
            0 => String::new(),
            unusable => format!(", {unusable} frames could not be used"),
        };
        let evidence = format!(
            "no performer is seen by two of the {} cameras at once ({} windows tried{unusable}{}); \
             check the calibration, the keypoint format ({}) and that the cameras share a clock",
            rig.cameras.len(),
            self.count(EventKind::NobodyFound) + self.windows.lost as u64,
            out_of_time(self.count(EventKind::Late), self.count(EventKind::Duplicate)),
            recording.format(),
        );
        let found = check.warnings().map(|warning| format!("; {warning}"));
        let evidence = found.fold(evidence, |all, warning| all + &warning);
        Error::NobodyFound { path: recording.path().to_owned(), evidence }
    }
}

/// A note on the frames of a recording that is not sorted by capture time.
fn out_of_time(late: u64, duplicate: u64) -> String {
    if late == 0 && duplicate == 0 {
        return String::new();
    }
    format!(
        ", {late} frames came late and {duplicate} came twice; they were not used: is the recording \
         sorted by capture time?"
    )
}
