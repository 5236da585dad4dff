//! One suite of checks over every bus, and what only one of them has.

use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use bundlemocap::bus::{Bus, BusError, Guard, Memory, Publisher, Sample, Zenoh, ZenohConfig};
use bundlemocap::time::Timestamp;

/// How long to wait for what must come.
const LONG: Duration = Duration::from_secs(20);

const POSE: &str = "application/protobuf;bundlemocap.v1.Pose";

/// Two ends of one bus, as two programs have them.
trait Pair {
    /// Where the checks publish.
    fn near(&self) -> &dyn Bus;
    /// Where they receive.
    fn far(&self) -> &dyn Bus;
    /// Makes what was published so far arrive, where that does not happen by itself.
    fn carry(&self) {}
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
}

/// A node that is a router, and a tool.
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

/// Two tools that hear each other through a node.
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

/// A subscription whose samples can be waited for.
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

    /// The payloads up to the one that says `end`.
    fn until_end(&self) -> Vec<Vec<u8>> {
        let mut got = Vec::new();
        loop {
            let sample = self.next();
            if sample.payload == b"end" {
                return got;
            }
            got.push(sample.payload);
        }
    }
}

fn put(publisher: &dyn Publisher, capture: i64, payload: &[u8]) {
    publisher.put(Timestamp::from_ns(capture), POSE, payload).unwrap();
}

/// Publishes until the inbox hears it, then takes out what this left there.
fn connect(pair: &dyn Pair, publisher: &dyn Publisher, inbox: &Inbox) {
    for _ in 0..1000 {
        put(publisher, 1, b"probe");
        pair.carry();
        if inbox.samples.recv_timeout(Duration::from_millis(20)).is_ok() {
            put(publisher, 1, b"end");
            pair.carry();
            inbox.until_end();
            return;
        }
    }
    panic!("nothing arrived in 20 s");
}

fn bytes_arrive_unchanged_and_in_order(pair: &dyn Pair) {
    for topic in ["t/actor/a/pose", "t/skeleton", "t/actor/a/journal"] {
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
        put(&*publisher, 1, b"end");
        pair.carry();
        assert_eq!(inbox.until_end(), (0..10).map(|i| vec![i]).collect::<Vec<_>>());
    }
}

fn every_encoding_and_size_arrives(pair: &dyn Pair) {
    for topic in ["t/pose", "t/rig"] {
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
            if bundlemocap::bus::matches(pattern, topic) {
                connect(pair, &**publisher, inbox);
            }
        }
    }
    for (topic, publisher) in topics.iter().zip(&publishers) {
        put(&**publisher, 1, topic.as_bytes());
    }
    pair.carry();
    // Topics of one pattern need not arrive in the order in which they were published.
    for (pattern, inbox) in &some {
        let expected: Vec<_> =
            topics.iter().filter(|topic| bundlemocap::bus::matches(pattern, topic)).collect();
        let mut got = Vec::new();
        while got.len() < expected.len() {
            let sample = inbox.next();
            if sample.payload != b"probe" && sample.payload != b"end" {
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
    for topic in ["t/pose", "t/keyframe"] {
        let [stays, goes] = [(); 2].map(|()| Inbox::open(pair.far(), topic));
        let publisher = pair.near().publisher(topic).unwrap();
        connect(pair, &*publisher, &stays);
        connect(pair, &*publisher, &goes);
        stays.until_end();
        drop(goes.guard);
        while goes.samples.try_recv().is_ok() {}
        put(&*publisher, 1, b"after");
        put(&*publisher, 1, b"end");
        pair.carry();
        assert_eq!(stays.until_end(), [b"after"]);
        let nothing = goes.samples.recv_timeout(LONG);
        assert_eq!(nothing, Err(RecvTimeoutError::Disconnected));
    }
}

fn late_joiners_get_the_history_of_states_only(pair: &dyn Pair) {
    for (topic, history) in [("s/rig", 1), ("s/keyframe", 8), ("s/events", 64), ("s/journal", 256)]
    {
        let publisher = pair.near().publisher(topic).unwrap();
        let number = |i: usize| (i as u32).to_le_bytes().to_vec();
        for i in 0..300 {
            put(&*publisher, i as i64, &number(i));
        }
        pair.carry();
        for pattern in [topic, "s/**"] {
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
    let stream = pair.near().publisher("s/pose").unwrap();
    put(&*stream, 1, b"old");
    pair.carry();
    let late = Inbox::open(pair.far(), "s/pose");
    connect(pair, &*stream, &late);
    put(&*stream, 1, b"new");
    pair.carry();
    assert_eq!(late.next().payload, b"new");
}

fn several_publish_on_one_topic(pair: &dyn Pair) {
    for topic in ["t/pose", "t/events"] {
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
        topic: "t/rig".into(),
        capture: Timestamp::from_ns(-5),
        encoding: POSE.into(),
        payload: vec![7; 5000],
    };
    let answer = sample.clone();
    let guard = pair.near().answer("t/rig", Box::new(move || Some(answer.clone()))).unwrap();
    let nothing = pair.near().answer("t/status", Box::new(|| None)).unwrap();
    if !pair.has_queries() {
        assert!(guard.is_none() && nothing.is_none());
        assert_eq!(pair.far().query("t/*", LONG).unwrap(), []);
        return;
    }
    for pattern in ["t/rig", "t/*", "**"] {
        assert_eq!(pair.far().query(pattern, LONG).unwrap(), [sample.clone()], "{pattern}");
    }
    assert_eq!(pair.far().query("t/other", LONG).unwrap(), []);
    drop(guard);
    let again = (0..100).map(|_| pair.far().query("t/rig", LONG).unwrap());
    assert!(again.into_iter().any(|samples| samples.is_empty()), "still answered");
}

macro_rules! conformance {
    ($bus:ident, $pair:expr) => {
        conformance!($bus, $pair,
            bytes_arrive_unchanged_and_in_order every_encoding_and_size_arrives
            patterns_choose_topics a_dropped_guard_gets_nothing_more
            late_joiners_get_the_history_of_states_only several_publish_on_one_topic
            bad_names_are_refused queries_are_answered);
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
