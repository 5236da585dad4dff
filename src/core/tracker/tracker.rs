//! The machine itself.

use std::collections::VecDeque;
use std::sync::Arc;

use super::config::Config;
use super::effort::Effort;
use super::event::{Event, EventKind};
use super::intake::Intake;
use super::job::{Job, Task, TimedKeyframe};
use super::noise::Noise;
use super::offset_estimator::OffsetEstimator;
use super::playout::{Latency, Live, MARGIN, Playout};
use super::port::{Input, Output, Performer};
use super::waiting::Waiting;
use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::time::{Grid, Timestamp};

/// Frame period of a recording that is too short to show it, ns: 60 frames a second.
const FALLBACK_PERIOD: f64 = 1e9 / 60.0;
/// A live machine whose open window ended longer ago than this, ns, goes on with newer frames.
const MAX_BACKLOG: i64 = 1_000_000_000;

#[derive(Clone, Debug)]
pub(super) enum Phase {
    Searching,
    /// From the last final keyframes, at most two.
    Tracking {
        past: Vec<TimedKeyframe>,
        coasted: usize,
    },
}

/// A window that is open.
#[derive(Clone, Copy, Debug)]
pub(super) struct Window {
    pub(super) start: Timestamp,
    pub(super) end: Timestamp,
    /// Up to here its solution is final.
    pub(super) publish: Timestamp,
}

/// The job that is out.
#[derive(Clone, Copy, Debug)]
pub(super) struct Out {
    pub(super) number: u64,
    pub(super) window: Window,
}

/// The machine of one performer.
#[derive(Clone, Debug)]
pub struct Tracker {
    pub(super) config: Config,
    pub(super) live: Option<Live>,
    pub(super) rig: Arc<Rig>,
    next_rig: Option<Arc<Rig>>,
    pub(super) effort: Effort,
    pub(super) latency: Option<Latency>,
    /// How long after its capture a frame usually comes, ns.
    delay_ns: i64,
    pub(super) intake: Intake,
    waiting: Waiting,
    pub(super) phase: Phase,
    pub(super) skeleton: Option<Arc<Skeleton>>,
    pub(super) estimator: Arc<OffsetEstimator>,
    /// How far detections lie from the solved body.
    pub(super) noise: Noise,
    /// Whether a window was ever solved well with that body.
    pub(super) is_proven: bool,
    /// Start of the open window.
    pub(super) start: Option<Timestamp>,
    /// Nominal frame period, ns.
    pub(super) period: Option<f64>,
    /// Nominal frame times; windows begin and end on it.
    pub(super) frames: Option<Grid>,
    pub(super) now: Option<Timestamp>,
    pub(super) ended: bool,
    pub(super) out: Option<Out>,
    /// The job that was out at a restart; its answer is of no use, but comes before the next job.
    abandoned: Option<u64>,
    /// Whether the open window is complete and its last provisional fit is out.
    is_closing: bool,
    jobs: u64,
    pub(super) window: u64,
    /// Keyframes of the open window that are not final.
    pub(super) ahead: Vec<TimedKeyframe>,
    /// The time of the last provisional pose.
    pub(super) newest: Option<Timestamp>,
    pub(super) playout: Playout,
    pub(super) outputs: VecDeque<Output>,
}

impl Tracker {
    /// A machine for those cameras that solves a recording.
    pub fn new(config: Config, rig: Arc<Rig>) -> Self {
        let cameras = rig.cameras.len();
        Self {
            live: None,
            rig,
            next_rig: None,
            effort: Effort::full(&config),
            latency: None,
            delay_ns: 0,
            intake: Intake::new(cameras),
            waiting: Waiting::new(cameras, config.grace_windows),
            phase: Phase::Searching,
            skeleton: None,
            estimator: Arc::default(),
            noise: Noise::default(),
            is_proven: false,
            start: None,
            period: (config.frame_rate_hz > 0.0).then(|| 1e9 / config.frame_rate_hz),
            config,
            frames: None,
            now: None,
            ended: false,
            out: None,
            abandoned: None,
            is_closing: false,
            jobs: 0,
            window: 0,
            ahead: Vec::new(),
            newest: None,
            playout: Playout::default(),
            outputs: VecDeque::new(),
        }
    }

    /// The same for a live node: poses wait for a latency, and there is one whenever one is due.
    #[must_use]
    pub fn live(mut self, live: Live) -> Self {
        self.live = Some(live);
        self
    }

    /// Takes an input in.
    pub fn handle(&mut self, input: Input) {
        match input {
            Input::Detections(frame) => self.add(frame),
            Input::Tick(now) => self.now = self.now.max(Some(now)),
            Input::Rig(rig) => self.calibrate(rig),
            Input::Restart => self.restart(),
            Input::Effort(effort) => self.effort = effort,
            Input::Latency(latency) => self.latency = Some(latency),
            Input::Delay(delay_ns) => self.delay_ns = delay_ns.max(0),
            Input::End => self.ended = true,
            Input::Solved(solution) if self.abandoned == Some(solution.number) => {
                self.abandoned = None;
            }
            Input::Solved(solution) => self.take(solution),
        }
        self.advance();
        self.play();
    }

    /// The next output, if there is one.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// When a live machine wants a tick, if no other input comes before.
    pub fn wake(&self) -> Option<Timestamp> {
        let due = self.due().map(|due| due + -MARGIN);
        let length = self.open_frames() as f64 * self.nominal_period();
        let end = self.start.filter(|_| self.out.is_none()).map(|start| start + length as i64);
        // A little later, since the grid's times are rounded.
        due.into_iter().chain(end.map(|end| end + self.grace() + 1000)).min()
    }

    /// What is known of the performer.
    pub fn performer(&self) -> Performer {
        match &self.phase {
            Phase::Tracking { coasted: 0, .. } => Performer::Tracking,
            Phase::Tracking { .. } => Performer::Coasting,
            Phase::Searching if self.intake.shows_somebody() => Performer::Acquiring,
            Phase::Searching if self.skeleton.is_some() => Performer::Lost,
            Phase::Searching => Performer::Searching,
        }
    }

    /// The body, once it is known.
    pub fn skeleton(&self) -> Option<&Arc<Skeleton>> {
        self.skeleton.as_ref()
    }

    /// Length of a window, ns; by a usual frame rate until the cameras' is known.
    pub fn span(&self) -> i64 {
        let period = self.nominal_period();
        (self.config.window_frames.max(1) as f64 * period).round() as i64
    }

    /// Nominal frame period, ns; a usual one until the cameras' is known.
    pub fn frame_period(&self) -> f64 {
        self.nominal_period()
    }

    /// The times of poses, once a performer was found.
    pub fn output_grid(&self) -> Option<Grid> {
        let frames = self.frames?;
        let rate = self.live.map_or(0.0, |live| live.output_rate_hz);
        Some(if rate > 0.0 { Grid { period_ns: 1e9 / rate, ..frames } } else { frames })
    }

    /// Frames of that camera that went into windows.
    pub fn used(&self, camera: usize) -> u64 {
        self.intake.used(camera)
    }

    /// Whether windows wait for that camera.
    pub fn is_waited_for(&self, camera: usize) -> bool {
        self.waiting.is_waited_for(camera)
    }

    /// Poses that were carried on since nothing else was there, and poses solved too late.
    pub fn carried_and_missed(&self) -> (u64, u64) {
        (self.playout.carried, self.playout.missed)
    }

    fn add(&mut self, frame: Detections) {
        let (camera, capture) = (frame.camera, frame.capture);
        let event = self.intake.add(frame);
        let is_of_use = event.as_ref().is_none_or(|event| event.kind == EventKind::OutOfOrder);
        self.outputs.extend(event.map(Output::Event));
        if is_of_use && self.waiting.returned(camera) {
            self.event(EventKind::Returned, capture, Some(camera), "waited for again".to_owned());
        }
    }

    fn calibrate(&mut self, rig: Arc<Rig>) {
        let names = |rig: &Rig| rig.cameras.iter().map(|c| c.name.clone()).collect::<Vec<_>>();
        if names(&rig) == names(&self.rig) {
            self.next_rig = Some(rig);
            return;
        }
        self.rig = rig;
        self.restart();
    }

    /// As new, but for the body, the numbers of windows and jobs, and the latency.
    fn restart(&mut self) {
        let fresh = Self::new(self.config, Arc::clone(&self.rig));
        let old = std::mem::replace(self, fresh);
        self.live = old.live;
        self.skeleton = old.skeleton.filter(|_| old.is_proven);
        self.is_proven = old.is_proven;
        (self.effort, self.latency) = (old.effort, old.latency);
        (self.jobs, self.window) = (old.jobs, old.window + 1);
        (self.delay_ns, self.ended) = (old.delay_ns, old.ended);
        self.abandoned = old.out.map(|out| out.number).or(old.abandoned);
        (self.next_rig, self.outputs) = (old.next_rig, old.outputs);
        self.playout.carried = old.playout.carried;
        self.playout.missed = old.playout.missed;
    }

    /// Sends the open window's job once it is complete, or that of a provisional fit.
    fn advance(&mut self) {
        if self.out.is_some() || self.abandoned.is_some() {
            return;
        }
        self.skip_backlog();
        let Some(window) = self.open_window() else { return };
        if !self.is_closing && !self.try_close_window(window.end) {
            if let Some(end) = self.reach() {
                self.send_live(window, end);
            }
            return;
        }
        self.start = Some(window.start);
        // The newest pose first: the window's own solve takes longer.
        self.is_closing = self.is_newest(window.end) && self.send_live(window, window.end);
        if !self.is_closing {
            self.send(window);
        }
    }

    /// Whether the cameras are not much further: the window is none of a backlog.
    pub(super) fn is_newest(&self, end: Timestamp) -> bool {
        self.intake.front().is_none_or(|at| at - end < self.span() / 2)
    }

    /// Live: leaves frames out that wait for longer than anybody will want their poses, and
    /// searches anew after them.
    fn skip_backlog(&mut self) {
        let (Some(now), Some(start)) = (self.now.filter(|_| self.live.is_some()), self.start)
        else {
            return;
        };
        let end = start + self.open_frames() as i64 * self.nominal_period() as i64;
        if self.ended || now - end <= MAX_BACKLOG + self.grace() {
            return;
        }
        let until = now + -(self.delay_ns + self.span());
        let waiting = self.intake.up_to(until).len() as u64;
        self.close(until);
        self.phase = Phase::Searching;
        self.is_closing = false;
        self.begin_at(self.intake.first());
        let behind = (now - end) as f64 * 1e-9;
        let detail = format!("{behind:.1} s behind, searching anew");
        self.event_of(EventKind::Dropped, until, None, waiting.max(1), detail);
    }

    /// Nominal frames of the open window: of several windows, while the shape is not known.
    fn open_frames(&self) -> usize {
        let is_new = matches!(self.phase, Phase::Searching) && self.skeleton.is_none();
        let windows = if is_new { self.config.shape_windows.max(1) } else { 1 };
        self.config.window_frames.max(1) * windows
    }

    /// Live cameras begin one by one, perhaps a slow one first: until the performer is known, the
    /// fastest of those that have come counts.
    fn watch_rate(&mut self) {
        let is_open = self.live.is_some() && self.skeleton.is_none();
        if !is_open || self.config.frame_rate_hz > 0.0 || self.period.is_none() {
            return;
        }
        let faster = self.intake.frame_period().filter(|period| Some(*period) < self.period);
        if faster.is_some() {
            (self.period, self.frames) = (faster, None);
        }
    }

    /// The window that is gathered, and its frame grid.
    fn open_window(&mut self) -> Option<Window> {
        let start = self.start.or_else(|| self.intake.first())?;
        self.watch_rate();
        let period = self.period.or_else(|| self.intake.frame_period());
        // A recording shorter than the frames that show the rate.
        let period = period.or_else(|| self.ended.then_some(FALLBACK_PERIOD))?;
        self.period = Some(period);
        if self.start.is_none() || self.frames.is_none() {
            self.frames = Some(Grid { origin: start, period_ns: period });
        }
        let grid = self.frames?;
        let searching = matches!(self.phase, Phase::Searching);
        let first = grid.nearest(start);
        let full = grid.time(first + self.open_frames() as i64);
        let end = match self.intake.last() {
            None if self.ended || self.live.is_none() => return None,
            Some(last) if self.ended && last <= start + self.tolerance() && !searching => {
                return None;
            }
            // The last frame's nominal time, or its own if it is far from that.
            Some(last) if self.ended && !searching => {
                let nominal = grid.time(grid.nearest(last));
                let is_near = (nominal - last).abs() <= self.tolerance();
                full.min(if is_near { nominal } else { last })
            }
            _ => full,
        };
        let publish = match searching || end < full {
            true => end,
            false => grid.time(first + self.config.publish() as i64),
        };
        Some(Window { start, end, publish })
    }

    /// Nominal frame period, ns.
    fn nominal_period(&self) -> f64 {
        self.period.unwrap_or(FALLBACK_PERIOD)
    }

    /// How far past a window's end a frame still belongs to it, ns.
    pub(super) fn tolerance(&self) -> i64 {
        self.period.map_or(0, |period| (period / 4.0) as i64)
    }

    /// How long past its end a window stays open for cameras that are behind, ns.
    fn grace(&self) -> i64 {
        let asked = (self.config.deadline_frames as f64 * self.nominal_period()) as i64;
        let asked = asked + self.delay_ns;
        let Some(latency) = self.latency else { return asked };
        // The window's first pose is one output period after its start.
        let output = self.output_grid().map_or(0.0, |grid| grid.period_ns) as i64;
        let left = latency.declared_ns - self.span() + output - latency.reserve_ns;
        asked.min(left.max(0))
    }

    fn try_close_window(&mut self, end: Timestamp) -> bool {
        let border = end + -self.tolerance();
        let behind: Vec<usize> = self.intake.behind(border).collect();
        let waited_for = behind.iter().any(|&camera| self.waiting.is_waited_for(camera));
        // Live by the clock alone: one camera's clock may be ahead.
        let clock = if self.live.is_some() { self.now } else { self.intake.newest() };
        let is_overdue = clock.max(self.now) >= Some(end + self.grace());
        if !(self.ended || (!waited_for && self.waiting.any()) || is_overdue) {
            return false;
        }
        if !self.ended {
            self.close_without(&behind, end);
        }
        true
    }

    /// Says which cameras a window did not wait for, and gives up those that stay away.
    fn close_without(&mut self, behind: &[usize], end: Timestamp) {
        for &camera in behind {
            if self.waiting.is_waited_for(camera) {
                let detail = format!("not waited for more than {} ms", self.grace() / 1_000_000);
                self.event(EventKind::Deadline, end, Some(camera), detail);
            }
        }
        for camera in self.waiting.closed_without(behind) {
            let windows = self.config.grace_windows.max(1);
            let detail = format!("nothing in {windows} windows, no longer waited for");
            self.event(EventKind::Silent, end, Some(camera), detail);
        }
    }

    pub(super) fn event(
        &mut self,
        kind: EventKind,
        capture: Timestamp,
        camera: Option<usize>,
        detail: String,
    ) {
        self.event_of(kind, capture, camera, 1, detail);
    }

    pub(super) fn event_of(
        &mut self,
        kind: EventKind,
        capture: Timestamp,
        camera: Option<usize>,
        count: u64,
        detail: String,
    ) {
        let window = Some(self.window);
        let event = Event { capture, kind, camera, window, count, detail };
        self.outputs.push_back(Output::Event(event));
    }

    fn send(&mut self, window: Window) {
        if let Some(rig) = self.next_rig.take() {
            let detail = format!("calibration {} from here on", rig.version);
            self.rig = rig;
            self.event(EventKind::Calibrated, window.start, None, detail);
        }
        let task = match &self.phase {
            Phase::Searching => Task::Acquire { skeleton: self.skeleton.clone() },
            Phase::Tracking { past, coasted } => {
                let Some(skeleton) = self.skeleton.clone() else { return };
                self.intake.refuse(window.publish + self.tolerance());
                let (past, coasted) = (past.clone(), *coasted);
                let (ahead, estimator) = (self.ahead.clone(), Arc::clone(&self.estimator));
                Task::Track { past, ahead, skeleton, estimator, coasted }
            }
        };
        self.send_job(window, task);
    }

    /// Sends a fit of the window up to the last frame set that is complete at `reach`, if that is a
    /// new one; whether it did.
    fn send_live(&mut self, window: Window, reach: Timestamp) -> bool {
        let Phase::Tracking { past, coasted: 0 } = &self.phase else { return false };
        let (Some(skeleton), Some(grid)) = (self.skeleton.clone(), self.frames) else {
            return false;
        };
        if self.effort.provisional_iterations == 0
            || !self.live.is_some_and(|live| live.provisional)
        {
            return false;
        }
        let k = grid.at_or_before(reach + self.tolerance());
        let end = grid.time(k).min(window.end);
        let last = self.newest.unwrap_or(window.start).max(window.start);
        let from_start = k - grid.nearest(window.start);
        if end <= last || from_start % self.effort.stride.max(1) as i64 != 0 {
            return false;
        }
        let task = Task::Provisional { past: past.clone(), ahead: self.ahead.clone(), skeleton };
        self.send_job(Window { end, publish: end, ..window }, task)
    }

    /// How far the frame sets are complete: all cameras that are waited for have come so far, or
    /// one is a frame further.
    fn reach(&self) -> Option<Timestamp> {
        let cameras = (0..self.rig.cameras.len()).filter(|&c| self.waiting.is_waited_for(c));
        let complete = cameras.map(|camera| self.intake.watermark(camera)).min().flatten();
        let moved_on = self.intake.front().map(|at| at + -(self.nominal_period() as i64));
        complete.max(moved_on)
    }

    /// Whether a job went out: there must have been a frame, ever.
    fn send_job(&mut self, window: Window, task: Task) -> bool {
        let Some(format) = self.intake.format() else { return false };
        let number = self.jobs;
        self.jobs += 1;
        self.out = Some(Out { number, window });
        let output_grid = self.output_grid();
        self.outputs.push_back(Output::Solve(Box::new(Job {
            number,
            window: self.window,
            start: window.start,
            end: window.end,
            publish: window.publish,
            knots: self.knots(window),
            pose_times: output_grid
                .map_or_else(Vec::new, |grid| grid.between(window.start, window.publish).collect()),
            frames: self.intake.up_to(window.end + self.tolerance()),
            format,
            rig: Arc::clone(&self.rig),
            frame_period: 2 * ((self.period.unwrap_or(0.0) / 2.0) as i64),
            effort: self.effort,
            noise: self.noise,
            task,
        })));
        true
    }

    /// The times of the window's keyframes.
    fn knots(&self, window: Window) -> Vec<Timestamp> {
        let Some(grid) = self.frames else { return vec![window.end] };
        let first = grid.nearest(window.start) + self.config.keyframe() as i64;
        let times = (first..).step_by(self.config.keyframe()).map(|k| grid.time(k));
        let mut knots: Vec<Timestamp> = times.take_while(|time| *time < window.end).collect();
        knots.push(window.end);
        knots
    }

    pub(super) fn close(&mut self, end: Timestamp) {
        for event in self.intake.close(end) {
            self.outputs.push_back(Output::Event(Event { window: Some(self.window), ..event }));
        }
    }
}
