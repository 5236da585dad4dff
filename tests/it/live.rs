//! The node's core in simulated time: simulated cameras, network, solver and clock, so that every
//! run is the same and takes only its computing time.

use std::collections::BTreeMap;
use std::sync::Arc;

use bundlemocap::config::Config;
use bundlemocap::core::body::{self, Skeleton};
use bundlemocap::core::camera::Rig;
use bundlemocap::core::detections::Detections;
use bundlemocap::core::manifold::Decoder;
use bundlemocap::core::random::Draws;
use bundlemocap::core::stage::{Known, PerformerId};
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::core::tracker::{Job, Outcome, Solution, Solver, Task, solve_aside};
use bundlemocap::io::wire::journal_entry::Input as JournalInput;
use bundlemocap::io::wire::{
    self, Event, KeypointFrame, Pose, Schema, Status, Topics, TrackingState, decode, encode,
};
use bundlemocap::live::{Core, Input, Loss, Output, Recorded, Settings, find_nodes};
use bundlemocap::research::synth::{
    Crowd, Meeting, Motion, MotionStyle, Noise, Recording, ring_rig,
};

use crate::slate::{assert_agrees, replayed};

const MS: Nanos = Nanos::from_ms(1);
const SECOND: Nanos = Nanos::SECOND;
/// Start of the cameras on the node's clock.
pub const START: Timestamp = Timestamp::from_ns(1_700_000_000_000_000_000);
/// Time from exposure to arrival.
pub const NETWORK: Nanos = Nanos::from_ms(3);

/// A message in transit.
#[derive(Clone, Debug)]
pub struct Sent {
    pub arrival: Timestamp,
    pub topic: String,
    pub payload: Vec<u8>,
}

impl From<Sent> for Recorded {
    fn from(Sent { arrival, topic, payload }: Sent) -> Self {
        let (capture, schema) = (Timestamp::default(), "".into());
        Self { time: arrival, capture, topic: topic.into(), schema, payload }
    }
}

/// All outputs, with their times.
#[derive(Default)]
pub struct Heard {
    pub messages: Vec<Recorded>,
}

impl Heard {
    pub fn of<T: Schema>(&self, topic: &str) -> Vec<(Timestamp, T)> {
        let of_topic = self.messages.iter().filter(|message| *message.topic == *topic);
        of_topic.map(|message| (message.time, decode(&message.payload).unwrap())).collect()
    }

    pub fn poses(&self) -> Vec<(Timestamp, Pose)> {
        self.of(&Topics::default().pose())
    }

    fn live(&self) -> Vec<(Timestamp, Pose)> {
        self.of(&Topics::default().provisional())
    }

    pub fn status(&self) -> Status {
        self.of(&Topics::default().status()).pop().unwrap().1
    }

    pub fn events(&self) -> BTreeMap<String, u64> {
        self.status().events.into_iter().map(|e| (e.kind, e.count)).collect()
    }

    pub fn details(&self, kind: &str) -> Vec<String> {
        let topics = [Topics::default().stage_events(), Topics::default().actor_events()];
        let events = topics.iter().flat_map(|topic| self.of::<Event>(topic));
        events.filter(|(_, e)| e.kind == kind).map(|(_, e)| e.detail).collect()
    }
}

/// A node in simulated time.
pub struct World {
    pub core: Core,
    solver: Solver,
    now: Timestamp,
    wake: Option<Timestamp>,
    /// The solutions that are being computed, and their completion times.
    answers: Vec<(Timestamp, PerformerId, Solution, Nanos)>,
    /// When each solver will be free.
    solvers: Vec<Timestamp>,
    /// The simulated solve time of a job.
    took: Box<dyn Fn(&Job) -> Nanos>,
    pub heard: Heard,
    /// The newest body for the folder of known bodies, by name.
    pub bodies: BTreeMap<String, wire::Skeleton>,
}

pub fn settings(config: &Config, decoder: &Decoder) -> Settings {
    config.core_settings(decoder).unwrap()
}

impl World {
    pub fn new(config: &Config) -> Self {
        Self::knowing(config, Vec::new())
    }

    /// A node that knows these people.
    pub fn knowing(config: &Config, known: Vec<Known>) -> Self {
        let decoder = Decoder::embedded().unwrap();
        let mut settings = settings(config, &decoder);
        settings.carried.performers = known;
        Self {
            core: Core::new(settings),
            solver: Solver::new(decoder, config.tracker),
            now: START - SECOND,
            wake: None,
            answers: Vec::new(),
            solvers: vec![START - SECOND; if config.stage.several() { 2 } else { 1 }],
            took: Box::new(|job| match job.task {
                Task::Acquire { .. } => MS * 40,
                Task::Track { .. } => MS * 5,
                Task::Provisional { .. } => MS,
                Task::Mend { .. } => MS * 200,
            }),
            heard: Heard::default(),
            bodies: BTreeMap::new(),
        }
    }

    /// Delivers messages in order of arrival, and continues for a while after the last.
    pub fn play(&mut self, mut sent: Vec<Sent>, until: Timestamp) {
        sent.sort_by_key(|message| message.arrival);
        let mut sent = sent.into_iter().peekable();
        loop {
            let arrival = sent.peek().map(|message| message.arrival);
            let answer = self.answers.iter().map(|(at, ..)| *at).min();
            let next = [arrival, answer, self.wake].into_iter().flatten().min();
            let Some(next) = next.filter(|next| *next <= until) else { break };
            self.now = self.now.max(next);
            let input = if answer == Some(next) {
                self.answer()
            } else if arrival == Some(next) {
                let message = sent.next().unwrap();
                Input::Message { topic: message.topic.into(), payload: message.payload }
            } else {
                self.wake = None;
                Input::Tick
            };
            self.tell(input);
        }
        self.now = until;
    }

    /// The node does not run until then. The first input after that is its timer's.
    pub fn sleep_until(&mut self, at: Timestamp) {
        self.now = at;
        self.tell(Input::Tick);
    }

    /// Gives an input to the core, and handles the outputs.
    pub fn tell(&mut self, input: Input) {
        self.core.handle(self.now, input);
        while let Some(output) = self.core.poll() {
            match output {
                Output::Wake(at) => self.wake = Some(at.max(self.now + Nanos::new(1))),
                Output::Solve { performer, job, .. } => {
                    let took = (self.took)(&job);
                    if job.is_aside() {
                        let solution = solve_aside(&job);
                        self.answers.push((self.now + took, performer, solution, took));
                        continue;
                    }
                    let is_out = self.answers.iter().any(|(_, other, solution, _)| {
                        *other == performer && !matches!(solution.outcome, Outcome::Mended(_))
                    });
                    assert!(!is_out, "two jobs of a performer at once");
                    // Searches never take the last solver.
                    let is_search = matches!(job.task, Task::Acquire { .. });
                    let free = if is_search { 1 } else { self.solvers.len() };
                    let free = self.solvers[..free].iter_mut().min().unwrap();
                    *free = self.now.max(*free) + took;
                    self.answers.push((*free, performer, self.solver.solve(&job), took));
                }
                Output::Mended { .. } => {}
                Output::Body { name, body: Some(body), .. } => drop(self.bodies.insert(name, body)),
                Output::Body { name, .. } => drop(self.bodies.remove(&name)),
                Output::Publish(publication) => {
                    let (schema, payload) = publication.content.encoded();
                    self.heard.messages.push(Recorded {
                        time: publication.due.map_or(self.now, |due| due.max(self.now)),
                        capture: publication.capture,
                        topic: publication.topic,
                        schema: schema.into(),
                        payload,
                    });
                }
            }
        }
    }

    pub fn end(&mut self) {
        self.tell(Input::End);
        while let Some(at) = self.answers.iter().map(|(at, ..)| *at).min() {
            self.now = self.now.max(at);
            let answer = self.answer();
            self.tell(answer);
        }
    }

    /// The next solution.
    fn answer(&mut self) -> Input {
        let next = (0..self.answers.len()).min_by_key(|&index| self.answers[index].0).unwrap();
        let (_, performer, solution, took) = self.answers.remove(next);
        Input::Solved { performer, solution: Box::new(solution), took }
    }
}

/// Cameras around the procedural motion.
pub struct Studio {
    pub rig: Rig,
    pub frames: Vec<Detections>,
}

impl Studio {
    pub fn new(cameras: usize, frames: u64) -> Self {
        Self::at_rate(cameras, frames, 60.0)
    }

    pub fn at_rate(cameras: usize, frames: u64, fps: f64) -> Self {
        let skeleton = Skeleton::default();
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let rig = ring_rig(cameras, 4.0, 1.6).unwrap();
        let mut recording = Recording::new(rig, skeleton, |seconds| motion.pose(seconds));
        (recording.frames, recording.fps) = (frames, fps);
        recording.noise = Noise::jitter_only();
        recording.start = START;
        let frames = recording.detections().collect();
        Self { rig: recording.rig, frames }
    }

    pub fn rig(&self) -> Sent {
        let payload = encode(&wire::Rig::from_core(&self.rig));
        let arrival = START - SECOND / 2;
        Sent { arrival, topic: Topics::default().rig(), payload }
    }

    pub fn message(&self, frame: &Detections) -> Sent {
        let camera = &self.rig.cameras[frame.camera];
        let message = KeypointFrame::from_core(frame, &camera.name, [camera.width, camera.height]);
        Sent {
            arrival: frame.capture + NETWORK,
            topic: Topics::default().keypoints(&camera.name),
            payload: encode(&message),
        }
    }

    /// The rig, and every frame with its arrival time.
    pub fn messages(&self) -> Vec<Sent> {
        let frames = self.frames.iter().map(|frame| self.message(frame));
        std::iter::once(self.rig()).chain(frames).collect()
    }
}

/// What four cameras see of that many performers, whose recordings `set` changes: of one who walks, or of several who
/// meet at arm's length.
pub fn performers(
    people: usize,
    set: impl Fn(&mut Recording<Box<dyn Fn(f64) -> body::Pose>>),
) -> Studio {
    let meeting = Meeting { people, distance: Some(0.7) };
    let rig = if people == 1 { ring_rig(4, 4.0, 1.6) } else { meeting.rig(4) }.unwrap();
    let one = |person| {
        let (skeleton, motion) = meeting.person(person, 5);
        let motion: Box<dyn Fn(f64) -> body::Pose> = match people {
            1 => {
                let motion = Motion::new(&skeleton, MotionStyle::default());
                Box::new(move |seconds| motion.pose(seconds))
            }
            _ => Box::new(motion),
        };
        let mut one = Recording::new(rig.clone(), skeleton, motion);
        set(&mut one);
        one
    };
    let crowd = Crowd::new((0..people).map(one).collect());
    let frames = crowd.detections().map(|(frame, _)| frame).collect();
    Studio { rig, frames }
}

pub fn at(seconds: f64) -> Timestamp {
    START + Nanos::new((seconds * 1e9) as i64)
}

/// A world after those messages.
pub fn after(messages: Vec<Sent>, seconds: f64) -> World {
    let mut world = World::new(&Config::default());
    world.play(messages, at(seconds));
    world
}

/// Every pose leaves at its capture time plus one latency, on an even grid.
fn assert_on_time(heard: &Heard) {
    let poses = heard.poses();
    assert!(poses.len() > 60, "{} poses", poses.len());
    let latency = Nanos::new(poses[0].1.declared_latency_ns as i64);
    for (time, pose) in &poses {
        assert_eq!(*time - Timestamp::from_ns(pose.capture_time_ns), latency);
        assert_eq!(pose.due_time_ns, Some(time.ns()));
        assert_eq!(Nanos::new(pose.declared_latency_ns as i64), latency);
    }
    for pair in poses.windows(2) {
        let step = pair[1].1.capture_time_ns - pair[0].1.capture_time_ns;
        assert!((step - 16_666_667).abs() <= 1, "a step of {step} ns");
    }
}

#[test]
fn poses_leave_at_one_latency_and_provisional_ones_at_once() {
    let world = after(Studio::new(4, 240).messages(), 4.0);
    let heard = &world.heard;
    assert_on_time(heard);
    // 150 ms from the first pose to the end of a window, at least 22 to solve, 3 network, 4
    // publishing.
    assert_eq!(heard.poses()[0].1.declared_latency_ns, 180_000_000);
    let last = heard.poses().pop().unwrap().1;
    assert!(last.capture_time_ns >= (START + MS * 3_600).ns(), "{}", last.capture_time_ns);
    assert!(heard.poses().iter().all(|(_, pose)| pose.state() == TrackingState::Tracking));
    // The first ones wait for the windows collected for the shape.
    let mut live = heard.live();
    live.retain(|(time, _)| *time > heard.poses()[0].0);
    assert!(live.len() > 160, "{} provisional poses", live.len());
    for (time, pose) in &live {
        let waited = *time - Timestamp::from_ns(pose.capture_time_ns) - NETWORK;
        // One millisecond for the fit; five if it had to wait for a window's solve.
        assert!((Nanos::ZERO..=MS * 6).contains(&waited), "{waited}");
        assert!(pose.provisional && pose.revision == 0 && pose.due_time_ns.is_none());
    }
    assert!(heard.poses().iter().all(|(_, pose)| !pose.provisional));
    // After the frames collected for the shape, each had a provisional pose before.
    let caught_up = (START + MS * 550).ns();
    let mut later = heard.poses().into_iter().filter(|(_, p)| p.capture_time_ns > caught_up);
    assert!(later.all(|(_, pose)| pose.revision == 1));
    assert_eq!(heard.status().tracker_state, "tracking");
    let playout = heard.status().playout.unwrap();
    assert_eq!((playout.coasted, playout.missed), (0, 0));
}

/// The messages of a studio at a declared latency.
fn at_latency(latency_ms: f64, messages: Vec<Sent>, seconds: f64) -> World {
    let mut config = Config::default();
    config.node.latency_ms = latency_ms;
    let mut world = World::new(&config);
    world.play(messages, at(seconds));
    assert_on_time(&world.heard);
    world
}

/// Every pose is solved, none extrapolated.
fn assert_solved(heard: &Heard) {
    assert!(heard.poses().len() > 100, "{} poses", heard.poses().len());
    assert!(heard.poses().iter().all(|(_, pose)| pose.state() == TrackingState::Tracking));
    let playout = heard.status().playout.unwrap();
    assert_eq!((playout.coasted, playout.missed), (0, 0), "{:?}", heard.details("latency"));
}

#[test]
fn any_latency_gives_solved_poses() {
    let studio = Studio::new(4, 240);
    for (latency_ms, look_ahead) in [(10.0, 0), (16.7, 0), (50.0, 2), (120.0, 5)] {
        let world = at_latency(latency_ms, studio.messages(), 4.0);
        assert_solved(&world.heard);
        let why = world.heard.details("latency");
        assert!(why[0].ends_with(&format!("look-ahead {look_ahead} frames")), "{why:?}");
        let last = world.heard.poses().pop().unwrap().1.capture_time_ns;
        assert!(last >= (at(4.0) - Nanos::rounded(1e6 * latency_ms) - MS * 40).ns(), "{last}");
    }
}

#[test]
fn short_latencies_do_not_wait_for_missing_frames() {
    let studio = Studio::new(4, 240);
    let is_missing = |frame: &&Detections| frame.camera == 1 && frame.frame.is_multiple_of(3);
    let frames = studio.frames.iter().filter(|frame| !is_missing(frame));
    let messages = frames.map(|frame| studio.message(frame)).chain([studio.rig()]);
    let messages: Vec<Sent> = messages.collect();
    for latency_ms in [12.0, 50.0] {
        assert_solved(&at_latency(latency_ms, messages.clone(), 4.0).heard);
    }
}

#[test]
fn short_latencies_follow_the_performer_out_and_in() {
    let studio = Studio::new(4, 480);
    let mut frames = studio.frames.clone();
    let away = frames.iter_mut().filter(|frame| (120..240).contains(&frame.frame));
    away.for_each(|frame| frame.people.clear());
    let messages = frames.iter().map(|frame| studio.message(frame)).chain([studio.rig()]);
    let world = at_latency(50.0, messages.collect(), 8.0);
    let state = |seconds: f64| {
        let capture = at(seconds).ns();
        let poses = world.heard.poses();
        poses.into_iter().find(|(_, pose)| pose.capture_time_ns >= capture).unwrap().1.state()
    };
    let states = [1.5, 2.3, 3.5, 5.0].map(state);
    use TrackingState::{Coasting, Lost, Tracking};
    assert_eq!(states, [Tracking, Coasting, Lost, Tracking]);
}

#[test]
fn an_impossible_latency_is_reported_with_the_smallest_possible_one() {
    let world = at_latency(7.0, Studio::new(4, 240).messages(), 4.0);
    let why = world.heard.details("latency");
    // Three of network, six to solve and publish.
    assert!(why[0].contains("too short") && why[0].contains("latency is 9.0 ms"), "{why:?}");
}

#[test]
fn the_same_inputs_give_the_same_bytes() {
    let body = wire::Skeleton::from_core(&Skeleton::default());
    for body in [None, Some(encode(&body))] {
        replays_to_the_same_bytes(body);
    }
}

/// Replays a run of a node that was given that body, as it was and with a changed pose.
fn replays_to_the_same_bytes(body: Option<Vec<u8>>) {
    let mut messages = Studio::new(4, 150).messages();
    for index in (40..messages.len()).step_by(17) {
        messages[index].arrival = messages[index].arrival + MS * 90;
        let twin = messages[index].clone();
        messages.push(twin);
    }
    let config = Config::default();
    let settings = settings(&config, &Decoder::embedded().unwrap());
    let core = Core::new(Settings { body: body.clone(), ..settings });
    let mut world = World { core, ..World::new(&config) };
    world.play(messages.clone(), at(3.0));
    world.end();
    let skeletons = world.heard.of::<wire::Skeleton>(&Topics::default().skeleton());
    let is_given = |(_, first): &(Timestamp, wire::Skeleton)| {
        body == Some(encode(&wire::Skeleton { run_id: 0, ..first.clone() }))
    };
    assert_eq!(skeletons.first().is_some_and(is_given), body.is_some());
    let mut recorded = recorded(world, messages);
    let whole = replayed(&recorded, None).unwrap();
    assert!(whole.is_whole);
    assert_agrees(&whole);
    // Poses, keyframes, status and journal carry the run id, in the replay as in the recording.
    let topics = Topics::default();
    let run_id = whole.start.run_id;
    assert_ne!(run_id, 0);
    let again = Heard { messages: whole.outputs };
    assert!(again.poses().iter().all(|(_, pose)| pose.run_id == run_id));
    assert!(again.live().iter().all(|(_, pose)| pose.run_id == run_id));
    let keyframes = again.of::<wire::Keyframe>(&topics.keyframe());
    assert!(!keyframes.is_empty() && keyframes.iter().all(|(_, k)| k.run_id == run_id));
    assert_eq!(again.status().run_id, run_id);
    assert_eq!(again.poses().len(), whole.topics[&topics.pose()].recorded);
    // A change is detected.
    let journal = Topics::default().journal();
    recorded.retain(|message| *message.topic != *journal || message.time < at(2.5));
    let pose = recorded.iter_mut().find(|message| *message.topic == *Topics::default().pose());
    pose.unwrap().payload[100] ^= 1;
    let changed = replayed(&recorded, None).unwrap();
    assert!(!changed.is_whole);
    let differing: Vec<_> =
        changed.topics.iter().filter(|(_, topic)| !topic.agrees()).map(|(name, _)| name).collect();
    assert_eq!(differing, [&Topics::default().pose()]);
}

#[test]
fn each_run_has_its_own_id() {
    let run_id = |delay: Nanos| {
        let mut messages = Studio::new(2, 2).messages();
        messages.iter_mut().for_each(|sent| sent.arrival = sent.arrival + delay);
        let mut world = after(messages, 2.0);
        world.end();
        let journal = world.heard.of::<wire::Journal>(&Topics::default().journal());
        match &journal[0].1.entries[0].input {
            Some(wire::journal_entry::Input::Start(start)) => start.run_id,
            other => panic!("the journal begins with {other:?}"),
        }
    };
    assert_eq!(run_id(Nanos::ZERO), run_id(Nanos::ZERO));
    assert_ne!(run_id(Nanos::ZERO), run_id(Nanos::new(1)));
}

#[test]
fn a_replay_finds_the_node_in_the_recording() {
    let journal = |stage: &str, actor: &str| Recorded {
        time: at(0.0),
        capture: at(0.0),
        topic: Topics::new(stage, actor).unwrap().journal().into(),
        schema: wire::Journal::FULL_NAME.into(),
        payload: Vec::new(),
    };
    let one = [journal("hall", "anna")];
    let topics = find_nodes(&one, None, None).unwrap();
    assert_eq!(topics, [Topics::new("hall", "anna").unwrap()]);
    assert_eq!(find_nodes(&one, Some("hall"), Some("anna")).unwrap(), topics);
    let error = find_nodes(&one, Some("stage"), None).unwrap_err().to_string();
    assert!(error.contains("\"stage\"") && error.contains("mocap/hall/actor/anna"), "{error}");
    let two = [journal("hall", "anna"), journal("hall", "ben")];
    let names =
        |found: Vec<Topics>| found.into_iter().map(|topics| topics.actor).collect::<Vec<_>>();
    assert_eq!(names(find_nodes(&two, Some("hall"), None).unwrap()), ["anna", "ben"]);
    assert_eq!(names(find_nodes(&two, None, Some("ben")).unwrap()), ["ben"]);
    assert!(find_nodes(&[], None, None).unwrap_err().to_string().contains("bundlemocap record"));
}

#[test]
fn extrapolated_poses_are_on_time_after_the_cameras_fall_silent() {
    let world = after(Studio::new(4, 120).messages(), 4.0);
    let coasted = world.heard.poses().into_iter().filter(|(_, pose)| {
        pose.state() == TrackingState::Coasting && pose.capture_time_ns > at(2.0).ns()
    });
    assert!(coasted.count() >= 10);
    assert_on_time(&world.heard);
}

#[test]
fn poses_continue_while_a_camera_is_silent_and_returns() {
    let studio = Studio::new(4, 360);
    let is_silent =
        |sent: &Sent| sent.topic.contains("cam03") && (at(2.0)..at(4.0)).contains(&sent.arrival);
    let messages = studio.messages().into_iter().filter(|sent| !is_silent(sent)).collect();
    let world = after(messages, 6.0);
    assert_on_time(&world.heard);
    assert!(world.heard.poses().iter().all(|(_, pose)| pose.state() == TrackingState::Tracking));
    let events = world.heard.events();
    assert_eq!((events["silent"], events["returned"], events["deadline"]), (1, 1, 5));
    // A status tells it, and not only the next one.
    let silent: Vec<_> = world.heard.of::<Status>(&Topics::default().status());
    let silent: Vec<_> = silent.iter().filter(|(_, status)| status.cameras[2].silent).collect();
    let (first, status) = silent.first().unwrap();
    let age = Nanos::rounded(status.cameras[2].age_s * 1e9);
    assert!((MS * 700..MS * 760).contains(&age), "{age}");
    assert!(*first < at(2.77) && silent.iter().all(|(time, _)| *time < at(4.1)), "{silent:?}");
    assert!(silent.iter().all(|(_, status)| !status.cameras[1].silent));
    assert!(!events.contains_key("overdue"), "{events:?}");
    let counters = &world.heard.status().cameras;
    assert!(counters.iter().all(|camera| camera.waited_for));
    assert_eq!(counters[2].missing, 120);
}

#[test]
fn overload_lowers_effort_and_keeps_the_latency() {
    let studio = Studio::new(4, 1200);
    let mut world = World::new(&Config::default());
    // From the fourth second on each iteration takes 20 ms, of all frames; later it is as before.
    let slow = |job: &Job| (at(4.0)..at(8.0)).contains(&job.end);
    world.took = Box::new(move |job| {
        let Task::Track { .. } = job.task else { return MS };
        let iterations = job.effort.iterations.min(12) as i64;
        match slow(job) {
            true => MS * 20 * iterations / job.effort.stride as i64,
            false => MS * 3,
        }
    });
    world.play(studio.messages(), at(20.0));
    assert_on_time(&world.heard);
    let steps = world.heard.details("effort");
    assert!(steps[0].starts_with("level 1: 2 iterations, stride 1"), "{steps:?}");
    let effort = world.heard.status().effort.unwrap();
    assert!(effort.degradation_steps >= 2, "{steps:?}");
    assert!(effort.level < effort.degradation_steps as u32, "it is given back: {steps:?}");
    let playout = world.heard.status().playout.unwrap();
    let coasting = |(_, pose): &&(Timestamp, Pose)| pose.state() == TrackingState::Coasting;
    let coasted = world.heard.poses().iter().filter(coasting).count() as u64;
    assert_eq!(playout.coasted, coasted);
    assert!(coasted <= 60, "{coasted} of 1100 carried on");
}

#[test]
fn a_solver_that_hangs_does_not_stop_the_poses() {
    let studio = Studio::new(4, 300);
    let mut world = World::new(&Config::default());
    world.took = Box::new(|job| if job.window == 12 { MS * 900 } else { MS * 3 });
    world.play(studio.messages(), at(5.0));
    assert_on_time(&world.heard);
    let states: Vec<TrackingState> =
        world.heard.poses().iter().map(|(_, pose)| pose.state()).collect();
    assert!(states.contains(&TrackingState::Coasting));
    assert_eq!(states.last(), Some(&TrackingState::Tracking), "it goes on");
    assert!(world.heard.events()["overdue"] > 30);
}

#[test]
fn the_output_may_have_another_rate() {
    for latency_ms in [0.0, 50.0] {
        let mut config = Config::default();
        (config.node.output_rate_hz, config.node.latency_ms) = (90.0, latency_ms);
        let mut world = World::new(&config);
        world.play(Studio::new(4, 240).messages(), at(4.0));
        let poses = world.heard.poses();
        assert!(poses.len() > 240, "{}", poses.len());
        for pair in poses.windows(2) {
            let step = pair[1].1.capture_time_ns - pair[0].1.capture_time_ns;
            assert!((step - 11_111_111).abs() <= 1, "{step}");
        }
        assert!(poses.iter().all(|(_, pose)| pose.state() == TrackingState::Tracking));
    }
}

#[test]
fn a_new_calibration_is_used_from_a_window_on() {
    let studio = Studio::new(4, 300);
    let mut messages = studio.messages();
    let mut rig = wire::Rig::from_core(&studio.rig);
    rig.version = 7;
    let (topic, arrival) = (Topics::default().rig(), at(2.51));
    messages.push(Sent { arrival, topic: topic.clone(), payload: encode(&rig) });
    // Once more, and an invalid one.
    messages.push(Sent { arrival: at(3.0), topic: topic.clone(), payload: encode(&rig) });
    messages.push(Sent { arrival: at(3.1), topic, payload: vec![0xff; 9] });
    let world = after(messages, 5.0);
    assert_on_time(&world.heard);
    let poses = world.heard.poses();
    let first = poses.iter().position(|(_, pose)| pose.rig_version == 7).unwrap();
    assert_eq!(poses[first - 1].1.window + 1, poses[first].1.window, "at a window's edge");
    assert!(poses[first..].iter().all(|(_, pose)| pose.rig_version == 7));
    assert!((Timestamp::from_ns(poses[first].1.capture_time_ns) - arrival).abs() < MS * 340);
    let events = world.heard.events();
    assert_eq!((events["calibrated"], events["rig_changed"], events["unusable"]), (2, 2, 1));
}

#[test]
fn a_rig_file_is_not_replaced_from_the_bus() {
    let studio = Studio::new(4, 240);
    let rig = |version: u64| {
        let mut rig = wire::Rig::from_core(&studio.rig);
        (rig.version, rig.cameras[0].focal_px[0]) = (version, 500.0 + version as f64);
        encode(&rig)
    };
    let (file, changed) = (encode(&wire::Rig::from_core(&studio.rig)), rig(9));
    let mut messages: Vec<Sent> = studio.frames.iter().map(|frame| studio.message(frame)).collect();
    // The node's own rig comes back; two foreign ones are published ten times, and an invalid one.
    for index in 0..10 {
        for payload in [file.clone(), rig(7), rig(8), vec![0xff; 9]] {
            let arrival = at(1.5) + MS * 20 * index;
            messages.push(Sent { arrival, topic: Topics::default().rig(), payload });
        }
    }
    let mut config = Config::default();
    config.node.rig = "rig.toml".into();
    let mut world = World::new(&config);
    world.tell(Input::RigFile(file.clone()));
    let (early, late) = messages.iter().cloned().partition(|sent| sent.arrival < at(2.5));
    world.play(early, at(2.5));
    world.tell(Input::RigFile(changed));
    world.play(late, at(4.0));
    // The first rig of the file comes back once more.
    world.tell(Input::Message { topic: Topics::default().rig().into(), payload: file });
    world.end();
    assert_on_time(&world.heard);
    let version = |at: usize| world.heard.poses()[at].1.rig_version;
    assert_eq!((version(0), version(world.heard.poses().len() - 1)), (studio.rig.version, 9));
    assert!(world.heard.poses().iter().all(|(_, pose)| ![7, 8].contains(&pose.rig_version)));
    let refused = world.heard.details("rig_refused");
    assert_eq!(refused.len(), 3, "{refused:?}");
    assert!(refused[0].starts_with("version 7 of 4 cameras (cam01, cam02, cam03, cam04), from"));
    // The journal has one copy of each.
    let journal = world.heard.of::<wire::Journal>(&Topics::default().journal());
    let entries = journal.iter().flat_map(|(_, part)| &part.entries);
    let is_copy = |entry: &&wire::JournalEntry| match &entry.input {
        Some(JournalInput::Message(message)) => {
            message.topic.ends_with("/rig") && message.payload.is_some()
        }
        _ => false,
    };
    assert_eq!(entries.filter(is_copy).count(), 3);
    let changes = world.heard.details("rig_changed");
    assert_eq!(world.heard.events()["rig_changed"], 2, "{changes:?}");
    assert!(changes.last().unwrap().ends_with("from the file"), "{changes:?}");
    let mut recorded = recorded(world, messages);
    // Others may publish anything there.
    let is_journal = |one: &Recorded| *one.topic == *Topics::default().journal();
    let first = recorded.iter().position(is_journal).unwrap();
    for payload in [&b"hello"[..], b""] {
        let foreign = Recorded { payload: payload.to_vec(), ..recorded[first].clone() };
        recorded.insert(first + 1, foreign);
    }
    assert_agrees(&replayed(&recorded, None).unwrap());
}

#[test]
fn points_far_outside_the_image_and_huge_rigs_are_not_used() {
    let studio = Studio::new(4, 180);
    let mut huge = wire::Rig::from_core(&studio.rig);
    huge.cameras = (0..257)
        .map(|index| {
            let mut camera = huge.cameras[index % 4].clone();
            camera.name = format!("camera{index}");
            camera
        })
        .collect();
    let mut messages = studio.messages();
    let (arrival, topic) = (at(1.0), Topics::default().rig());
    messages.push(Sent { arrival, topic, payload: encode(&huge) });
    for (frame, sent) in studio.frames.iter().zip(&mut messages[1..]) {
        let mut message: KeypointFrame = decode(&sent.payload).unwrap();
        if frame.camera == 2 {
            message.people[0].points[12..18].copy_from_slice(&[1e9, 9.0, 1.0, 9.0, -3e3, 1.0]);
        }
        sent.payload = encode(&message);
    }
    let mut world = after(messages, 3.0);
    world.end();
    assert_on_time(&world.heard);
    assert!(world.heard.poses().iter().all(|(_, pose)| pose.state() == TrackingState::Tracking));
    let events = world.heard.events();
    assert_eq!((events["far_point"], events["unusable"]), (2 * 180, 1), "{events:?}");
    assert!(world.heard.details("unusable")[0].contains("257 cameras, at most 256"));
}

#[test]
fn frames_of_another_image_size_are_not_used() {
    let studio = Studio::new(4, 180);
    let mut messages = studio.messages();
    for (frame, sent) in studio.frames.iter().zip(&mut messages[1..]) {
        let mut message: KeypointFrame = decode(&sent.payload).unwrap();
        match frame.camera {
            // Half the resolution, and a size that is not known.
            1 => (message.image_width, message.image_height) = (960, 540),
            2 => (message.image_width, message.image_height) = (0, 0),
            _ => {}
        }
        sent.payload = encode(&message);
    }
    let mut world = after(messages, 3.0);
    world.end();
    let status = world.heard.status();
    let used: Vec<bool> = status.cameras.iter().map(|camera| camera.used > 0).collect();
    assert_eq!(used, [true, false, true, true]);
    assert_eq!(world.heard.events()["unusable"], 180);
    let details = world.heard.details("unusable");
    assert!(details[0].contains("960 x 540, the calibration is for 1280 x 1024"), "{details:?}");
    assert!(world.heard.poses().iter().all(|(_, pose)| pose.state() == TrackingState::Tracking));
}

#[test]
fn losses_are_inputs_of_a_replay() {
    let messages = Studio::new(4, 90).messages();
    let mut world = World::new(&Config::default());
    world.play(messages.clone(), at(1.0));
    let loss = |camera: Option<&str>, dropped, too_large| Loss {
        camera: camera.map(str::to_owned),
        dropped,
        too_large,
        bytes: too_large * 5_000_000,
    };
    world.tell(Input::Dropped(vec![loss(Some("cam02"), 7, 0), loss(None, 3, 2)]));
    let rest = messages.iter().filter(|sent| sent.arrival > at(1.0)).cloned().collect();
    world.play(rest, at(2.0));
    world.end();
    let (status, events) = (world.heard.status(), world.heard.events());
    assert_eq!((status.queue_dropped, status.cameras[1].dropped), (12, 7));
    assert_eq!((events["dropped"], events["unusable"]), (10, 2));
    let recorded = recorded(world, messages);
    assert_agrees(&replayed(&recorded, None).unwrap());
}

/// All messages of a run, as a recorder has them.
fn recorded(world: World, sent: Vec<Sent>) -> Vec<Recorded> {
    let sent = sent.into_iter().map(Recorded::from);
    world.heard.messages.into_iter().chain(sent).collect()
}

#[test]
fn states_follow_the_performer() {
    let studio = Studio::new(4, 600);
    let mut frames = studio.frames.clone();
    for frame in &mut frames {
        if (180..300).contains(&frame.frame) || frame.frame < 66 {
            frame.people.clear();
        }
    }
    let mut messages: Vec<Sent> = frames.iter().map(|frame| studio.message(frame)).collect();
    messages.push(studio.rig());
    let world = after(messages, 10.0);
    assert_on_time(&world.heard);
    let mut states: Vec<String> =
        (world.heard.of::<Status>(&Topics::default().status()).into_iter())
            .map(|(_, status)| status.tracker_state)
            .collect();
    states.dedup();
    assert_eq!(states, ["searching", "acquiring", "tracking", "coasting", "lost", "tracking"]);
    let events = world.heard.events();
    assert_eq!((events["acquired"], events["left"], events["coasted"]), (2, 1, 6));
    let state = |seconds: f64| {
        let capture = at(seconds).ns();
        let poses = world.heard.poses();
        let pose = poses.into_iter().find(|(_, pose)| pose.capture_time_ns >= capture);
        pose.unwrap().1.state()
    };
    // The window in which the performer leaves is fitted to the remaining detections.
    assert_eq!(state(3.3), TrackingState::Coasting);
    assert_eq!(state(4.0), TrackingState::Lost);
    // Frame 300 shows the performer again: at 5.0 s, and there it is tracked.
    assert_eq!(state(4.97), TrackingState::Lost);
    assert_eq!(state(5.0), TrackingState::Tracking);
}

#[test]
fn one_bad_camera_never_stops_the_others() {
    let studio = Studio::new(4, 360);
    let hour = SECOND * 3600;
    let bad = |index: usize, frame: &Detections| -> Vec<u8> {
        let camera = &studio.rig.cameras[frame.camera];
        let mut message =
            KeypointFrame::from_core(frame, &camera.name, [camera.width, camera.height]);
        match index % 8 {
            0 => return vec![0xff; 40],
            1 => message.people[0].points[3] = f32::NAN,
            2 => message.people[0].points[4] = f32::INFINITY,
            3 => message.capture_time_ns += hour.ns(),
            4 => message.capture_time_ns -= hour.ns(),
            5 => message.format = "my_format".into(),
            6 => message.camera = "somebody".into(),
            _ => message.people = vec![wire::DetectedPerson::default(); 1_000_000],
        }
        encode(&message)
    };
    let mut messages = vec![studio.rig()];
    let mut spoiled = 0;
    for frame in &studio.frames {
        let mut sent = studio.message(frame);
        if frame.camera == 1 && frame.frame >= 100 && spoiled < 80 {
            sent.payload = bad(spoiled, frame);
            spoiled += 1;
        }
        messages.push(sent);
    }
    messages.push(Sent {
        arrival: at(2.0),
        topic: Topics::default().keypoints("nobody"),
        payload: messages[9].payload.clone(),
    });
    messages.push(Sent { arrival: at(2.0), topic: "mocap/stage/x".into(), payload: vec![1] });
    let world = after(messages, 6.0);
    assert_on_time(&world.heard);
    assert!(world.heard.poses().iter().all(|(_, pose)| pose.state() == TrackingState::Tracking));
    let (events, status) = (world.heard.events(), world.heard.status());
    assert_eq!(events["clock_jump"], 20, "{events:?}");
    assert_eq!(events["unusable"], 61, "{events:?}");
    assert_eq!(status.cameras[1].unusable, 80);
    assert_eq!(status.cameras.iter().map(|camera| camera.unusable).sum::<u64>(), 80);
    let why = world.heard.details("unusable");
    for word in [
        "is not finite; a missing point has confidence 0",
        "my_format",
        "not the camera of its topic",
        "bytes",
    ] {
        assert!(why.iter().any(|detail| detail.contains(word)), "{word}: {why:?}");
    }
}

#[test]
fn a_jump_of_all_clocks_starts_a_new_time_line() {
    let studio = Studio::new(4, 480);
    let mut messages = vec![studio.rig()];
    for frame in &studio.frames {
        let arrival = frame.capture + NETWORK;
        let mut jumped = frame.clone();
        if frame.frame >= 240 {
            jumped.capture = frame.capture - SECOND * 3600;
        }
        messages.push(Sent { arrival, ..studio.message(&jumped) });
    }
    let world = after(messages, 8.0);
    let poses = world.heard.poses();
    let after_jump: Vec<_> =
        poses.iter().filter(|(_, pose)| pose.capture_time_ns < START.ns()).collect();
    assert!(after_jump.len() > 120, "{} poses after the jump", after_jump.len());
    // The delays were known before the step, so that the latency still counts from the exposure.
    for (time, pose) in &after_jump {
        let latency = *time - Timestamp::from_ns(pose.capture_time_ns) - SECOND * 3600;
        assert_eq!(latency, Nanos::new(pose.declared_latency_ns as i64));
    }
    let status = world.heard.status();
    assert_eq!((&*status.clock, status.clock_offset_s), ("behind", 3600.0));
    // The frames of before are counted, too.
    assert!(status.cameras.iter().all(|camera| camera.used > 420), "{:?}", status.cameras);
    assert_eq!(world.heard.events()["clock_jump"], 1);
}

/// The last camera is switched off after 2 s; the clocks of the others step at 5 s.
#[test]
fn nothing_is_said_of_the_clock_of_a_camera_that_is_off() {
    let studio = Studio::new(4, 480);
    let mut messages = vec![studio.rig()];
    for frame in &studio.frames {
        let seconds = frame.capture.seconds_since(START);
        if frame.camera == 3 && seconds > 2.0 {
            continue;
        }
        let step = if seconds > 5.0 { SECOND * 10 } else { Nanos::ZERO };
        let stepped = Detections { capture: frame.capture + step, ..frame.clone() };
        messages.push(Sent { arrival: frame.capture + NETWORK, ..studio.message(&stepped) });
    }
    let world = after(messages, 8.0);
    assert_eq!(world.heard.events()["clock_jump"], 1);
    let said = world.heard.details("clock_offset");
    assert!(said.is_empty(), "{said:?}");
}

/// The frames of a camera come 0.4 s late, and it is left out until the second of the others is switched off.
#[test]
fn a_late_camera_is_used_if_only_one_other_is_left() {
    let studio = Studio::new(3, 600);
    let mut messages = studio.messages();
    messages.retain(|sent| !sent.topic.contains("cam02") || sent.arrival < at(5.0));
    for message in messages.iter_mut().filter(|sent| sent.topic.contains("cam03")) {
        message.arrival = message.arrival + MS * 400;
    }
    let world = after(messages, 10.0);
    let said = world.heard.details("clock_offset");
    assert!(said.iter().any(|one| one.contains("too late to wait for")), "{said:?}");
    let poses = world.heard.poses();
    let last = poses.iter().filter(|(_, pose)| pose.state == TrackingState::Tracking as i32);
    let last = last.map(|(at, _)| *at).max().unwrap();
    assert!(last > at(9.0), "{} s: {said:?}", last.seconds_since(START));
}

#[test]
fn a_camera_whose_clock_is_off_raises_an_alarm() {
    let studio = Studio::new(4, 360);
    let mut messages = studio.messages();
    for message in messages.iter_mut().filter(|m| m.topic.contains("cam02")) {
        message.arrival = message.arrival + MS * 6;
    }
    let world = after(messages, 6.0);
    let events = world.heard.details("clock_offset");
    assert_eq!(events.len(), 1, "{events:?}");
    assert!(events[0].starts_with("+6.0 ms off from the other cameras, limit 4.2"), "{events:?}");
    // A window waits for the latest camera; what remains of the latency is for the solve.
    let windows = world.heard.status().windows.clone().unwrap();
    let declared = world.heard.status().declared_latency_ns as f64 * 1e-6;
    let [p50, p99] = [windows.age_p50_ms, windows.age_p99_ms];
    assert!(p50 > 150.0 && p99 >= p50 && p99 < declared, "{p50}, {p99} of {declared} ms");
    assert!(windows.cost_p50 > 0.0);
    let status = world.heard.status();
    assert!((status.cameras[1].offset_s - 0.009).abs() < 1e-4, "{}", status.cameras[1].offset_s);
    assert!((status.cameras[0].rate_hz - 60.0).abs() < 2.0, "{}", status.cameras[0].rate_hz);
}

#[test]
fn two_publishers_of_one_camera_are_reported() {
    let studio = Studio::new(4, 240);
    let mut messages = studio.messages();
    for frame in studio.frames.iter().filter(|f| f.camera == 0 && f.frame > 60) {
        let mut other = frame.clone();
        (other.frame, other.capture) = (frame.frame + 5000, frame.capture + MS * 4);
        messages.push(studio.message(&other));
    }
    let world = after(messages, 4.0);
    assert_on_time(&world.heard);
    let details = world.heard.details("conflict");
    assert!(!details.is_empty() && details[0].contains("a second publisher?"), "{details:?}");
}

#[test]
fn memory_does_not_grow_with_time() {
    let studio = Studio::new(4, 60);
    let mut world = World::new(&Config::default());
    // The same second of frames repeated with new times.
    let round = |number: i64, cameras: usize| -> Vec<Sent> {
        let frames = studio.frames.iter().filter(|frame| frame.camera < cameras).map(|frame| {
            let mut frame = frame.clone();
            frame.capture = frame.capture + SECOND * number;
            frame.frame += 60 * number as u64;
            studio.message(&frame)
        });
        let rig = (number == 0).then(|| studio.rig());
        rig.into_iter().chain(frames).collect()
    };
    let mut play = |rounds: std::ops::Range<i64>, cameras: usize| {
        for number in rounds {
            let messages = round(number, cameras);
            world.play(messages, at(number as f64 + 1.0));
            world.heard.messages = Vec::new();
        }
    };
    // What was seen in a minute is remembered, for cameras that are moved.
    play(0..80, 4);
    let grown = allocation_counter::measure(|| play(80..100, 4)).bytes_current;
    assert!(grown < 20_000, "{grown} bytes more after 20 seconds");
    // All cameras but one are switched off.
    play(100..120, 1);
    let grown = allocation_counter::measure(|| play(120..140, 1)).bytes_current;
    assert!(grown < 20_000, "{grown} bytes more after 20 seconds of one camera");
}

#[test]
fn poses_can_be_decoded_from_keyframes_alone() {
    let world = after(Studio::new(4, 200).messages(), 4.0);
    let keyframes = world.heard.of::<wire::Keyframe>(&Topics::default().keyframe());
    assert!(keyframes.len() > 10);
    let size = keyframes.iter().map(|(_, keyframe)| encode(keyframe).len()).max().unwrap();
    assert!(size < 800, "{size} bytes");
    let decoder = Arc::new(Decoder::embedded().unwrap());
    let poses: BTreeMap<i64, Pose> =
        world.heard.poses().into_iter().map(|(_, pose)| (pose.capture_time_ns, pose)).collect();
    let mut compared = 0;
    for pair in keyframes.windows(2) {
        let [from, to] = [&pair[0].1, &pair[1].1].map(|keyframe| keyframe.to_core().unwrap());
        let skeleton = Skeleton::new(to.shape);
        for capture in to.grid.between(to.start, to.capture) {
            let Some(published) = poses.get(&capture.ns()) else { continue };
            let s = capture.fraction(to.start, to.capture);
            let keyframe = to.interpolation.keyframe(&from.keyframe, &to.keyframe, s);
            let positions = decoder.pose(&keyframe).posture(&skeleton).positions;
            let told = published.joint_positions().unwrap();
            for (a, b) in positions.iter().zip(&told) {
                assert!((a - b).norm() < 1e-6);
            }
            compared += 1;
        }
    }
    assert!(compared > 100, "{compared}");
}

#[test]
fn windows_wait_for_slow_detectors() {
    let studio = Studio::new(4, 300);
    let mut messages = studio.messages();
    for message in &mut messages[1..] {
        message.arrival = message.arrival + MS * 250;
    }
    let world = after(messages, 5.2);
    assert_on_time(&world.heard);
    let latency = Nanos::new(world.heard.poses()[0].1.declared_latency_ns as i64);
    assert!((MS * 400..MS * 450).contains(&latency), "{latency}");
    assert!(world.heard.poses().iter().all(|(_, pose)| pose.state() == TrackingState::Tracking));
    let events = world.heard.events();
    assert!(!events.contains_key("late") && !events.contains_key("deadline"), "{events:?}");
}

#[test]
fn a_camera_with_a_fast_clock_is_left_out() {
    // Whosever frame comes first, also long before the others.
    for (fast, alone) in [(2, 0), (0, 0), (0, 120)] {
        let studio = Studio::new(4, 300);
        let mut messages = vec![studio.rig()];
        for frame in studio.frames.iter().filter(|one| one.camera == fast || one.frame >= alone) {
            let arrival = frame.capture + NETWORK;
            let ahead = if frame.camera == fast { MS * 300 } else { Nanos::ZERO };
            let stamped = Detections { capture: frame.capture + ahead, ..frame.clone() };
            messages.push(Sent { arrival, ..studio.message(&stamped) });
        }
        let world = after(messages, 5.0);
        let (events, status) = (world.heard.events(), world.heard.status());
        if fast > 0 {
            assert_on_time(&world.heard);
            assert!(!events.contains_key("late") && !events.contains_key("overdue"), "{events:?}");
        }
        let why = world.heard.details("clock_offset");
        assert!(fast == 0 || why.len() == 1, "{why:?}");
        assert!(why.last().unwrap().contains("0.300 s ahead of the other cameras'"), "{why:?}");
        for (index, camera) in status.cameras.iter().enumerate() {
            let is_used = index != fast;
            let case = format!("{fast} {alone} {camera:?}");
            assert_eq!(camera.waited_for, is_used, "{case}");
            assert!(!is_used || camera.used > 120, "{case}");
        }
        // The clock of the others is the node's.
        assert_eq!((&*status.clock, status.clock_offset_s), ("shared", 0.0));
    }
}

#[test]
fn the_status_continues_without_a_performer_and_without_input() {
    let studio = Studio::new(4, 90);
    let mut frames = studio.frames.clone();
    frames.iter_mut().for_each(|frame| frame.people.clear());
    let mut messages: Vec<Sent> = frames.iter().map(|frame| studio.message(frame)).collect();
    messages.push(studio.rig());
    let world = after(messages, 10.0);
    let times: Vec<Timestamp> =
        world.heard.of::<Status>(&Topics::default().status()).iter().map(|(at, _)| *at).collect();
    assert!(times.windows(2).all(|pair| pair[1] - pair[0] < SECOND + MS * 50), "{times:?}");
    assert!(*times.last().unwrap() > at(8.9));
    assert!(world.heard.poses().is_empty());
}

#[test]
fn a_solver_that_is_far_behind_continues_with_new_frames() {
    let studio = Studio::new(4, 900);
    let mut world = World::new(&Config::default());
    let slow = |job: &Job| (at(3.0)..at(5.0)).contains(&job.end);
    world.took = Box::new(move |job| if slow(job) { MS * 2500 } else { MS * 3 });
    world.play(studio.messages(), at(15.0));
    assert_on_time(&world.heard);
    let events = world.heard.events();
    assert!(events["dropped"] > 100, "the frames that were left out are counted: {events:?}");
    let last = world.heard.poses().pop().unwrap().1;
    assert_eq!(last.state(), TrackingState::Tracking);
    assert!(last.capture_time_ns > at(14.5).ns());
}

/// A studio of another rate, with timestamps that jitter.
fn jittering(fps: f64, frames: u64, jitter_ms: f64, seed: u64) -> Studio {
    let mut studio = Studio::at_rate(4, frames, fps);
    let draws = Draws { seed, stream: 0 };
    for frame in &mut studio.frames {
        let jitter = draws.normals(0, 16 * frame.frame + frame.camera as u64)[0] * jitter_ms * 1e6;
        frame.capture = frame.capture + Nanos::rounded(jitter);
    }
    studio
}

/// Poses per second, of the poses from one time to another.
fn pose_rate(heard: &Heard, from: f64, to: f64) -> f64 {
    let poses = heard.poses().into_iter().map(|(_, pose)| pose.capture_time_ns);
    let times: Vec<i64> =
        poses.filter(|&at_ns| (at(from).ns()..at(to).ns()).contains(&at_ns)).collect();
    (times.len() - 1) as f64 * 1e9 / (times[times.len() - 1] - times[0]) as f64
}

#[test]
fn the_rate_of_poses_is_that_of_the_cameras_under_jitter() {
    for (fps, jitter_ms, seed) in
        [(30.0, 0.5, 1), (60.0, 0.5, 2), (60.0, 1.0, 3), (30e3 / 1001.0, 1.0, 4)]
    {
        let world = after(jittering(fps, (8.0 * fps) as u64, jitter_ms, seed).messages(), 8.0);
        let found = pose_rate(&world.heard, 5.0, 7.5);
        println!("{fps:.3} Hz, jitter {jitter_ms} ms: {found:.4} Hz after 5 s");
        assert!((found / fps - 1.0).abs() < 1e-4, "{fps} Hz: {found}");
        let events = world.heard.events();
        assert!(!events.contains_key("lost") && !events.contains_key("overdue"), "{events:?}");
        let playout = world.heard.status().playout.unwrap();
        assert_eq!((playout.coasted, playout.missed), (0, 0), "{events:?}");
    }
}

#[test]
fn a_lasting_change_of_rate_is_followed() {
    for (before, after_hz) in [(60.0, 30.0), (30.0, 60.0)] {
        let mut studio = Studio::at_rate(4, (6.0 * before) as u64, before);
        let mut later = Studio::at_rate(4, (14.0 * after_hz) as u64, after_hz);
        // The frame counter goes on.
        later.frames.retain(|frame| frame.capture >= at(6.0));
        let first = later.frames[0].frame;
        later.frames.iter_mut().for_each(|f| f.frame = f.frame - first + (6.0 * before) as u64);
        studio.frames.extend(later.frames);
        let mut messages = studio.messages();
        for message in &mut messages[1..40] {
            message.arrival = message.arrival + MS;
        }
        let world = after(messages, 14.0);
        let heard = &world.heard;
        let found = [pose_rate(heard, 3.0, 5.9), pose_rate(heard, 9.0, 13.5)];
        println!("{before} to {after_hz} Hz: {found:?}, {:?}", heard.events());
        assert!((found[0] / before - 1.0).abs() < 1e-4, "{found:?}");
        assert!((found[1] / after_hz - 1.0).abs() < 1e-4, "{found:?}");
        assert_eq!(heard.details("latency").len(), 2, "{:?}", heard.details("latency"));
        let late = heard.poses().into_iter().filter(|(_, p)| p.capture_time_ns > at(10.0).ns());
        assert!(late.into_iter().all(|(_, pose)| pose.state() == TrackingState::Tracking));
        assert_eq!(heard.details("acquired").len(), 1, "tracking never ended");
        let events = heard.of::<Status>(&Topics::default().status()).into_iter();
        let events: Vec<_> =
            events.filter(|(time, _)| *time > at(10.0)).map(|(_, s)| s.events).collect();
        assert_eq!(events.first(), events.last(), "nothing is late after 10 s");
    }
}

#[test]
fn capture_times_in_other_units_are_named_once_for_each_camera() {
    for (unit, ns) in [("milliseconds", 1_000_000), ("microseconds", 1_000)] {
        let mut studio = Studio::new(4, 240);
        let arrivals: Vec<Timestamp> = studio.frames.iter().map(|f| f.capture + NETWORK).collect();
        for frame in &mut studio.frames {
            frame.capture = Timestamp::from_ns(frame.capture.ns() / ns);
        }
        let mut messages = studio.messages();
        for (message, arrival) in messages.iter_mut().skip(1).zip(arrivals) {
            message.arrival = arrival;
        }
        let world = after(messages, 5.0);
        let details = world.heard.details("unusable");
        assert!(details.len() == 4 && details.iter().all(|d| d.contains(unit)), "{details:?}");
        assert_eq!(world.heard.events()["unusable"], 4, "{:?}", world.heard.events());
        // The other frames are counted.
        let status = world.heard.status();
        assert!(status.cameras.iter().all(|camera| camera.unusable > 200), "{status:?}");
        assert!(world.heard.poses().is_empty());
    }
}

#[test]
fn a_single_frame_far_off_its_cameras_line_is_not_used() {
    for off in [-0.5, 0.5, 1.5] {
        let mut studio = Studio::new(4, 480);
        for frame in &mut studio.frames {
            if frame.camera == 1 && (60..440).contains(&frame.frame) && frame.frame % 50 == 0 {
                frame.capture = frame.capture + Nanos::rounded(off * 1e9);
            }
        }
        // They arrive as usual.
        let mut messages = studio.messages();
        for (message, frame) in messages.iter_mut().skip(1).zip(&studio.frames) {
            message.arrival = START + Nanos::of_frames(frame.frame, 60.0) + NETWORK;
        }
        let world = after(messages, 8.0);
        assert_on_time(&world.heard);
        let events = world.heard.events();
        println!("{off} s off: {events:?}");
        let refused = ["unusable", "clock_jump"].map(|kind| events.get(kind).copied().unwrap_or(0));
        assert_eq!(refused.iter().sum::<u64>(), 7, "{events:?}");
        assert!(!events.contains_key("late") && !events.contains_key("out_of_order"), "{events:?}");
        assert_eq!(world.heard.status().playout.unwrap().coasted, 0);
    }
}

#[test]
fn a_pause_or_a_restart_of_a_camera_costs_no_frame() {
    let mut studio = Studio::new(4, 480);
    // One camera loses 40 frames, one stops and counts on, one starts counting anew.
    studio.frames.retain(|frame| frame.camera == 0 || !(200..240).contains(&frame.frame));
    for frame in studio.frames.iter_mut().filter(|frame| frame.frame >= 240) {
        match frame.camera {
            2 => frame.frame -= 40,
            3 => frame.frame -= 240,
            _ => {}
        }
    }
    let world = after(studio.messages(), 8.0);
    let status = world.heard.status();
    let events = world.heard.events();
    assert!(!events.contains_key("unusable"), "{events:?}");
    for camera in &status.cameras[1..] {
        // The last status is at 7.5 s.
        assert!(camera.used >= 395, "{} of 410 frames of {}", camera.used, camera.camera);
    }
}

/// The windows of the body wait while it is found; they are longer than a second.
#[test]
fn cameras_of_low_rates_lose_no_window() {
    for fps in [25.0, 15.0, 5.0] {
        let world = after(Studio::at_rate(4, (12.0 * fps) as u64, fps).messages(), 12.0);
        let events = world.heard.events();
        assert!(!events.contains_key("dropped"), "{fps} Hz: {events:?}");
        assert_eq!(events["acquired"], 1, "{fps} Hz: {events:?}");
        assert!(!events.contains_key("effort"), "{:?}", world.heard.details("effort"));
    }
    // A window waits for a camera that sends nothing.
    let mut studio = Studio::at_rate(4, 90, 3.0);
    studio.frames.retain(|frame| frame.camera != 3);
    let world = after(studio.messages(), 30.0);
    let events = world.heard.events();
    assert!(!events.contains_key("dropped") && events.contains_key("acquired"), "{events:?}");
}

/// Two detectors of each camera send under its name, without frame numbers.
#[test]
fn poses_come_although_the_frame_rate_cannot_be_measured() {
    let mut studio = Studio::at_rate(4, 600, 30.0);
    let again = studio.frames.clone().into_iter();
    studio
        .frames
        .extend(again.map(|frame| Detections { capture: frame.capture + MS * 4, ..frame }));
    studio.frames.iter_mut().for_each(|frame| frame.frame = 0);
    let world = after(studio.messages(), 20.0);
    let poses = world.heard.poses();
    let tracked = poses.iter().filter(|(_, pose)| pose.state() == TrackingState::Tracking).count();
    println!("{tracked} of {} poses are tracked, {:?}", poses.len(), world.heard.events());
    assert!(tracked > 300, "{tracked} poses");
    assert!(!world.heard.events().contains_key("effort"));
}

#[test]
fn other_cameras_do_not_change_the_latency() {
    let fps = 25.0;
    let mut studio = Studio::at_rate(4, (14.0 * fps) as u64, fps);
    let mut messages = studio.messages();
    messages.retain(|message| message.arrival < at(6.0));
    studio.rig.cameras[3].name = "other".into();
    studio.rig.version += 1;
    let later = studio.messages().into_iter().skip(1).filter(|message| message.arrival > at(6.5));
    messages.push(Sent { arrival: at(6.2), ..studio.rig() });
    messages.extend(later);
    let world = after(messages, 14.0);
    let events = world.heard.events();
    assert_eq!((events["rig_changed"], events["acquired"]), (2, 2), "{events:?}");
    assert!(events.contains_key("abandoned"), "frames that waited are counted: {events:?}");
    let latencies = world.heard.details("latency");
    assert_eq!(latencies.len(), 1, "{latencies:?}");
}

#[test]
fn where_the_latency_falls_no_pose_overtakes_another() {
    for delay in [60, 1500] {
        falling_latency(MS * delay);
    }
}

/// Frames come so much later for some seconds.
fn falling_latency(delay: Nanos) {
    let studio = Studio::new(3, 50 * 60);
    let mut messages = studio.messages();
    for (message, frame) in messages.iter_mut().skip(1).zip(&studio.frames) {
        let is_slow = frame.capture < START + SECOND * 4;
        message.arrival = message.arrival + if is_slow { delay } else { Nanos::ZERO };
    }
    let world = after(messages, 50.0);
    let latencies = world.heard.details("latency");
    assert_eq!(latencies.len(), 2, "{latencies:?}");
    let mut poses = world.heard.poses();
    poses.sort_by_key(|(leaves, _)| *leaves);
    assert!(poses.len() > 2400, "{} poses", poses.len());
    let is_sorted = poses.is_sorted_by_key(|(_, pose)| pose.capture_time_ns);
    assert!(
        is_sorted
            && poses.iter().all(|(leaves, pose)| {
                let due = pose.due_time_ns.unwrap();
                (leaves.ns() - due).abs() < 1_000_000
            })
    );
}

#[test]
fn a_slow_camera_that_comes_first_does_not_set_the_rate() {
    let studio = Studio::new(4, 300);
    let mut messages = vec![studio.rig()];
    for frame in &studio.frames {
        let is_slow = frame.camera == 0;
        if (is_slow && frame.frame % 2 == 1) || (!is_slow && frame.frame < 24) {
            continue;
        }
        messages.push(studio.message(frame));
    }
    let world = after(messages, 5.0);
    assert_on_time(&world.heard);
}
