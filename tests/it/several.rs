//! Several performers live: the node's core in simulated time, with bad cameras, slates and returns.

use std::collections::{BTreeMap, BTreeSet};

use bundlemocap::config::Config;
use bundlemocap::core::body::Pose as CorePose;
use bundlemocap::core::detections::Detections;
use bundlemocap::core::stage::PerformerId;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::io::recording::{known_people, write_body};
use bundlemocap::io::wire::{self, Event, KeypointFrame, Pose, Topics, TrackingState, encode};
use bundlemocap::live::{Recorded, people_of};
use bundlemocap::research::synth::{Crowd, Meeting, Noise, Recording};
use nalgebra::Vector3;

use crate::live::{START, Sent, Studio, World, at};
use crate::slate::{answers, assert_agrees, from, recorded, replayed, slate};

/// Of the bodies and steps.
const SEED: u64 = 5;

/// Cameras around people who cross and meet.
pub struct Stage {
    pub studio: Studio,
    /// By frame and person in it, whose detections they are.
    owners: Vec<Vec<usize>>,
    meeting: Meeting,
    pub config: Config,
}

impl Stage {
    pub fn new(people: usize, cameras: usize, seconds: u64) -> Self {
        Self::of_bodies((people, cameras), seconds, &Noise::clean(), |person| person)
    }

    /// `body`: whose body each has.
    fn of_bodies(
        (people, cameras): (usize, usize),
        seconds: u64,
        noise: &Noise,
        body: fn(usize) -> usize,
    ) -> Self {
        let meeting = Meeting { people, distance: Some(0.7) };
        let rig = meeting.rig(cameras).unwrap();
        let one = |person| {
            let motion = meeting.person(person, SEED).1;
            let skeleton = meeting.person(body(person), SEED).0;
            let motion = Box::new(motion) as Box<dyn Fn(f64) -> CorePose>;
            let mut one = Recording::new(rig.clone(), skeleton, motion);
            (one.frames, one.noise, one.start) = (60 * seconds, noise.clone(), START);
            one
        };
        let crowd = Crowd::new((0..people).map(one).collect());
        let (frames, owners) = crowd.detections().unzip();
        let mut config = Config::default();
        config.stage.performers = if people == 1 { "1" } else { "auto" }.parse().unwrap();
        Self { studio: Studio { rig, frames }, owners, meeting, config }
    }

    /// The messages of all frames for which there is one.
    fn messages(&self, message: impl Fn(&Detections) -> Option<Sent>) -> Vec<Sent> {
        let frames = self.studio.frames.iter().filter_map(message);
        frames.chain([self.studio.rig()]).collect()
    }

    pub fn all(&self) -> Vec<Sent> {
        self.messages(|frame| Some(self.studio.message(frame)))
    }

    fn play(&self, messages: Vec<Sent>, seconds: f64) -> World {
        let mut world = World::new(&self.config);
        world.play(messages, at(seconds));
        world
    }
}

fn topics(performer: usize) -> Topics {
    Topics { actor: PerformerId(performer).to_string(), ..Topics::default() }
}

fn poses(world: &World, performer: usize) -> Vec<(Timestamp, Pose)> {
    world.heard.of(&topics(performer).pose())
}

/// The longest time between two poses of a performer after a time, and the last one, seconds.
fn longest_gap(world: &World, performer: usize, after: f64) -> (f64, f64) {
    let captures = poses(world, performer).into_iter().map(|(_, pose)| pose.capture_time_ns);
    let seconds = captures.map(|ns| Timestamp::from_ns(ns).seconds_since(START));
    let late: Vec<f64> = seconds.filter(|seconds| *seconds >= after).collect();
    let gap = late.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max);
    (gap, late.last().copied().unwrap_or(0.0))
}

/// Number of events of a kind.
fn count(world: &World, kind: &str) -> u64 {
    let events = world.heard.status().events;
    events.iter().find(|event| event.kind == kind).map_or(0, |event| event.count)
}

/// Kinds of the events that concern cameras, with the camera.
fn of_cameras(world: &World, after: f64) -> BTreeSet<(String, Option<String>)> {
    let events: Vec<(Timestamp, Event)> = world.heard.of(&Topics::default().stage_events());
    let late = events.into_iter().filter(|(time, _)| *time >= at(after));
    late.map(|(_, event)| (event.kind, event.camera)).collect()
}

#[test]
fn everybody_has_each_pose_once_at_one_latency() {
    let stage = Stage::new(4, 4, 6);
    let world = stage.play(stage.all(), 6.0);
    let mut latencies = BTreeSet::new();
    let mut phases = BTreeSet::new();
    for performer in 0..4 {
        let poses = poses(&world, performer);
        assert!(poses.len() > 280, "p{}: {}", performer + 1, poses.len());
        for (time, pose) in &poses {
            let latency = Nanos::new(pose.declared_latency_ns as i64);
            assert_eq!(*time - Timestamp::from_ns(pose.capture_time_ns), latency);
            latencies.insert(latency);
        }
        let steps = poses.windows(2).map(|p| p[1].1.capture_time_ns - p[0].1.capture_time_ns);
        assert!(steps.clone().all(|step| (step - 16_666_667).abs() <= 1), "{:?}", steps.max());
        let window = poses.windows(2).find(|p| p[1].1.window > p[0].1.window).unwrap();
        phases.insert((window[1].1.capture_time_ns - START.ns()) / 16_666_667 % 5);
    }
    assert_eq!(latencies.len(), 1, "{latencies:?}");
    assert!(*latencies.first().unwrap() <= Nanos::from_ms(200), "{latencies:?}");
    assert!(phases.len() > 1, "windows end at different frames: {phases:?}");
    let status = world.heard.status();
    let playout = status.playout.unwrap();
    assert_eq!((playout.coasted, playout.missed, status.effort.unwrap().level), (0, 0, 0));
    let entered = status.events.iter().find(|event| event.kind == "entered").unwrap();
    assert_eq!((status.tracker_state.as_str(), entered.count), ("tracking", 4));
    // What concerns everybody is said once.
    for kind in ["latency", "calibrated", "rig_changed"] {
        let count = status.events.iter().find(|event| event.kind == kind).unwrap().count;
        assert_eq!(count, 1, "{kind}");
    }
}

/// A camera that is wrong from second 3 on: everybody goes on within a second, it is named, and the
/// events are those of one performer.
#[test]
fn one_bad_camera_stops_nobody() {
    type Fault = fn(&Stage, &Detections) -> Option<Sent>;
    let faults: [(&str, &str, Fault); 4] = [
        ("its clock is 0.5 s ahead", "clock_offset", |stage, frame| {
            let mut sent = frame.clone();
            sent.capture = sent.capture + Nanos::from_ms(500);
            let arrival = stage.studio.message(frame).arrival;
            Some(Sent { arrival, ..stage.studio.message(&sent) })
        }),
        ("half size", "unusable", |stage, frame| {
            let camera = &stage.studio.rig.cameras[frame.camera];
            let size = [camera.width / 2, camera.height / 2];
            let message = KeypointFrame::from_core(frame, &camera.name, size);
            Some(Sent { payload: encode(&message), ..stage.studio.message(frame) })
        }),
        ("broken messages", "unusable", |stage, frame| {
            Some(Sent { payload: vec![0xff; 40], ..stage.studio.message(frame) })
        }),
        ("gone", "silent", |_, _| None),
    ];
    for (name, kind, fault) in faults {
        let mut kinds = BTreeMap::new();
        for people in [1, 4] {
            let stage = Stage::new(people, 5, 6);
            let messages = stage.messages(|frame| {
                let is_wrong = frame.camera == 2 && frame.capture >= at(3.0);
                if is_wrong { fault(&stage, frame) } else { Some(stage.studio.message(frame)) }
            });
            let world = stage.play(messages, 6.0);
            let found = of_cameras(&world, 3.0);
            let camera = Some(stage.studio.rig.cameras[2].name.clone());
            assert!(found.contains(&(kind.to_owned(), camera.clone())), "{name}: {found:?}");
            assert!(found.iter().all(|(_, of)| of.is_none() || *of == camera), "{name}: {found:?}");
            for performer in (0..people).filter(|_| people > 1) {
                let (gap, last) = longest_gap(&world, performer, 4.0);
                assert!(gap < 0.1 && last > 5.5, "{name}, p{}: {gap}, {last}", performer + 1);
            }
            kinds.insert(people, found);
        }
        assert_eq!(kinds[&1], kinds[&4], "{name}");
    }
}

#[test]
fn a_take_of_several_replays_to_the_same_bytes() {
    let stage = Stage::new(3, 4, 9);
    // The third performer enters during the take.
    let mut frames = stage.studio.frames.clone();
    let hidden = |frame: &&mut Detections| frame.capture < at(5.0);
    for frame in frames.iter_mut().filter(hidden) {
        frame.people.truncate(2);
    }
    let messages = frames.iter().map(|frame| stage.studio.message(frame));
    let slates = [slate("start", "fight", 3.0), slate("stop", "", 8.0)];
    let messages: Vec<Sent> = messages.chain([stage.studio.rig()]).chain(slates).collect();
    let (world, recorded) = recorded(World::new(&stage.config), messages, 9.0);
    let answers = answers(&world);
    let refused = answers.iter().filter(|(refused, _)| *refused).count();
    assert_eq!((answers.len(), refused), (2, 0), "{answers:?}");

    let take = replayed(&from(&recorded, 3.0), Some("fight")).unwrap();
    assert_agrees(&take);
    assert!(take.is_whole && take.gap.is_none());
    assert!(take.start.performers.len() >= 2, "{:?}", take.start.performers);
    for performer in 0..2 {
        let compared = &take.topics[&topics(performer).pose()];
        assert!(compared.equal == compared.recorded && compared.equal > 200, "{compared:?}");
        // The names hold over the beginning of the take.
        let poses = poses(&world, performer);
        let place = |seconds: f64| {
            let near = poses
                .iter()
                .min_by_key(|(_, pose)| (pose.capture_time_ns - at(seconds).ns()).abs());
            near.unwrap().1.joint_positions().unwrap()[0]
        };
        let step = (place(2.9) - place(3.7)).norm();
        assert!(step < 1.5, "p{} moved by {step} m", performer + 1);
    }
}

#[test]
fn who_comes_back_has_the_old_name() {
    let stage = Stage::new(2, 4, 12);
    let mut frames = stage.studio.frames.clone();
    // Nobody is in view for a while.
    let away = frames.iter_mut().filter(|f| f.capture >= at(5.0) && f.capture < at(7.0));
    away.for_each(|frame| frame.people.clear());
    let messages = frames.iter().map(|frame| stage.studio.message(frame));
    let world = stage.play(messages.chain([stage.studio.rig()]).collect(), 12.0);
    assert_eq!((count(&world, "entered"), count(&world, "reentered")), (2, 2));
    for performer in 0..2 {
        let (gap, last) = longest_gap(&world, performer, 8.5);
        assert!(gap < 0.02 && last > 11.5, "p{}: {gap}, {last}", performer + 1);
    }
}

#[test]
fn a_new_calibration_holds_for_everybody() {
    let stage = Stage::new(2, 4, 8);
    let mut messages = stage.all();
    let mut rig = stage.studio.rig.clone();
    rig.version += 1;
    let payload = encode(&wire::Rig::from_core(&rig));
    messages.push(Sent { arrival: at(4.0), topic: Topics::default().rig(), payload });
    let world = stage.play(messages, 8.0);
    for performer in 0..2 {
        let (gap, last) = longest_gap(&world, performer, 3.0);
        assert!(gap < 0.02 && last > 7.5, "p{}: {gap}, {last}", performer + 1);
        let (_, pose) = poses(&world, performer).pop().unwrap();
        assert_eq!(pose.rig_version, rig.version);
    }
    assert_eq!(world.heard.details("calibrated").len(), 2);
    assert_eq!((count(&world, "entered"), count(&world, "reentered")), (2, 0));
}

#[test]
fn who_is_in_a_world_with_another_origin_keeps_the_name() {
    let stage = Stage::new(2, 4, 9);
    let mut messages = stage.all();
    let mut rig = stage.studio.rig.clone();
    rig.version += 1;
    for camera in &mut rig.cameras {
        camera.translation -= camera.rotation * nalgebra::Vector3::new(0.8, 0.0, 0.0);
    }
    let payload = encode(&wire::Rig::from_core(&rig));
    messages.push(Sent { arrival: at(4.0), topic: Topics::default().rig(), payload });
    let world = stage.play(messages, 9.0);
    assert_eq!((count(&world, "entered"), count(&world, "reentered")), (2, 2));
    for performer in 0..2 {
        let (gap, last) = longest_gap(&world, performer, 6.0);
        assert!(gap < 0.02 && last > 8.5, "p{}: {gap}, {last}", performer + 1);
    }
}

#[test]
fn bodies_that_are_forgotten_are_estimated_again_and_everybody_keeps_the_name() {
    let stage = Stage::new(2, 4, 8);
    let reset = wire::Take { action: "reset".to_owned(), ..wire::Take::default() };
    let payload = encode(&reset);
    let mut messages = stage.all();
    messages.push(Sent { arrival: at(4.0), topic: Topics::default().take(), payload });
    let lock = wire::Take { action: "lock".to_owned(), name: "p2".to_owned(), ..reset };
    let payload = encode(&lock);
    messages.push(Sent { arrival: at(3.9), topic: Topics::default().take(), payload });
    let world = stage.play(messages, 8.0);
    for performer in 0..2 {
        let (gap, last) = longest_gap(&world, performer, 3.5);
        assert!(last > 7.5, "p{}: {last}", performer + 1);
        // Who is locked goes on.
        assert_eq!(gap < 0.02, performer == 1, "p{}: {gap}", performer + 1);
    }
    assert_eq!((count(&world, "entered"), count(&world, "reentered")), (2, 0));
}

/// The camera whose frames come last sends every second one for a second, and then all of them again.
#[test]
fn a_camera_that_was_slow_for_a_moment_is_waited_for_again() {
    let stage = Stage::new(3, 4, 10);
    let messages = stage.messages(|frame| {
        let is_last = frame.camera == 3;
        let is_slow = (at(3.0)..at(4.0)).contains(&frame.capture) && frame.frame % 2 == 1;
        let mut sent = stage.studio.message(frame);
        sent.arrival = sent.arrival + if is_last { Nanos::from_ms(8) } else { Nanos::ZERO };
        (!is_last || !is_slow).then_some(sent)
    });
    let world = stage.play(messages, 10.0);
    let statuses = world.heard.of::<wire::Status>(&Topics::default().status());
    let camera = &statuses.last().unwrap().1.cameras[3];
    println!("{} used, {} late, {} missing", camera.used, camera.late, camera.missing);
    assert!(camera.used > 520 && camera.late < 40, "of 570: {} and {}", camera.used, camera.late);
    // The frames that came late are not missing too.
    assert!((20..=31).contains(&camera.missing), "{} of 30", camera.missing);
}

/// People of one build: only their places tell who is who when takes begin and the clock steps.
#[test]
fn twins_keep_their_names_when_everybody_is_lost_for_a_moment() {
    for (people, cameras) in [(3, 4), (5, 6)] {
        twins(Stage::of_bodies((people, cameras), 10, &Noise::studio(), |_| 0));
    }
}

fn twins(mut stage: Stage) {
    let people = stage.meeting.people;
    for frame in stage.studio.frames.iter_mut().filter(|frame| frame.capture >= at(7.0)) {
        frame.capture = frame.capture - Nanos::from_ms(500);
    }
    let mut messages = stage.all();
    messages.extend([slate("start", "one", 3.0), slate("start", "two", 5.0)]);
    let world = stage.play(messages, 9.0);
    let mut all = BTreeSet::new();
    for number in 1..=people {
        let name = &*format!("p{number}");
        let poses = poses_of(&world, name, [0.0, 9.0]);
        let early = poses.into_iter().filter(|pose| pose.capture_time_ns < at(6.4).ns());
        let (person, off) = nearest_person(&stage, early);
        println!("{name} is person {person}, {off:.2} m");
        assert!(all.insert(person) && off < 0.4, "{name} {person} {off}");
    }
    // In the last take.
    assert_eq!(count(&world, "entered"), 0);
}

/// The cameras' common clock steps back by 10 s: everybody goes on within a few seconds.
#[test]
fn a_clock_that_steps_back_stops_nobody() {
    let stage = Stage::new(2, 4, 10);
    let messages = stage.messages(|frame| {
        let sent = stage.studio.message(frame);
        let mut stepped = frame.clone();
        if frame.capture >= at(4.0) {
            stepped.capture = frame.capture - Nanos::SECOND * 10;
        }
        Some(Sent { arrival: sent.arrival, ..stage.studio.message(&stepped) })
    });
    let world = stage.play(messages, 10.0);
    for performer in 0..2 {
        let late = poses(&world, performer).into_iter().filter(|(time, _)| *time >= at(8.0));
        let count = late.count();
        assert!(count > 100, "p{}: {count} poses in the last 2 s", performer + 1);
    }
}

/// A command with what only some of them need.
fn order(take: wire::Take, seconds: f64) -> Sent {
    let payload = encode(&take);
    Sent { arrival: at(seconds), topic: Topics::default().take(), payload }
}

fn name(from: &str, to: &str, seconds: f64) -> Sent {
    let (action, name, new_name) = ("name".into(), from.into(), to.into());
    order(wire::Take { action, name, new_name, ..wire::Take::default() }, seconds)
}

fn follow(place_m: Vec<f64>, seconds: f64) -> Sent {
    order(wire::Take { action: "follow".into(), place_m, ..wire::Take::default() }, seconds)
}

/// The poses of a name, from the first time to the second, seconds.
fn poses_of(world: &World, name: &str, [from, to]: [f64; 2]) -> Vec<Pose> {
    let topics = Topics { actor: name.to_owned(), ..Topics::default() };
    let poses = world.heard.of::<Pose>(&topics.pose()).into_iter().map(|(_, pose)| pose);
    let span = at(from).ns()..at(to).ns();
    poses.filter(|pose| span.contains(&pose.capture_time_ns)).collect()
}

/// The last status of the stage up to a time, seconds.
fn status_of_stage(world: &World, until: f64) -> wire::StageStatus {
    let all = world.heard.of::<wire::StageStatus>(&Topics::default().stage_status());
    all.into_iter().rfind(|(time, _)| *time <= at(until)).unwrap().1
}

/// Name and life of everybody.
fn lives(status: &wire::StageStatus) -> Vec<(&str, &str)> {
    status.performers.iter().map(|one| (one.name.as_str(), one.life.as_str())).collect()
}

/// Names by the settings and by commands; one is dropped, and followed again after a take has begun.
#[test]
fn performers_are_named_dropped_and_followed() {
    let mut stage = Stage::new(3, 4, 11);
    stage.config.stage.names = vec!["lead".into()];
    // Where the third one is when somebody points at it.
    let before = stage.play(stage.all(), 9.0);
    let pose = poses_of(&before, "p3", [8.0, 8.02]).remove(0);
    let place = vec![pose.root_position_m[0], pose.root_position_m[2]];

    let mut messages = stage.all();
    messages.extend([
        name("p2", "double", 2.0),
        name("p3", "lead", 2.1),
        name("p3", "p1", 2.2),
        name("p7", "extra", 2.3),
        slate("drop", "p3", 3.0),
        slate("drop", "p3", 3.1),
        slate("start", "fight", 5.0),
        follow(vec![40.0, 0.0], 7.9),
        follow(place.clone(), 8.0),
        follow(place, 9.5),
        slate("reset", "double", 9.6),
    ]);
    let (world, recorded) = recorded(World::new(&stage.config), messages, 11.0);
    let answers = answers(&world);
    let refused: Vec<bool> = answers.iter().map(|answer| answer.0).collect();
    let expected = [false, true, true, true, false, true, false, true, false, true, false];
    assert_eq!(refused, expected, "{answers:?}");
    for (at, what) in
        [(1, "lead"), (3, "lead, double, p3"), (5, "not here"), (7, "nobody"), (9, "p3")]
    {
        assert!(answers[at].1.contains(what), "{what} is not in {:?}", answers[at]);
    }

    let first = status_of_stage(&world, 1.9);
    let all = [("lead", "confirmed"), ("p2", "confirmed"), ("p3", "confirmed")];
    assert_eq!((lives(&first), first.others, first.places), (all.to_vec(), 0, 32));
    let one = &first.performers[0];
    assert_eq!(
        (one.tracker_state.as_str(), one.solver.as_str(), one.views),
        ("tracking", "actor", 4)
    );
    assert!(one.residual_px > 0.0 && one.unseen_s < 0.2 && one.place_m.len() == 2, "{one:?}");
    let dropped = status_of_stage(&world, 7.5);
    let all = [("lead", "confirmed"), ("double", "confirmed"), ("p3", "left")];
    assert_eq!((lives(&dropped), dropped.others), (all.to_vec(), 1));
    let followed = status_of_stage(&world, 11.0);
    let all = [("lead", "confirmed"), ("double", "confirmed"), ("p3", "confirmed")];
    assert_eq!((lives(&followed), followed.others), (all.to_vec(), 0));

    let count = |name: &str, span: [f64; 2]| poses_of(&world, name, span).len();
    assert!(count("p2", [1.0, 2.0]) > 30 && count("p2", [2.1, 11.0]) == 0);
    assert!(count("double", [2.1, 5.0]) > 160 && count("double", [6.0, 9.4]) > 190);
    assert!(count("p3", [2.0, 2.9]) > 50 && count("p3", [3.1, 8.0]) == 0);
    assert!(count("p3", [8.6, 10.5]) > 110, "{}", count("p3", [8.6, 10.5]));
    // Who is called something else keeps the body, on the topic of the new name.
    let double = Topics { actor: "double".into(), ..Topics::default() };
    let bodies = world.heard.of::<wire::Skeleton>(&double.skeleton());
    assert!(bodies[0].0 <= at(2.01), "{:?}", bodies[0].0);

    let take = replayed(&from(&recorded, 5.0), Some("fight")).unwrap();
    assert_agrees(&take);
    let known: Vec<(&str, bool)> =
        take.start.performers.iter().map(|one| (one.name.as_str(), one.dropped)).collect();
    assert_eq!(known, [("lead", false), ("double", false), ("", true)]);
    assert!(take.topics[&Topics::default().stage_status()].equal > 5);
}

#[test]
fn the_body_of_a_name_given_by_mistake_is_not_kept() {
    let mut stage = Stage::new(2, 4, 13);
    stage.config.stage.bodies = "bodies".into();
    let messages = |from: f64, to: f64, names: [&str; 2]| {
        let mut messages = stage.all();
        messages.retain(|message| (at(from)..at(to)).contains(&message.arrival));
        messages.push(name(names[0], names[1], to - 0.5));
        messages
    };
    let mut world = World::new(&stage.config);
    for (from, to, names) in [(-1.0, 12.0, ["p2", "duble"]), (12.0, 13.0, ["duble", "double"])] {
        world.play(messages(from, to, names), at(to));
        assert_eq!(world.bodies.keys().collect::<Vec<_>>(), [names[1]]);
    }
}

/// The second one leaves; a third one comes, and has its number if it had no name.
#[test]
fn a_number_is_somebody_elses_when_a_performer_without_a_name_has_left() {
    for has_name in [false, true] {
        let mut stage = Stage::new(3, 4, 10);
        stage.config.stage.performers = "2".parse().unwrap();
        stage.config.stage.left_after_s = 1.0;
        for (frame, owners) in stage.studio.frames.iter_mut().zip(&stage.owners) {
            let away = if frame.capture < at(4.0) { 2 } else { 1 };
            let mut owners = owners.iter();
            frame.people.retain(|_| owners.next() != Some(&away));
        }
        let mut messages = stage.all();
        let mut label = slate("lock", "p2", 2.0);
        if has_name {
            label = name("p2", "double", 2.0);
        }
        messages.push(label);
        let world = stage.play(messages, 10.0);
        let kinds = ["entered", "vacated", "reentered"].map(|kind| count(&world, kind));
        assert_eq!(kinds, [3, 1, 0]);
        let new = if has_name { "p3" } else { "p2" };
        let mut poses = poses_of(&world, new, [4.1, 10.0]);
        poses.retain(|pose| pose.state() == TrackingState::Tracking);
        let begin = Timestamp::from_ns(poses[0].capture_time_ns).seconds_since(START);
        assert!(
            (5.0..6.0).contains(&begin) && poses.len() > 220,
            "{new}: {begin}, {}",
            poses.len()
        );
        // It is at the place of the third one, with a body of its own.
        let status = status_of_stage(&world, 10.0);
        let expected = if has_name { vec!["p1", "double", "p3"] } else { vec!["p1", "p2"] };
        let names: Vec<&str> = status.performers.iter().map(|one| one.name.as_str()).collect();
        assert_eq!((names, status.performers[0].life.as_str()), (expected, "confirmed"));
        let topics = Topics { actor: new.to_owned(), ..Topics::default() };
        let of_new = world.heard.of::<wire::Skeleton>(&topics.skeleton());
        let shape = |from: f64, to: f64| {
            let mut within = of_new.iter().filter(|(time, _)| (at(from)..at(to)).contains(time));
            within.next_back().map(|(_, body)| body.shape[0])
        };
        let (first, last) = (shape(0.0, 4.0), shape(4.0, 11.0).unwrap());
        assert!(first.is_none_or(|first| (first - last).abs() > 0.3), "{first:?}, {last}");
        let label = status.performers.last().unwrap().label.clone().unwrap_or_default();
        assert!(!label.locked, "the label was of who has left");
    }
}

/// The person who is where a name has its poses, a few seconds in, and how far they are from one another, metres.
fn person_of(world: &World, stage: &Stage, name: &str) -> (usize, f64) {
    let poses = poses_of(world, name, [0.0, 9.0]);
    assert!(poses.len() > 100, "{name}: {} poses", poses.len());
    nearest_person(stage, poses.into_iter())
}

fn nearest_person(stage: &Stage, poses: impl Iterator<Item = Pose>) -> (usize, f64) {
    let poses: Vec<Pose> = poses.collect();
    let off = |person: usize| {
        let motion = stage.meeting.person(person, SEED).1;
        let off = poses.iter().map(|pose| {
            let seconds = Timestamp::from_ns(pose.capture_time_ns).seconds_since(START);
            let root = Vector3::from_column_slice(&pose.root_position_m);
            (root - motion(seconds).root_position).norm()
        });
        off.fold(0.0, f64::max)
    };
    let all = (0..stage.meeting.people).map(|person| (person, off(person)));
    all.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap()
}

/// Three people have names. Another day they are there with a fourth one.
#[test]
fn people_are_known_again_by_their_bodies() {
    let mut first = Stage::new(3, 4, 12);
    first.config.stage.names = ["lead", "double", "extra"].map(String::from).to_vec();
    first.config.stage.bodies = "bodies".into();
    let mut world = first.play(first.all(), 12.0);
    world.end();
    let names: Vec<&String> = world.bodies.keys().collect();
    assert_eq!(names, ["double", "extra", "lead"]);
    let person = |name: &str| person_of(&world, &first, name).0;
    let people = ["double", "extra", "lead"].map(person);

    let folder = tempfile::tempdir().unwrap();
    for (name, body) in &world.bodies {
        write_body(folder.path(), name, body, false).unwrap();
    }
    let known = known_people(folder.path(), "actor", &["lead".into()]).unwrap();
    assert_eq!(known.iter().map(|one| &one.name).collect::<Vec<_>>(), names);
    let error = known_people(folder.path(), "actor", &["ghost".into()]).unwrap_err().to_string();
    assert!(error.contains("ghost") && error.contains("double, extra, lead"), "{error}");

    let second = Stage::new(4, 4, 6);
    let (world, heard) = recorded(World::knowing(&second.config, known.clone()), second.all(), 6.0);
    let replay = replayed(&heard, None).unwrap();
    assert_agrees(&replay);
    assert!(replay.is_whole && replay.start.performers.len() == 3);
    for (name, person) in ["double", "extra", "lead"].into_iter().zip(people) {
        let (found, off) = person_of(&world, &second, name);
        assert!(found == person && off < 0.1, "{name}: {found} is not {person}, {off} m");
        let begin = poses_of(&world, name, [0.0, 6.0])[0].capture_time_ns;
        assert!(begin < at(0.5).ns(), "{name}: {begin}");
    }
    assert_eq!(person_of(&world, &second, "p4").0, 3);

    // Only two of them are to be performers; a take begins, somebody points at the stranger, and nobody is in view for
    // a while.
    let place = second.meeting.person(3, SEED).1(4.0).root_position;
    let mut only = Stage::new(4, 4, 10);
    only.config.stage.only = vec!["double".into(), "lead".into()];
    only.config.stage.bodies = "bodies".into();
    let away = |frame: &&mut Detections| (at(6.0)..at(7.5)).contains(&frame.capture);
    only.studio.frames.iter_mut().filter(away).for_each(|frame| frame.people.clear());
    let mut messages = only.all();
    messages.extend([slate("start", "fight", 2.0), follow(vec![place.x, place.z], 4.0)]);
    let mut world = World::knowing(&only.config, known);
    world.play(messages, at(10.0));
    let [before, take, end] = [1.9, 3.9, 9.9].map(|seconds| status_of_stage(&world, seconds));
    for status in [before, take] {
        assert_eq!(lives(&status), [("double", "confirmed"), ("lead", "confirmed")]);
        assert_eq!(status.others, 2);
    }
    let all = [("double", "confirmed"), ("lead", "confirmed"), ("p4", "confirmed")];
    assert_eq!((lives(&end), end.others), (all.to_vec(), 1));
}

/// Killed, so its journal has no end.
#[test]
fn a_node_that_was_started_again_in_a_take_is_told() {
    let stage = Stage::new(1, 4, 6);
    let mut messages = stage.all();
    messages.push(slate("start", "walk", 1.0));
    let mut recorded = Vec::new();
    for (from, to) in [(-1.0, 3.0), (3.0, 6.0)] {
        let span = at(from)..at(to);
        let sent = messages.iter().filter(|message| span.contains(&message.arrival)).cloned();
        let sent: Vec<Sent> = sent.collect();
        let mut world = World::new(&stage.config);
        world.play(sent.clone(), at(to));
        recorded.extend(world.heard.messages.clone());
        recorded.extend(sent.into_iter().map(Recorded::from));
        let take = replayed(&recorded, Some("walk")).unwrap();
        assert_eq!((take.is_whole, take.others.len()), (false, usize::from(from > 0.0)));
    }
}

#[test]
fn one_node_tells_who_is_on_the_stage() {
    let stage = Stage::new(1, 4, 3);
    let world = stage.play(stage.all(), 3.0);
    let status = status_of_stage(&world, 3.0);
    assert_eq!((lives(&status), status.places), (vec![("actor", "confirmed")], 1));
}

/// Another node knows the performers from the last status: by their bodies and places, with their names.
#[test]
fn a_standby_goes_on_with_the_performers() {
    let mut stage = Stage::new(4, 4, 8);
    stage.config.stage.names = vec!["lead".into()];
    let (first, mut second): (Vec<_>, Vec<_>) =
        stage.all().into_iter().partition(|message| message.arrival < at(4.0));
    second.retain(|message| message.arrival > at(4.7));
    second.push(Sent { arrival: at(4.6), ..stage.studio.rig() });
    let one = stage.play(first, 4.0);
    let known = people_of(&status_of_stage(&one, 4.0), "actor");
    let mut other = World::knowing(&stage.config, known);
    other.play(second, at(8.0));
    let all = ["lead", "p2", "p3", "p4"];
    assert_eq!(lives(&status_of_stage(&other, 8.0)), all.map(|name| (name, "confirmed")));
    for name in all {
        let [before, after] = [&one, &other].map(|world| person_of(world, &stage, name).0);
        assert_eq!(before, after, "{name}");
        let topics = Topics { actor: name.to_owned(), ..Topics::default() };
        let first = other.heard.of::<Pose>(&topics.pose())[0].0;
        assert!(first < at(5.7), "{name}: {first:?}");
    }
}
