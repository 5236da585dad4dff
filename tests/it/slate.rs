//! Takes of the node's core in simulated time: a journal for each, replays, a new performer.

use bundlemocap::config::Config;
use bundlemocap::core::body::{self, Joint, Shape};
use bundlemocap::core::manifold::Decoder;
use bundlemocap::core::time::Nanos;
use bundlemocap::core::tracker::Solver;
use bundlemocap::io::wire::{
    self, Event, PerformerLabel, Skeleton, Status, Take, TakeAnswer, Topics, TrackingState, decode,
    encode,
};
use bundlemocap::live::{
    Carried, Core, Input, MOST_BYTES, MOST_ORDER_BYTES, Recorded, ReplayError, Replayed, Settings,
    replay,
};
use bundlemocap::research::synth::{Motion, MotionStyle, Noise, Recording, ring_rig};

use crate::live::{Sent, Studio, World, at, settings};

/// A command, `at` seconds after the start.
pub fn slate(action: &str, name: &str, seconds: f64) -> Sent {
    let take = Take { id: 7, action: action.into(), name: name.into(), ..Take::default() };
    Sent { arrival: at(seconds), topic: Topics::default().take(), payload: encode(&take) }
}

/// A session of that many seconds with those commands, and all its messages.
fn session(seconds: u64, slates: Vec<Sent>) -> (World, Vec<Recorded>) {
    let mut messages = Studio::new(4, 60 * seconds).messages();
    messages.extend(slates);
    recorded(World::new(&Config::default()), messages, seconds as f64)
}

/// What was answered to the commands: whether they were refused, and why or what was done.
pub fn answers(world: &World) -> Vec<(bool, String)> {
    let answers = world.heard.of::<TakeAnswer>(&Topics::default().take_answers());
    answers.into_iter().map(|(_, answer)| (answer.refused, answer.text)).collect()
}

/// The world after these messages and its end, and what a recorder has.
pub fn recorded(mut world: World, messages: Vec<Sent>, seconds: f64) -> (World, Vec<Recorded>) {
    world.play(messages.clone(), at(seconds));
    world.end();
    let mut recorded = world.heard.messages.clone();
    recorded.extend(messages.into_iter().map(Recorded::from));
    (world, recorded)
}

pub fn replayed(recorded: &[Recorded], run: Option<&str>) -> Result<Replayed, ReplayError> {
    replayed_as(recorded, &Topics::default(), run)
}

/// A run of the node with these topics.
pub fn replayed_as(
    recorded: &[Recorded],
    topics: &Topics,
    run: Option<&str>,
) -> Result<Replayed, ReplayError> {
    replay(recorded, topics, run, |start| {
        let decoder = Decoder::embedded().unwrap();
        let config = Config::parse(&start.config, "journal".as_ref()).unwrap();
        let (body, carried) = (start.body.clone(), Carried::of(start));
        let solver = Solver::new(decoder.clone(), config.tracker);
        Ok((Settings { body, carried, ..settings(&config, &decoder) }, solver))
    })
}

pub fn assert_agrees(replayed: &Replayed) {
    for (topic, compared) in &replayed.topics {
        assert!(compared.agrees() && compared.equal > 0, "{topic}: {compared:?}");
    }
    assert!(replayed.topics.len() >= 7, "{:?}", replayed.topics.keys());
}

/// What a recorder has that began with the take.
pub fn from(recorded: &[Recorded], seconds: f64) -> Vec<Recorded> {
    recorded.iter().filter(|message| message.time >= at(seconds)).cloned().collect()
}

#[test]
fn each_take_has_a_journal_that_needs_nothing_of_the_time_before() {
    let slates =
        vec![slate("start", "walk", 3.0), slate("stop", "", 5.0), slate("start", "run", 6.0)];
    let (world, recorded) = session(8, slates);
    let answers = answers(&world);
    let texts: Vec<&str> = answers.iter().map(|(_, text)| text.as_str()).collect();
    assert_eq!(
        texts,
        ["actor: take walk begins", "actor: take walk ended", "actor: take run begins"]
    );
    let error = replayed(&recorded, None).unwrap_err().to_string();
    assert!(error.contains("(take walk)") && error.contains("(take run)"), "{error}");

    let walk = replayed(&from(&recorded, 3.0), Some("walk")).unwrap();
    assert_agrees(&walk);
    assert!(walk.is_whole && walk.gap.is_none());
    assert_eq!((walk.start.take.as_str(), walk.start.latency_ns), ("walk", 180_000_000));
    let poses = &walk.topics[&Topics::default().pose()];
    assert!(poses.equal == poses.recorded && poses.equal > 100, "{poses:?}");
    // The rig of the take came before the take.
    assert!(walk.start.rig.is_some());

    let run = replayed(&from(&recorded, 6.0), None).unwrap();
    assert_agrees(&run);
    assert_ne!(run.start.run_id, walk.start.run_id);
}

#[test]
fn a_status_tells_what_a_check_found_until_there_is_another_calibration() {
    let judged = |camera: &str, words: &str, seconds: f64| {
        let (action, name, note) = ("verdict".into(), camera.into(), words.into());
        let take = Take { action, name, note, ..Take::default() };
        Sent { arrival: at(seconds), topic: Topics::default().take(), payload: encode(&take) }
    };
    let mut rig = Studio::new(4, 1).rig();
    let mut other: wire::Rig = decode(&rig.payload).unwrap();
    // The camera has its pose, and another lens.
    (other.version, other.cameras[1].focal_px[0]) = (2, other.cameras[1].focal_px[0] + 50.0);
    (rig.arrival, rig.payload) = (at(6.2), encode(&other));
    // A status comes at the middle of each second.
    let sent = vec![
        judged("cam02", "turned by 3 degrees", 2.2),
        judged("cam03", "mirrored", 2.2),
        judged("cam9", "not in the calibration", 2.2),
        judged("", "in millimetres", 3.2),
        judged("cam03", "", 4.2),
        slate("start", "walk", 4.7),
        rig,
    ];
    let (world, recorded) = session(8, sent);
    let all = world.heard.of::<Status>(&Topics::default().status());
    let told = |seconds: f64| {
        let (_, status) = all.iter().rev().find(|(time, _)| *time <= at(seconds)).unwrap();
        let of_cameras = status.cameras.iter().map(|camera| camera.verdict.as_str());
        let all: Vec<&str> = of_cameras.chain([status.verdict.as_str()]).collect();
        <[&str; 5]>::try_from(all).unwrap()
    };
    let turned = "turned by 3 degrees";
    assert_eq!(told(2.1), [""; 5]);
    assert_eq!(told(3.0), ["", turned, "mirrored", "", ""]);
    assert_eq!(told(6.0), ["", turned, "", "", "in millimetres"]);
    assert_eq!(told(8.0), [""; 5]);
    assert_eq!(answers(&world).len(), 1, "{:?}", answers(&world));
    let take = replayed(&from(&recorded, 4.7), Some("walk")).unwrap();
    assert_eq!((&*take.start.verdicts[1], &*take.start.verdict), (turned, "in millimetres"));
    assert_agrees(&take);
    let before: Vec<_> = recorded.into_iter().filter(|one| one.time < at(4.6)).collect();
    assert_agrees(&replayed(&before, None).unwrap());
}

/// The node is killed during the take, or ends in order, and another one goes on.
#[test]
fn a_node_that_starts_during_a_take_takes_part() {
    for in_order in [false, true] {
        let studio = Studio::new(4, 480);
        let (first, mut second): (Vec<_>, Vec<_>) =
            studio.messages().into_iter().partition(|message| message.arrival < at(4.0));
        let first: Vec<Sent> = first.into_iter().chain([slate("start", "walk", 1.0)]).collect();
        second.push(Sent { arrival: at(4.0), ..studio.rig() });
        second.extend([slate("join", "walk", 5.0), slate("join", "run", 6.0)]);
        second.extend([slate("stop", "", 7.0), slate("start", "walk", 7.5)]);
        let mut world = World::new(&Config::default());
        world.play(first.clone(), at(4.0));
        if in_order {
            world.end();
        }
        let mut other = World::new(&Config::default());
        other.play(second.clone(), at(8.0));
        other.end();
        assert_eq!(other.heard.status().take, "walk");
        let refused: Vec<bool> = answers(&other).into_iter().map(|(refused, _)| refused).collect();
        assert_eq!(refused, [false, true, false, false]);

        let outputs = [world, other].map(|world| world.heard.messages);
        let inputs = first.into_iter().chain(second).map(Recorded::from);
        let recorded: Vec<Recorded> = outputs.into_iter().flatten().chain(inputs).collect();
        let error = replayed(&recorded, Some("walk")).unwrap_err().to_string();
        assert!(error.contains("--run"), "another take is called alike: {error}");
        let until = |seconds: f64| -> Vec<Recorded> {
            recorded.iter().filter(|message| message.time < at(seconds)).cloned().collect()
        };
        let take = until(7.4);
        let walk = replayed(&take, Some("walk")).unwrap();
        assert_agrees(&walk);
        let [other] = &walk.others[..] else { panic!("{:?}", walk.others) };
        let rest = replayed(&take, Some(other)).unwrap();
        assert_agrees(&rest);
        assert_eq!(rest.others, [""; 0]);
        assert_eq!((walk.is_whole, rest.is_whole), (in_order, true));
    }
}

#[test]
fn a_replay_goes_up_to_the_first_input_that_was_lost() {
    let (_, recorded) = session(4, Vec::new());
    let mut lossy = recorded.clone();
    let lost = lossy.iter().position(|m| m.topic.ends_with("keypoints") && m.time > at(2.5));
    let lost = lossy.remove(lost.unwrap());
    let cut = replayed(&lossy, None).unwrap();
    assert_agrees(&cut);
    let gap = cut.gap.unwrap();
    assert!(gap.what.contains(&*lost.topic), "{gap:?}");
    assert!((gap.after.seconds() - 3.0).abs() < 0.1, "{gap:?}");
    let poses = &cut.topics[&Topics::default().pose()];
    assert!(poses.equal > 90 && poses.equal < poses.recorded, "{poses:?}");
    // A lost part of the journal is a gap too.
    let journal = Topics::default().journal();
    let part = recorded.iter().position(|m| *m.topic == *journal && m.time > at(1.5)).unwrap();
    let mut lossy = recorded;
    lossy.remove(part);
    let cut = replayed(&lossy, None).unwrap();
    assert_agrees(&cut);
    assert!(cut.gap.unwrap().what.contains("of the journal"));
    // A change before the gap is still found.
    let pose = lossy.iter_mut().find(|m| *m.topic == *Topics::default().pose());
    pose.unwrap().payload[100] ^= 1;
    assert!(!replayed(&lossy, None).unwrap().topics[&Topics::default().pose()].agrees());
}

#[test]
fn commands_that_cannot_be_followed_are_refused() {
    let slates = vec![
        slate("stop", "", 1.0),
        slate("start", "../walk", 1.1),
        slate("start", "walk", 1.2),
        slate("stop", "run", 1.4),
        slate("reset", "actor", 1.5),
        slate("pause", "", 1.6),
    ];
    let (world, recorded) = session(2, slates);
    let refused: Vec<bool> = answers(&world).iter().map(|(refused, _)| *refused).collect();
    assert_eq!(refused, [true, true, false, true, false, true]);
    assert_agrees(&replayed(&from(&recorded, 1.2), None).unwrap());
}

#[test]
fn a_take_may_begin_with_the_rig_that_comes_back_from_the_bus() {
    let rig = |seconds| Sent { arrival: at(seconds), ..Studio::new(4, 1).rig() };
    // The take begins at the end of a job; then no keypoints come first.
    let mut slates = vec![slate("start", "walk", 1.0)];
    slates.extend((0..100).map(|index| rig(1.0001 + 0.0002 * f64::from(index))));
    let (_, taken) = session(3, slates.clone());
    let replay = replayed(&from(&taken, 1.0), Some("walk")).unwrap();
    assert_agrees(&replay);
    // The rig of a file comes back, too; that is not refused.
    let rig = Studio::new(4, 1).rig();
    let mut config = Config::default();
    config.node.rig = "rig.toml".into();
    let mut world = World::new(&config);
    world.tell(Input::RigFile(rig.payload.clone()));
    let messages = Studio::new(4, 180).messages().into_iter().filter(|one| one.topic != rig.topic);
    let (world, taken) = recorded(world, messages.chain(slates).collect(), 3.0);
    assert!(world.heard.details("rig_refused").is_empty());
    assert_agrees(&replayed(&from(&taken, 1.0), Some("walk")).unwrap());
}

#[test]
fn a_start_is_answered_even_if_it_never_begins() {
    // The second comes while a job is out; so does the end after the third.
    let during_a_job = Studio::new(4, 120).frames[4 * 60].capture.seconds_since(at(0.0)) + 0.006;
    let slates = vec![slate("start", "a", during_a_job), slate("start", "b", during_a_job)];
    let (world, recorded) = session(2, slates);
    let said = answers(&world);
    assert_eq!(said.len(), 2, "{said:?}");
    assert_eq!(said[0], (true, "actor: take b begins instead".to_owned()));
    assert_eq!(said[1], (false, "actor: take b begins".to_owned()));
    assert_agrees(&replayed(&recorded, Some("b")).unwrap());

    let mut world = World::new(&Config::default());
    let mut messages = Studio::new(4, 120).messages();
    messages.push(slate("start", "a", during_a_job));
    world.play(messages, at(during_a_job));
    world.end();
    assert_eq!(answers(&world), [(true, "actor: the node ends".to_owned())]);
}

#[test]
fn a_take_that_waits_for_a_job_can_be_stopped() {
    let during_a_job = Studio::new(4, 120).frames[4 * 60].capture.seconds_since(at(0.0)) + 0.006;
    let slates = vec![slate("start", "a", during_a_job), slate("stop", "a", during_a_job)];
    let (world, recorded) = session(3, slates);
    let said = "actor: take a ended before it began".to_owned();
    assert_eq!(answers(&world), [(true, said.clone()), (false, said)]);
    let poses = world.heard.poses();
    let tracked = poses.iter().filter(|(_, pose)| pose.state == TrackingState::Tracking as i32);
    assert!(tracked.count() > 140);
    assert_agrees(&replayed(&recorded, None).unwrap());

    // Take a runs and another one waits: a stop without a name, or of a take that has the same name, ends both.
    for (waiting, stopped) in [("a", "a"), ("b", "")] {
        let slates = vec![
            slate("start", "a", 0.5),
            slate("start", waiting, during_a_job),
            slate("stop", stopped, during_a_job),
        ];
        let (world, recorded) = session(3, slates);
        let said = answers(&world);
        let refused: Vec<bool> = said.iter().map(|(refused, _)| *refused).collect();
        assert_eq!((refused, &*said[2].1), (vec![false, true, false], "actor: take a ended"));
        let replay = replayed(&recorded, Some("a")).unwrap();
        assert!(replay.is_whole);
        assert_agrees(&replay);
    }
}

#[test]
fn a_refused_slate_does_not_end_a_journal() {
    let slates = vec![
        slate("start", "walk", 1.0),
        slate("stop", "run", 1.4),
        slate("start", "../run", 1.5),
        slate("reset", "", 1.6),
    ];
    let (_, recorded) = session(4, slates);
    let cut = recorded.iter().filter(|message| message.time < at(3.5)).cloned();
    let walk = replayed(&cut.collect::<Vec<_>>(), Some("walk")).unwrap();
    assert!(!walk.is_whole && walk.gap.is_none());
    assert!(replayed(&recorded, Some("walk")).unwrap().is_whole);
}

#[test]
fn parts_of_the_journal_fit_in_a_message() {
    let rig = |index: u8| {
        let payload = vec![index; MOST_ORDER_BYTES];
        let arrival = at(1.5 + 0.01 * f64::from(index));
        Sent { arrival, topic: Topics::default().rig(), payload }
    };
    let (_, recorded) = session(3, (0..16).map(rig).collect());
    let journal = recorded.iter().filter(|m| *m.topic == *Topics::default().journal());
    let most = journal.map(|message| message.payload.len()).max().unwrap();
    assert!((MOST_ORDER_BYTES..MOST_BYTES).contains(&most), "{most}");
    assert_agrees(&replayed(&recorded, None).unwrap());
}

#[test]
fn a_take_keeps_the_body_unless_it_is_reset() {
    let body = |slates| {
        let (world, _) = session(16, slates);
        let bodies = world.heard.of::<Skeleton>(&Topics::default().skeleton());
        bodies.into_iter().map(|(time, body)| (time, body.shape)).collect::<Vec<_>>()
    };
    let bodies = body(vec![slate("start", "walk", 14.0)]);
    let [.., before, after] = &bodies[..] else { panic!("{} bodies", bodies.len()) };
    assert!(before.0 < at(14.0) && after.0 >= at(14.0), "{:?}", after.0);
    assert_eq!(before.1, after.1);
    let bodies = body(vec![slate("reset", "", 14.0)]);
    let anew = bodies.iter().filter(|(time, _)| *time > at(14.0) + Nanos::from_ms(100));
    assert!(anew.count() >= 4, "{bodies:?}");
}

#[test]
fn a_given_body_of_another_day_keeps_its_bones() {
    // The bones are right. Its offsets are none, this detector has some.
    let given =
        body::Skeleton::new(Shape::symmetric([1.0, -0.5, 1.0, 0.5, 0.0, 0.0, 0.5, -1.0, 0.0, 0.0]));
    let motion = Motion::new(&given, MotionStyle::default());
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut recording = Recording::new(rig, given.clone(), |seconds| motion.pose(seconds));
    recording.noise = Noise { bias_m: 0.01, ..Noise::jitter_only() };
    (recording.frames, recording.start) = (60 * 17, at(0.0));
    let studio = Studio { frames: recording.detections().collect(), rig: recording.rig };
    let decoder = Decoder::embedded().unwrap();
    let settings = Settings {
        body: Some(encode(&Skeleton::from_core(&given))),
        ..settings(&Config::default(), &decoder)
    };
    let mut world = World::new(&Config::default());
    world.core = Core::new(settings);
    let mut messages = studio.messages();
    // The second take begins before the places are known, the third after that.
    messages.extend([slate("start", "one", 2.0), slate("start", "two", 13.0)]);
    // The fourth begins while the third checks the body.
    messages.push(slate("start", "three", 14.6));
    let (world, recorded) = recorded(world, messages, 17.0);
    let events = world.heard.of::<Event>(&Topics::default().actor_events());
    assert!(events.iter().all(|(_, event)| event.kind != "body"), "{events:?}");
    let bodies = world.heard.of::<Skeleton>(&Topics::default().skeleton());
    let bodies: Vec<_> = bodies.iter().map(|(_, body)| body.to_core().unwrap()).collect();
    assert!(bodies.iter().all(|body| body.shape() == given.shape()));
    let offsets = bodies.last().unwrap().keypoint_offsets();
    assert!(offsets.0.iter().any(|offset| offset.abs() > 0.3), "{offsets:?}");
    let start = |take: &str, seconds| {
        let replayed = replayed(&from(&recorded, seconds), Some(take)).unwrap();
        assert_agrees(&replayed);
        replayed.start.offsets_are_known
    };
    assert!(!start("one", 2.0));
    assert_eq!([start("two", 13.0), start("three", 14.6)], [true; 2]);
}

#[test]
fn a_label_and_a_lock_stay_until_they_are_changed() {
    let label = |performer: &str, shown: &str, colour: &str, seconds| {
        let take = Take {
            action: "label".into(),
            name: performer.into(),
            display_name: shown.into(),
            colour: colour.into(),
            ..Take::default()
        };
        Sent { payload: encode(&take), ..slate("", "", seconds) }
    };
    let (world, recorded) = session(
        6,
        vec![
            slate("lock", "actor", 1.0),
            slate("reset", "", 1.2),
            label("actor", "the lead", "#d55e00", 1.4),
            label("p9", "nobody", "", 1.6),
            label("actor", "the lead", "red", 1.8),
            label("actor", &"x".repeat(61), "", 2.0),
            slate("start", "walk", 3.0),
            slate("unlock", "actor", 4.5),
            slate("reset", "", 4.7),
        ],
    );
    let answers = answers(&world);
    let refused: Vec<bool> = answers.iter().map(|(refused, _)| *refused).collect();
    assert_eq!(refused, [false, true, false, true, true, true, false, false, false], "{answers:?}");
    assert_eq!(answers[1].1, "actor: all performers are locked (actor): unlock one, then reset");
    assert_eq!(answers[2].1, "actor: actor is shown as \"the lead\", #d55e00");
    let statuses = world.heard.of::<Status>(&Topics::default().status());
    let label_at = |seconds| {
        let (_, status) = statuses.iter().rfind(|(time, _)| *time < at(seconds)).unwrap();
        status.label.clone()
    };
    let labelled = |locked| {
        Some(PerformerLabel { display_name: "the lead".into(), colour: "#d55e00".into(), locked })
    };
    assert_eq!(label_at(1.0), None);
    assert_eq!(
        (label_at(2.9), label_at(4.4), label_at(5.9)),
        (labelled(true), labelled(true), labelled(false))
    );
    assert_agrees(&replayed(&from(&recorded, 3.0), Some("walk")).unwrap());
}

/// Frames of performers of those shapes, one after the other, each for 15 s, with that pause between.
fn in_turn(shapes: &[Shape], pause_s: u64) -> Studio {
    const FRAMES: u64 = 15 * 60;
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut frames = Vec::new();
    for (turn, shape) in (0..).zip(shapes) {
        let skeleton = body::Skeleton::new(*shape);
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let mut recording = Recording::new(rig.clone(), skeleton, |seconds| motion.pose(seconds));
        recording.noise = Noise::jitter_only();
        recording.frames = FRAMES + pause_s * 60;
        let before = turn * recording.frames;
        recording.start = at(0.0) + Nanos::rounded(before as f64 * 1e9 / 60.0);
        frames.extend(recording.detections().map(|mut frame| {
            if frame.frame >= FRAMES {
                frame.people.clear();
            }
            frame.frame += before;
            frame
        }));
    }
    Studio { rig, frames }
}

/// Mean length of the limbs, metres.
fn limbs(skeleton: &body::Skeleton) -> f64 {
    let ends =
        [Joint::LKnee, Joint::RKnee, Joint::LAnkle, Joint::RAnkle, Joint::LElbow, Joint::RElbow];
    ends.iter().map(|joint| skeleton.offset(*joint).norm()).sum::<f64>() / ends.len() as f64
}

#[test]
fn the_next_performer_gets_a_body_without_a_restart() {
    let tall = Shape::symmetric([1.5, 0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    let short = Shape::symmetric([-1.5, -0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    let like = Shape::symmetric([0.8, 0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    for (first, second, pause) in [(&tall, &short, 0), (&tall, &like, 3), (&tall, &tall, 3)] {
        let studio = in_turn(&[*first, *second], pause);
        let change = 15.0 + pause as f64;
        let world = crate::live::after(studio.messages(), change + 15.0);
        let wanted = [first, second].map(|shape| limbs(&body::Skeleton::new(*shape)));
        let bodies = world.heard.of::<Skeleton>(&Topics::default().skeleton());
        let found = |until: f64| {
            let body = bodies.iter().rfind(|(time, _)| *time < at(until)).unwrap().1.clone();
            limbs(&body.to_core().unwrap())
        };
        let off = [found(15.0) - wanted[0], found(change + 15.0) - wanted[1]];
        let events: Vec<f64> = world
            .heard
            .of::<Event>(&Topics::default().actor_events())
            .iter()
            .filter(|(_, event)| event.kind == "body")
            .map(|(time, _)| time.seconds_since(at(change)))
            .collect();
        println!("{pause} s: limbs {wanted:.3?} m, off {off:.4?} m, events {events:.2?}");
        assert!(off.iter().all(|off| off.abs() < 0.004), "limbs {wanted:.3?} m, off {off:.4?} m");
        assert_eq!(events.len(), usize::from(first != second), "{events:?}");
        assert!(events.iter().all(|at| (0.0..4.0).contains(at)), "{events:?}");
    }
}
