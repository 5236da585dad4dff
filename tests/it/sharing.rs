//! Solvers that share the performers of a stage, in simulated time: the node of the stage, the solvers, and the network
//! between them.

use std::collections::{BTreeMap, BTreeSet};

use bundlemocap::config::Config;
use bundlemocap::core::detections::Detections;
use bundlemocap::core::fnv::fnv1a;
use bundlemocap::core::stage::{self, Known};
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::io::recording::{known_people, write_body};
use bundlemocap::io::wire::{
    self, ActorChannel, Event, PlayoutCounters, Pose, Status, Topic, Topics, TrackingState, decode,
    encode,
};
use bundlemocap::live::{Input, Recorded};

use crate::live::{START, Sent, World, at, performers};
use crate::several::Stage;
use crate::slate::{assert_agrees, replayed_as, slate};

/// Time of a message from node to node, and until the others know that a solver came or is gone.
const NETWORK: Nanos = Nanos::from_ms(2);
const NOTICED: Nanos = Nanos::from_ms(60);
const PEOPLE: usize = 5;
const SECONDS: f64 = 6.0;

/// What happens to a solver.
#[derive(Clone, Copy)]
enum Happens {
    Starts,
    Leaves,
    IsKilled,
    /// Its messages are lost, and those to it. The others do not notice it.
    IsCutOff,
    IsBack,
    /// It hears and says nothing from here on, but its connections stay.
    Hangs,
    /// It is stopped, and goes on with everything that came meanwhile.
    Sleeps,
    WakesUp,
    /// The next set of everybody's frames is lost on the way to it, or all are.
    LosesASet,
    IsDeaf,
    /// Some of its last hand-overs are sent again.
    Echoes,
    /// Somebody else offers it another calibration.
    IsOffered,
    /// All nodes get this command for the performer of that name.
    IsTold(&'static str),
}
use Happens::{
    Echoes, Hangs, IsBack, IsCutOff, IsDeaf, IsKilled, IsOffered, IsTold, Leaves, LosesASet,
    Sleeps, Starts, WakesUp,
};

/// A node and the number of its messages that are on their way.
struct Node {
    world: World,
    sent: usize,
    /// It hears and says nothing from here on.
    killed: Option<Timestamp>,
    is_cut_off: bool,
    is_asleep: bool,
    /// Everything that it was sent.
    inputs: Vec<Sent>,
}

impl Node {
    fn new(stage: &Stage, known: &[Known]) -> Self {
        let world = World::knowing(&stage.config, known.to_vec());
        Self {
            world,
            sent: 0,
            killed: None,
            is_cut_off: false,
            is_asleep: false,
            inputs: Vec::new(),
        }
    }

    /// The messages since the last call that other nodes of the stage read.
    fn says(&mut self) -> Vec<Sent> {
        let all = &self.world.heard.messages[self.sent..];
        self.sent += all.len();
        let is_for_nodes = |message: &&Recorded| {
            let topic = Topic::parse(&message.topic).unwrap();
            let Topic::Actor { channel, .. } = topic else { return false };
            use ActorChannel::{HandOver, Keypoints, Status};
            matches!(channel, Keypoints | HandOver | Status)
        };
        let all = all.iter().filter(is_for_nodes);
        all.map(|message| on_its_way(message, message.time)).collect()
    }

    /// What it published in time.
    fn heard(&self) -> impl Iterator<Item = &Recorded> {
        let all = self.world.heard.messages.iter();
        all.filter(|message| self.killed.is_none_or(|killed| message.time < killed))
    }
}

/// A stage; the settings are those of one node that does everything.
fn stage_of(people: usize, cameras: usize, seconds: f64) -> Stage {
    let mut stage = Stage::new(people, cameras, seconds as u64);
    let node = &mut stage.config.node;
    (node.latency_ms, node.provisional) = (300.0, false);
    (node.time_offsets, node.watch_cameras) = (false, false);
    stage
}

/// A message that is sent at a time.
fn on_its_way(Recorded { topic, payload, .. }: &Recorded, at: Timestamp) -> Sent {
    Sent { arrival: at + NETWORK, topic: topic.to_string(), payload: payload.clone() }
}

/// The stage of most tests.
fn stage() -> Stage {
    stage_of(PEOPLE, 4, SECONDS)
}

/// All nodes, after the script: what happens to which solver, and when.
fn play(
    (mut stage, seconds): (Stage, f64),
    known: &[Known],
    script: &[(f64, &str, Happens)],
) -> BTreeMap<String, Node> {
    let (mut cameras, rig) = (stage.all(), stage.studio.rig());
    cameras.sort_by_key(|message| message.arrival);
    let mut cameras = cameras.into_iter().peekable();
    stage.config.stage.solve = false;
    let mut nodes = BTreeMap::from([("front".to_owned(), Node::new(&stage, known))]);
    stage.config.stage =
        stage::Config { performers: stage.config.stage.performers, ..stage::Config::default() };
    stage.config.node.solver = true;
    let mut transit: BTreeMap<String, Vec<Sent>> = BTreeMap::new();
    let (mut solvers, mut notices) = (BTreeSet::new(), Vec::new());
    let mut script = script.iter().peekable();
    let (mut deaf, mut losing) = (BTreeSet::new(), BTreeMap::new());
    let mut now = at(-0.8);
    while now < at(seconds) {
        now = now + Nanos::from_ms(2);
        while let Some((_, name, happens)) = script.next_if(|(when, ..)| at(*when) <= now) {
            match happens {
                Starts => {
                    stage.config.node.actor = (*name).to_owned();
                    nodes.insert((*name).to_owned(), Node::new(&stage, &[]));
                    let begin = Sent { arrival: now + NETWORK, ..rig.clone() };
                    transit.entry((*name).to_owned()).or_default().push(begin);
                    solvers.insert((*name).to_owned());
                }
                IsCutOff => nodes.get_mut(*name).unwrap().is_cut_off = true,
                IsBack => nodes.get_mut(*name).unwrap().is_cut_off = false,
                Sleeps => nodes.get_mut(*name).unwrap().is_asleep = true,
                WakesUp => {
                    let node = nodes.get_mut(*name).unwrap();
                    node.is_asleep = false;
                    node.world.sleep_until(now);
                }
                Hangs => nodes.get_mut(*name).unwrap().killed = Some(now),
                IsTold(action) => {
                    let told = slate(action, name, now.seconds_since(at(0.0)));
                    let to = nodes.keys().map(|node| (node.clone(), told.clone()));
                    to.for_each(|(node, told)| transit.entry(node).or_default().push(told));
                }
                IsOffered => {
                    let mut other: wire::Rig = decode(&rig.payload).unwrap();
                    other.cameras[0].focal_px[0] *= 1.2;
                    let (arrival, payload) = (now + NETWORK * 2, encode(&other));
                    let offer = Sent { arrival, payload, ..rig.clone() };
                    transit.entry((*name).to_owned()).or_default().push(offer);
                }
                LosesASet => {
                    losing.insert((*name).to_owned(), BTreeSet::new());
                }
                IsDeaf => drop(deaf.insert((*name).to_owned())),
                Echoes => {
                    let all = nodes[*name].world.heard.messages.iter().rev();
                    let states = all.filter(|m| m.topic.ends_with("/hand_over"));
                    let old = states.skip(20).take(20);
                    let again: Vec<Sent> = old.map(|m| on_its_way(m, now)).collect();
                    transit.values_mut().for_each(|all| all.extend(again.iter().cloned()));
                }
                Leaves => {
                    solvers.remove(*name);
                    nodes.get_mut(*name).unwrap().world.end();
                }
                IsKilled => {
                    solvers.remove(*name);
                    nodes.get_mut(*name).unwrap().killed = Some(now);
                }
            }
            notices.push((now + NOTICED, Vec::from_iter(solvers.clone())));
        }
        let mut said = Vec::new();
        let runs = |node: &Node| node.killed.is_none() && !node.is_asleep;
        for (name, node) in nodes.iter_mut().filter(|(_, node)| runs(node)) {
            for (_, names) in notices.iter().filter(|(at, _)| *at <= now) {
                node.world.tell(Input::Solvers(names.clone()));
            }
            let waiting = transit.entry(name.clone()).or_default();
            let mut messages: Vec<Sent> =
                waiting.extract_if(.., |message| message.arrival <= now).collect();
            if let Some(lost) = losing.get_mut(name) {
                messages
                    .retain(|m| !m.topic.ends_with("/keypoints") || !lost.insert(m.topic.clone()));
            }
            if deaf.contains(name) {
                messages.retain(|m| !m.topic.ends_with("/keypoints"));
            }
            if name == "front" {
                messages.extend(std::iter::from_fn(|| cameras.next_if(|m| m.arrival <= now)));
            }
            if node.is_cut_off {
                messages.clear();
            }
            node.inputs.extend(messages.iter().cloned());
            node.world.play(messages, now);
            let says = node.says();
            said.extend(says.into_iter().filter(|_| !node.is_cut_off));
        }
        notices.retain(|(at, _)| *at > now);
        transit.values_mut().for_each(|messages| messages.extend(said.iter().cloned()));
    }
    nodes
}

/// All final poses by topic and capture time, without the run; each once.
fn poses<'a>(heard: impl Iterator<Item = &'a Recorded>) -> BTreeMap<(String, i64), Pose> {
    let mut all = BTreeMap::new();
    for message in heard {
        let topic = Topic::parse(&message.topic).unwrap();
        if matches!(topic, Topic::Actor { channel: ActorChannel::Pose, .. }) {
            let pose = Pose { run_id: 0, ..decode(&message.payload).unwrap() };
            assert!(pose.capture_time_ns + 300_000_000 == message.time.ns(), "at one latency");
            let key = (message.topic.to_string(), pose.capture_time_ns);
            assert!(all.insert(key, pose).is_none(), "a pose comes twice");
        }
    }
    all.retain(|(_, capture), _| *capture > at(1.5).ns());
    all
}

fn poses_of(nodes: &BTreeMap<String, Node>) -> BTreeMap<(String, i64), Pose> {
    poses(nodes.values().flat_map(Node::heard))
}

/// The poses of one node that does everything.
fn poses_of_one() -> BTreeMap<(String, i64), Pose> {
    let stage = stage();
    let mut world = World::new(&stage.config);
    world.play(stage.all(), at(SECONDS));
    poses(world.heard.messages.iter())
}

/// The last status of a solver.
fn status_of(nodes: &BTreeMap<String, Node>, name: &str) -> wire::Status {
    let topics = Topics { actor: name.to_owned(), ..Topics::default() };
    nodes[name].world.heard.of(&topics.status()).pop().unwrap().1
}

/// Which solver published poses of which performers.
fn who(nodes: &BTreeMap<String, Node>, range: [f64; 2]) -> BTreeMap<String, BTreeSet<String>> {
    let mut all: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (name, node) in nodes {
        for (topic, capture) in poses(node.heard()).into_keys() {
            if (at(range[0]).ns()..at(range[1]).ns()).contains(&capture) {
                all.entry(name.clone()).or_default().insert(Topic::actor(&topic));
            }
        }
    }
    all
}

fn start_three(script: &[(f64, &'static str, Happens)]) -> Vec<(f64, &'static str, Happens)> {
    let three = ["a", "b", "c"].map(|name| (-0.8, name, Starts));
    three.into_iter().chain(script.iter().copied()).collect()
}

#[test]
fn solvers_give_the_poses_of_one_node() {
    let one = poses_of_one();
    assert!(one.len() > PEOPLE * 230, "{}", one.len());
    let nodes = play((stage(), SECONDS), &[], &start_three(&[]));
    let who = who(&nodes, [0.0, SECONDS]);
    assert!(who.len() > 1 && !who.contains_key("front"), "{who:?}");
    assert_eq!(who.values().map(BTreeSet::len).sum::<usize>(), PEOPLE, "{who:?}");
    assert!(poses_of(&nodes) == one);
    // The stage tells who solves whom.
    let status =
        nodes["front"].world.heard.of::<wire::StageStatus>(&Topics::default().stage_status());
    for performer in &status.last().unwrap().1.performers {
        assert!(who[&performer.solver].contains(&performer.name), "{performer:?}");
        assert!(performer.tracker_state == "tracking" && performer.residual_px > 0.0);
    }
    // So does its status of the solvers' windows and poses, and of the cameras' residuals.
    let front = nodes["front"].world.heard.status();
    let tracked_by = |name| status_of(&nodes, name).windows.unwrap().tracked;
    let sum: u64 = ["a", "b", "c"].map(tracked_by).iter().sum();
    let tracked = front.windows.unwrap().tracked;
    // It is one second older at most.
    assert!(tracked <= sum && tracked + 15 * PEOPLE as u64 > sum, "{tracked} of {sum}");
    assert!(front.cameras.iter().all(|camera| camera.residual_px > 0.0 && camera.near > 0.0));
    assert_eq!(front.declared_latency_ns, 300_000_000);
    assert_eq!(front.tracker_state, "tracking");
}

#[test]
fn solvers_use_the_calibration_of_the_front() {
    let script = [(-0.79, "a", IsOffered), (-0.79, "b", IsOffered), (3.0, "c", IsOffered)];
    let mut nodes = play((stage(), SECONDS), &[], &start_three(&script));
    assert!(poses_of(&nodes) == poses_of_one());
    assert_replays(nodes.remove("b").unwrap(), "b", None);
}

/// A take begins anew, and then somebody offers another calibration before the first keypoints.
#[test]
fn solvers_use_the_calibration_of_the_front_in_a_take_too() {
    let script = [(2.0, "walk", IsTold("start")), (2.0, "b", IsOffered)];
    let mut nodes = play((stage(), SECONDS), &[], &start_three(&script));
    let details = nodes["b"].world.heard.details("rig_changed");
    assert!(details.iter().any(|detail| detail.ends_with("from the bus")), "{details:?}");
    assert!(details.last().unwrap().ends_with("from the front"), "{details:?}");
    assert_replays(nodes.remove("b").unwrap(), "b", Some("walk"));
}

#[test]
fn a_solver_uses_the_last_calibration_if_the_front_does_not_say_its_own() {
    let stage = stage();
    let mut config = stage.config.clone();
    config.node.solver = true;
    let mut world = World::new(&config);
    let rig: wire::Rig = decode(&stage.studio.rig().payload).unwrap();
    let offer = |world: &mut World, version: u64| {
        let payload = encode(&wire::Rig { version, ..rig.clone() });
        let topic = Topics::default().rig().into();
        world.tell(Input::Message { topic, payload });
        world.core.rig().map(|rig| decode::<wire::Rig>(rig).unwrap().version).unwrap()
    };
    let set = |world: &mut World, rig_hash: u64| {
        let payload = encode(&wire::KeypointSet { rig_hash, ..wire::KeypointSet::default() });
        let topics = Topics { actor: "p1".into(), ..Topics::default() };
        world.tell(Input::Message { topic: topics.actor_keypoints().into(), payload });
    };
    assert_eq!([1, 2].map(|version| offer(&mut world, version)), [1, 2]);
    // The front uses one that has not come.
    set(&mut world, 7);
    assert!(world.heard.details("unusable")[0].contains("has not come"));
    assert_eq!(offer(&mut world, 3), 3);
    let hash = fnv1a(&encode(&wire::Rig { version: 2, ..rig.clone() }));
    set(&mut world, hash);
    let many: Vec<u64> = (4..24).map(|version| offer(&mut world, version)).collect();
    assert_eq!(many, [2; 20]);
    // An older front does not say which one it uses.
    set(&mut world, 0);
    assert_eq!(offer(&mut world, 24), 24);
}

#[test]
fn a_solver_that_comes_or_leaves_is_not_noticed() {
    let one = poses_of_one();
    let nodes =
        play((stage(), SECONDS), &[], &start_three(&[(3.0, "d", Starts), (4.5, "b", Leaves)]));
    let [before, with, after] =
        [[0.0, 2.5], [3.5, 4.0], [5.0, SECONDS]].map(|range| who(&nodes, range));
    assert!(!before.contains_key("d") && with.contains_key("d"), "{before:?} {with:?}");
    assert!(with.contains_key("b") && !after.contains_key("b"), "{with:?} {after:?}");
    let moved = with["d"].len();
    assert!(moved < PEOPLE - 1, "only some performers move: {with:?}");
    let all = poses_of(&nodes);
    assert!(all.keys().eq(one.keys()), "{} of {} poses", all.len(), one.len());
    assert!(all == one);
    // Nobody is said to hang.
    let said = nodes["front"].world.heard.details("solver");
    assert!(
        said.iter().all(|detail| detail.starts_with("the performers are solved by")),
        "{said:?}"
    );
    // It is said for each of those who moved.
    let of_d = nodes["d"].world.heard.messages.iter().filter(|message| {
        message.topic.ends_with("/events")
            && decode::<Event>(&message.payload).unwrap().kind == "solver"
    });
    assert!(of_d.count() >= moved);
}

#[test]
fn a_killed_solver_is_replaced() {
    let one = poses_of_one();
    let nodes = play((stage(), SECONDS), &[], &start_three(&[(4.0, "b", IsKilled)]));
    let [before, after] = [[0.0, 3.5], [4.5, SECONDS]].map(|range| who(&nodes, range));
    assert!(before.contains_key("b") && !after.contains_key("b"), "{before:?} {after:?}");
    let all = poses_of(&nodes);
    let missing: Vec<_> = one.keys().filter(|key| !all.contains_key(key)).collect();
    let moved = before["b"].len();
    assert!(!missing.is_empty() && missing.len() < moved * 30, "{}", missing.len());
    let late = at(4.0).ns() - 300_000_000..at(4.5).ns();
    assert!(missing.iter().all(|(_, capture)| late.contains(capture)), "{missing:?}");
    assert!(all.iter().all(|(key, pose)| *pose == one[key]), "the others are those of one node");
}

#[test]
fn a_solver_that_was_cut_off_goes_on() {
    // For so short that the others do not notice, and until they go on with its performers.
    for (back, seconds) in [(4.3, 6.0), (6.6, 10.0)] {
        let script = start_three(&[(2.5, "a", IsCutOff), (back, "a", IsBack)]);
        let nodes = play((stage_of(PEOPLE, 4, seconds), seconds), &[], &script);
        let settled = if back < 5.0 { back + 0.7 } else { back + 1.7 };
        let [before, after] = [[0.0, 2.0], [settled, seconds]].map(|range| who(&nodes, range));
        assert!(before.contains_key("a"));
        assert_eq!(before, after);
        // None comes twice.
        let all = poses_of(&nodes);
        let late = all.keys().filter(|(_, capture)| *capture > at(settled).ns());
        let each = (60.0 * (seconds - 0.35 - settled)) as usize;
        assert!(late.count() >= PEOPLE * each, "{back}");
    }
}

/// A solver that was stopped leaves the time to others in which they went on.
#[test]
fn a_solver_that_was_stopped_steps_back() {
    let script = start_three(&[(2.5, "a", Sleeps), (7.5, "a", WakesUp)]);
    let nodes = play((stage_of(PEOPLE, 4, 11.0), 11.0), &[], &script);
    let [before, without, after] =
        [[0.0, 2.0], [6.0, 7.0], [9.5, 11.0]].map(|range| who(&nodes, range));
    assert!(before.contains_key("a") && !without.contains_key("a"), "{before:?} {without:?}");
    assert_eq!(before, after);
    // Each is at its time, and comes once. Those of the others are not missed.
    poses_of(&nodes);
    assert_eq!(status_of(&nodes, "a").playout.unwrap().missed, 0);
}

/// What a front and a solver got and published, replayed.
#[test]
fn a_front_and_a_solver_replay_to_the_same_bytes() {
    let mut nodes = play((stage_of(3, 4, 4.0), 4.0), &[], &start_three(&[(2.5, "d", Starts)]));
    let solver =
        *["a", "b", "c"].iter().find(|name| who(&nodes, [1.5, 4.0]).contains_key(**name)).unwrap();
    for (name, actor) in [("front", "actor"), (solver, solver)] {
        assert_replays(nodes.remove(name).unwrap(), actor, None);
    }
}

/// The node ends. Its run, or that of the take, is replayed to the same bytes.
fn assert_replays(Node { mut world, inputs, .. }: Node, actor: &str, run: Option<&str>) {
    world.end();
    let mut recorded = world.heard.messages;
    recorded.extend(inputs.into_iter().map(Recorded::from));
    let topics = Topics { actor: actor.to_owned(), ..Topics::default() };
    let replayed = replayed_as(&recorded, &topics, run).unwrap();
    assert!(replayed.is_whole && replayed.gap.is_none(), "{actor}");
    assert_agrees(&replayed);
}

/// The performers of a solver that says nothing any more, and is still there, go to the others.
#[test]
fn a_solver_that_hangs_is_replaced() {
    let nodes = play((stage(), SECONDS), &[], &start_three(&[(2.2, "b", Hangs)]));
    let [before, after] = [[0.0, 2.2], [5.4, SECONDS]].map(|range| who(&nodes, range));
    assert!(before.contains_key("b") && !after.contains_key("b"), "{before:?} {after:?}");
    assert_eq!(after.values().map(BTreeSet::len).sum::<usize>(), PEOPLE, "{after:?}");
    // Each is at its time, and comes once.
    poses_of(&nodes);
    let told = nodes["front"].world.heard.details("solver");
    assert!(told.iter().any(|detail| detail.contains("no status from solver b")), "{told:?}");
}

/// A solver that gets no frames any more does not release a performer: the one to which it belongs takes it.
#[test]
fn a_solver_without_frames_keeps_nobody() {
    let shares = |script: &[_]| who(&play((stage(), 5.0), &[], &start_three(script)), [4.0, 5.0]);
    let (before, with) = (shares(&[]), shares(&[(2.5, "d", Starts)]));
    let moved = with["d"].first().unwrap();
    let owner = before.iter().find(|(_, of)| of.contains(moved)).unwrap().0;
    let owner = *["a", "b", "c"].iter().find(|name| *name == owner).unwrap();
    let after = shares(&[(2.4, "d", Starts), (2.5, owner, IsDeaf)]);
    assert!(after["d"].contains(moved), "{moved} was of {owner}: {after:?}");
}

/// Old messages of a solver that is gone do not count.
#[test]
fn states_that_come_late_are_not_used() {
    let one = poses_of_one();
    let script = start_three(&[(4.0, "b", IsKilled), (4.02, "b", Echoes)]);
    let nodes = play((stage(), SECONDS), &[], &script);
    let all = poses_of(&nodes);
    let late = one.iter().filter(|((_, capture), _)| *capture > at(4.6).ns());
    assert!(late.clone().count() > PEOPLE * 60);
    late.into_iter().for_each(|(key, pose)| assert!(all.get(key) == Some(pose), "{key:?}"));
}

#[test]
fn a_set_that_is_lost_is_counted() {
    let nodes = play((stage(), SECONDS), &[], &start_three(&[(3.0, "b", LosesASet)]));
    let lost: u64 = nodes["b"].world.heard.messages.iter().filter_map(dropped).sum();
    assert_eq!(lost, who(&nodes, [2.0, 4.0])["b"].len() as u64);
    let others = nodes.iter().filter(|(name, _)| *name != "b");
    let others = others.flat_map(|(_, node)| &node.world.heard.messages).filter_map(dropped);
    assert_eq!(others.count(), 0);
}

/// Number of messages that an event says were dropped.
fn dropped(message: &Recorded) -> Option<u64> {
    let event = || decode::<Event>(&message.payload).unwrap();
    let event = message.topic.ends_with("/events").then(event)?;
    (event.kind == "dropped").then_some(event.count)
}

/// A solver that comes later knows who is locked.
#[test]
fn a_lock_holds_on_a_solver_that_comes_later() {
    let lock = |name| (2.0, name, IsTold("lock"));
    let script = [
        lock("p1"),
        lock("p2"),
        lock("p3"),
        lock("p4"),
        lock("p5"),
        (3.0, "d", Starts),
        (4.5, "", IsTold("reset")),
    ];
    let nodes = play((stage(), SECONDS), &[], &start_three(&script));
    assert!(who(&nodes, [4.0, SECONDS]).contains_key("d"));
    assert!(poses_of(&nodes) == poses_of_one());
}

/// Who comes back goes on with the body, and with later windows.
#[test]
fn who_comes_back_is_solved_as_before() {
    let mut stage = stage_of(2, 4, 14.0);
    let away = |frame: &&mut Detections| frame.capture >= at(9.0) && frame.capture < at(11.0);
    stage.studio.frames.iter_mut().filter(away).for_each(|frame| frame.people.clear());
    let nodes = play((stage, 14.0), &[], &[(-0.8, "a", Starts), (-0.8, "b", Starts)]);
    for actor in ["p1", "p2"] {
        let topics = Topics { actor: actor.to_owned(), ..Topics::default() };
        let heard = nodes.values().flat_map(|node| node.world.heard.of::<Pose>(&topics.pose()));
        let mut poses: Vec<Pose> = heard.map(|(_, pose)| pose).collect();
        poses.sort_by_key(|pose| pose.capture_time_ns);
        let last = poses.last().unwrap();
        assert!(last.capture_time_ns > at(13.5).ns() && last.state() == TrackingState::Tracking);
        let windows: Vec<u64> = poses.iter().map(|pose| pose.window).collect();
        assert!(windows.is_sorted(), "{actor}: {windows:?}");
    }
}

/// Twenty-four people before eight cameras.
#[test]
fn a_crowd_is_shared() {
    const CROWD: usize = 24;
    let nodes = play((stage_of(CROWD, 8, 4.0), 4.0), &[], &start_three(&[]));
    let who = who(&nodes, [2.0, 4.0]);
    assert_eq!(who.len(), 3, "{who:?}");
    assert_eq!(who.values().map(BTreeSet::len).sum::<usize>(), CROWD, "{who:?}");
    assert!(who.values().all(|some| some.len() >= CROWD / 6), "{who:?}");
    let poses = poses_of(&nodes);
    let after_2_s = poses.keys().filter(|(_, capture)| *capture > at(2.0).ns()).count();
    let each = after_2_s as f64 / CROWD as f64;
    assert!(each > 90.0, "{each} poses of each in 1.7 s");
}

/// The front writes the bodies that the solvers find, and tells them of people whom it knows.
#[test]
fn known_bodies_are_those_of_the_front() {
    let two = || {
        let mut stage = stage_of(2, 4, 10.0);
        stage.config.stage.names = vec!["lead".into(), "double".into()];
        stage.config.stage.bodies = "bodies".into();
        stage
    };
    let start = [(-0.8, "a", Starts), (-0.8, "b", Starts)];
    let mut nodes = play((two(), 10.0), &[], &start);
    let front = &mut nodes.get_mut("front").unwrap().world;
    front.end();
    let folder = tempfile::tempdir().unwrap();
    for (name, body) in &front.bodies {
        write_body(folder.path(), name, body, false).unwrap();
    }
    let known = known_people(folder.path(), "actor", &[]).unwrap();
    assert_eq!(known.iter().map(|one| &*one.name).collect::<Vec<_>>(), ["double", "lead"]);

    let nodes = play((two(), 2.0), &known, &start);
    for one in &known {
        let topics = Topics { actor: one.name.clone(), ..Topics::default() };
        let all = nodes
            .values()
            .flat_map(|node| node.world.heard.of::<wire::Skeleton>(&topics.skeleton()));
        let bodies: Vec<_> = all.map(|(_, body)| body.to_core().unwrap()).collect();
        let saved = one.body.as_ref().map(|body| body.shape());
        assert!(bodies.iter().all(|body| Some(body.shape()) == saved), "{}", one.name);
        let poses = nodes.values().flat_map(|node| node.world.heard.of::<Pose>(&topics.pose()));
        let first = poses.map(|(time, _)| time).min().unwrap();
        assert!(first < at(0.9), "{} is published {first:?}", one.name);
    }
}

/// A solver is cut off for 2 s. The front counts what it has done once.
#[test]
fn a_solver_that_comes_back_is_not_counted_again() {
    let mut config = Config::default();
    config.stage.performers = "auto".parse().unwrap();
    config.stage.solve = false;
    let studio = performers(2, |one| {
        (one.fps, one.frames, one.start) = (60.0, 480, START);
    });
    let topic = Topics { actor: "a".into(), ..Topics::default() }.status();
    let status = |published: u64, seconds: f64| {
        let playout = Some(PlayoutCounters { published, ..PlayoutCounters::default() });
        let payload = encode(&Status { run_id: 7, playout, ..Status::default() });
        Sent { arrival: at(seconds), topic: topic.clone(), payload }
    };
    let mut sent = studio.messages();
    sent.extend([status(10, 3.0), status(15, 6.0)]);
    let mut world = World::new(&config);
    let solver = || vec!["a".to_owned()];
    for (solvers, until) in [(solver(), 3.5), (Vec::new(), 5.5), (solver(), 8.0)] {
        world.tell(Input::Solvers(solvers));
        let (now, later) = sent.into_iter().partition(|one: &Sent| one.arrival <= at(until));
        world.play(now, at(until));
        sent = later;
    }
    let counted = world.heard.of::<Status>(&Topics::default().status());
    let counted: BTreeSet<u64> =
        counted.into_iter().map(|(_, status)| status.playout.unwrap().published).collect();
    assert_eq!(counted.into_iter().collect::<Vec<_>>(), [0, 10, 15]);
}
