//! The first pass over a recording: it estimates the body, and the cameras' time offsets.

use std::collections::VecDeque;
use std::fmt;
use std::sync::Arc;

use serde::Serialize;

use super::Error;
use super::driver::{Driver, State, Step};
use super::options::{Observer, Options};
use super::recording::{Item, Recording};
use crate::core::body::{Skeleton, TrackingState};
use crate::core::calibration::{
    self, OFFSET_REACH, OffsetVerdict, TimeOffset, Tracks, offset_step,
};
use crate::core::camera::{Camera, Rig};
use crate::core::cost;
use crate::core::detections::Detections;
use crate::core::stage::Stage;
use crate::core::time::Nanos;
use crate::core::tracker::{self, BodyEstimator, Effort, EventKind, FramePeriod, Output, Tracker};
use crate::diagnose::{CameraCheck, Evidence};

/// Wrong times are corrected, or corrections undone, at most so often.
const CORRECTIONS: usize = 4;
/// A correction must lower the mean error of its camera below this part.
const LOWERED: f64 = 0.9;

/// Most frames that wait for their poses.
const WAITING: usize = 8192;

/// An optimiser of the first pass stops if a step lowers the cost by less than this fraction.
const COARSE_CHANGE: f64 = 0.03;

/// A take is long if only one window in this many, or fewer, estimates the body.
const LONG: usize = 16;

/// [`tracker::Config::reference_rate_hz`] is multiplied by this for a long take.
const COARSE_RATE: f64 = 0.5;

/// The settings and the effort of a first pass over `frames` frames of that period, ns (0: not known): the body is
/// estimated from windows of the whole recording. It needs no corrections, and no exact poses. In a long take it has about
/// 30 keyframes a second, and uses as many frames of each camera.
pub fn first_pass_settings(
    config: tracker::Config,
    frames: usize,
    period_ns: f64,
) -> (tracker::Config, Effort) {
    let period_ns = if config.frame_rate_hz > 0.0 { 1e9 / config.frame_rate_hz } else { period_ns };
    let spacing = |config: &tracker::Config| {
        frames / config.at_period(period_ns).publish() / tracker::BODY_WINDOWS
    };
    let (mut config, mut stride) = (config, 1);
    if spacing(&config) >= LONG {
        config.reference_rate_hz *= COARSE_RATE;
        stride = config.at_period(period_ns).window() / config.window();
    }
    let settings = tracker::Config {
        body_windows: spacing(&config).max(1),
        change_threshold: config.change_threshold.max(COARSE_CHANGE),
        cost: cost::Config { correction_prior: 0.0, ..config.cost },
        ..config
    };
    (settings, Effort { stride, deviations: false, ..Effort::full(&settings) })
}

/// A camera's time offset: what is added to its capture times to agree with the other cameras.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraOffset {
    /// The camera.
    pub camera: String,
    /// The estimate, milliseconds; `None` if it is unknown.
    pub offset_ms: Option<f64>,
    /// The same in nominal frames.
    pub offset_frames: Option<f64>,
    /// Its standard error, nominal frames.
    pub error_frames: f64,
    /// `in_sync`, `shifted`, or `unknown` if too little moves to tell.
    pub verdict: &'static str,
    /// Whether the offset is significant and in use.
    pub applied: bool,
}

impl CameraOffset {
    fn new(camera: &Camera, found: &TimeOffset, period: Nanos) -> Self {
        let frames = |time: Nanos| time.ns() as f64 / period.ns() as f64;
        Self {
            camera: camera.name.clone(),
            offset_ms: found.offset.map(Nanos::ms),
            offset_frames: found.offset.map(frames),
            error_frames: frames(found.error),
            verdict: match found.verdict {
                OffsetVerdict::InSync => "in_sync",
                OffsetVerdict::Shifted => "shifted",
                OffsetVerdict::Unknown => "unknown",
            },
            applied: found.verdict == OffsetVerdict::Shifted,
        }
    }
}

/// A first pass over a recording.
pub(super) struct FirstPass {
    /// The performers' bodies; `None` of those who were not found.
    pub(super) bodies: Vec<Option<Arc<Skeleton>>>,
    /// Nominal frame periods, by performer, ns.
    periods: Vec<f64>,
    /// By performer.
    followed: Vec<Followed>,
    cameras: Vec<Camera>,
    waiting: VecDeque<Detections>,
    /// Number of frames that no longer wait.
    passed: usize,
    /// What all cameras saw.
    pub(super) evidence: Evidence,
    /// Of all cameras; empty if they were not estimated.
    pub(super) offsets: Vec<CameraOffset>,
    /// What was wrong with the times of cameras, besides offsets. It is corrected.
    pub(super) notes: Vec<String>,
    /// Whether the known body did not fit and was estimated anew.
    pub(super) is_body_wrong: bool,
}

/// The driver of a first pass over `frames` frames of the busiest camera.
fn driver(
    options: &Options,
    body: Option<&Arc<Skeleton>>,
    frames: u64,
    rig: &Rig,
    period: Option<FramePeriod>,
) -> Result<Driver, Error> {
    let period_ns = period.map_or(0.0, |period| period.ns);
    let (config, effort) = first_pass_settings(options.config, frames as usize, period_ns);
    let tracker = Tracker::new(config, Arc::new(rig.clone()));
    let tracker = tracker.with_body_of_another_take(body.cloned());
    let stage = Stage::new(tracker, options.performers, period);
    let mut stage = stage.choosing(options.choice.clone()).with_known(&options.known);
    stage.set_effort(effort);
    Ok(Driver::new(stage, options.decoder()?, config, options.threads))
}

/// A performer in the views of the rig's cameras, then of the held-out ones.
struct Followed {
    tracks: Tracks,
    /// Number of tracked poses.
    poses: usize,
    /// Number of frames that the poses have reached.
    frames: usize,
    /// What was known when the estimate of the body had most windows.
    best: State,
}

/// What was done to the times of a camera.
#[derive(Clone, Default)]
struct Corrected {
    /// By how much they were late.
    late: Nanos,
    /// What else was wrong.
    notes: Vec<String>,
    /// A correction that is not confirmed: the camera's mean error before it, and the time shift that it removed, if any.
    unconfirmed: Option<(f64, Option<Nanos>)>,
    /// Whether a correction was undone: no others are tried.
    was_undone: bool,
}

impl FirstPass {
    /// Streams a recording through the tracker and adds the significant time offsets to the cameras.
    /// If a camera of the rig is shifted, or the given body is wrong, the recording is streamed again.
    pub(super) fn run(
        recording: &mut Recording,
        options: &Options,
        rig: &mut Rig,
        period: Option<FramePeriod>,
        held_out: &mut [Camera],
        observer: &mut dyn Observer,
    ) -> Result<Self, Error> {
        let mut body = options.body.as_ref();
        let mut once = |recording: &mut Recording, body, rig: &Rig, held_out: &[Camera]| {
            let driver = driver(options, body, recording.frames_in_span(), rig, period)?;
            let mut pass = Self::new(options, rig, period, held_out);
            pass.stream(driver, recording, rig, held_out, observer)?;
            Ok::<_, Error>(pass)
        };
        let mut pass = once(recording, body, rig, held_out)?;
        // Large faults of clocks first, by what the cameras saw. One may hide another.
        let mut corrected = vec![Corrected::default(); pass.cameras.len()];
        let corrections = if options.no_sync { 0 } else { CORRECTIONS };
        // The last round only confirms.
        for left in (0..=corrections).rev() {
            if left == 0 && corrected.iter().all(|one| one.unconfirmed.is_none()) {
                break;
            }
            if !pass.correct_times(recording, rig, held_out, &mut corrected, left > 0) {
                break;
            }
            pass = once(recording, body, rig, held_out)?;
        }
        let mut is_body_wrong = pass.is_body_wrong;
        if is_body_wrong && body.is_some() {
            // An estimate from the whole recording is better than one from the rest of it.
            body = None;
            pass = once(recording, body, rig, held_out)?;
        }
        if options.no_sync {
            return Ok(Self { is_body_wrong, ..pass });
        }
        let (offsets, are_shifted) = pass.apply_time_offsets(rig, held_out, &corrected);
        if are_shifted {
            pass = once(recording, body, rig, held_out)?;
            is_body_wrong |= pass.is_body_wrong;
        }
        let notes = corrected.into_iter().flat_map(|one| one.notes).collect();
        Ok(Self { offsets, is_body_wrong, notes, ..pass })
    }

    fn new(options: &Options, rig: &Rig, period: Option<FramePeriod>, held_out: &[Camera]) -> Self {
        let cameras: Vec<Camera> = rig.cameras.iter().chain(held_out).cloned().collect();
        let all = Arc::new(Rig { cameras: cameras.clone(), ..rig.clone() });
        Self {
            evidence: Evidence::new(all, options.config, period),
            bodies: Vec::new(),
            periods: Vec::new(),
            followed: Vec::new(),
            cameras,
            waiting: VecDeque::new(),
            passed: 0,
            offsets: Vec::new(),
            notes: Vec::new(),
            is_body_wrong: false,
        }
    }

    fn stream(
        &mut self,
        mut driver: Driver,
        recording: &mut Recording,
        rig: &Rig,
        held_out: &[Camera],
        observer: &mut dyn Observer,
    ) -> Result<(), Error> {
        let solved = rig.cameras.len();
        let mut take = |step| {
            match step {
                Step::Item(Item::Detections(frame, percent)) => self.wait(frame, percent),
                Step::Item(Item::HeldOut(frame, percent)) => {
                    self.wait(Detections { camera: solved + frame.camera, ..frame }, percent);
                }
                Step::Item(_) => {}
                Step::Output(performer, output, state) => self.output(performer, &output, &state),
            }
            Ok(())
        };
        let message = || observer.message();
        recording.stream(rig, held_out, message, |item| driver.feed(Some(item), &mut take))?;
        driver.feed(None, take)?;
        (self.bodies, self.periods) = (driver.skeletons(), driver.frame_periods());
        for (body, followed) in self.bodies.iter_mut().zip(&self.followed) {
            if let (Some(body), Some(best)) = (body, &followed.best.skeleton) {
                body.clone_from(best);
            }
        }
        Ok(())
    }

    fn wait(&mut self, mut frame: Detections, percent: usize) {
        self.evidence.add(&frame, percent);
        frame.capture = frame.capture + self.cameras[frame.camera].time_offset;
        self.waiting.push_back(frame);
        if self.waiting.len() > WAITING {
            self.waiting.pop_front();
            self.passed += 1;
        }
    }

    /// The frames up to each pose show the performer in about that pose.
    fn output(&mut self, performer: usize, output: &Output, state: &State) {
        if let Output::Event(event) = output {
            self.is_body_wrong |= event.kind == EventKind::Body;
        }
        let (Output::Pose(pose), Some(skeleton)) = (output, &state.skeleton) else { return };
        let Self { followed, cameras, waiting, passed, .. } = self;
        let (cameras_count, frames) = (cameras.len(), *passed);
        let new = || Followed {
            tracks: Tracks::new(cameras_count),
            poses: 0,
            frames,
            best: State::default(),
        };
        followed.resize_with(followed.len().max(performer + 1), new);
        let Followed { tracks, poses, frames, best } = &mut followed[performer];
        // After a break, the person may be another one, or the rest of the take is short.
        if state.estimate.windows() >= best.estimate.windows() {
            best.clone_from(state);
        }
        *poses += usize::from(pose.state == TrackingState::Tracking);
        *frames = (*frames).max(*passed);
        while let Some(frame) = waiting.get(*frames - *passed)
            && frame.capture <= pose.capture
        {
            *frames += 1;
            if pose.state == TrackingState::Tracking {
                tracks.add(frame, &cameras[frame.camera], &pose.pose, skeleton);
            }
        }
        let reached = followed.iter().map(|one| one.frames).min().unwrap_or(0);
        let done = reached.saturating_sub(*passed);
        waiting.drain(..done);
        *passed += done;
    }

    /// The estimate of the first performer's body that has most windows.
    pub(super) fn estimate(&self) -> Arc<BodyEstimator> {
        self.followed.first().map(|one| Arc::clone(&one.best.estimate)).unwrap_or_default()
    }

    /// The body of the first of the performers who were found.
    pub(super) fn lead(&self, recording: &Recording) -> Result<Arc<Skeleton>, Error> {
        self.bodies.iter().flatten().next().cloned().ok_or_else(|| Error::NobodyFound {
            path: recording.path().to_owned(),
            evidence: "no performer is seen by two cameras at once; check the calibration".into(),
        })
    }

    /// The performer who was tracked longest, and their views.
    pub(super) fn tracks(&self) -> (usize, Tracks) {
        let all = self.followed.iter().enumerate().rev();
        let longest = all.max_by_key(|(_, one)| one.poses);
        let none = || (0, Tracks::new(self.cameras.len()));
        longest.map_or_else(none, |(performer, one)| (performer, one.tracks.clone()))
    }

    /// The judgement on each camera. The held-out ones, which follow the `solved` ones, do not judge these.
    fn checks(&self, solved: usize) -> Vec<CameraCheck> {
        let of_first = |cameras: usize| {
            let cameras = self.cameras[..cameras].to_vec();
            self.evidence.clone().check(&Rig { version: 0, cameras }).cameras
        };
        let mut all = of_first(solved);
        if self.cameras.len() > solved {
            all.extend(of_first(self.cameras.len()).split_off(solved));
        }
        all
    }

    /// Undoes corrections after which a camera fits no better. Corrects the wrong times that a check finds, if there are
    /// `more` rounds. Returns whether anything has changed.
    fn correct_times(
        &self,
        recording: &mut Recording,
        rig: &mut Rig,
        held_out: &mut [Camera],
        corrected: &mut [Corrected],
        more: bool,
    ) -> bool {
        let checks = self.checks(rig.cameras.len());
        let period = self.periods.first().copied().unwrap_or_default();
        let nearest = offset_step(Nanos::rounded(period)) * OFFSET_REACH;
        let mut has_changed = false;
        let cameras = rig.cameras.iter_mut().chain(held_out);
        for ((row, one), camera) in checks.iter().zip(corrected).zip(cameras) {
            let error = row.mean_error.unwrap_or(f64::INFINITY);
            if let Some((before, late)) = one.unconfirmed.take()
                && error > LOWERED * before
            {
                match late {
                    Some(by) => {
                        one.late = one.late - by;
                        camera.time_offset = camera.time_offset + by;
                    }
                    None => {
                        recording.undo_correction(&row.camera);
                        one.notes.pop();
                    }
                }
                one.was_undone = true;
                has_changed = true;
            }
            let Some(wrong) = row.times.filter(|_| more && !one.was_undone) else { continue };
            let late = wrong.late();
            match late {
                // The performer's motion tells small ones more exactly.
                Some(by) if by.abs() <= nearest => continue,
                Some(by) => {
                    one.late = one.late + by;
                    camera.time_offset = camera.time_offset - by;
                }
                None => {
                    recording.correct(&row.camera, wrong);
                    let what = row.findings.iter().map(|finding| &*finding.what);
                    let what: String = what.collect::<Vec<_>>().join("; ");
                    one.notes.push(format!("camera {}: {what}", row.camera));
                }
            }
            one.unconfirmed = Some((error, late));
            has_changed = true;
        }
        has_changed
    }

    /// Estimates the time offsets, and adds the significant ones to the cameras: those of the rig
    /// from their own views, then those of held-out cameras relative to them. `corrected` is what was done before. Also
    /// returns whether a camera of the rig was shifted.
    fn apply_time_offsets(
        &self,
        rig: &mut Rig,
        held_out: &mut [Camera],
        corrected: &[Corrected],
    ) -> (Vec<CameraOffset>, bool) {
        let (performer, tracks) = self.tracks();
        let Some(period) = self.periods.get(performer) else { return (Vec::new(), false) };
        let period = Nanos::rounded(*period);
        let solved = rig.cameras.len();
        let estimate = |count: usize, known: &[Nanos]| {
            calibration::time_offsets(&tracks, &self.cameras[..count], offset_step(period), known)
        };
        let mut found = estimate(solved, &[]);
        if !held_out.is_empty() {
            let known: Vec<Nanos> = found.iter().map(TimeOffset::applied).collect();
            found.extend(estimate(self.cameras.len(), &known).split_off(solved));
        }
        for (camera, found) in rig.cameras.iter_mut().chain(held_out).zip(&found) {
            camera.time_offset = camera.time_offset + found.applied();
        }
        let all = self.cameras.iter().zip(&found).zip(corrected);
        let all = all.map(|((camera, found), Corrected { late, .. })| {
            let found = if *late == Nanos::ZERO { *found } else { found.after(-*late) };
            CameraOffset::new(camera, &found, period)
        });
        let are_shifted = found.iter().take(solved).any(|one| one.applied() != Nanos::ZERO);
        (all.collect(), are_shifted)
    }
}

/// As `+1.0 ms (+0.06 ± 0.02 frames)`.
impl fmt::Display for CameraOffset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let error = self.error_frames;
        match self.offset_ms.zip(self.offset_frames) {
            Some((ms, frames)) => write!(f, "{ms:+.1} ms ({frames:+.2} ± {error:.2} frames)"),
            None => write!(f, "± {error:.2} frames"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_pass_over_a_long_take_uses_fewer_frames() {
        let of = |config: tracker::Config, seconds: f64, fps: f64| {
            let (settings, effort) =
                first_pass_settings(config, (seconds * fps) as usize, 1e9 / fps);
            assert_eq!(settings.validate(), Ok(()), "{fps}");
            let settings = tracker::Config { frame_rate_hz: fps, ..settings };
            (settings.at_period(1e9 / fps).keyframe(), effort.stride, settings.body_windows)
        };
        let config = tracker::Config::default();
        assert_eq!(of(config, 30.0, 60.0), (1, 1, 14));
        assert_eq!(of(config, 300.0, 60.0), (2, 2, 72));
        assert_eq!(of(config, 30.0, 120.0), (2, 1, 14));
        assert_eq!(of(config, 300.0, 120.0), (4, 4, 72));
        // Slow cameras have no frames to spare.
        assert_eq!(of(config, 600.0, 30.0), (1, 1, 144));
        assert_eq!(of(tracker::Config::paper(), 300.0, 60.0).1, 1);
        // The frame rate of the settings counts.
        let slow = tracker::Config { frame_rate_hz: 30.0, ..config };
        assert_eq!(first_pass_settings(slow, 18_000, 1e9 / 60.0).1.stride, 1);
    }
}
