//! The machine itself.

use std::collections::VecDeque;
use std::sync::Arc;

use super::config::Config;
use super::event::{Event, EventKind};
use super::intake::Intake;
use super::job::{Job, Outcome, Residual, Solution, Task, Tracked};
use crate::body::{Pose, Skeleton, StampedPose, TrackingState};
use crate::camera::Rig;
use crate::detect::Detections;
use crate::manifold::Keyframe;
use crate::solve::Summary;
use crate::time::Timestamp;

/// Frame period of a recording that is too short to show it, ns: 60 frames a second.
const FALLBACK_PERIOD: f64 = 1e9 / 60.0;

/// What the machine is told.
#[derive(Clone, Debug)]
pub enum Input {
    /// A camera's detections.
    Detections(Detections),
    /// The answer to the job that is out.
    Solved(Solution),
    /// The capture clock has reached this time.
    Tick(Timestamp),
    /// Nothing more will come: windows that are open close.
    End,
}

/// What the machine wants done or known.
#[derive(Clone, Debug)]
pub enum Output {
    /// A job to solve.
    Solve(Box<Job>),
    /// The body, whenever its shape has been found.
    Skeleton(Arc<Skeleton>),
    /// A pose, in order of capture time.
    Pose(Box<StampedPose>),
    /// A keyframe at a window's border.
    Keyframe(Box<KeyframeAt>),
    /// How a window went.
    Window(Box<WindowReport>),
    /// Something to count.
    Event(Event),
}

/// A keyframe with its time.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyframeAt {
    /// Its capture time.
    pub capture: Timestamp,
    /// The window that it ends.
    pub window: u64,
    /// Its value.
    pub keyframe: Keyframe,
}

/// How a window went.
#[derive(Clone, Debug)]
pub struct WindowReport {
    /// Number of the window.
    pub window: u64,
    /// After this time ...
    pub start: Timestamp,
    /// ... up to this one.
    pub end: Timestamp,
    /// What the optimiser did.
    pub summary: Summary,
    /// Euclidean length of the keyframe's latent code.
    pub latent_norm: f64,
    /// Where each observation ended up.
    pub residuals: Vec<Residual>,
    /// Why the window is lost, if it is.
    pub lost: Option<String>,
}

/// What is known of the performer.
#[derive(Clone, Debug)]
enum Phase {
    Searching,
    Tracking { from: Box<Keyframe>, before: Option<Box<Keyframe>> },
}

/// The window that is open, or whose job is out.
#[derive(Clone, Copy, Debug)]
struct Window {
    start: Timestamp,
    end: Timestamp,
}

/// The machine of one performer.
#[derive(Clone, Debug)]
pub struct Track {
    config: Config,
    rig: Arc<Rig>,
    intake: Intake,
    phase: Phase,
    skeleton: Option<Arc<Skeleton>>,
    /// Whether a window was ever solved well with that body.
    is_proven: bool,
    /// Start of the open window.
    start: Option<Timestamp>,
    /// Nominal frame period, ns.
    period: Option<f64>,
    now: Option<Timestamp>,
    ended: bool,
    out: Option<Window>,
    window: u64,
    /// The last pose given, to hold while the performer is lost.
    held: Option<StampedPose>,
    outputs: VecDeque<Output>,
}

impl Track {
    /// A machine for those cameras.
    pub fn new(config: Config, rig: Arc<Rig>) -> Self {
        let period = (config.frame_rate_hz > 0.0).then(|| 1e9 / config.frame_rate_hz);
        Self {
            intake: Intake::new(rig.cameras.len()),
            config,
            rig,
            phase: Phase::Searching,
            skeleton: None,
            is_proven: false,
            start: None,
            period,
            now: None,
            ended: false,
            out: None,
            window: 0,
            held: None,
            outputs: VecDeque::new(),
        }
    }

    /// Takes an input in.
    pub fn handle(&mut self, input: Input) {
        match input {
            Input::Detections(frame) => {
                let event = self.intake.add(frame);
                self.outputs.extend(event.map(Output::Event));
            }
            Input::Tick(now) => self.now = self.now.max(Some(now)),
            Input::End => self.ended = true,
            Input::Solved(solution) => self.take(solution),
        }
        self.advance();
    }

    /// The next output, if there is one.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// Sends the open window's job, once it is complete.
    fn advance(&mut self) {
        if self.out.is_some() {
            return;
        }
        let Some(start) = self.start.or_else(|| self.intake.first()) else { return };
        let Some(period) = self.period.or_else(|| self.intake.frame_period()).or_else(|| {
            // A recording shorter than the frames that show the rate.
            self.ended.then_some(FALLBACK_PERIOD)
        }) else {
            return;
        };
        self.period = Some(period);
        let searching = matches!(self.phase, Phase::Searching);
        let windows = match searching && self.skeleton.is_none() {
            true => self.config.shape_windows.max(1),
            false => 1,
        };
        let frames = self.config.window_frames.max(1) * windows;
        let end = start + (frames as f64 * period).round() as i64;
        let last = self.intake.last();
        let end = match last {
            None => return,
            Some(last) if self.ended && last <= start + self.tolerance() && !searching => return,
            Some(last) if self.ended && !searching => end.min(last),
            _ => end,
        };
        if self.is_complete(end) {
            self.start = Some(start);
            self.send(Window { start, end });
        }
    }

    /// Nominal frame period, ns.
    fn nominal_period(&self) -> f64 {
        self.period.unwrap_or(FALLBACK_PERIOD)
    }

    /// Length of a window, ns.
    fn span(&self) -> i64 {
        let period = self.nominal_period();
        (self.config.window_frames.max(1) as f64 * period).round() as i64
    }

    /// How far past a window's end a frame still belongs to it, ns.
    fn tolerance(&self) -> i64 {
        self.period.map_or(0, |period| (period / 4.0) as i64)
    }

    fn is_complete(&mut self, end: Timestamp) -> bool {
        let waiting: Vec<usize> = self.intake.behind(end + -self.tolerance()).collect();
        if self.ended || waiting.is_empty() {
            return true;
        }
        let grace = self.config.deadline_frames as f64 * self.period.unwrap_or(0.0);
        let overdue = self.intake.newest().max(self.now) >= Some(end + grace as i64);
        if overdue {
            for camera in waiting {
                let detail =
                    format!("not waited for more than {} frames", self.config.deadline_frames);
                self.event(EventKind::Deadline, end, Some(camera), detail);
            }
        }
        overdue
    }

    fn event(
        &mut self,
        kind: EventKind,
        capture: Timestamp,
        camera: Option<usize>,
        detail: String,
    ) {
        let window = Some(self.window);
        self.outputs.push_back(Output::Event(Event {
            capture,
            kind,
            camera,
            window,
            count: 1,
            detail,
        }));
    }

    fn send(&mut self, window: Window) {
        let Some(format) = self.intake.format() else { return };
        let frames = self.intake.up_to(window.end + self.tolerance());
        let task = match &self.phase {
            Phase::Searching => Task::Acquire {
                skeleton: self.skeleton.clone(),
                half_frame: (self.period.unwrap_or(0.0) / 2.0) as i64,
            },
            Phase::Tracking { from, before } => {
                let Some(skeleton) = self.skeleton.clone() else { return };
                Task::Track { from: from.clone(), before: before.clone(), skeleton }
            }
        };
        if matches!(task, Task::Track { .. }) {
            self.close(window.end + self.tolerance());
        }
        self.out = Some(window);
        self.outputs.push_back(Output::Solve(Box::new(Job {
            window: self.window,
            start: window.start,
            end: window.end,
            pose_times: self.pose_times(window),
            frames,
            format,
            rig: Arc::clone(&self.rig),
            task,
        })));
    }

    fn close(&mut self, end: Timestamp) {
        for event in self.intake.close(end) {
            self.outputs.push_back(Output::Event(Event { window: Some(self.window), ..event }));
        }
    }

    /// Nominal frame times after the window's start, up to its end.
    fn pose_times(&self, window: Window) -> Vec<Timestamp> {
        let period = self.nominal_period();
        let frames = ((window.end - window.start) as f64 / period).round() as usize;
        (1..=frames.max(1))
            .map(|i| window.start + (i as f64 * period).round() as i64)
            .map(|time| time.min(window.end))
            .collect()
    }

    fn take(&mut self, solution: Solution) {
        let Some(window) = self.out.filter(|_| solution.window == self.window) else { return };
        self.out = None;
        match solution.outcome {
            Outcome::Acquired { at, keyframe, skeleton, pose } => {
                self.acquired(window, at, keyframe, skeleton, pose);
            }
            Outcome::NobodyFound => self.nobody_found(window),
            Outcome::Tracked(tracked) => self.tracked(window, *tracked),
        }
    }

    fn acquired(
        &mut self,
        window: Window,
        at: Timestamp,
        keyframe: Box<Keyframe>,
        skeleton: Arc<Skeleton>,
        pose: Box<Pose>,
    ) {
        self.hold(window.start, at + -self.tolerance());
        if self.skeleton.is_none() && !self.ended && at > window.start + self.span() {
            // Too few frames are left for the shape: gather anew from here.
            self.close(at + -self.tolerance());
            self.start = Some(at);
            return;
        }
        self.close(at + self.tolerance());
        if self.skeleton.is_none() {
            self.outputs.push_back(Output::Skeleton(Arc::clone(&skeleton)));
        }
        self.event(EventKind::Acquired, at, None, "performer found".to_owned());
        self.skeleton = Some(skeleton);
        self.start = Some(at);
        self.give(at, *pose, TrackingState::Tracking);
        let capture = at;
        let at = KeyframeAt { capture, window: self.window, keyframe: (*keyframe).clone() };
        self.outputs.push_back(Output::Keyframe(Box::new(at)));
        self.phase = Phase::Tracking { from: keyframe, before: None };
    }

    /// Goes on searching one window later.
    fn nobody_found(&mut self, window: Window) {
        let span = self.span();
        let end = window.end.min(window.start + span);
        let end = self.intake.last().filter(|_| self.ended).map_or(end, |last| end.min(last));
        self.hold(window.start, end);
        self.event(EventKind::NobodyFound, end, None, "no person seen by two cameras".to_owned());
        self.close(end + self.tolerance());
        // The grid of pose times goes on, but for a gap in the stream, which is skipped.
        let goes_on = |first: &Timestamp| *first <= end + span;
        self.start = self.intake.first().map(|first| if goes_on(&first) { end } else { first });
        self.window += 1;
    }

    fn tracked(&mut self, window: Window, tracked: Tracked) {
        let is_lost = tracked.lost.is_some();
        let state = if is_lost { TrackingState::Lost } else { TrackingState::Tracking };
        let times = self.pose_times(window);
        for (capture, pose) in times.into_iter().zip(tracked.poses) {
            self.give(capture, pose, state);
        }
        if let Some(reason) = &tracked.lost {
            self.event(EventKind::Lost, window.end, None, reason.clone());
        }
        let keyframe = Box::new(tracked.keyframe);
        self.outputs.push_back(Output::Keyframe(Box::new(KeyframeAt {
            capture: window.end,
            window: self.window,
            keyframe: (*keyframe).clone(),
        })));
        self.outputs.push_back(Output::Window(Box::new(WindowReport {
            window: self.window,
            start: window.start,
            end: window.end,
            summary: tracked.summary,
            latent_norm: crate::manifold::norm(&keyframe.z),
            residuals: tracked.residuals,
            lost: tracked.lost,
        })));
        let previous = std::mem::replace(&mut self.phase, Phase::Searching);
        if let (Phase::Tracking { from, .. }, false) = (previous, is_lost) {
            self.phase = Phase::Tracking { from: keyframe, before: Some(from) };
        }
        self.is_proven |= !is_lost;
        if !self.is_proven {
            // The body was found together with a pose that was wrong at once.
            self.skeleton = None;
        }
        self.start = Some(window.end);
        self.window += 1;
    }

    fn give(&mut self, capture: Timestamp, pose: Pose, state: TrackingState) {
        let stamped = StampedPose {
            capture,
            pose,
            state,
            window: self.window,
            rig_version: self.rig.version,
            provisional: false,
            revision: 0,
        };
        self.held = Some(stamped.clone());
        self.outputs.push_back(Output::Pose(Box::new(stamped)));
    }

    /// Repeats the last pose, flagged lost, at the nominal times after `start` up to `end`.
    fn hold(&mut self, start: Timestamp, end: Timestamp) {
        let Some(held) = self.held.clone() else { return };
        let Some(period) = self.period else { return };
        let count = ((end - start) as f64 / period).floor() as u64;
        for frame in 1..=count {
            let capture = start + (frame as f64 * period).round() as i64;
            self.give(capture, held.pose.clone(), TrackingState::Lost);
        }
    }
}
