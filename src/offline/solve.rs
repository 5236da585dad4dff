//! The pipeline: streams a recording through the stage; writes, compares and summarises the outputs.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use super::Error;
use super::collected::{Collected, nobody};
use super::driver::{Driver, State, Step};
use super::first_pass::{CameraOffset, FirstPass};
use super::hold_out::HeldOut;
use super::options::{Observer, Options};
use super::output::{self, OutputFolder, PoseFile};
use super::poses::{Comparisons, PLAYED, Poses};
use super::recording::{Item, Recording};
use super::reference::{FrameClock, Reference, ReferenceComparison};
use super::summary::{Group, PerformerSummary, Summary};
use super::tracking::Tracking;
use super::windows::Windows;
use crate::core::body::Skeleton;
use crate::core::camera::{Camera, Rig};
use crate::core::detections::Detections;
use crate::core::manifold::Decoder;
use crate::core::stage::{Names, PerformerId, Performers, Stage};
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{EventKind, FramePeriod, Output, Tracker};
use crate::diagnose::{Check, Evidence};
use crate::io::recording::Provenance;
use crate::io::wire::Topics;

/// Solves one performer of a recording, in memory that does not grow with its length. The files appear
/// only if the whole solve succeeds.
///
/// # Errors
/// See [`Error`], for instance a recording without a performer.
pub fn solve(
    recording: &mut Recording,
    options: &Options,
    observer: &mut dyn Observer,
) -> Result<Summary, Error> {
    let one = Options { performers: Performers::default(), ..options.clone() };
    let mut group = solve_group(recording, &one, observer)?;
    Ok(group.performers.swap_remove(0).summary)
}

/// Solves the performers of a recording together, as many as the options say.
///
/// # Errors
/// As [`solve`]; nobody at all was found.
pub fn solve_group(
    recording: &mut Recording,
    options: &Options,
    observer: &mut dyn Observer,
) -> Result<Group, Error> {
    let decoder = options.decoder()?;
    let folder = options.out.as_deref().map(|path| output_folder(path, options));
    let folder = folder.transpose()?;
    let begin = Instant::now();
    let Prepared { rig, period, held_out, bodies, count, offsets, notes, is_body_wrong, evidence } =
        prepare(recording, options, observer)?;
    let names = names(options, count);
    // Known people may not be in the recording.
    let found = bodies.iter().flatten().count();
    let shown = if options.passes() > 1 { found } else { names.len() };
    let judged =
        Rig { cameras: rig.cameras.iter().chain(&held_out).cloned().collect(), ..Rig::clone(&rig) };
    // Without a pass before, the evidence is gathered in this one.
    let mut check = evidence
        .map(|evidence| evidence.check(&judged))
        .ok_or_else(|| Evidence::new(Arc::new(judged.clone()), options.config, period));
    let all = Arc::new(recording.rig_with(rig.cameras.iter().chain(&held_out)));
    let outputs = folder.map(|folder| {
        Outputs::create(folder, &all, options, (&rig, check.as_ref().ok()), &decoder, &names)
    });
    let mut outputs = outputs.transpose()?;
    let tracker = Tracker::new(options.config, Arc::clone(&rig));
    let stage = Stage::new(tracker, options.performers, period).with_bodies(bodies);
    let stage = stage.choosing(options.choice.clone()).naming(Names::new(options.names.clone()));
    let stage = stage.with_known(&options.known);
    let bvh = |name: &String| {
        let folder = &outputs.as_ref()?.folder;
        Some(folder.file(&output::of_performer(name, options.performers, "bvh")))
    };
    let played = if outputs.is_some() { (PLAYED / shown.max(1)).max(1) } else { 1 };
    let collected = |name: &String| Collected {
        name: name.clone(),
        poses: Poses::new(bvh(name), played),
        windows: Windows::of_cameras(rig.cameras.len()),
        events: BTreeMap::new(),
        comparisons: Comparisons {
            held_out: held_out.iter().cloned().map(HeldOut::new).collect(),
            references: options.references.iter().map(ReferenceComparison::new).collect(),
            ..Comparisons::default()
        },
    };
    let collected = names.iter().map(collected).collect();
    let file = outputs.as_mut().map(|outputs| &mut outputs.file);
    let tracking = (options.performers.limit() > 1).then(Tracking::default);
    let mut driver = Driver::new(stage, decoder, options.config, options.threads);
    let mut run = Run {
        collected,
        tracking,
        file,
        evidence: check.as_mut().err(),
        offsets: rig.cameras.iter().map(|camera| camera.time_offset).collect(),
        starts: vec![None; rig.cameras.len()],
        recorded: vec![(0, None); rig.cameras.len()],
        clock: recording.clock_camera(&rig),
    };
    run.stream(&mut driver, recording, (&rig, &held_out), observer)?;
    let Run { mut collected, tracking, recorded, .. } = run;
    let frames = || recorded.iter().map(|(frames, _)| *frames);
    let (frames_recorded, all_frames) = (frames().max().unwrap_or_default(), frames().sum());
    let check = check.unwrap_or_else(|evidence| evidence.check(&judged));
    let mut bodies = driver.skeletons();
    let followed = bodies.len();
    bodies.resize(collected.len(), None);
    let found = |(body, one): (Option<_>, &Collected)| body.filter(|_| one.poses.found_somebody());
    let skeletons: Vec<_> = bodies.into_iter().zip(&collected).map(found).collect();
    if skeletons.iter().all(Option::is_none) {
        let is_several = options.performers.limit() > 1;
        return Err(nobody(&collected, recording, &rig, &check, driver.others(), is_several));
    }
    let mut summaries = Vec::new();
    for (one, skeleton) in collected.iter_mut().zip(&skeletons) {
        let Some(skeleton) = skeleton else { continue };
        summaries.push(one.poses.finish(skeleton, &mut one.comparisons)?);
    }
    let seconds = begin.elapsed().as_secs_f64();
    let solved =
        collected.into_iter().zip(&skeletons).filter_map(|(one, s)| Some((one, s.as_ref()?)));
    let new = skeletons.iter().take(followed).skip(options.known.len());
    let unsolved = new.filter(|body| body.is_none()).count();
    let mut group = Group {
        performers: Vec::new(),
        others: driver.others() + unsolved,
        scores: tracking.and_then(Tracking::finish),
        known: driver.known(),
    };
    let silent = recording.silent_note().filter(|_| options.cameras.is_empty());
    let mut pages = Vec::new();
    for ((one, skeleton), poses) in solved.zip(summaries) {
        let states = poses.states.csv();
        let is_alone = options.performers.limit() == 1;
        let fits = one.windows.cameras.iter().zip(&check.cameras);
        let fits: Vec<String> = fits.filter_map(|(errors, check)| errors.note(check)).collect();
        let (one, summary) = one.summarise(recording, &rig, skeleton, poses, seconds, is_alone);
        let mut summary = Summary { time_offsets: offsets.clone(), frames_recorded, ..summary };
        summary.notes.extend(silent.iter().cloned().chain(recording.rig_note()));
        summary.notes.extend(notes.iter().map(|note| format!("{note}; its times are corrected")));
        summary.notes.extend(check.warnings());
        // One of several performers may not be in the view of each camera.
        if is_alone {
            summary.notes.extend(fits);
        }
        if !options.references.is_empty() {
            summary.notes.extend(Reference::note(summary.reference.as_ref(), false));
        }
        summary.check = Some(check.clone());
        if is_body_wrong {
            summary.notes.push(BODY_IS_WRONG.to_owned());
        }
        summary.notes.extend(rate_note(options.config.frame_rate_hz, period));
        summary.notes.extend(order_note(&summary, all_frames));
        // Of several, some enter late or leave. With another frame rate there are other numbers of poses.
        if is_alone && options.config.frame_rate_hz == 0.0 {
            summary.notes.extend(missing_note(&summary));
        }
        if let Some(Outputs { folder, .. }) = &outputs {
            let csv = output::of_performer(&one.name, options.performers, "states.csv");
            output::text(&folder.file(&csv), &states)?;
            pages.push(output::page(&one, &rig, skeleton, &summary));
        }
        group.performers.push(PerformerSummary { performer: one.name, summary });
    }
    if let Some(outputs) = outputs {
        output::report(&outputs.folder.file("report.html"), pages, &group, options.performers)?;
        let starts = group.performers.iter().filter_map(|one| one.summary.first_capture_time_ns);
        outputs.file.finish(starts.min().map(Timestamp::from_ns))?;
    }
    Ok(group)
}

/// The performers' names: with one performer, that of the topics.
fn names(options: &Options, count: usize) -> Vec<String> {
    if options.performers.limit() == 1 {
        return vec![Topics::default().actor];
    }
    // As the stage gives them.
    let mut names = Names::new(options.names.clone());
    names.know(&options.known);
    let numbers = (0..count).map(PerformerId);
    numbers.clone().skip(options.known.len()).for_each(|number| names.enter(number));
    numbers.map(|number| names.of(number)).collect()
}

/// A note for the user.
const BODY_IS_WRONG: &str =
    "the given body fits worse than one from these detections; it was estimated anew";

/// A note if the given frame rate, Hz (0: none), is not that of the recording.
fn rate_note(given: f64, period: Option<FramePeriod>) -> Option<String> {
    const OFF: f64 = 0.05;
    let measured = 1e9 / period.filter(|_| given > 0.0)?.ns;
    let is_off = (given / measured - 1.0).abs() > OFF;
    is_off.then(|| format!("the cameras have {measured:.1} frames a second, not {given:.1}"))
}

/// A note if many of all cameras' frames were too late to be used.
fn order_note(summary: &Summary, all_frames: usize) -> Option<String> {
    const MANY: f64 = 0.05;
    let late = summary.events.get(EventKind::Late.name()).copied().unwrap_or_default();
    (late as f64 > MANY * all_frames as f64).then(|| {
        format!(
            "{late} frames came late and were not used: is the recording sorted by capture time?"
        )
    })
}

/// A note if many frames have no pose.
fn missing_note(summary: &Summary) -> Option<String> {
    const MANY: f64 = 0.05;
    let recorded = summary.frames_recorded;
    let missing = recorded.saturating_sub(summary.frames);
    let is_many = missing as f64 > MANY * recorded as f64;
    is_many.then(|| format!("{missing} of {recorded} frames have no pose: nobody was found there"))
}

fn output_folder(path: &Path, options: &Options) -> Result<OutputFolder, Error> {
    if !options.overwrite {
        OutputFolder::refuse_existing(path, &["poses.mcap", "report.html"])?;
        // The names of the performers are not known yet.
        OutputFolder::refuse_performers(path)?;
    }
    OutputFolder::make(path)
}

/// What is known before the second pass.
struct Prepared {
    rig: Arc<Rig>,
    period: Option<FramePeriod>,
    held_out: Vec<Camera>,
    /// By performer.
    bodies: Vec<Option<Arc<Skeleton>>>,
    /// Number of performers, or the most.
    count: usize,
    offsets: Vec<CameraOffset>,
    /// What else was wrong with the cameras' times.
    notes: Vec<String>,
    is_body_wrong: bool,
    /// What the cameras saw.
    evidence: Option<Evidence>,
}

/// The first pass, if it is not switched off: estimates the body and the time offsets.
fn prepare(
    recording: &mut Recording,
    options: &Options,
    observer: &mut dyn Observer,
) -> Result<Prepared, Error> {
    let (mut rig, mut held_out) = recording.chosen(&options.cameras, &options.hold_out)?;
    let period = recording.frame_period(&rig)?;
    let (mut bodies, mut offsets, mut is_body_wrong) =
        (vec![options.body.clone()], Vec::new(), false);
    let mut notes = Vec::new();
    let (mut count, mut evidence) = (options.performers.limit() + options.known.len(), None);
    if options.passes() > 1 {
        let first = FirstPass::run(recording, options, &mut rig, period, &mut held_out, observer)?;
        is_body_wrong = first.is_body_wrong && options.body.is_some();
        (bodies, notes) = (first.bodies, first.notes);
        (count, offsets, evidence) = (bodies.len(), first.offsets, Some(first.evidence));
    }
    let rig = Arc::new(rig);
    Ok(Prepared { rig, period, held_out, bodies, count, offsets, notes, is_body_wrong, evidence })
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
        judged: (&Rig, Option<&Check>),
        decoder: &Decoder,
        performers: &[String],
    ) -> Result<Self, Error> {
        let own = || toml::to_string(&options.config).unwrap_or_default();
        let provenance = Provenance {
            config: options.config_toml.clone().unwrap_or_else(own),
            weights: format!("{:016x}", decoder.fingerprint()),
            ..Provenance::default()
        };
        let path = folder.file("poses.mcap");
        let file = PoseFile::create(&path, all, judged, &provenance, performers, options)?;
        Ok(Self { folder, file })
    }
}

/// A solve in progress.
struct Run<'file> {
    /// By performer.
    collected: Vec<Collected>,
    /// With several performers.
    tracking: Option<Tracking>,
    file: Option<&'file mut PoseFile>,
    /// Gathered here if there was no pass before.
    evidence: Option<&'file mut Evidence>,
    /// The time offsets of the cameras that are solved; the held-out ones follow.
    offsets: Vec<Nanos>,
    /// The first capture time of each of them.
    starts: Vec<Option<Timestamp>>,
    /// The number of frames of each of them, without repetitions, and the newest capture time.
    recorded: Vec<(usize, Option<Timestamp>)>,
    /// The camera whose frame numbers are those of the recording.
    clock: usize,
}

/// A camera that begins so long before all others does not begin the poses.
const EARLY: Nanos = Nanos::from_ms(1000);

impl Run<'_> {
    fn stream(
        &mut self,
        driver: &mut Driver,
        recording: &mut Recording,
        (rig, held_out): (&Rig, &[Camera]),
        observer: &mut dyn Observer,
    ) -> Result<(), Error> {
        // Both closures use the observer.
        let observer = std::cell::RefCell::new(observer);
        let mut take = |step| match step {
            Step::Item(item) => self.item(item),
            Step::Output(performer, output, state) => {
                self.output(performer, &output, &state, *observer.borrow_mut())
            }
        };
        let message = || observer.borrow_mut().message();
        recording.stream(rig, held_out, message, |item| driver.feed(Some(item), &mut take))?;
        driver.feed(None, take)
    }

    /// The poses begin at the first frame of any camera. One camera that begins long before all others does not count.
    fn begin(&mut self, frame: &Detections) {
        let own = &mut self.starts[frame.camera];
        if own.is_some() {
            return;
        }
        *own = Some(frame.capture);
        let mut all: Vec<Timestamp> = self.starts.iter().flatten().copied().collect();
        all.sort_unstable();
        let second = all[1.min(all.len() - 1)];
        let start = all.into_iter().find(|start| second - *start <= EARLY);
        for one in self.collected.iter_mut().filter(|one| one.poses.count == 0) {
            one.poses.start = start;
        }
    }

    fn item(&mut self, mut item: Item) -> Result<(), Error> {
        if let Item::Detections(frame, percent) = &mut item {
            if let Some(evidence) = &mut self.evidence {
                evidence.add(frame, *percent);
            }
            frame.capture = frame.capture + self.offsets[frame.camera];
            self.begin(frame);
            let (frames, newest) = &mut self.recorded[frame.camera];
            if Some(frame.capture) > *newest {
                (*frames, *newest) = (*frames + 1, Some(frame.capture));
            }
        }
        for Collected { comparisons, .. } in &mut self.collected {
            match &item {
                Item::Detections(detections, _) => {
                    if detections.camera == self.clock {
                        comparisons.clock = Some(FrameClock::of(detections));
                    }
                }
                Item::HeldOut(detections, _) => {
                    if let Some(held_out) = comparisons.held_out.get_mut(detections.camera) {
                        held_out.add_frame(detections.clone());
                    }
                }
                Item::TrueBody(actor, body) => comparisons.truths.set_body(actor, body),
                Item::TruePose(actor, pose) => {
                    comparisons.truths.add_truth(actor, pose.as_ref().into());
                }
            }
        }
        match (item, &mut self.tracking) {
            (Item::Detections(detections, _), _) => {
                if let Some(file) = &mut self.file {
                    file.frame(&detections)?;
                }
            }
            (Item::HeldOut(frame, percent), _) => {
                let camera = self.offsets.len() + frame.camera;
                if let Some(evidence) = &mut self.evidence {
                    evidence.add(&Detections { camera, ..frame }, percent);
                }
            }
            (Item::TrueBody(actor, body), Some(tracking)) => tracking.set_body(&actor, *body),
            (Item::TruePose(actor, pose), Some(tracking)) => tracking.add_truth(&actor, &pose),
            _ => {}
        }
        Ok(())
    }

    fn output(
        &mut self,
        performer: usize,
        output: &Output,
        state: &State,
        observer: &mut dyn Observer,
    ) -> Result<(), Error> {
        let Some(one) = self.collected.get_mut(performer) else { return Ok(()) };
        if let (Some(tracking), Output::Pose(pose), Some(body)) =
            (&mut self.tracking, output, &state.skeleton)
        {
            tracking.add_pose(&one.name, pose, body);
        }
        one.add(output, state, observer)?;
        self.file.as_mut().map_or(Ok(()), |file| file.write(performer, output))
    }
}
