//! One suite of checks for every bus, and tests of single buses.

use std::io::Read;
use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicI64, AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use bundlemocap::core::time::Timestamp;
use bundlemocap::io::bus::{
    Bus, BusError, Guard, Iceoryx2, Iceoryx2Config, Memory, Publisher, Replay, Sample, Zenoh,
    ZenohConfig, ZenohMode,
};
use zenoh::Wait;

use crate::program::Program;

/// Longest wait for an expected message.
const LONG: Duration = Duration::from_secs(20);

const POSE: &str = "application/protobuf;bundlemocap.v1.Pose";

/// Two ends of one bus, like those of two programs.
trait Pair {
    /// The publishing end.
    fn near(&self) -> &dyn Bus;
    /// The receiving end.
    fn far(&self) -> &dyn Bus;
    /// Delivers the published messages, for a bus that does not do so itself.
    fn carry(&self) {}
    /// Whether both ends see the same programs.
    fn is_one_bus(&self) -> bool {
        true
    }
    /// Whether the programs that receive are known.
    fn knows_receivers(&self) -> bool {
        true
    }
    /// Whether queries are answered.
    fn has_queries(&self) -> bool {
        true
    }
}

struct InMemory(Memory);

impl InMemory {
    fn new() -> Self {
        Self(Memory::new())
    }
}

impl Pair for InMemory {
    fn near(&self) -> &dyn Bus {
        &self.0
    }
    fn far(&self) -> &dyn Bus {
        &self.0
    }
    fn knows_receivers(&self) -> bool {
        false
    }
}

/// A node as the router, and a tool.
struct NodeAndTool {
    node: Zenoh,
    tool: Zenoh,
}

impl NodeAndTool {
    fn new() -> Self {
        let node = node();
        let tool = Zenoh::open_client(&at(&node)).unwrap();
        Self { node, tool }
    }
}

impl Pair for NodeAndTool {
    fn near(&self) -> &dyn Bus {
        &self.node
    }
    fn far(&self) -> &dyn Bus {
        &self.tool
    }
}

/// Two tools connected through a node.
struct TwoTools {
    _node: Zenoh,
    tools: [Zenoh; 2],
}

impl TwoTools {
    fn new() -> Self {
        let node = node();
        let tools = [(); 2].map(|()| Zenoh::open_client(&at(&node)).unwrap());
        Self { _node: node, tools }
    }
}

impl Pair for TwoTools {
    fn near(&self) -> &dyn Bus {
        &self.tools[0]
    }
    fn far(&self) -> &dyn Bus {
        &self.tools[1]
    }
}

fn node() -> Zenoh {
    let listen = vec!["tcp/127.0.0.1:0".into()];
    Zenoh::open_node(&ZenohConfig { listen, ..ZenohConfig::default() }).unwrap()
}

fn at(node: &Zenoh) -> ZenohConfig {
    ZenohConfig { connect: node.listens_on(), ..ZenohConfig::default() }
}

/// Two programs on one host (here in one process, each with its own ports).
struct InSharedMemory {
    ends: Option<[Iceoryx2; 2]>,
    prefix: Prefix,
}

impl InSharedMemory {
    fn new() -> Self {
        let prefix = Prefix::new();
        let ends = [(); 2].map(|()| Iceoryx2::open(&prefix.config()).unwrap());
        Self { ends: Some(ends), prefix }
    }
}

impl Pair for InSharedMemory {
    fn near(&self) -> &dyn Bus {
        &self.ends.as_ref().unwrap()[0]
    }
    fn far(&self) -> &dyn Bus {
        &self.ends.as_ref().unwrap()[1]
    }
    fn has_queries(&self) -> bool {
        false
    }
}

impl Drop for InSharedMemory {
    fn drop(&mut self) {
        self.ends = None;
        if !std::thread::panicking() {
            assert_eq!(self.prefix.leftovers(), Vec::<String>::new());
        }
    }
}

/// Prefix of all names that a test leaves in shared memory.
pub(crate) struct Prefix(pub(crate) String);

impl Prefix {
    pub(crate) fn new() -> Self {
        static NUMBERS: AtomicU32 = AtomicU32::new(0);
        let number = NUMBERS.fetch_add(1, Ordering::Relaxed);
        Self(format!("bmtest_{}_{number}_", std::process::id()))
    }

    fn config(&self) -> Iceoryx2Config {
        Iceoryx2Config { prefix: self.0.clone(), ..Default::default() }
    }

    /// Files of iceoryx2 with this prefix, except the one of 16 bytes that always stays.
    pub(crate) fn leftovers(&self) -> Vec<String> {
        self.files().filter(|file| !file.ends_with(".global_mgmt")).collect()
    }

    fn files(&self) -> impl Iterator<Item = String> {
        let folders = ["/dev/shm", "/tmp/iceoryx2/nodes", "/tmp/iceoryx2/services"];
        let entries = folders.into_iter().filter_map(|folder| std::fs::read_dir(folder).ok());
        let paths = entries.flatten().flatten().map(|entry| entry.path());
        paths.map(|path| path.display().to_string()).filter(|path| path.contains(&self.0))
    }
}

impl Drop for Prefix {
    fn drop(&mut self) {
        for file in self.files() {
            let _ = std::fs::remove_file(file);
        }
    }
}

/// Messages are recorded, and then played for delivery.
struct Recorded {
    recorder: Replay,
    player: Replay,
}

impl Recorded {
    fn new() -> Self {
        let (sender, tape) = channel();
        let recorder =
            Replay::new(std::iter::empty(), move |s: &Sample| sender.send(s.clone()).unwrap());
        let player = Replay::new(std::iter::from_fn(move || tape.try_recv().ok()), |_| {});
        Self { recorder, player }
    }
}

impl Pair for Recorded {
    fn near(&self) -> &dyn Bus {
        &self.recorder
    }
    fn far(&self) -> &dyn Bus {
        &self.player
    }
    fn is_one_bus(&self) -> bool {
        false
    }
    fn knows_receivers(&self) -> bool {
        false
    }
    fn carry(&self) {
        self.player.play();
    }
    /// Its nodes answer in their own process, as in memory, but not through a recording.
    fn has_queries(&self) -> bool {
        false
    }
}

/// A subscription with samples that can be waited for.
struct Inbox {
    samples: Receiver<Sample>,
    guard: Box<dyn Guard>,
}

impl Inbox {
    fn open(bus: &dyn Bus, pattern: &str) -> Self {
        let (sender, samples) = channel();
        let sink = Box::new(move |sample| drop(sender.send(sample)));
        Self { samples, guard: bus.subscribe(pattern, sink).unwrap() }
    }

    fn next(&self) -> Sample {
        self.samples.recv_timeout(LONG).expect("a sample within 20 s")
    }

    /// The payloads up to the end message of this time.
    fn until(&self, end: i64) -> Vec<Vec<u8>> {
        let ends = |sample: &Sample| sample.payload == b"end" && sample.capture.ns() == end;
        std::iter::from_fn(|| Some(self.next()))
            .take_while(|sample| !ends(sample))
            .map(|sample| sample.payload)
            .collect()
    }
}

fn put(publisher: &dyn Publisher, capture: i64, payload: &[u8]) {
    publisher.put(Timestamp::from_ns(capture), POSE, payload).unwrap();
}

/// Publishes a unique message and returns it.
fn put_end(pair: &dyn Pair, publisher: &dyn Publisher) -> i64 {
    static ENDS: AtomicI64 = AtomicI64::new(0);
    let end = ENDS.fetch_add(1, Ordering::Relaxed);
    put(publisher, end, b"end");
    pair.carry();
    end
}

/// Publishes until the inbox receives it, and empties the inbox. Twice: before a publisher knows
/// its listeners it sends to everybody, then only to those it knows so far.
fn connect(pair: &dyn Pair, publisher: &dyn Publisher, inbox: &Inbox) {
    let heard = || {
        let end = put_end(pair, publisher);
        let soon = Duration::from_millis(100);
        std::iter::from_fn(|| inbox.samples.recv_timeout(soon).ok())
            .any(|sample| sample.payload == b"end" && sample.capture.ns() == end)
    };
    let twice = (0..200).any(|_| heard() && heard());
    assert!(twice, "nothing arrived in 20 s");
}

fn bytes_arrive_unchanged_and_in_order(pair: &dyn Pair) {
    for topic in ["mocap/t/actor/a/pose", "mocap/t/actor/a/skeleton", "mocap/t/actor/a/journal"] {
        let inbox = Inbox::open(pair.far(), topic);
        let publisher = pair.near().publisher(topic).unwrap();
        connect(pair, &*publisher, &inbox);
        let payload = |i: u8| (0..=255).map(|b: u8| b.wrapping_mul(i)).collect::<Vec<u8>>();
        let captures = [0, -1, i64::MIN, i64::MAX, 1_700_000_000_000_000_000];
        for i in 0..100 {
            put(&*publisher, captures[usize::from(i) % 5], &payload(i));
            pair.carry();
            let sample = inbox.next();
            assert_eq!(&*sample.topic, topic);
            assert_eq!(sample.capture.ns(), captures[usize::from(i) % 5]);
            assert_eq!(&*sample.encoding, POSE);
            assert_eq!(sample.payload, payload(i));
        }
        for i in 0..10 {
            put(&*publisher, 1, &[i]);
        }
        let end = put_end(pair, &*publisher);
        assert_eq!(inbox.until(end), (0..10).map(|i| vec![i]).collect::<Vec<_>>());
    }
}

fn every_encoding_and_size_arrives(pair: &dyn Pair) {
    for topic in ["mocap/t/actor/a/pose", "mocap/t/rig"] {
        let inbox = Inbox::open(pair.far(), topic);
        let publisher = pair.near().publisher(topic).unwrap();
        connect(pair, &*publisher, &inbox);
        for encoding in ["", "my/own", "application/json", "text/plain;x", "größe;ä"] {
            for size in [0, 1, 200_000, 1_000_000, 7] {
                let payload: Vec<u8> = (0..size).map(|i| (i % 251) as u8).collect();
                publisher.put(Timestamp::from_ns(3), encoding, &payload).unwrap();
                pair.carry();
                let sample = inbox.next();
                assert_eq!(&*sample.encoding, encoding);
                assert!(sample.payload == payload, "{size} bytes became others");
            }
        }
    }
}

fn patterns_choose_topics(pair: &dyn Pair) {
    let topics = ["p/camera/a/keypoints", "p/camera/b/keypoints", "p/rig", "p/pose", "q/rig"];
    let everything = Inbox::open(pair.far(), "**");
    let some = ["p/camera/*/keypoints", "p/**", "*/rig", "p/*", "p/**/keypoints", "p/rig"]
        .map(|pattern| (pattern, Inbox::open(pair.far(), pattern)));
    let publishers = topics.map(|topic| pair.near().publisher(topic).unwrap());
    for (topic, publisher) in topics.iter().zip(&publishers) {
        connect(pair, &**publisher, &everything);
        for (pattern, inbox) in &some {
            if bundlemocap::io::bus::matches(pattern, topic) {
                connect(pair, &**publisher, inbox);
            }
        }
    }
    for (topic, publisher) in topics.iter().zip(&publishers) {
        put(&**publisher, 1, topic.as_bytes());
    }
    pair.carry();
    // Topics of one pattern may arrive in another order than they were published in.
    for (pattern, inbox) in &some {
        let expected: Vec<_> =
            topics.iter().filter(|topic| bundlemocap::io::bus::matches(pattern, topic)).collect();
        let mut got = Vec::new();
        while got.len() < expected.len() {
            let sample = inbox.next();
            if sample.payload != b"end" {
                assert_eq!(sample.payload, sample.topic.as_bytes());
                got.push(sample.topic.to_string());
            }
        }
        got.sort();
        let mut expected: Vec<_> = expected.iter().map(ToString::to_string).collect();
        expected.sort();
        assert_eq!(got, expected, "{pattern}");
    }
}

fn a_dropped_guard_gets_nothing_more(pair: &dyn Pair) {
    for topic in ["mocap/t/actor/a/pose", "mocap/t/actor/a/keyframe"] {
        let [stays, goes] = [(); 2].map(|()| Inbox::open(pair.far(), topic));
        let publisher = pair.near().publisher(topic).unwrap();
        connect(pair, &*publisher, &stays);
        connect(pair, &*publisher, &goes);
        drop(goes.guard);
        put(&*publisher, 1, b"after");
        let end = put_end(pair, &*publisher);
        assert_eq!(stays.until(end).last().unwrap(), b"after");
        let nothing = goes.samples.recv_timeout(LONG);
        assert_eq!(nothing, Err(RecvTimeoutError::Disconnected));
    }
}

fn late_joiners_get_the_history_of_states_only(pair: &dyn Pair) {
    for (topic, history) in [
        ("mocap/s/rig", 1),
        ("mocap/s/actor/a/keyframe", 8),
        ("mocap/s/events", 64),
        ("mocap/s/actor/a/journal", 256),
    ] {
        let publisher = pair.near().publisher(topic).unwrap();
        let early = Inbox::open(pair.far(), topic);
        connect(pair, &*publisher, &early);
        let number = |i: usize| (i as u32).to_le_bytes().to_vec();
        for i in 0..300 {
            put(&*publisher, i as i64, &number(i));
            pair.carry();
            early.next();
        }
        for pattern in [topic, "mocap/s/**"] {
            let late = Inbox::open(pair.far(), pattern);
            for i in 300 - history..300 {
                let sample = loop {
                    let sample = late.next();
                    if &*sample.topic == topic {
                        break sample;
                    }
                };
                assert_eq!(sample.payload, number(i), "{topic} by {pattern}");
                assert_eq!((sample.capture.ns(), &*sample.encoding), (i as i64, POSE));
            }
        }
    }
    let stream = pair.near().publisher("mocap/s/actor/a/pose").unwrap();
    let early = Inbox::open(pair.far(), "mocap/s/actor/a/pose");
    connect(pair, &*stream, &early);
    put(&*stream, 1, b"old");
    pair.carry();
    early.next();
    let late = Inbox::open(pair.far(), "mocap/s/actor/a/pose");
    let nothing = late.samples.recv_timeout(Duration::from_millis(200));
    assert_eq!(nothing, Err(RecvTimeoutError::Timeout));
    connect(pair, &*stream, &late);
    put(&*stream, 1, b"new");
    pair.carry();
    assert_eq!(late.next().payload, b"new");
}

fn several_publish_on_one_topic(pair: &dyn Pair) {
    for topic in ["mocap/t/actor/a/pose", "mocap/t/events"] {
        let inbox = Inbox::open(pair.far(), topic);
        let publishers = [(); 3].map(|()| pair.near().publisher(topic).unwrap());
        for publisher in &publishers {
            connect(pair, &**publisher, &inbox);
        }
        for (i, publisher) in publishers.iter().enumerate() {
            put(&**publisher, 1, &[i as u8]);
        }
        pair.carry();
        let mut got: Vec<u8> = (0..3).map(|_| inbox.next().payload[0]).collect();
        got.sort();
        assert_eq!(got, [0, 1, 2]);
    }
}

fn bad_names_are_refused(pair: &dyn Pair) {
    let refused = |result: Result<(), BusError>, name: &str| {
        assert!(matches!(result, Err(BusError::Name { .. })), "{name:?}: {result:?}");
    };
    for name in ["", "/a", "a/", "a//b", "a/$b", "a?b", "a#b", "@a/b", "a\0b", &"x".repeat(201)] {
        refused(pair.near().publisher(name).map(drop), name);
        refused(pair.far().subscribe(name, Box::new(drop)).map(drop), name);
        refused(pair.near().answer(name, Box::new(|| None)).map(drop), name);
        refused(pair.far().query(name, LONG).map(drop), name);
    }
    for name in ["*", "a/*", "**", "a/**/b"] {
        refused(pair.near().publisher(name).map(drop), name);
        refused(pair.near().answer(name, Box::new(|| None)).map(drop), name);
        pair.far().subscribe(name, Box::new(drop)).unwrap();
    }
    refused(pair.far().subscribe("a/b*", Box::new(drop)).map(drop), "a/b*");
}

fn queries_are_answered(pair: &dyn Pair) {
    let sample = Sample {
        topic: "mocap/t/rig".into(),
        capture: Timestamp::from_ns(-5),
        encoding: POSE.into(),
        payload: vec![7; 50],
    };
    let answer = sample.clone();
    let guard = pair.near().answer("mocap/t/rig", Box::new(move || Some(answer.clone()))).unwrap();
    let _nothing = pair.near().answer("mocap/t/actor/a/status", Box::new(|| None)).unwrap();
    if !pair.has_queries() {
        assert_eq!(pair.far().query("mocap/t/*", LONG).unwrap(), []);
        return;
    }
    let asked = (0..1000).map(|_| pair.far().query("mocap/t/rig", LONG).unwrap());
    assert!(asked.into_iter().any(|samples| !samples.is_empty()), "not answered");
    for pattern in ["mocap/t/rig", "mocap/t/*", "**"] {
        assert_eq!(
            pair.far().query(pattern, LONG).unwrap(),
            std::slice::from_ref(&sample),
            "{pattern}"
        );
    }
    assert_eq!(pair.far().query("mocap/t/other", LONG).unwrap(), []);
    drop(guard);
    let again = (0..1000).map(|_| pair.far().query("mocap/t/rig", LONG).unwrap());
    assert!(again.into_iter().any(|samples| samples.is_empty()), "still answered");
}

fn announced_names_are_seen_until_they_end(pair: &dyn Pair) {
    let (name, pattern) = ("mocap/t/actor/a/node/1", "mocap/t/actor/*/node/*");
    let is_seen = |bus: &dyn Bus, wanted: &[&str]| {
        (0..1000).any(|_| {
            std::thread::sleep(Duration::from_millis(5));
            bus.announced(pattern).unwrap() == wanted
        })
    };
    // The far end of a recording is another bus.
    let announcing = if pair.is_one_bus() { pair.far() } else { pair.near() };
    let guard = announcing.announce(name).unwrap();
    assert!(is_seen(pair.near(), &[name]), "not seen");
    assert!(pair.near().announced("mocap/t/actor/b/node/*").unwrap().is_empty());
    drop(guard);
    assert!(is_seen(pair.near(), &[]), "seen after its end");
    assert!(pair.near().announce("mocap/*").is_err());
}

fn receivers_are_known_with_what_they_take(pair: &dyn Pair) {
    if !pair.knows_receivers() {
        assert_eq!(pair.near().receivers("mocap/t/actor").unwrap(), []);
        return;
    }
    let is_known = |wanted: &[&str]| {
        (0..1000).any(|_| {
            std::thread::sleep(Duration::from_millis(5));
            let receivers = pair.near().receivers("mocap/t/actor").unwrap();
            let programs = receivers.iter().all(|one| one.program.starts_with("it"));
            programs && receivers.iter().flat_map(|one| &one.patterns).eq(wanted)
        })
    };
    let patterns = ["mocap/*/actor/p1/pose", "mocap/t/**", "mocap/t/rig", "mocap/u/actor/*/pose"];
    let guards = patterns.map(|pattern| pair.far().subscribe(pattern, Box::new(|_| {})).unwrap());
    assert!(is_known(&patterns[..2]), "{:?}", pair.near().receivers("mocap/t/actor"));
    let others = pair.far().receivers("mocap/t/actor").unwrap();
    assert_eq!(others, [], "an end does not receive from itself");
    drop(guards);
    assert!(is_known(&[]), "known after its end");
    assert!(pair.near().receivers("mocap/*").is_err());
}

fn anybody_who_receives_is_known(pair: &dyn Pair) {
    let watch = pair.near().watch("mocap/t/actor/*/pose").unwrap();
    assert_eq!(watch.is_some(), pair.knows_receivers() && pair.has_queries(), "zenoh knows it");
    let Some(is_received) = watch else { return };
    let is = |wanted: bool| {
        (0..1000).any(|_| {
            std::thread::sleep(Duration::from_millis(5));
            is_received() == wanted
        })
    };
    let own = pair.near().subscribe("mocap/t/actor/p1/pose", Box::new(|_| {})).unwrap();
    let other = pair.far().subscribe("mocap/t/rig", Box::new(|_| {})).unwrap();
    let below = |name: &str| pair.near().receivers(name).unwrap().len();
    assert!((0..4000).any(|_| {
        std::thread::sleep(Duration::from_millis(5));
        below("mocap/t") > 0
    }));
    assert!(!is_received(), "its own subscription counts, or one of another topic");
    let guard = pair.far().subscribe("mocap/t/actor/p1/pose", Box::new(|_| {})).unwrap();
    assert!(is(true), "never known");
    drop((guard, own, other));
    assert!(is(false), "known after its end");
    assert!(pair.near().watch("mocap//t").is_err());
}

fn a_hundred_performers_have_topics(pair: &dyn Pair) {
    let topic = |performer: usize| format!("mocap/h/actor/p{performer}/skeleton");
    let new = |performer| pair.near().publisher(&topic(performer)).unwrap();
    let publishers: Vec<_> = (0..100).map(new).collect();
    let inbox = Inbox::open(pair.far(), "mocap/h/actor/*/skeleton");
    for (performer, publisher) in publishers.iter().enumerate() {
        put(&**publisher, 0, &[performer as u8]);
        pair.carry();
    }
    let mut seen: Vec<_> = publishers.iter().map(|_| inbox.next().payload[0]).collect();
    seen.sort_unstable();
    assert_eq!(seen, (0..100).collect::<Vec<u8>>());
}

macro_rules! conformance {
    ($bus:ident, $pair:expr) => {
        conformance!($bus, $pair,
            bytes_arrive_unchanged_and_in_order every_encoding_and_size_arrives
            patterns_choose_topics a_dropped_guard_gets_nothing_more
            late_joiners_get_the_history_of_states_only several_publish_on_one_topic
            bad_names_are_refused queries_are_answered announced_names_are_seen_until_they_end
            receivers_are_known_with_what_they_take anybody_who_receives_is_known
            a_hundred_performers_have_topics);
    };
    ($bus:ident, $pair:expr, $($check:ident)*) => {
        mod $bus {
            use super::*;
            $(#[test] fn $check() { super::$check(&$pair) })*
        }
    };
}

conformance!(memory, InMemory::new());
conformance!(zenoh_node_and_tool, NodeAndTool::new());
conformance!(zenoh_two_tools, TwoTools::new());
conformance!(iceoryx2, InSharedMemory::new());
conformance!(replay, Recorded::new());

/// A program that receives everything stops to read, as on a computer that is cut off. States and streams of one tool go to
/// another one all the same.
#[test]
fn a_hung_receiver_does_not_stop_the_others() {
    let pair = TwoTools::new();
    let address = pair._node.listens_on().remove(0);
    let mut echo = Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
    let echo = Program::start(echo.args(["echo", "all", "--connect", &address]));
    let [stream, state] = ["pose", "keyframe"].map(|channel| {
        let topic = format!("mocap/stage/actor/a/{channel}");
        (pair.near().publisher(&topic).unwrap(), Inbox::open(pair.far(), &topic))
    });
    for (publisher, inbox) in [&stream, &state] {
        connect(&pair, &**publisher, inbox);
    }
    let begin = Instant::now();
    while pair.near().receivers("mocap/stage").unwrap().is_empty() {
        assert!(begin.elapsed() < LONG, "echo does not come");
        std::thread::sleep(Duration::from_millis(50));
    }
    echo.signal("STOP");
    // As long as it takes to fill the queues for it, and several heartbeats of the states.
    const FRAMES: usize = 250;
    let large = vec![0; 60_000];
    for number in 0..FRAMES {
        put(&*state.0, number as i64, &large);
        put(&*stream.0, number as i64, &[number as u8]);
        std::thread::sleep(Duration::from_millis(16));
    }
    let arrived = |inbox: &Inbox| {
        let soon = Duration::from_millis(500);
        std::iter::from_fn(|| inbox.samples.recv_timeout(soon).ok()).collect::<Vec<_>>()
    };
    // A busy computer loses a few.
    let streamed = arrived(&stream.1).len();
    assert!(streamed > FRAMES * 4 / 5, "{streamed} of {FRAMES}");
    let last = arrived(&state.1).last().map(|sample| sample.capture);
    assert_eq!(last, Some(Timestamp::from_ns(FRAMES as i64 - 1)));
}

#[test]
fn a_port_in_use_is_named_with_the_fix() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp/{}", taken.local_addr().unwrap());
    let config = ZenohConfig { listen: vec![endpoint.clone()], ..ZenohConfig::default() };
    let error = Zenoh::open_node(&config).err().unwrap();
    assert_eq!(
        error.to_string(),
        format!(
            "cannot listen on {endpoint}: address in use; another node runs there, or choose \
             another with [bus.zenoh] listen"
        )
    );
    // The same for the second node of one program.
    let first = node();
    let config = ZenohConfig { listen: first.listens_on(), ..ZenohConfig::default() };
    assert!(matches!(Zenoh::open_node(&config), Err(BusError::InUse { .. })));
}

#[test]
fn a_tool_without_a_node_reports_the_address_it_tried() {
    let port = free_port();
    let config =
        ZenohConfig { listen: vec![format!("tcp/0.0.0.0:{port}")], ..ZenohConfig::default() };
    let error = Zenoh::open_client(&config).err().unwrap();
    assert_eq!(
        error.to_string(),
        format!(
            "nothing answers at tcp/127.0.0.1:{port}; is `bundlemocap run` up? [bus.zenoh] \
             connect says where it is"
        )
    );
}

#[test]
fn invalid_addresses_are_refused() {
    for wrong in ["127.0.0.1:7447", "", "tcp", "udp/127.0.0.1:7447"] {
        let config = ZenohConfig { connect: vec![wrong.into()], ..ZenohConfig::default() };
        for opened in [Zenoh::open_node(&config), Zenoh::open_client(&config)] {
            let error = opened.err().unwrap().to_string();
            assert!(error.starts_with(&format!("[bus] zenoh.connect = {wrong}: ")), "{error}");
        }
    }
    let alone = ZenohConfig { mode: ZenohMode::Client, ..ZenohConfig::default() };
    assert!(matches!(Zenoh::open_node(&alone), Err(BusError::Setting { .. })));
    for prefix in ["", "a/b", &"x".repeat(65)] {
        let opened =
            Iceoryx2::open(&Iceoryx2Config { prefix: prefix.into(), ..Default::default() });
        assert!(matches!(opened, Err(BusError::Setting { .. })), "{prefix:?}");
    }
}

#[test]
fn a_payload_too_large_for_shared_memory_is_refused() {
    let pair = InSharedMemory::new();
    let publisher = pair.near().publisher("mocap/t/actor/a/pose").unwrap();
    let error = publisher.put(Timestamp::default(), POSE, &vec![0; 1 << 20]).unwrap_err();
    assert!(matches!(error, BusError::TooLarge { bytes: 1_048_576, .. }), "{error}");
    put(&*publisher, 1, b"goes on");
}

#[test]
fn a_message_that_is_too_large_is_dropped_on_the_way() {
    let pair = NodeAndTool::new();
    for topic in ["mocap/t/rig", "mocap/t/camera/c/keypoints"] {
        let inbox = Inbox::open(pair.far(), topic);
        let publisher = pair.near().publisher(topic).unwrap();
        connect(&pair, &*publisher, &inbox);
        put(&*publisher, 1, &vec![1; 1 << 20]);
        put(&*publisher, 2, &vec![2; 4 << 20]);
        put(&*publisher, 3, b"small");
        let end = put_end(&pair, &*publisher);
        let sizes: Vec<usize> = inbox.until(end).iter().map(Vec::len).collect();
        assert_eq!(sizes, [1 << 20, 5], "{topic}");
    }
}

#[test]
fn messages_of_foreign_publishers_are_received() {
    let node = node();
    let inboxes =
        ["mocap/f/rig", "mocap/f/actor/a/pose", "**"].map(|pattern| Inbox::open(&node, pattern));
    let foreign = foreign(&node);
    let heard = |inbox: &Inbox, capture: i64, encoding: &str| {
        let sample = inbox.next();
        assert_eq!((sample.capture.ns(), &*sample.encoding), (capture, encoding));
        assert_eq!(sample.payload, b"x");
    };
    for (topic, inbox) in [("mocap/f/rig", &inboxes[0]), ("mocap/f/actor/a/pose", &inboxes[1])] {
        foreign.put(topic, "x").wait().unwrap();
        foreign.put(topic, "x").attachment([1, 2, 3]).wait().unwrap();
        foreign.put(topic, "x").encoding(POSE).attachment(7i64.to_le_bytes()).wait().unwrap();
        for inbox in [inbox, &inboxes[2]] {
            heard(inbox, 0, "");
            heard(inbox, 0, "");
            heard(inbox, 7, POSE);
        }
    }
}

/// A client of the node that is not of this program.
fn foreign(node: &Zenoh) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", "\"client\"").unwrap();
    config.insert_json5("connect/endpoints", &format!("{:?}", node.listens_on())).unwrap();
    config.insert_json5("scouting/multicast/enabled", "false").unwrap();
    zenoh::open(config).wait().unwrap()
}

/// A foreign router stamps the messages of all publishers with one clock, and one may overtake another.
#[test]
fn messages_with_stamps_out_of_order_are_received() {
    let node = node();
    let topics = ["mocap/f/rig", "mocap/f/actor/a/pose"];
    let inboxes = ["mocap/f/rig", "mocap/f/**"].map(|pattern| Inbox::open(&node, pattern));
    let foreign = foreign(&node);
    for stamp in [7, 3, 5] {
        let stamp = zenoh::time::Timestamp::new(zenoh::time::NTP64(stamp), foreign.zid().into());
        for topic in topics {
            foreign.put(topic, "x").timestamp(stamp).wait().unwrap();
        }
    }
    let own = node.publisher("mocap/f/rig").unwrap();
    put(&*own, 1, b"own");
    let end = 1000_i64;
    foreign.put("mocap/f/rig", "end").attachment(end.to_le_bytes()).wait().unwrap();
    for (inbox, count) in inboxes.iter().zip([3, 6]) {
        let payloads = inbox.until(end);
        let of = |what: &[u8]| payloads.iter().filter(|payload| *payload == what).count();
        assert_eq!((of(b"x"), of(b"own"), payloads.len()), (count, 1, count + 1));
    }
}

#[test]
fn a_tool_outlives_its_node() {
    let listen = vec![format!("tcp/127.0.0.1:{}", free_port())];
    let config = ZenohConfig { listen, ..ZenohConfig::default() };
    let first = Zenoh::open_node(&config).unwrap();
    let tool = Zenoh::open_client(&config).unwrap();
    let inboxes =
        ["mocap/t/actor/a/pose", "mocap/t/rig", "**"].map(|pattern| Inbox::open(&tool, pattern));
    let hears = |node: &Zenoh, by: &str| {
        for (topic, inbox) in [("mocap/t/actor/a/pose", &inboxes[0]), ("mocap/t/rig", &inboxes[1])]
        {
            let publisher = node.publisher(topic).unwrap();
            for inbox in [inbox, &inboxes[2]] {
                let from_this_node = |sample: Sample| sample.payload == by.as_bytes();
                let heard = (0..1000).any(|_| {
                    put(&*publisher, 1, by.as_bytes());
                    let moment = Duration::from_millis(20);
                    inbox.samples.recv_timeout(moment).is_ok_and(from_this_node)
                });
                assert!(heard, "{topic} of the {by} node");
            }
        }
    };
    hears(&first, "first");
    drop(first);
    let second = Zenoh::open_node(&config).unwrap();
    hears(&second, "second");
}

/// A port without a listener.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

const PREFIX: &str = "BUNDLEMOCAP_TEST_PREFIX";

/// The other program of `either_side_may_be_killed`: answers pings with its process number, and
/// publishes it as a state when it starts. Ends with its standard input.
#[test]
#[ignore = "started by another test"]
fn child() {
    let Ok(prefix) = std::env::var(PREFIX) else { return };
    let bus = Iceoryx2::open(&Iceoryx2Config { prefix, ..Default::default() }).unwrap();
    let name = std::process::id().to_string();
    let rig = bus.publisher("mocap/c/rig").unwrap();
    put(&*rig, 1, name.as_bytes());
    let pong = bus.publisher("c/pong").unwrap();
    let sink = Box::new(move |_| put(&*pong, 1, name.as_bytes()));
    let _guard = bus.subscribe("c/ping", sink).unwrap();
    let _present = bus.announce(&format!("c/node/{}", std::process::id())).unwrap();
    std::io::stdin().read_to_end(&mut Vec::new()).unwrap();
}

/// Killed on drop.
struct Killed(Child);

impl Killed {
    fn start(prefix: &Prefix) -> Self {
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "bus::child", "--ignored", "--nocapture", "--quiet"])
            .env(PREFIX, &prefix.0)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn();
        Self(child.unwrap())
    }
}

impl Drop for Killed {
    fn drop(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

#[test]
fn either_side_may_be_killed() {
    let prefix = Prefix::new();
    let bus = Iceoryx2::open(&prefix.config()).unwrap();
    let ping = bus.publisher("c/ping").unwrap();
    let pong = Inbox::open(&bus, "c/pong");
    for round in 0..4 {
        let child = Killed::start(&prefix);
        let name = child.0.id().to_string();
        let says_its_name = |inbox: &Inbox| {
            (0..1000).any(|_| {
                put(&*ping, 1, b"ping");
                let sample = inbox.samples.recv_timeout(Duration::from_millis(20));
                sample.is_ok_and(|sample| sample.payload == name.as_bytes())
            })
        };
        assert!(says_its_name(&pong), "child {round} does not answer");
        let late = Inbox::open(&bus, "mocap/c/rig");
        let of_this_child = |sample: &Sample| sample.payload == name.as_bytes();
        assert!(std::iter::from_fn(|| Some(late.next())).take(9).any(|s| of_this_child(&s)));
        let present = || bus.announced("c/node/*").unwrap();
        assert!((0..1000).any(|_| {
            std::thread::sleep(Duration::from_millis(5));
            present() == [format!("c/node/{name}")]
        }));
        // A program that joins after the child was killed is not blocked by its remains.
        drop(child);
        assert_eq!(present(), Vec::<String>::new());
        let newcomer = Iceoryx2::open(&prefix.config()).unwrap();
        let inbox = Inbox::open(&newcomer, "c/ping");
        put(&*ping, 1, b"to the newcomer");
        assert!((0..1000).any(|_| {
            put(&*ping, 1, b"to the newcomer");
            inbox.samples.recv_timeout(Duration::from_millis(20)).is_ok()
        }));
    }
    drop((pong, ping, bus));
    assert_eq!(prefix.leftovers(), Vec::<String>::new());
}
