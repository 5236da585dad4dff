//! The tracker: its state, its inputs and its outputs.

use std::collections::VecDeque;
use std::sync::Arc;

use super::body_estimator::BodyEstimator;
use super::config::Config;
use super::effort::Effort;
use super::event::{Event, EventKind};
use super::frame_rate::FramePeriod;
use super::idle::Idle;
use super::intake::Intake;
use super::job::{Job, Solution};
use super::mending::{Memory, Mending};
use super::noise::Noise;
use super::playout::{Latency, Live, MARGIN, Playout, ROUNDING};
use super::port::{Input, Output};
use super::window::{FALLBACK_PERIOD, Window};
use crate::core::body::{JointDeviations, Skeleton, TrackingState};
use crate::core::calibration::{LiveOffsets, Watchdog};
use crate::core::camera::Rig;
use crate::core::detections::Detections;
use crate::core::manifold::TimedKeyframe;
use crate::core::time::{Grid, Nanos, Timestamp};

/// Whether the performer is known.
#[derive(Clone, Debug)]
pub(super) enum Phase {
    Searching,
    Tracking {
        /// The last final keyframes, at most two.
        past: Vec<TimedKeyframe>,
        /// Number of windows in a row that were extrapolated.
        coasted: usize,
    },
}

/// The solver's job.
#[derive(Clone, Copy, Debug)]
pub(super) struct PendingJob {
    pub(super) number: u64,
    pub(super) window: Window,
}

/// Tracks one performer. See the [module](super) for the contract.
#[derive(Clone, Debug)]
pub struct Tracker {
    pub(super) config: Config,
    pub(super) live: Option<Live>,
    pub(super) rig: Arc<Rig>,
    /// The rig of the next window.
    pub(super) next_rig: Option<Arc<Rig>>,
    pub(super) effort: Effort,
    pub(super) latency: Option<Latency>,
    /// Usual time from the capture of a frame to its arrival.
    pub(super) delay: Nanos,
    pub(super) intake: Intake,
    /// Whether a stage gives it frames: their times are checked and those of the cameras' common clock,
    /// and windows close when the stage says that their frames are complete, up to `complete`.
    pub(super) is_fed: bool,
    pub(super) complete: Option<Timestamp>,
    /// Whether it puts out its state after each window.
    pub(super) hands_over: bool,
    /// Nominal frames by which its windows end earlier than others'.
    pub(super) stagger: usize,
    pub(super) idle: Idle,
    pub(super) phase: Phase,
    /// The last keyframe of the last window that was tracked.
    pub(super) last_seen: Option<TimedKeyframe>,
    pub(super) skeleton: Option<Arc<Skeleton>>,
    pub(super) estimator: Arc<BodyEstimator>,
    pub(super) noise: Noise,
    /// Relative error of the detections when the body was complete.
    pub(super) first_fit: Option<f64>,
    /// Whether any window was tracked with this body.
    pub(super) is_proven: bool,
    /// Start of the open window.
    pub(super) start: Option<Timestamp>,
    /// Nominal frame period, ns.
    pub(super) period: Option<f64>,
    /// The grid of nominal frame times; windows begin and end on it.
    pub(super) frames: Option<Grid>,
    /// A pose time of any other output rate.
    pub(super) first_output: Option<Timestamp>,
    /// The capture clock at the last tick.
    pub(super) now: Option<Timestamp>,
    pub(super) ended: bool,
    pub(super) pending: Option<PendingJob>,
    /// The pending job at a restart: its solution is dropped, but must arrive before the next job.
    pub(super) abandoned: Option<u64>,
    /// Whether the open window is complete and its last provisional fit is with the solver.
    pub(super) is_closing: bool,
    /// Number of the next job.
    pub(super) jobs: u64,
    /// Number of the open window.
    pub(super) window: u64,
    /// Standard deviations of the joint centres at the start of the open window, if it follows a tracked one.
    pub(super) deviations: Option<JointDeviations>,
    /// Keyframes of the open window that are not final.
    pub(super) ahead: Vec<TimedKeyframe>,
    /// The time of the last provisional pose.
    pub(super) newest: Option<Timestamp>,
    pub(super) playout: Playout,
    pub(super) offsets: LiveOffsets,
    pub(super) watchdog: Watchdog,
    /// One of several performers: the newest frames to watch the cameras with.
    pub(super) watch_frames: VecDeque<Arc<Detections>>,
    pub(super) memory: Memory,
    /// Cameras that were moved and are left out.
    pub(super) mending: Vec<Mending>,
    /// Cameras that were found moved from another performer, or in the run before.
    pub(super) left_out: Vec<bool>,
    pub(super) outputs: VecDeque<Output>,
}

impl Tracker {
    /// A tracker for a recording of the cameras of `rig`.
    pub fn new(config: Config, rig: Arc<Rig>) -> Self {
        let cameras = rig.cameras.len();
        Self {
            live: None,
            rig,
            next_rig: None,
            effort: Effort::full(&config),
            latency: None,
            delay: Nanos::ZERO,
            intake: Intake::new(cameras, config.grace_windows),
            is_fed: false,
            complete: None,
            hands_over: false,
            stagger: 0,
            idle: Idle::default(),
            phase: Phase::Searching,
            last_seen: None,
            skeleton: None,
            estimator: Arc::default(),
            noise: Noise::default(),
            first_fit: None,
            is_proven: false,
            start: None,
            period: (config.frame_rate_hz > 0.0).then(|| 1e9 / config.frame_rate_hz),
            config,
            frames: None,
            first_output: None,
            now: None,
            ended: false,
            pending: None,
            abandoned: None,
            is_closing: false,
            jobs: 0,
            window: 0,
            deviations: None,
            ahead: Vec::new(),
            newest: None,
            playout: Playout::default(),
            offsets: LiveOffsets::new(cameras),
            watchdog: Watchdog::new(cameras),
            watch_frames: VecDeque::new(),
            memory: Memory::default(),
            mending: Vec::new(),
            left_out: Vec::new(),
            outputs: VecDeque::new(),
        }
    }

    /// A tracker for a live node: it publishes each pose by its due time, solved or extrapolated. It publishes no final
    /// pose before [`Tracker::set_latency`] is called. To be on time it needs [`Input::Tick`] at the times of
    /// [`Tracker::wake`].
    #[must_use]
    pub fn live(mut self, live: Live) -> Self {
        self.live = Some(live);
        self
    }

    /// A tracker for one of several performers, by number from 0: a stage gives it frames with the
    /// performer alone, and [`Input::Complete`]. Live, windows of different performers end at different
    /// frames, so that their solves do not come all at once.
    #[must_use]
    pub(in crate::core) fn fed(mut self, performer: usize) -> Self {
        self.is_fed = true;
        if let Some(live) = &mut self.live {
            (live.time_offsets, live.watch_cameras) = (false, false);
            (self.stagger, self.window) = (performer, performer as u64);
        }
        self
    }

    /// Live: time offsets are estimated and moved cameras found from this performer from here on, as
    /// `live` says, with what is known from the performer before.
    pub(in crate::core) fn watch_for_all(&mut self, live: Live, before: Option<&mut Self>) {
        self.live = Some(live);
        if let Some(before) = before {
            before.use_next_rig();
            std::mem::swap(&mut self.left_out, &mut before.left_out);
            std::mem::swap(&mut self.watchdog, &mut before.watchdog);
            std::mem::swap(&mut self.offsets, &mut before.offsets);
            // A camera's bias depends on the performer: what was seen of another one is of no use.
            before.mending.clear();
            before.live =
                before.live.map(|live| Live { time_offsets: false, watch_cameras: false, ..live });
        }
    }

    /// By camera, whether it is left out because it was moved. A calibration that waits for its window counts.
    pub(in crate::core) fn left_out(&self) -> Vec<bool> {
        let next = self.next_rig.as_ref().unwrap_or(&self.rig);
        let cameras = self.rig.cameras.iter().zip(&next.cameras).enumerate();
        cameras.map(|(i, (old, new))| self.is_left_out(i) && old.has_pose_of(new)).collect()
    }

    /// These cameras are left out of all windows. Ignored if a new calibration waits: the tracker then finds the moved
    /// cameras itself.
    pub(in crate::core) fn leave_out_moved(&mut self, cameras: Vec<bool>) {
        if self.next_rig.is_none() {
            self.left_out = cameras;
        }
    }

    pub(super) fn is_left_out(&self, camera: usize) -> bool {
        self.watchdog.is_left_out(camera) || self.left_out.get(camera).copied().unwrap_or(false)
    }

    /// The settings of a live tracker.
    pub(in crate::core) fn live_settings(&self) -> Option<Live> {
        self.live
    }

    /// Sets the effort from the next job on.
    pub fn set_effort(&mut self, effort: Effort) {
        self.effort = effort;
    }

    /// Sets the latency of a live tracker. Takes effect at the next [`Tracker::handle`].
    pub fn set_latency(&mut self, latency: Latency) {
        if self.latency.is_some_and(|before| latency.declared < before.declared) {
            // The poses between are skipped.
            self.playout.stop();
            self.resume();
        }
        self.latency = Some(latency);
    }

    /// Sets the usual time from the capture of a frame to its arrival, of a live tracker; negative
    /// values count as 0. Takes effect at the next [`Tracker::handle`].
    pub fn set_delay(&mut self, delay: Nanos) {
        self.delay = delay.max(Nanos::ZERO);
    }

    /// Tracks a performer whose body is known, if there is one. The body is not estimated.
    #[must_use]
    pub fn with_body(self, body: impl Into<Option<Arc<Skeleton>>>) -> Self {
        let Some(body) = body.into() else { return self };
        let tracker = self.with_body_to_check(body);
        let config = Config { body_windows: 0, ..tracker.config };
        Self { config, estimator: Arc::new(BodyEstimator::complete()), ..tracker }
    }

    /// Tracks a performer whose body is known from this take, if there is one. It is checked in the first
    /// windows, and estimated anew if it does not fit.
    #[must_use]
    pub fn with_body_to_check(mut self, body: impl Into<Option<Arc<Skeleton>>>) -> Self {
        let Some(body) = body.into() else { return self };
        self.outputs.push_back(Output::Skeleton(Arc::clone(&body)));
        (self.skeleton, self.is_proven) = (Some(body), true);
        self.estimator = Arc::new(BodyEstimator::check());
        self
    }

    /// Tracks a performer whose body is known from another take, if there is one. Its bones are kept, its
    /// keypoint offsets are estimated; both are estimated anew if it does not fit.
    #[must_use]
    pub fn with_body_of_another_take(self, body: impl Into<Option<Arc<Skeleton>>>) -> Self {
        let Some(body) = body.into() else { return self };
        let estimator = Arc::new(BodyEstimator::of_another_take(&body));
        Self { estimator, ..self.with_body_to_check(body) }
    }

    /// Tracks a performer whose body is known, if there is one: with the keypoint offsets of this detector,
    /// or the bones alone.
    #[must_use]
    pub fn with_known_body(
        self,
        body: impl Into<Option<Arc<Skeleton>>>,
        offsets_are_known: bool,
    ) -> Self {
        match offsets_are_known {
            true => self.with_body_to_check(body),
            false => self.with_body_of_another_take(body),
        }
    }

    /// Begins with a frame period that was measured before, if there is one. It counts while the cameras
    /// agree with it.
    #[must_use]
    pub fn with_frame_period(mut self, period: Option<FramePeriod>) -> Self {
        self.intake.rate().know(period);
        self
    }

    /// Begins with the corrections of time offsets that an earlier run found, by camera.
    #[must_use]
    pub fn with_time_corrections(mut self, corrections: &[Nanos]) -> Self {
        self.offsets.resume(corrections);
        Arc::make_mut(&mut self.rig).shift_times(self.offsets.corrections());
        self
    }

    /// Corrects the capture times of a camera by so much, in place of its correction so far; also those of its frames
    /// that wait.
    pub(in crate::core) fn correct_times(&mut self, camera: usize, correction: Nanos) {
        let Some(before) = self.time_corrections().get(camera) else { return };
        let by = correction - *before;
        if by == Nanos::ZERO {
            return;
        }
        self.offsets.set(camera, correction);
        Arc::make_mut(&mut self.rig).shift_time(camera, by);
        self.shift_waiting(camera, by);
    }

    /// Takes the time offsets of a new calibration of the same cameras at once. Corrections end if they change.
    pub(in crate::core) fn take_time_offsets(&mut self, new: &Rig) {
        let changes = self.rig.offset_changes(self.time_corrections(), new);
        for (camera, by) in changes.into_iter().enumerate() {
            self.correct_times(camera, self.time_corrections()[camera] + by);
            self.offsets.set(camera, Nanos::ZERO);
        }
    }

    /// The capture times of a camera's frames that wait are so much later.
    pub(super) fn shift_waiting(&mut self, camera: usize, by: Nanos) {
        let late = self.intake.shift(camera, by);
        // Of several performers, each would report the same frames.
        if !self.is_fed {
            self.report(late);
        }
    }

    /// By camera, all corrections of time offsets so far.
    pub fn time_corrections(&self) -> &[Nanos] {
        self.offsets.corrections()
    }

    /// The performer's body once its estimate is complete, or if it was given.
    pub fn known_body(&self) -> Option<&Arc<Skeleton>> {
        let is_known = self.estimator.is_known();
        self.skeleton.as_ref().filter(|_| self.is_proven && is_known)
    }

    /// The estimate of the body.
    pub fn body_estimate(&self) -> &Arc<BodyEstimator> {
        &self.estimator
    }

    /// Usual time from the capture of a frame to its arrival.
    pub(in crate::core) fn delay(&self) -> Nanos {
        self.delay
    }

    /// Processes an input. Call [`Tracker::poll`] until it is empty before the next one.
    pub fn handle(&mut self, input: Input) {
        match input {
            Input::Detections(frame) => self.add(frame),
            Input::Tick(now) => self.now = self.now.max(Some(now)),
            Input::Rig(rig) => self.calibrate(rig),
            Input::Restart => {
                self.restart();
                self.idle.clock_jumped();
            }
            Input::ClockJumped => {
                self.handle(Input::Restart);
                self.offsets.clock_jumped();
                self.watchdog.clock_jumped();
            }
            Input::WatchFrame(frame) => return self.push_watch_frame(frame),
            Input::Complete(until) => self.complete = self.complete.max(Some(until)),
            Input::End => {
                for frame in self.intake.release() {
                    let grace = self.live.map(|_| self.grace());
                    let events = self.intake.admit(frame, self.now, grace);
                    self.report(events);
                }
                self.ended = true;
            }
            Input::Forget => {
                self.is_proven = false;
                self.mending.clear();
                self.restart();
            }
            Input::Solved(solution) if self.abandoned == Some(solution.number) => {
                self.abandoned = None;
            }
            Input::Solved(solution) => self.apply(solution),
        }
        self.watch_idle();
        self.advance();
        self.play();
    }

    /// The next output, if there is one.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// The next output that is not a job. `solve` solves the jobs on this thread; their solutions
    /// are handled at once.
    ///
    /// With [`Tracker::handle`], this is the whole run loop of a program that solves on one thread:
    /// `while let Some(output) = tracker.poll_and_solve(|job| solver.solve(job)) { ... }`.
    pub fn poll_and_solve(&mut self, mut solve: impl FnMut(&Job) -> Solution) -> Option<Output> {
        loop {
            match self.poll()? {
                Output::Solve(job) => self.handle(Input::Solved(solve(&job))),
                output => return Some(output),
            }
        }
    }

    /// The capture time at which a live tracker needs an [`Input::Tick`], if no other input arrives
    /// before.
    pub fn wake(&self) -> Option<Timestamp> {
        let due = self.due().map(|due| due - MARGIN);
        let after = |start: Option<Timestamp>, frames: usize| {
            let length = Nanos::new((frames as f64 * self.frame_period()) as i64);
            let wait = length + self.grace() + ROUNDING;
            start.filter(|_| self.pending.is_none()).map(|start| start + wait)
        };
        let fitted = self.look_ahead().and(self.newest.max(self.start));
        let times = match self.is_fed {
            true => [due, None, None],
            false => [due, after(fitted, 1), after(self.start, self.open_frames())],
        };
        // What is past waits for an input and not for a time.
        times.into_iter().flatten().filter(|at| Some(*at) > self.now).min()
    }

    /// The state of the performer: `Lost` if the body is known but nobody is tracked, `None` before the
    /// first acquisition.
    pub fn state(&self) -> Option<TrackingState> {
        match &self.phase {
            Phase::Tracking { coasted: 0, .. } => Some(TrackingState::Tracking),
            Phase::Tracking { .. } => Some(TrackingState::Coasting),
            Phase::Searching => self.skeleton.as_ref().map(|_| TrackingState::Lost),
        }
    }

    /// Whether any camera sees a person in the frames that wait for their window.
    pub fn sees_somebody(&self) -> bool {
        self.intake.shows_somebody()
    }

    /// Of one of several performers: whether nothing is known of it.
    pub(in crate::core) fn is_new(&self) -> bool {
        self.complete.is_none() && self.skeleton.is_none()
    }

    pub(in crate::core) fn config(&self) -> Config {
        self.config
    }

    /// The cameras, with the time offsets in use.
    pub fn rig(&self) -> &Arc<Rig> {
        &self.rig
    }

    /// The body, once it is known.
    pub fn skeleton(&self) -> Option<&Arc<Skeleton>> {
        self.skeleton.as_ref()
    }

    /// Length of a window; at 60 frames per second until the cameras' rate is known.
    pub fn span(&self) -> Nanos {
        Nanos::rounded(self.at_rate().window() as f64 * self.frame_period())
    }

    /// The settings at the cameras' frame rate.
    pub(super) fn at_rate(&self) -> Config {
        self.config.at_period(self.frame_period())
    }

    /// Nominal frame period, ns; of 60 frames per second until the cameras' rate is known.
    pub fn frame_period(&self) -> f64 {
        self.period.unwrap_or(FALLBACK_PERIOD)
    }

    /// The times of poses, after a performer was found.
    pub fn output_grid(&self) -> Option<Grid> {
        let frames = self.frames?;
        let rate = self.live.map_or(0.0, |live| live.output_rate_hz);
        let origin = self.first_output.unwrap_or(frames.origin);
        Some(if rate > 0.0 { Grid { origin, period_ns: 1e9 / rate } } else { frames })
    }

    /// Number of frames of that camera that were used in windows.
    pub fn used(&self, camera: usize) -> u64 {
        self.intake.used(camera)
    }

    /// Whether windows wait for that camera.
    pub fn is_waited_for(&self, camera: usize) -> bool {
        self.intake.waiting.is_waited_for(camera)
    }

    /// Windows do not wait for a camera until one of its frames is given.
    pub fn leave_out(&mut self, camera: usize) {
        self.intake.waiting.leave_out(camera);
    }

    /// Number of poses that were extrapolated because no solved pose was there in time, and number
    /// of poses that were solved too late.
    pub fn extrapolated_and_missed(&self) -> (u64, u64) {
        (self.playout.extrapolated, self.playout.missed)
    }

    fn add(&mut self, mut frame: Detections) {
        if self.is_fed {
            // The stage has reported what is to be.
            self.intake.admit(frame, self.now, None);
            return;
        }
        if let Some(camera) = self.rig.cameras.get(frame.camera) {
            frame.capture = frame.capture + camera.time_offset;
        }
        let grace = self.live.map(|_| self.grace());
        let events = self.intake.receive(frame, self.now, grace);
        self.report(events);
    }

    /// Reports events of the intake.
    fn report(&mut self, events: Vec<Event>) {
        for event in events {
            let is_of_window = event.kind == EventKind::Returned;
            let window = if is_of_window { Some(self.window) } else { event.window };
            self.outputs.push_back(Output::Event(Event { window, ..event }));
        }
    }

    fn calibrate(&mut self, rig: Arc<Rig>) {
        // Answers to jobs that are out are relative to the old calibration.
        self.mending.iter_mut().for_each(Mending::begin_anew);
        if rig.has_cameras_of(&self.rig) {
            self.take_time_offsets(&rig);
            self.next_rig = Some(rig);
            return;
        }
        self.offsets = LiveOffsets::new(rig.cameras.len());
        self.watchdog = Watchdog::new(rig.cameras.len());
        self.mending.clear();
        self.left_out.clear();
        self.next_rig = None;
        let fresh = Intake::new(rig.cameras.len(), self.config.grace_windows);
        let before = std::mem::replace(&mut self.intake, fresh);
        self.rig = rig;
        self.restart();
        if self.live.is_some() && !self.is_fed {
            // The new rig may not have their cameras.
            self.report(before.abandoned().map(|event| Event { camera: None, ..event }).collect());
        }
    }

    /// Forgets everything except the body, the numbers of windows and jobs, and the values of the
    /// setters.
    pub(super) fn restart(&mut self) {
        let period = self.intake.rate().known();
        let fresh = Self::new(self.config, Arc::clone(&self.rig)).with_frame_period(period);
        let old = std::mem::replace(self, fresh);
        (self.live, self.idle) = (old.live, old.idle);
        (self.is_fed, self.stagger, self.hands_over) = (old.is_fed, old.stagger, old.hands_over);
        (self.offsets, self.watchdog, self.mending) = (old.offsets, old.watchdog, old.mending);
        self.mending.iter_mut().for_each(Mending::begin_anew);
        self.left_out = old.left_out;
        self.skeleton = old.skeleton.filter(|_| old.is_proven);
        self.is_proven = old.is_proven;
        if self.skeleton.is_some() {
            self.estimator = old.estimator;
        }
        (self.effort, self.latency) = (old.effort, old.latency);
        (self.jobs, self.window) = (old.jobs, old.window + 1);
        (self.delay, self.ended) = (old.delay, old.ended);
        self.abandoned = old.pending.map(|job| job.number).or(old.abandoned);
        (self.next_rig, self.outputs) = (old.next_rig, old.outputs);
        self.intake.count_on_from(&old.intake);
        self.playout.extrapolated = old.playout.extrapolated;
        self.playout.missed = old.playout.missed;
        // The stage counts the frames of several performers.
        if self.live.is_some() && !self.is_fed {
            self.report(old.intake.abandoned().collect());
        }
    }

    pub(super) fn event(
        &mut self,
        kind: EventKind,
        capture: Timestamp,
        camera: Option<usize>,
        detail: String,
    ) {
        self.counted_event(kind, capture, camera, 1, detail);
    }

    pub(super) fn counted_event(
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
}

/// Solves a whole recording on this thread: gives the tracker all `frames` in order of arrival,
/// then the end, and passes every output except jobs to `sink`.
pub fn run_to_end(
    tracker: &mut Tracker,
    solver: &mut super::Solver,
    frames: impl IntoIterator<Item = Detections>,
    mut sink: impl FnMut(Output),
) {
    for input in frames.into_iter().map(Input::Detections).chain([Input::End]) {
        tracker.handle(input);
        while let Some(output) = tracker.poll_and_solve(|job| solver.solve(job)) {
            sink(output);
        }
    }
}
