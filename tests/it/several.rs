//! Several performers live: the node's core in simulated time, with bad cameras, slates and returns.

use std::collections::{BTreeMap, BTreeSet};

use bundlemocap::config::Config;
use bundlemocap::core::body::Pose as CorePose;
use bundlemocap::core::detections::Detections;
use bundlemocap::core::stage::PerformerId;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::io::wire::{self, Event, KeypointFrame, Pose, TakeAnswer, Topics, encode};
use bundlemocap::research::synth::{Crowd, Meeting, Noise, Recording};

use crate::live::{START, Sent, Studio, World, at};
use crate::slate::{assert_agrees, from, recorded, replayed, slate};

/// Cameras around people who cross and meet.
pub struct Stage {
    pub studio: Studio,
    pub config: Config,
}

impl Stage {
    pub fn new(people: usize, cameras: usize, seconds: u64) -> Self {
        let meeting = Meeting { people, distance: Some(0.7) };
        let rig = meeting.rig(cameras).unwrap();
        let one = |person| {
            let (skeleton, motion) = meeting.person(person, 5);
            let motion = Box::new(motion) as Box<dyn Fn(f64) -> CorePose>;
            let mut one = Recording::new(rig.clone(), skeleton, motion);
            (one.frames, one.noise, one.start) = (60 * seconds, Noise::clean(), START);
            one
        };
        let crowd = Crowd::new((0..people).map(one).collect());
        let frames = crowd.detections().map(|(frame, _)| frame).collect();
        let mut config = Config::default();
        config.stage.performers = if people == 1 { "1" } else { "auto" }.parse().unwrap();
        Self { studio: Studio { rig, frames }, config }
    }

    /// The messages of all frames for which there is one.
    fn messages(&self, message: impl Fn(&Detections) -> Option<Sent>) -> Vec<Sent> {
        let frames = self.studio.frames.iter().filter_map(message);
        frames.chain([self.studio.rig()]).collect()
    }

    fn all(&self) -> Vec<Sent> {
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
    let answers: Vec<(Timestamp, TakeAnswer)> = world.heard.of(&Topics::default().take_answers());
    let refused = answers.iter().filter(|(_, answer)| answer.refused).count();
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
