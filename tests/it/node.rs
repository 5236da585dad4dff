//! The live node with its threads, on the bus inside this process.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bundlemocap::core::body::Skeleton;
use bundlemocap::core::camera::Rig;
use bundlemocap::core::detections::Detections;
use bundlemocap::core::manifold::Decoder;
use bundlemocap::core::stage;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::core::tracker::{self, Solver};
use bundlemocap::io::bus::{Bus, Guard, Memory, Publisher};
use bundlemocap::io::formats::{Up, write_calibration};
use bundlemocap::io::wire::journal_entry::Input as JournalInput;
use bundlemocap::io::wire::{
    self, Event, Journal, JournalEntry, Keyframe, KeypointFrame, Pose, Status, Topics,
    TrackingState, decode, encode,
};
use bundlemocap::live::{
    Carried, Config, Core, Node, NodeError, Presence, Running, Settings, WallClock,
};
use bundlemocap::research::synth::{Motion, MotionStyle, Noise, Recording, ring_rig};

const FPS: f64 = 60.0;
/// Timeout of things that take a short time; only a failing test waits that long.
const LONG: Duration = Duration::from_secs(60);

/// All messages from the node.
#[derive(Default)]
struct Heard {
    poses: Vec<Pose>,
    live: Vec<Pose>,
    status: Option<Status>,
    events: Vec<Event>,
    journal: Vec<JournalEntry>,
    keyframes: Vec<Keyframe>,
}

/// A node on a bus, cameras, and a listener.
struct Studio {
    bus: Memory,
    topics: Topics,
    heard: Arc<Mutex<Heard>>,
    clock: WallClock,
    detections: Vec<Vec<Detections>>,
    publishers: Vec<Box<dyn Publisher>>,
    names: Vec<String>,
    start: Timestamp,
    frame: u64,
    _guards: Vec<Box<dyn Guard>>,
}

fn cameras() -> Rig {
    ring_rig(4, 4.0, 1.6).unwrap()
}

fn start_node(bus: &Memory, config: &Config) -> Result<Running, NodeError> {
    start_node_with(bus, config, 1)
}

fn start_node_with(bus: &Memory, config: &Config, solvers: usize) -> Result<Running, NodeError> {
    let track = tracker::Config::default();
    let decoder = Decoder::embedded().unwrap();
    let solver = || Solver::new(decoder.clone(), track);
    let solvers = std::iter::repeat_with(solver).take(solvers).collect();
    let settings = Settings {
        tracker: track,
        stage: stage::Config::default(),
        node: config.clone(),
        toml: String::new(),
        weights: format!("{:016x}", decoder.fingerprint()),
        body: None,
        carried: Carried::default(),
        timecode: None,
    };
    let core = Core::new(settings);
    let topics = Topics { stage: config.stage.clone(), actor: config.actor.clone() };
    let now = WallClock::start().now();
    let presence = Presence::announce(Arc::new(bus.clone()), topics, false, now)?.alone()?;
    Node::start(Arc::new(bus.clone()), presence, core, solvers, config, None)
}

#[test]
fn a_node_that_cannot_work_does_not_start() {
    let bus = Memory::new();
    let start = |config: &Config, solvers| start_node_with(&bus, config, solvers).err();
    let fault = start(&Config::default(), 0);
    assert!(matches!(fault, Some(NodeError::NoSolver)), "{fault:?}");
    for latency_ms in [f64::NAN, -100.0, 1e15] {
        let fault = start(&Config { latency_ms, ..Config::default() }, 1);
        assert!(matches!(fault, Some(NodeError::Settings(_))), "{fault:?}");
    }
}

impl Studio {
    /// Four cameras around the procedural motion; the rig is on the bus.
    fn new() -> Self {
        let studio = Self::without_rig();
        let rig = encode(&wire::Rig::from_core(&cameras()));
        studio.put(&studio.topics.rig(), &rig);
        studio
    }

    /// [`Studio::new`] without a rig on the bus.
    fn without_rig() -> Self {
        let bus = Memory::new();
        let topics = Topics::default();
        let skeleton = Skeleton::default();
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let mut recording = Recording::new(cameras(), skeleton, |seconds| motion.pose(seconds));
        recording.frames = 1200;
        recording.noise = Noise::jitter_only();
        let all: Vec<Detections> = recording.detections().collect();
        let names: Vec<String> = recording.rig.cameras.iter().map(|c| c.name.clone()).collect();
        let clock = WallClock::start();
        let studio = Self {
            detections: all.chunks(4).map(<[Detections]>::to_vec).collect(),
            publishers: (names.iter())
                .map(|name| bus.publisher(&topics.keypoints(name)).unwrap())
                .collect(),
            heard: Arc::default(),
            start: clock.now(),
            frame: 0,
            _guards: Vec::new(),
            names,
            bus,
            topics,
            clock,
        };
        studio.listening()
    }

    fn listening(mut self) -> Self {
        let mut on = |topic: String, note: fn(&mut Heard, &[u8])| {
            let heard = Arc::clone(&self.heard);
            let sink = move |sample: bundlemocap::io::bus::Sample| {
                note(&mut heard.lock().unwrap(), &sample.payload);
            };
            self._guards.push(self.bus.subscribe(&topic, Box::new(sink)).unwrap());
        };
        on(self.topics.pose(), |heard, bytes| heard.poses.push(decode(bytes).unwrap()));
        on(self.topics.provisional(), |heard, bytes| heard.live.push(decode(bytes).unwrap()));
        for topic in [self.topics.stage_events(), self.topics.actor_events()] {
            on(topic, |heard, bytes| heard.events.push(decode(bytes).unwrap()));
        }
        on(self.topics.journal(), |heard, bytes| {
            heard.journal.extend(decode::<Journal>(bytes).unwrap().entries);
        });
        on(self.topics.keyframe(), |heard, bytes| heard.keyframes.push(decode(bytes).unwrap()));
        on(self.topics.status(), |heard, bytes| heard.status = Some(decode(bytes).unwrap()));
        self
    }

    fn put(&self, topic: &str, payload: &[u8]) {
        let publisher = self.bus.publisher(topic).unwrap();
        publisher.put(self.clock.now(), "", payload).unwrap();
    }

    /// The next message of a camera.
    fn message(&self, camera: usize) -> KeypointFrame {
        let capture = self.start + Nanos::of_frames(self.frame, FPS);
        let last = self.detections.len() as u64 - 1;
        let at = self.frame % (2 * last);
        let detections = &self.detections[at.min(2 * last - at) as usize][camera];
        let seen = KeypointFrame::from_core(detections, &self.names[camera], [1280, 1024]);
        KeypointFrame { frame: self.frame, capture_time_ns: capture.ns(), ..seen }
    }

    /// All cameras send a frame at its time.
    fn send_frame(&mut self) {
        let capture = self.start + Nanos::of_frames(self.frame, FPS);
        self.clock.wait_until(capture);
        for (camera, publisher) in self.publishers.iter().enumerate() {
            let bytes = encode(&self.message(camera));
            publisher
                .put(capture, "application/protobuf;bundlemocap.v1.KeypointFrame", &bytes)
                .unwrap();
        }
        self.frame += 1;
    }

    /// The cameras send until the received messages fulfil a condition.
    fn play_until(&mut self, what: &str, wanted: impl Fn(&Heard) -> bool) {
        let begin = Instant::now();
        while !wanted(&self.heard.lock().unwrap()) {
            assert!(begin.elapsed() < LONG, "never: {what}; {}", self.summary());
            self.send_frame();
        }
    }

    fn poses(&self) -> usize {
        self.heard.lock().unwrap().poses.len()
    }

    fn summary(&self) -> String {
        let heard = self.heard.lock().unwrap();
        format!(
            "{} poses, {} live, events {:?}, status {:?}",
            heard.poses.len(),
            heard.live.len(),
            heard.events,
            heard.status
        )
    }
}

fn steps(poses: &[Pose]) -> Vec<i64> {
    poses.windows(2).map(|pair| pair[1].capture_time_ns - pair[0].capture_time_ns).collect()
}

#[test]
fn poses_leave_evenly_at_one_latency_and_provisional_ones_before() {
    let mut studio = Studio::new();
    let node = start_node(&studio.bus, &Config::default()).unwrap();
    studio.play_until("90 poses", |heard| heard.poses.len() >= 90);
    let status = node.stop().unwrap().expect("a last status");
    let after_the_end = studio.poses();
    let heard = studio.heard.lock().unwrap();

    let latency = heard.poses[0].declared_latency_ns;
    assert!(latency > 150_000_000, "shorter than a window: {latency} ns");
    for pose in &heard.poses {
        assert_eq!(pose.declared_latency_ns, latency);
        let left = pose.due_time_ns.unwrap() - pose.capture_time_ns;
        assert_eq!(left, latency as i64);
        assert!(!pose.provisional);
        pose.to_core().unwrap();
    }
    let period = (1e9 / FPS) as i64;
    let uneven: Vec<i64> =
        steps(&heard.poses).into_iter().filter(|step| (step - period).abs() > 2).collect();
    assert!(uneven.is_empty(), "{uneven:?} ns");

    assert!(!heard.live.is_empty() && heard.live.iter().all(|pose| pose.provisional));
    assert!(heard.live[0].capture_time_ns < heard.poses.last().unwrap().capture_time_ns);
    let playout = status.playout.clone().unwrap();
    assert!(playout.published as usize <= after_the_end, "{playout:?}");
    assert_eq!(status.queue_dropped, 0);
    assert_eq!(heard.status.as_ref(), Some(&status), "the last one is on the bus, too");
    assert_eq!(heard.journal.len() as u64, status.inputs);
    let ends = heard.journal.iter().filter(|entry| entry.input == Some(JournalInput::End(true)));
    assert_eq!(ends.count(), 1);
}

#[test]
fn a_short_latency_gives_solved_poses() {
    let mut studio = Studio::new();
    let config = Config { latency_ms: 50.0, ..Config::default() };
    let node = start_node(&studio.bus, &config).unwrap();
    let is_solved = |pose: &&Pose| pose.state() == TrackingState::Tracking;
    studio
        .play_until("60 solved poses", |heard| heard.poses.iter().filter(is_solved).count() >= 60);
    node.stop().unwrap();
    let heard = studio.heard.lock().unwrap();
    assert!(heard.poses.iter().all(|pose| pose.declared_latency_ns == 50_000_000));
    let latency = heard.events.iter().find(|event| event.kind == "latency").unwrap();
    assert!(latency.detail.contains("50.0 ms as configured"), "{latency:?}");
}

/// Unusable messages, each with a word of its error.
fn bad_messages(studio: &Studio) -> Vec<(&'static str, String, Vec<u8>)> {
    let good = studio.message(0);
    let hour = 3_600_000_000_000;
    let first = studio.topics.keypoints("cam01");
    let change = |change: fn(&mut KeypointFrame)| {
        let mut message = good.clone();
        change(&mut message);
        encode(&message)
    };
    let jump = |ns: i64| {
        encode(&KeypointFrame { capture_time_ns: good.capture_time_ns + ns, ..good.clone() })
    };
    let crowd = KeypointFrame { people: vec![Default::default(); 1_000_000], ..good.clone() };
    vec![
        ("garbage", first.clone(), vec![0xff; 300]),
        ("empty", first.clone(), Vec::new()),
        ("NaN", first.clone(), change(|m| m.people[0].points[0] = f32::NAN)),
        ("infinite", first.clone(), change(|m| m.people[0].points[1] = f32::INFINITY)),
        ("another format", first.clone(), change(|m| m.format = "coco_17".into())),
        (
            "unknown camera",
            studio.topics.keypoints("nobody"),
            change(|m| m.camera = "nobody".into()),
        ),
        ("a crowd", first.clone(), encode(&crowd)),
        ("five megabytes", first.clone(), vec![0x0a; 5_000_000]),
        ("another schema", first.clone(), encode(&Status::default())),
        ("an hour ahead", first.clone(), jump(hour)),
        ("an hour back", first.clone(), jump(-hour)),
        ("before all time", first.clone(), jump(i64::MIN / 2)),
        ("no rig", studio.topics.rig(), vec![0xff; 50]),
        ("an empty rig", studio.topics.rig(), Vec::new()),
    ]
}

#[test]
fn bad_messages_are_counted_and_the_poses_continue() {
    let mut studio = Studio::new();
    let node = start_node(&studio.bus, &Config::default()).unwrap();
    studio.play_until("a pose", |heard| !heard.poses.is_empty());
    let bad = bad_messages(&studio);
    for (_, topic, payload) in &bad {
        studio.put(topic, payload);
        studio.send_frame();
    }
    let after = studio.message(0).capture_time_ns;
    studio.play_until("poses after the bad messages", |heard| {
        heard.poses.last().is_some_and(|pose| pose.capture_time_ns > after + 200_000_000)
    });
    let status = node.stop().unwrap().expect("a last status");
    let heard = studio.heard.lock().unwrap();
    let refused = |kind: &str| kind == "unusable" || kind == "clock_jump";
    let told = heard.events.iter().filter(|event| refused(&event.kind));
    assert!(told.clone().all(|event| !event.detail.is_empty()), "{:?}", heard.events);
    assert_eq!(told.map(|event| event.count).sum::<u64>(), bad.len() as u64, "{:?}", heard.events);
    let counted = status.events.iter().filter(|event| refused(&event.kind));
    assert_eq!(counted.map(|event| event.count).sum::<u64>(), bad.len() as u64);
    let period = (1e9 / FPS) as i64;
    assert!(steps(&heard.poses).iter().all(|step| (step - period).abs() <= 2));
    let tracked = wire::TrackingState::Tracking as i32;
    let last = heard.poses.iter().rev().take(6);
    assert!(last.clone().any(|pose| pose.state == tracked), "{:?}", heard.events);
}

#[test]
fn a_full_queue_drops_the_oldest_and_counts_them() {
    let mut studio = Studio::new();
    let config = Config { queue: 16, ..Config::default() };
    let node = start_node(&studio.bus, &config).unwrap();
    let begin = Instant::now();
    let dropped = |heard: &Heard| heard.status.as_ref().is_some_and(|s| s.queue_dropped > 0);
    while !dropped(&studio.heard.lock().unwrap()) {
        assert!(begin.elapsed() < LONG, "{}", studio.summary());
        let flood = encode(&studio.message(0));
        (0..2000).for_each(|_| studio.publishers[0].put(studio.start, "", &flood).unwrap());
        studio.send_frame();
    }
    let status = node.stop().unwrap().expect("a last status");
    assert!(status.queue_dropped > 0);
}

#[test]
fn a_flood_harms_only_the_camera_whose_name_it_uses() {
    let mut studio = Studio::new();
    let node = start_node(&studio.bus, &Config { queue: 256, ..Config::default() }).unwrap();
    studio.play_until("a pose", |heard| !heard.poses.is_empty());
    let (bus, topics) = (studio.bus.clone(), studio.topics.clone());
    let (old, large) = (encode(&studio.message(0)), vec![0; 2 << 20]);
    // The flood ends with it.
    let going = Arc::new(());
    let (is_going, over) = (Arc::downgrade(&going), studio.poses() + 60);
    let flood = std::thread::spawn(move || {
        let put = |name: &str, payload: &[u8]| {
            let publisher = bus.publisher(&topics.keypoints(name)).unwrap();
            publisher.put(Timestamp::default(), "", payload).unwrap();
        };
        for round in (0_u64..).take_while(|_| is_going.strong_count() > 0) {
            (0..100).for_each(|_| put("cam01", &old));
            (0..100).for_each(|name| put(&format!("made-up-{round}-{name}"), &old));
            put("cam01", &large);
        }
    });
    let is_told = |heard: &Heard, camera: Option<&str>| {
        let dropped = heard.events.iter().filter(|event| event.kind == "dropped");
        dropped.filter(|event| event.camera.as_deref() == camera).count() > 0
    };
    studio.play_until("tracked poses in the flood, and what was lost", |heard| {
        let large = |event: &Event| event.detail.contains("a message of 2097152 bytes");
        heard.poses.iter().skip(over).any(|pose| pose.state() == TrackingState::Tracking)
            && is_told(heard, Some("cam01"))
            && is_told(heard, None)
            && heard.events.iter().any(large)
    });
    // It ends although the flood goes on.
    let status = node.stop().unwrap().expect("a last status");
    drop(going);
    flood.join().unwrap();
    let dropped: Vec<u64> = status.cameras.iter().map(|camera| camera.dropped).collect();
    // On a busy computer the others lose a few.
    let few = dropped[0] / 1000;
    assert!(dropped[0] > 0 && dropped[1..].iter().all(|others| *others <= few), "{dropped:?}");
}

#[test]
fn the_second_node_of_a_performer_stands_back() {
    let studio = Studio::new();
    let config = Config::default();
    let first = start_node(&studio.bus, &config).unwrap();
    let other = Config { actor: "other".into(), ..config.clone() };
    start_node(&studio.bus, &other).unwrap().stop().unwrap();
    let error = start_node(&studio.bus, &config).err().unwrap();
    assert!(matches!(error, NodeError::Occupied { .. }), "{error}");
    let events = |kind: &str| {
        studio.heard.lock().unwrap().events.iter().filter(|event| event.kind == kind).count()
    };
    assert_eq!((events("second_node"), first.presence().elder().unwrap()), (1, None));
    let bus: Arc<dyn Bus> = Arc::new(studio.bus.clone());
    // Its clock is far behind.
    let announced = |topics: &Topics, several: bool| {
        let (bus, now) = (Arc::clone(&bus), Timestamp::default());
        Presence::announce(bus, topics.clone(), several, now).unwrap()
    };
    let standby = announced(&studio.topics, false);
    assert_eq!(first.presence().elder().unwrap(), None);
    let elder = standby.elder().unwrap().unwrap();
    assert!(error.to_string().contains(&elder.to_string()), "{error}; {elder}");
    first.stop().unwrap();
    assert!(standby.elder().unwrap().is_none());
    // Several performers have the same topics, whatever the nodes are called.
    let other = Topics { actor: "other".into(), ..studio.topics.clone() };
    let (front, second) = (announced(&studio.topics, true), announced(&other, true));
    assert!(second.elder().unwrap().is_some());
    drop((front, standby));
    assert!(second.elder().unwrap().is_none());
    let recorder = |take: &str| bus.announce(&studio.topics.recorded_take(take)).unwrap();
    let (walk, _again, run) = (recorder("walk"), recorder("walk"), recorder("run"));
    assert_eq!(second.recorded_take().unwrap(), "", "different ones");
    drop(run);
    assert_eq!(second.recorded_take().unwrap(), "walk");
    drop(walk);
    assert_eq!(second.recorded_take().unwrap(), "walk");
}

#[test]
fn a_node_without_input_reports_its_status_and_ends() {
    let studio = Studio { detections: Vec::new(), ..Studio::new() };
    let config = Config { prometheus: "127.0.0.1:0".into(), ..Config::default() };
    let node = start_node(&studio.bus, &config).unwrap();
    let begin = Instant::now();
    while node.status().is_none() {
        assert!(begin.elapsed() < LONG);
        std::thread::yield_now();
    }
    assert!(node.over().try_recv().is_err_and(|error| error.is_empty()), "it runs");
    let rig = studio.bus.query(&studio.topics.rig(), LONG).unwrap();
    assert_eq!(rig.len(), 1, "the node answers with the rig");
    assert_eq!(node.publish_failures(), 0);
    let mut metrics = TcpStream::connect(node.prometheus().unwrap()).unwrap();
    write!(metrics, "GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").unwrap();
    let mut text = String::new();
    metrics.read_to_string(&mut text).unwrap();
    assert!(text.contains("bundlemocap_tracker_state{state=\"searching\"} 1"), "{text}");
    assert!(text.contains("bundlemocap_camera_waited_for{camera=\"cam03\"}"), "{text}");
    node.stop().unwrap();
    assert_eq!(studio.poses(), 0);
}

#[test]
fn errors_at_the_start_of_a_node_name_their_cause() {
    let bus = Memory::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let prometheus = taken.local_addr().unwrap().to_string();
    let error = |config: Config| start_node(&bus, &config).err().unwrap().to_string();
    let message = error(Config { prometheus: prometheus.clone(), ..Config::default() });
    assert!(message.contains(&prometheus), "{message}");
    let message = error(Config { rig: "/nowhere/rig.toml".into(), ..Config::default() });
    assert!(message.contains("/nowhere/rig.toml"), "{message}");
    let message = error(Config { stage: "a/*".into(), ..Config::default() });
    assert!(message.contains("a/*"), "{message}");
}

/// Replaces a file by another one and a rename, as tools do.
fn replace(path: &Path, write: impl FnOnce(&Path)) {
    let beside = path.with_extension("new");
    write(&beside);
    std::fs::rename(beside, path).unwrap();
}

/// Replaces a calibration file by that of the cameras, one of them moved along its axis, metres.
fn calibrate(path: &Path, forward: f64) {
    let mut rig = cameras();
    rig.cameras[0].translation.z += forward;
    replace(path, |beside| write_calibration(beside, &rig, Up::Y).unwrap());
}

/// Log lines of this process from the first call on.
fn log_lines() -> &'static Mutex<Vec<u8>> {
    static LINES: Mutex<Vec<u8>> = Mutex::new(Vec::new());
    struct Tape;
    impl Write for Tape {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            LINES.lock().unwrap().extend(bytes);
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    let subscriber = tracing_subscriber::fmt().with_ansi(false).with_writer(|| Tape);
    let _ = subscriber.with_max_level(tracing::Level::WARN).try_init();
    &LINES
}

#[test]
fn a_changed_calibration_file_is_used_from_the_next_window_on() {
    let log = log_lines();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("studio_rig.toml");
    calibrate(&path, 0.0);
    let mut studio = Studio::without_rig();
    let rig = path.display().to_string();
    let config = Config { rig: rig.clone(), ..Config::default() };
    let node = start_node(&studio.bus, &config).unwrap();
    studio.play_until("poses", |heard| heard.poses.len() > 10);
    let in_use = |studio: &Studio| -> u64 {
        let samples = studio.bus.query(&studio.topics.rig(), LONG).unwrap();
        let [sample] = &samples[..] else { panic!("{} rigs", samples.len()) };
        decode::<wire::Rig>(&sample.payload).unwrap().to_core().unwrap().version
    };
    let first = studio.heard.lock().unwrap().poses[0].rig_version;
    assert_eq!(in_use(&studio), first);

    replace(&path, |beside| std::fs::write(beside, "no calibration").unwrap());
    let is_logged = || {
        let text = String::from_utf8(log.lock().unwrap().clone()).unwrap();
        let mut lines = text.lines();
        lines.any(|line| line.contains("the previous calibration is kept") && line.contains(&rig))
    };
    studio.play_until("a word about the malformed file", |_| is_logged());
    let malformed_until = studio.poses();
    studio.play_until("poses after it", |heard| heard.poses.len() > malformed_until + 30);
    assert_eq!(in_use(&studio), first);

    calibrate(&path, 0.001);
    studio.play_until("poses of the new calibration", |heard| {
        heard.poses.last().is_some_and(|pose| pose.rig_version != first)
    });
    let second = in_use(&studio);
    assert_ne!(second, first);
    node.stop().unwrap();

    let heard = studio.heard.lock().unwrap();
    let versions: Vec<u64> = heard.poses.iter().map(|pose| pose.rig_version).collect();
    let edge = versions.iter().position(|&version| version == second).unwrap();
    assert!(edge > malformed_until + 30);
    assert!(versions[..edge].iter().all(|&version| version == first), "{versions:?}");
    assert!(versions[edge..].iter().all(|&version| version == second), "{versions:?}");
    // The previous window ends between the two poses.
    let keyframe = heard.keyframes.iter().rfind(|k| k.rig_version == first).unwrap();
    let around = [edge - 1, edge].map(|pose| heard.poses[pose].capture_time_ns);
    let end = keyframe.capture_time_ns;
    assert!(around[0] <= end && end <= around[1], "{end} is not in {around:?}");
    assert_eq!(heard.events.iter().filter(|event| event.kind == "calibrated").count(), 2);
}

#[test]
fn the_calibration_of_the_nodes_file_stays_the_last_one_on_the_bus() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.toml");
    calibrate(&path, 0.0);
    let studio = Studio::without_rig();
    let rigs = Arc::new(Mutex::new(Vec::new()));
    let heard = Arc::clone(&rigs);
    let sink =
        move |sample: bundlemocap::io::bus::Sample| heard.lock().unwrap().push(sample.payload);
    let _guard = studio.bus.subscribe(&studio.topics.rig(), Box::new(sink)).unwrap();
    let rig = path.display().to_string();
    let config = Config { rig, ..Config::default() };
    let node = start_node(&studio.bus, &config).unwrap();
    let count = |least: usize| {
        let begin = Instant::now();
        while rigs.lock().unwrap().len() < least {
            assert!(begin.elapsed() < LONG, "{} rigs", rigs.lock().unwrap().len());
            std::thread::sleep(Duration::from_millis(5));
        }
        rigs.lock().unwrap().clone()
    };
    let ours = count(1)[0].clone();
    let other = encode(&wire::Rig::from_core(&cameras()));
    assert_ne!(other, ours);
    for played in 1..=2 {
        studio.put(&studio.topics.rig(), &other);
        let rigs = count(1 + 2 * played);
        assert!(rigs[2 * played - 1] == other && rigs[2 * played] == ours, "{played}");
    }
    node.stop().unwrap();
}

/// Exit code, standard output, standard error.
fn program(arguments: &[&str]) -> (Option<i32>, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_bundlemocap")).args(arguments).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[test]
fn run_names_a_port_in_use() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let (code, _, error) = program(&["run", "--listen", &format!("tcp/127.0.0.1:{port}")]);
    assert_eq!(code, Some(13), "{error}");
    assert!(error.lines().last().unwrap().contains(&port), "{error}");
    let free = ["run", "--listen", "tcp/127.0.0.1:0", "--prometheus"];
    let (code, _, error) = program(&[&free[..], &[&format!("127.0.0.1:{port}")]].concat());
    assert_eq!(code, Some(2), "{error}");
    assert!(error.lines().last().unwrap().contains(&port), "{error}");
}

#[test]
fn the_bench_runs_a_node_and_ends_it() {
    let arguments = "bench latency --seconds 2 --noise jitter --json";
    let (code, text, error) = program(&arguments.split(' ').collect::<Vec<_>>());
    assert_eq!(code, Some(0), "{error}");
    let figures: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert!(figures["poses"]["published"].as_u64().unwrap() > 0, "{text}");
    assert!(figures["declared_latency_ms"].as_f64().unwrap() > 0.0, "{text}");
    assert!(figures["cpu_percent"].as_f64().is_some(), "{text}");
}
