//! A camera whose capture times are late, and are corrected while the node runs, in simulated time.

use std::ops::Range;

use bundlemocap::config::Config;
use bundlemocap::core::time::Nanos;
use bundlemocap::io::wire::{Event, KeypointSet, Pose, Rig, Status, Take, Topics, decode, encode};
use bundlemocap::research::synth::Noise;

use crate::live::{NETWORK, START, Sent, World, at, performers};
use crate::slate::{answers, assert_agrees, from, recorded, replayed};

/// What four cameras send of that many performers up to the end. The frames of the last one come late, by so many
/// seconds, and its times are those of the arrival.
fn studio(people: usize, late: f64, end: f64) -> Vec<Sent> {
    let mut studio = performers(people, |one| {
        (one.fps, one.frames) = (60.0, (60.0 * end) as u64);
        (one.noise, one.start) = (Noise::clean(), START);
    });
    for frame in studio.frames.iter_mut().filter(|frame| frame.camera == 3) {
        frame.capture = frame.capture + Nanos::rounded(1e9 * late);
    }
    studio.messages()
}

fn order(camera: &str, offset_ms: f64, seconds: f64) -> Sent {
    let (action, name) = ("clock".to_owned(), camera.to_owned());
    let take = Take { id: 7, action, name, offset_ms, ..Take::default() };
    Sent { arrival: at(seconds), topic: Topics::default().take(), payload: encode(&take) }
}

/// The last status before a time.
fn status(world: &World, seconds: f64) -> Status {
    let mut all = world.heard.of::<Status>(&Topics::default().status());
    all.retain(|(time, _)| *time <= at(seconds));
    all.pop().unwrap().1
}

/// The mean residual of the last camera, pixels.
fn residual(world: &World, seconds: Range<f64>) -> f64 {
    let all = world.heard.of::<Status>(&Topics::default().status());
    let all = all.iter().filter(|(time, _)| (at(seconds.start)..at(seconds.end)).contains(time));
    let all: Vec<f64> = all.map(|(_, status)| status.cameras[3].residual_px).collect();
    all.iter().sum::<f64>() / all.len() as f64
}

fn latency(status: &Status) -> Nanos {
    Nanos::new(status.declared_latency_ns.cast_signed())
}

#[test]
fn capture_times_are_corrected_when_ordered() {
    let late = Nanos::from_ms(100);
    for people in [1, 3] {
        let mut sent = studio(people, 0.1, 18.0);
        let start = Take { id: 8, action: "start".into(), name: "walk".into(), ..Take::default() };
        let topic = Topics::default().take();
        sent.push(Sent { arrival: at(12.0), topic, payload: encode(&start) });
        sent.push(order("cam04", -100.0, 6.0));
        // A calibration that says so too.
        let mut rig: Rig = decode(&sent[0].payload).unwrap();
        (rig.version, rig.cameras[3].time_offset_ns) = (rig.version + 1, -100_000_000);
        let topic = Topics::default().rig();
        sent.push(Sent { arrival: at(14.0), topic, payload: encode(&rig) });
        sent.extend([order("cam9", -100.0, 7.0), order("cam04", 1e6, 7.0)]);
        let mut config = Config::default();
        config.stage.performers = if people == 1 { "1" } else { "auto" }.parse().unwrap();
        let (world, recorded) = recorded(World::new(&config), sent, 18.0);
        let refused: Vec<bool> = answers(&world).iter().map(|(refused, _)| *refused).collect();
        assert_eq!(refused, [false, true, true, false], "{:?}", answers(&world));
        let [before, after, again, last] =
            [5.9, 11.9, 13.9, 17.9].map(|seconds| status(&world, seconds));
        for (status, correction) in [(&before, 0.0), (&after, -0.1), (&again, -0.1), (&last, 0.0)] {
            assert_eq!(status.cameras[3].time_correction_s, correction);
        }
        let residuals = [2.0..6.0, 7.0..12.0, 14.5..18.0].map(|seconds| residual(&world, seconds));
        let latencies = [&before, &after].map(latency);
        println!("{people} performers: {residuals:?} px, {latencies:?}");
        assert!(residuals[1] < 0.5 * residuals[0] && residuals[2] < 0.5 * residuals[0]);
        // The frames come so much later, and nothing else has changed.
        let by = latencies[1] - latencies[0];
        assert!((late..late + NETWORK + Nanos::from_ms(20)).contains(&by), "{by}");
        if people == 1 {
            let newest = world.heard.of::<Pose>(&Topics::default().provisional());
            let newest = newest.iter().filter(|(time, _)| (at(8.0)..at(11.5)).contains(time));
            assert!(newest.count() > 200, "of 210 frame sets");
        }
        let events = world.heard.of::<Event>(&Topics::default().stage_events());
        let of_clocks = ["clock", "clock_jump", "clock_offset"];
        let wrong = |event: &Event| {
            of_clocks.contains(&&*event.kind) && !event.detail.contains("use the node's clock")
        };
        let wrong: Vec<_> = events.iter().filter(|(_, event)| wrong(event)).collect();
        assert!(wrong.is_empty(), "{wrong:?}");
        let of_camera = |count: fn(&bundlemocap::io::wire::CameraCounters) -> u64| {
            count(&after.cameras[3]) - count(&before.cameras[3])
        };
        let (late, disordered) = (of_camera(|c| c.late), of_camera(|c| c.out_of_order));
        println!("{late} late, {disordered} out of order, {} missing", of_camera(|c| c.missing));
        // The frames of 0.1 s, for which windows did not wait.
        assert!(late <= 7 && disordered == 0 && of_camera(|c| c.missing) <= 7);
        let take = replayed(&from(&recorded, 12.0), Some("walk")).unwrap();
        assert_eq!(take.start.time_offsets_ns[3], -100_000_000);
        assert_agrees(&take);
        let first: Vec<_> = recorded.into_iter().filter(|one| one.time < at(11.9)).collect();
        assert_agrees(&replayed(&first, None).unwrap());
    }
}

/// A wrong sign makes all others late.
#[test]
fn a_wrong_correction_is_undone_by_zero() {
    let mut sent = studio(1, 0.0, 14.0);
    sent.extend([order("cam04", 1000.0, 4.0), order("cam04", 0.0, 8.0)]);
    let (world, recorded) = recorded(World::new(&Config::default()), sent, 14.0);
    let corrections = |seconds: f64| -> Vec<f64> {
        status(&world, seconds).cameras.iter().map(|camera| camera.time_correction_s).collect()
    };
    let wrong = corrections(7.9);
    assert!(wrong[..3].iter().all(|s| (s + 1.0).abs() < 0.1) && wrong[3].abs() < 0.1, "{wrong:?}");
    assert_eq!(corrections(13.9), [0.0; 4]);
    let poses = world.heard.of::<Pose>(&Topics::default().provisional());
    let poses = poses.iter().filter(|(time, _)| (at(10.0)..at(13.5)).contains(time));
    let count = poses.count();
    assert!(count > 190, "{count} of 210 frame sets, {:?}", world.heard.details("time_offset"));
    assert_agrees(&replayed(&recorded, None).unwrap());
}

#[test]
fn a_front_corrects_the_frames_that_it_sends_to_solvers() {
    let mut config = Config::default();
    config.stage.performers = "auto".parse().unwrap();
    config.stage.solve = false;
    let mut sent = studio(3, 0.1, 4.0);
    sent.push(order("cam04", -100.0, 2.0));
    let mut world = World::new(&config);
    world.play(sent, at(4.0));
    let topics = Topics { actor: "p1".into(), ..Topics::default() };
    let sets = world.heard.of::<KeypointSet>(&topics.actor_keypoints());
    let off = |(_, set): &(_, KeypointSet)| {
        let of = |name: &str| set.frames.iter().find(|frame| frame.camera == name);
        let (late, other) = (of("cam04")?, of("cam01")?);
        Some(late.capture_time_ns - other.capture_time_ns)
    };
    let frames = |(_, set): &(_, KeypointSet)| {
        let of = |name: &str| set.frames.iter().find(|frame| frame.camera == name);
        Some(of("cam04")?.frame.cast_signed() - of("cam01")?.frame.cast_signed())
    };
    let offs: Vec<i64> = sets.iter().filter_map(off).collect();
    assert!(offs.len() > 200 && offs.iter().all(|off| off.abs() < 1_000_000), "{}", offs.len());
    let frames: Vec<i64> = sets.iter().filter_map(frames).collect();
    assert_eq!([frames[60], frames[frames.len() - 60]], [-6, 0], "the same instant");
}

#[test]
fn frames_do_not_come_before_their_capture() {
    for early in [0.1, 0.4] {
        // Its times are early, but the arrivals are those of its own times, so all others are late.
        let mut sent = studio(1, -early, 14.0);
        sent.push(order("cam04", 1e3 * early, 4.0));
        // Later a calibration says so.
        let mut rig: Rig = decode(&sent[0].payload).unwrap();
        (rig.version, rig.cameras[3].time_offset_ns) = (rig.version + 1, (1e9 * early) as i64);
        let topic = Topics::default().rig();
        sent.push(Sent { arrival: at(10.0), topic, payload: encode(&rig) });
        let mut world = World::new(&Config::default());
        world.play(sent, at(14.0));
        let last = status(&world, 9.9);
        let corrections = last.cameras.iter().map(|camera| camera.time_correction_s);
        let corrections: Vec<f64> = corrections.collect();
        println!("{corrections:.4?}, {:?}", world.heard.details("time_offset"));
        for (camera, correction) in corrections.into_iter().enumerate() {
            let right = if camera == 3 { 0.0 } else { -early };
            assert!((correction - right).abs() < 1e-3 + NETWORK.seconds(), "{correction}");
        }
        assert_eq!(last.tracker_state, "tracking");
        let times = [2.0..4.0, 6.0..10.0, 12.0..14.0];
        let residuals = times.map(|seconds| residual(&world, seconds));
        println!("{residuals:?} px");
        assert!(residuals[1..].iter().all(|after| *after < 0.5 * residuals[0]));
        let events = world.heard.details("clock");
        assert!(events.iter().all(|detail| detail.contains("use the node's clock")), "{events:?}");
    }
}

#[test]
fn later_errors_are_corrected_step_by_step_for_all_performers() {
    for people in [1, 3] {
        let mut sent = studio(people, 0.0, 60.0);
        let late = studio(people, 0.03, 60.0);
        // At 20 s, the last camera falls behind by 30 ms.
        let keypoints = Topics::default().keypoints("cam04");
        let is_late = |one: &Sent| one.topic == keypoints && one.arrival > at(20.0);
        sent.retain(|one| !is_late(one));
        sent.extend(late.into_iter().filter(is_late));
        let mut config = Config::default();
        config.stage.performers = if people == 1 { "1" } else { "auto" }.parse().unwrap();
        let mut world = World::new(&config);
        world.play(sent, at(60.0));
        let details = world.heard.details("time_offset");
        let last = status(&world, 60.0).cameras[3].time_correction_s;
        println!("{people} performers: {last} s, {details:?}");
        assert!(details[0].ends_with("corrected step by step") && details.len() <= 2);
        // Half of it after 40 s.
        assert!((-0.035..-0.014).contains(&last), "{last}");
    }
}
