//! The node without its threads. Inputs: messages, solutions and time. Outputs: jobs and messages.

mod answers;
mod attendance;
mod events;
mod governor;
pub(super) mod journal;
mod latency;
mod mend;
mod messages;
mod peers;
mod performer;
mod performers;
pub(super) mod port;
pub(super) mod publication;
mod rigs;
mod sharing;
mod status;
pub(super) mod take;
mod watch;

use std::collections::VecDeque;
use std::sync::Arc;

use crate::core::body::Skeleton;
use crate::core::camera::Rig;
use crate::core::stage::{self, Names, PerformerId, Stage};
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{self, EventKind, Live, Solution, Tracker};
use crate::io::bus::LONGEST_TOPIC;
use crate::io::wire::{self, Topics};
use crate::live::clock::Clock;
use crate::metrics::CameraState;
use events::Events;
use governor::Governor;
use journal::Journal;
use latency::Finder;
use peers::Peers;
use performer::{Performer, Progress, coasted_and_missed, state_of_all, windows_of_all};
use port::{Input, Loss, MOST_BYTES, MOST_ORDER_BYTES, Output, Settings};
use publication::{Content, Publication};
use sharing::Sharing;
use status::Published;

/// The current calibration and its bytes.
struct Calibration {
    rig: Arc<Rig>,
    bytes: Vec<u8>,
    hash: u64,
}

/// The node without its threads. The same inputs at the same times give the same outputs.
pub struct Core {
    settings: Settings,
    topics: Topics,
    outputs: VecDeque<Output>,
    now: Timestamp,
    /// Calibration from a file or of the run before, before the first message.
    rig_at_start: Option<Vec<u8>>,
    /// Hashes of the file's rigs and of refused ones: each is reported once.
    known_rigs: Vec<u64>,
    calibration: Option<Calibration>,
    stage: Option<Stage>,
    /// By number.
    performers: Vec<Performer>,
    cameras: Vec<CameraState>,
    clock: Clock,
    latency: Finder,
    governor: Governor,
    counts: Events,
    published: Published,
    queue_dropped: u64,
    /// What went wrong since the last window; input of the governor.
    trouble: Option<&'static str>,
    /// Poses and windows of this second that were not solved when due.
    overdue: u64,
    /// Capture and arrival times of the last frames.
    arrivals: VecDeque<(Timestamp, Timestamp)>,
    /// Solve time of the current answer.
    took: Nanos,
    journal: Journal,
    /// Whether all entries of the journal are written now.
    is_flushed: bool,
    /// Most people at a time who are not performers.
    others: usize,
    /// Whether somebody entered, returned, left or got a name since the last status of the stage.
    is_changed: bool,
    /// Of a solver: the performers of the stage.
    sharing: Sharing,
    /// The other nodes of the stage.
    peers: Peers,
    /// Number of jobs that are out.
    jobs: usize,
    /// The take that begins as soon as no job is out.
    starting: Option<wire::Take>,
    /// Solutions that came while that take waits. If it begins, they are dropped: their windows are of
    /// this run.
    held: Vec<(PerformerId, Solution, Nanos)>,
    /// Name of the take that runs, or empty.
    running: String,
    /// Time of the first message of this run, node's clock.
    began: Timestamp,
    /// Id of this run, set at the first message; 0 before.
    run_id: u64,
    /// What a check finds wrong with all cameras.
    verdict: String,
    next_second: Option<Timestamp>,
    wake: Option<Timestamp>,
    ended: bool,
}

impl Core {
    /// A core that waits for a rig and for keypoints.
    pub fn new(settings: Settings) -> Self {
        let node = &settings.node;
        let topics = Topics { stage: node.stage.clone(), actor: node.actor.clone() };
        Self {
            latency: Finder::new(
                node.latency_ms,
                settings.carried.latency.map(|all| [all, settings.carried.solve]),
                settings.stage.several(),
            ),
            running: settings.carried.take.clone(),
            settings,
            topics,
            outputs: VecDeque::new(),
            now: Timestamp::default(),
            rig_at_start: None,
            known_rigs: Vec::new(),
            calibration: None,
            stage: None,
            performers: Vec::new(),
            cameras: Vec::new(),
            clock: Clock::new(0),
            governor: Governor::default(),
            counts: Events::default(),
            published: Published::new(),
            queue_dropped: 0,
            trouble: None,
            overdue: 0,
            arrivals: VecDeque::new(),
            took: Nanos::ZERO,
            journal: Journal::default(),
            is_flushed: false,
            is_changed: false,
            sharing: Sharing::default(),
            peers: Peers::default(),
            jobs: 0,
            others: 0,
            starting: None,
            held: Vec::new(),
            began: Timestamp::default(),
            run_id: 0,
            verdict: String::new(),
            next_second: None,
            wake: None,
            ended: false,
        }
    }

    /// Handles an input. `now` is the node's clock, nanoseconds since 1970; it never goes back.
    pub fn handle(&mut self, now: Timestamp, input: Input) {
        self.note_time(now);
        let input = if self.changes_nothing(&input) { Input::Tick } else { input };
        if matches!(input, Input::Message { .. }) {
            self.note_message();
        }
        let (settings, rig) = (&self.settings, self.rig_at_start.as_deref());
        let is_first = self.journal.count == 0 && matches!(input, Input::Message { .. });
        if is_first {
            self.run_id = journal::run_id(self.now, settings, rig);
        }
        let run_id = self.run_id;
        self.journal.note(self.now, &input, || journal::start(settings, rig, run_id));
        if is_first {
            self.begin_anew();
        }
        // Inputs after the end, such as the last solution, also belong to the journal.
        self.ended |= matches!(input, Input::End);
        let is_last = self.ended;
        if self.clock.is_known() {
            self.give(stage::Input::Tick(self.clock.capture_time(self.now)));
        }
        match input {
            Input::Message { topic, payload } => self.message(&topic, &payload),
            Input::RigFile(bytes) => self.rig_file(bytes),
            Input::Solved { performer, solution, took } => {
                self.jobs = self.jobs.saturating_sub(1);
                match self.starting {
                    Some(_) => self.held.push((performer, *solution, took)),
                    None => self.solved(performer, *solution, took),
                }
            }
            Input::Tick => {}
            Input::Solvers(names) => self.solvers(names),
            Input::Dropped(losses) => self.dropped(losses),
            Input::Played(deviations_us) => self.published.played(&deviations_us),
            Input::End => {
                self.give_up_start();
                self.use_held();
                self.release_all();
                self.put_out_bodies();
                self.give(stage::Input::End);
            }
        }
        self.drain();
        if self.jobs == 0
            && let Some(take) = self.starting.take()
        {
            self.begin_take(take);
        }
        self.seconds(is_last);
        self.tell_silence();
        if std::mem::take(&mut self.is_changed) {
            self.publish_stage_status(&self.progress());
        }
        let is_flushed = std::mem::take(&mut self.is_flushed);
        self.write_journal(is_last || is_flushed);
        self.wake();
    }

    /// The take that waited does not begin: the solutions that came meanwhile are of use.
    fn use_held(&mut self) {
        for (performer, solution, took) in std::mem::take(&mut self.held) {
            self.solved(performer, solution, took);
            self.drain();
        }
    }

    /// Publishes the journal's entries if it is time, or if all are to be written.
    fn write_journal(&mut self, all: bool) {
        if let Some(part) = self.journal.take(self.now, all, self.run_id) {
            self.publish(self.topics.journal(), self.now, Content::Journal(part));
        }
    }

    /// The next output, if there is one.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// The bytes of the `Rig` message in use, if there is one.
    pub fn rig(&self) -> Option<&[u8]> {
        self.calibration.as_ref().map(|calibration| &*calibration.bytes)
    }

    /// The hash of that message.
    pub(in crate::live) fn rig_hash(&self) -> Option<u64> {
        self.calibration.as_ref().map(|calibration| calibration.hash)
    }

    fn give(&mut self, input: stage::Input) {
        if let Some(stage) = &mut self.stage {
            stage.handle(input);
        }
    }

    fn begin(&mut self, rig: Arc<Rig>) {
        let node = &self.settings.node;
        let live = Live {
            provisional: node.provisional,
            time_offsets: node.time_offsets,
            watch_cameras: node.watch_cameras,
            output_rate_hz: node.output_rate_hz,
        };
        let detail = format!("calibration {} of {} cameras", rig.version, rig.cameras.len());
        self.performers.clear();
        let carried = &self.settings.carried;
        for (camera, usual) in self.cameras.iter_mut().zip(&carried.usual_px) {
            camera.set_usual_px(*usual);
        }
        for (camera, verdict) in self.cameras.iter_mut().zip(&carried.verdicts) {
            camera.set_verdict(verdict);
        }
        self.verdict.clone_from(&carried.verdict);
        let Settings { tracker: config, stage: of_stage, carried, .. } = &self.settings;
        let tracker = Tracker::new(*config, rig).live(live);
        let tracker = tracker.with_time_corrections(&carried.time_offsets);
        let tracker = tracker.with_known_body(self.body(), carried.offsets_are_known);
        let stage = match self.settings.node.solver {
            true => Stage::of_associated(tracker),
            false => Stage::new(tracker, of_stage.performers, None),
        };
        let stage = stage.choosing(of_stage.choice()).naming(Names::new(of_stage.names.clone()));
        let stage = if of_stage.solve { stage } else { stage.without_solving() };
        let stage = stage.with_known(&carried.performers).with_left_out(&carried.left_out);
        self.stage = Some(stage);
        if !self.is_several() {
            self.performer(PerformerId(0));
        }
        self.event(EventKind::Calibrated, None, detail);
    }

    /// The body that was given.
    fn body(&self) -> Option<Arc<Skeleton>> {
        let body = wire::decode::<wire::Skeleton>(self.settings.body.as_deref()?).ok()?;
        body.to_core().ok().map(Arc::new)
    }

    /// A new core that has only waiting outputs of the old one.
    fn reset(&mut self, settings: Settings, rig_at_start: Option<Vec<u8>>) {
        let outputs = std::mem::take(&mut self.outputs);
        *self = Self { now: self.now, outputs, rig_at_start, ..Self::new(settings) };
    }

    /// Resets all state before the first message: a replay knows only what is in the journal's head.
    fn begin_anew(&mut self) {
        let (journal, run_id) = (std::mem::take(&mut self.journal), self.run_id);
        let rig = self.rig_at_start.take();
        self.reset(self.settings.clone(), rig);
        (self.journal, self.run_id, self.began) = (journal, run_id, self.now);
        self.next_second = Some(self.now + Nanos::SECOND);
        let Some(rig) = self.rig_at_start.clone() else { return };
        let outputs = self.outputs.len();
        self.calibrate(&rig, "the file");
        self.outputs.truncate(outputs);
        for camera in self.stage.as_ref().map_or_else(Vec::new, Stage::left_out) {
            let Some(name) = self.cameras.get(camera).map(|c| c.name().to_owned()) else {
                continue;
            };
            let detail =
                "moved before this take: it is left out until a calibration gives it a new pose";
            self.event(EventKind::CameraMoved, Some(&name), detail.to_owned());
        }
    }

    fn dropped(&mut self, losses: Vec<Loss>) {
        for Loss { camera, dropped, too_large, bytes } in losses {
            let lost = dropped.saturating_add(too_large);
            self.queue_dropped = self.queue_dropped.saturating_add(lost);
            if dropped > 0 {
                let detail = match camera {
                    Some(_) => "more messages than the node reads; they were dropped",
                    None => {
                        "too many rigs, slates, or messages of cameras that the rig does not have"
                    }
                };
                self.events(EventKind::Dropped, camera.as_deref(), dropped, detail.to_owned());
            }
            if too_large > 0 {
                let most = if camera.is_some() { MOST_BYTES } else { MOST_ORDER_BYTES };
                let detail = format!(
                    "a message of {bytes} bytes, at most {most}, or with a topic of more than {LONGEST_TOPIC} bytes"
                );
                self.events(EventKind::Unusable, camera.as_deref(), too_large, detail);
            }
        }
    }

    /// Counts and publishes an event that happens now.
    fn event(&mut self, kind: EventKind, camera: Option<&str>, detail: String) {
        self.events(kind, camera, 1, detail);
    }

    fn events(&mut self, kind: EventKind, camera: Option<&str>, count: u64, detail: String) {
        let capture = self.clock.capture_time(self.now);
        let event = tracker::Event { capture, kind, camera: None, window: None, count, detail };
        self.emit(&event, None, camera);
    }

    /// Counts and publishes an event of one of several performers, or else of the node. `camera` is the
    /// name of the camera that it concerns.
    fn emit(
        &mut self,
        event: &tracker::Event,
        performer: Option<PerformerId>,
        camera: Option<&str>,
    ) {
        if let Some(name) = camera
            && let Some(camera) = self.cameras.iter_mut().find(|camera| camera.name() == name)
        {
            camera.event(event.kind, event.count);
        }
        if let Some(message) = self.counts.add(event, performer, camera) {
            self.publish_event(event.kind, performer, message);
        }
    }

    /// Publishes an event of one of several performers, or else of the node.
    fn publish_event(
        &mut self,
        kind: EventKind,
        performer: Option<PerformerId>,
        message: wire::Event,
    ) {
        let message = wire::Event { run_id: self.run_id, ..message };
        let capture = Timestamp::from_ns(message.capture_time_ns);
        let performer = performer.and_then(|performer| self.performers.get(performer.0));
        let topics = performer.map_or(&self.topics, |performer| &performer.topics);
        self.publish(topics.events(kind), capture, Content::Event(message));
    }

    /// Publishes a message at once.
    fn publish(&mut self, topic: String, capture: Timestamp, content: Content) {
        let publication = Publication { topic: topic.into(), capture, due: None, content };
        self.outputs.push_back(Output::Publish(publication));
    }

    /// Work that is done once a second.
    fn seconds(&mut self, is_last: bool) {
        let next = *self.next_second.get_or_insert(self.now + Nanos::SECOND);
        if self.now < next && !is_last {
            return;
        }
        let passed = (self.now - next + Nanos::SECOND).max(Nanos::new(1));
        self.next_second = Some(self.now + Nanos::SECOND);
        self.overdue = 0;
        self.publish_counts();
        self.review_peers();
        for camera in &mut self.cameras {
            camera.second(self.now, passed);
        }
        self.watch_crowd();
        self.watch_clocks();
        self.clock.follow(self.now);
        self.lower_latency();
        self.publish_status();
    }

    /// Publishes the status when a camera falls silent, not only at the next second.
    fn tell_silence(&mut self) {
        // A solver gets frames from the front, and only while it solves somebody.
        if self.is_solver() {
            return;
        }
        let mut is_new = false;
        for camera in &mut self.cameras {
            is_new |= camera.falls_silent(self.now);
        }
        if is_new {
            self.publish_status();
        }
    }

    /// Publishes the events that were only counted.
    fn publish_counts(&mut self) {
        for (kind, performer, message) in self.counts.second() {
            self.publish_event(kind, performer, message);
        }
    }

    /// Publishes the status of the node and, with several performers, of each.
    fn publish_status(&mut self) {
        let all = self.progress();
        self.publish_stage_status(&all);
        self.is_changed = false;
        let states: Vec<&str> = all.iter().map(|one| one.state).collect();
        let of_node = Progress {
            state: state_of_all(&states),
            windows: windows_of_all(all.iter().map(|one| &one.windows)),
            playout: self.published.counters(coasted_and_missed(&all)),
        };
        let mut status = self.status(of_node);
        if self.is_front() {
            status = self.with_solvers(status);
        }
        let capture = self.clock.capture_time(self.now);
        let known = self.solved_here();
        for (number, Progress { state, windows, playout }) in all.into_iter().enumerate() {
            if !known.contains(&PerformerId(number)) {
                continue;
            }
            let topic = self.performers[number].topics.status();
            let status = wire::Status {
                tracker_state: state.to_owned(),
                windows: Some(windows),
                playout: Some(playout),
                label: self.label_of(number).cloned(),
                residual_px: self.performers[number].residual_px,
                ..status.clone()
            };
            self.publish(topic, capture, Content::Status(Box::new(status)));
        }
        self.publish(self.topics.status(), capture, Content::Status(Box::new(status)));
    }

    fn status(&mut self, of_node: Progress) -> wire::Status {
        let mut cameras = Vec::new();
        for (index, camera) in self.cameras.iter().enumerate() {
            let stage = self.stage.as_mut();
            let (waited_for, used) = stage.map_or((false, 0), |stage| stage.camera(index));
            let waited_for = waited_for && !self.clock.is_left_out(index);
            let offset = self.clock.offset(index, self.now).unwrap_or_default();
            let counters = camera.counters(self.now, used, waited_for, offset);
            let time_correction_s = self.time_correction(index).seconds();
            cameras.push(wire::CameraCounters { time_correction_s, ..counters });
        }
        let effort = tracker::Effort::at(self.governor.level(), &self.settings.tracker);
        wire::Status {
            capture_time_ns: self.clock.capture_time(self.now).ns(),
            cameras,
            windows: Some(of_node.windows),
            node_time_ns: self.now.ns(),
            inputs: self.journal.count,
            tracker_state: of_node.state.to_owned(),
            declared_latency_ns: self.latency.declared().unwrap_or_default().ns().unsigned_abs(),
            playout: Some(of_node.playout),
            effort: Some(wire::EffortStatus {
                level: self.governor.level(),
                iterations: effort.iterations as u32,
                stride: effort.stride as u32,
                degradation_steps: self.governor.degradation_steps,
            }),
            events: self.counts.counts(),
            queue_dropped: self.queue_dropped,
            run_id: self.run_id,
            clock: self.clock.kind().to_owned(),
            clock_offset_s: self.clock.base().seconds(),
            label: self.label_of(0).filter(|_| !self.is_several()).cloned(),
            residual_px: 0.0,
            verdict: self.verdict.clone(),
            take: self.running.clone(),
            take_since_ns: if self.running.is_empty() { 0 } else { self.began.ns() },
        }
    }

    fn wake(&mut self) {
        let track = self.stage.as_mut().and_then(Stage::wake);
        // If its wake time is past, the tracker waits for an input and not for a time.
        let next = track.map(|capture| self.clock.node_time(capture)).filter(|at| *at > self.now);
        let silent = self.cameras.iter().filter_map(CameraState::silent_from);
        let next = next.into_iter().chain(silent.filter(|at| *at > self.now));
        let Some(at) = next.chain(self.next_second).min() else { return };
        if self.wake != Some(at) {
            self.wake = Some(at);
            self.outputs.push_back(Output::Wake(at));
        }
    }
}
