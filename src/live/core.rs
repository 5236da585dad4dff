//! The node without its threads. Inputs: messages, solutions and time. Outputs: jobs and messages.

use std::collections::VecDeque;
use std::sync::Arc;

use super::cameras::Camera;
use super::clock::Clock;
use super::events::Events;
use super::governor::Governor;
use super::journal::{self, Journal};
use super::latency::Finder;
use super::port::{Input, Loss, MOST_BYTES, MOST_ORDER_BYTES, Output, Settings};
use super::publication::{Content, Publication};
use super::status::{Published, Windows};
use crate::core::body::{Skeleton, TrackingState};
use crate::core::camera::Rig;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{self, EventKind, Live, Tracker};
use crate::io::wire::{self, Topics};

/// The current calibration and its bytes.
pub(super) struct Calibration {
    pub(super) rig: Arc<Rig>,
    pub(super) bytes: Vec<u8>,
}

/// The node without its threads. The same inputs at the same times give the same outputs.
pub struct Core {
    pub(super) settings: Settings,
    pub(super) topics: Topics,
    pub(super) outputs: VecDeque<Output>,
    pub(super) now: Timestamp,
    /// Calibration from a file or of the run before, before the first message.
    pub(super) rig_at_start: Option<Vec<u8>>,
    /// Hashes of the file's rigs and of refused ones: each is reported once.
    pub(super) known_rigs: Vec<u64>,
    pub(super) calibration: Option<Calibration>,
    pub(super) track: Option<Tracker>,
    /// The body of the next pose.
    pub(super) skeleton: Option<Arc<Skeleton>>,
    pub(super) cameras: Vec<Camera>,
    pub(super) clock: Clock,
    pub(super) latency: Finder,
    pub(super) governor: Governor,
    pub(super) counts: Events,
    pub(super) windows: Windows,
    pub(super) published: Published,
    pub(super) queue_dropped: u64,
    /// What went wrong since the last window; input of the governor.
    pub(super) trouble: Option<&'static str>,
    /// Capture and arrival times of the last frames.
    pub(super) arrivals: VecDeque<(Timestamp, Timestamp)>,
    /// Solve time of the current answer.
    pub(super) took: Nanos,
    pub(super) journal: Journal,
    /// Whether all entries of the journal are written now.
    pub(super) is_flushed: bool,
    /// Whether a job is out.
    pub(super) is_solving: bool,
    /// The take that begins as soon as no job is out.
    pub(super) starting: Option<wire::Take>,
    /// Name of the take that runs, or empty.
    pub(super) running: String,
    /// Id of this run, set at the first message; 0 before.
    pub(super) run_id: u64,
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
            latency: Finder::new(node.latency_ms, settings.carried.latency),
            running: settings.carried.take.clone(),
            settings,
            topics,
            outputs: VecDeque::new(),
            now: Timestamp::default(),
            rig_at_start: None,
            known_rigs: Vec::new(),
            calibration: None,
            track: None,
            skeleton: None,
            cameras: Vec::new(),
            clock: Clock::new(0),
            governor: Governor::default(),
            counts: Events::default(),
            windows: Windows::default(),
            published: Published::new(),
            queue_dropped: 0,
            trouble: None,
            arrivals: VecDeque::new(),
            took: Nanos::ZERO,
            journal: Journal::default(),
            is_flushed: false,
            is_solving: false,
            starting: None,
            run_id: 0,
            next_second: None,
            wake: None,
            ended: false,
        }
    }

    /// Handles an input. `now` is the node's clock, nanoseconds since 1970; it never goes back.
    pub fn handle(&mut self, now: Timestamp, input: Input) {
        self.now = self.now.max(now);
        let input = if self.changes_nothing(&input) { Input::Tick } else { input };
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
            self.give(tracker::Input::Tick(self.clock.capture_time(self.now)));
        }
        match input {
            Input::Message { topic, payload } => self.message(&topic, &payload),
            Input::RigFile(bytes) => self.rig_file(bytes),
            Input::Solved { solution, took } => {
                self.is_solving = false;
                // Its window would end in the next run.
                if self.starting.is_none() {
                    self.solved(*solution, took);
                }
            }
            Input::Tick => {}
            Input::Dropped(losses) => self.dropped(losses),
            Input::Played(deviations_us) => self.published.played(&deviations_us),
            Input::End => {
                self.give_up_start();
                self.give(tracker::Input::End);
            }
        }
        self.drain();
        if !self.is_solving
            && let Some(take) = self.starting.take()
        {
            self.begin_take(take);
        }
        self.seconds(is_last);
        let is_flushed = std::mem::take(&mut self.is_flushed);
        self.write_journal(is_last || is_flushed);
        self.wake();
    }

    /// Publishes the journal's entries if it is time, or if all are to be written.
    pub(super) fn write_journal(&mut self, all: bool) {
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

    pub(super) fn give(&mut self, input: tracker::Input) {
        if let Some(track) = &mut self.track {
            track.handle(input);
        }
    }

    pub(super) fn begin(&mut self, rig: Arc<Rig>) {
        let node = &self.settings.node;
        let live = Live {
            provisional: node.provisional,
            time_offsets: node.time_offsets,
            watch_cameras: node.watch_cameras,
            output_rate_hz: node.output_rate_hz,
        };
        let detail = format!("calibration {} of {} cameras", rig.version, rig.cameras.len());
        self.skeleton = None;
        let tracker = Tracker::new(self.settings.tracker, rig).live(live);
        let tracker = tracker.with_time_corrections(&self.settings.carried.time_offsets);
        self.track = Some(tracker.with_body_to_check(self.body()));
        self.event(EventKind::Calibrated, None, detail);
    }

    /// The body that was given.
    fn body(&self) -> Option<Arc<Skeleton>> {
        let body = wire::decode::<wire::Skeleton>(self.settings.body.as_deref()?).ok()?;
        body.to_core().ok().map(Arc::new)
    }

    /// A new core that has only waiting outputs of the old one.
    pub(super) fn reset(&mut self, settings: Settings, rig_at_start: Option<Vec<u8>>) {
        let outputs = std::mem::take(&mut self.outputs);
        *self = Self { now: self.now, outputs, rig_at_start, ..Self::new(settings) };
    }

    /// Resets all state before the first message: a replay knows only what is in the journal's head.
    fn begin_anew(&mut self) {
        let (journal, run_id) = (std::mem::take(&mut self.journal), self.run_id);
        let rig = self.rig_at_start.take();
        self.reset(self.settings.clone(), rig);
        (self.journal, self.run_id) = (journal, run_id);
        self.next_second = Some(self.now + Nanos::SECOND);
        let Some(rig) = self.rig_at_start.clone() else { return };
        let outputs = self.outputs.len();
        self.calibrate(&rig, "the file");
        self.outputs.truncate(outputs);
    }

    fn dropped(&mut self, losses: Vec<Loss>) {
        for Loss { camera, dropped, too_large, bytes } in losses {
            self.queue_dropped += dropped + too_large;
            if dropped > 0 {
                let detail = match camera {
                    Some(_) => "more messages than the node reads; the oldest were dropped",
                    None => {
                        "too many rigs, slates, or messages of cameras that the rig does not have"
                    }
                };
                self.events(EventKind::Dropped, camera.as_deref(), dropped, detail.to_owned());
            }
            if too_large > 0 {
                let most = if camera.is_some() { MOST_BYTES } else { MOST_ORDER_BYTES };
                let detail = format!("a message of {bytes} bytes, at most {most}");
                self.events(EventKind::Unusable, camera.as_deref(), too_large, detail);
            }
        }
    }

    /// Counts and publishes an event that happens now.
    pub(super) fn event(&mut self, kind: EventKind, camera: Option<&str>, detail: String) {
        self.events(kind, camera, 1, detail);
    }

    pub(super) fn events(
        &mut self,
        kind: EventKind,
        camera: Option<&str>,
        count: u64,
        detail: String,
    ) {
        let capture = self.clock.capture_time(self.now);
        let event = tracker::Event { capture, kind, camera: None, window: None, count, detail };
        self.emit(&event, camera);
    }

    /// Counts and publishes an event; `camera` is the name of the camera that it concerns.
    pub(super) fn emit(&mut self, event: &tracker::Event, camera: Option<&str>) {
        if let Some(name) = camera
            && let Some(camera) = self.cameras.iter_mut().find(|camera| camera.name() == name)
        {
            camera.event(event.kind, event.count);
        }
        if let Some(message) = self.counts.add(event, camera) {
            self.publish_event(event.kind, message);
        }
    }

    fn publish_event(&mut self, kind: EventKind, message: wire::Event) {
        let message = wire::Event { run_id: self.run_id, ..message };
        let capture = Timestamp::from_ns(message.capture_time_ns);
        self.publish(self.topics.events(kind), capture, Content::Event(message));
    }

    /// Publishes a message at once.
    pub(super) fn publish(&mut self, topic: String, capture: Timestamp, content: Content) {
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
        for (kind, message) in self.counts.second() {
            self.publish_event(kind, message);
        }
        for camera in &mut self.cameras {
            camera.second(passed);
        }
        self.watch_clocks();
        self.clock.follow(self.now);
        self.lower_latency();
        let status = self.status();
        let capture = self.clock.capture_time(self.now);
        self.publish(self.topics.status(), capture, Content::Status(Box::new(status)));
    }

    fn status(&self) -> wire::Status {
        let track = self.track.as_ref();
        let cameras = self.cameras.iter().enumerate().map(|(index, camera)| {
            let used = track.map_or(0, |track| track.used(index));
            let waited_for = track.is_some_and(|track| track.is_waited_for(index))
                && !self.clock.is_left_out(index);
            let offset = self.clock.offset(index, self.now).unwrap_or_default();
            camera.counters(self.now, used, waited_for, offset)
        });
        let effort = tracker::Effort::at(self.governor.level(), &self.settings.tracker);
        wire::Status {
            capture_time_ns: self.clock.capture_time(self.now).ns(),
            cameras: cameras.collect(),
            windows: Some(self.windows.counters()),
            node_time_ns: self.now.ns(),
            inputs: self.journal.count,
            tracker_state: track.map_or("searching", tracker_state).to_owned(),
            declared_latency_ns: self.latency.declared().unwrap_or_default().ns().unsigned_abs(),
            playout: Some(
                self.published.counters(track.map_or((0, 0), Tracker::extrapolated_and_missed)),
            ),
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
        }
    }

    fn wake(&mut self) {
        let track = self.track.as_ref().and_then(Tracker::wake);
        // If its wake time is past, the tracker waits for an input and not for a time.
        let next = track.map(|capture| self.clock.node_time(capture)).filter(|at| *at > self.now);
        let next = next.into_iter();
        let Some(at) = next.chain(self.next_second).min() else { return };
        if self.wake != Some(at) {
            self.wake = Some(at);
            self.outputs.push_back(Output::Wake(at));
        }
    }
}

/// The tracker's state by its name in the status message.
fn tracker_state(track: &Tracker) -> &'static str {
    match track.state() {
        _ if track.is_idle() => "idle",
        Some(TrackingState::Tracking) => "tracking",
        Some(TrackingState::Coasting) => "coasting",
        _ if track.sees_somebody() => "acquiring",
        Some(TrackingState::Lost) => "lost",
        None => "searching",
    }
}
