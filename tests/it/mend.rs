//! A camera that is bumped while the node runs, in simulated time.

use bundlemocap::config::Config;
use bundlemocap::core::camera::{Camera, Rig};
use bundlemocap::core::so3;
use bundlemocap::core::time::Nanos;
use bundlemocap::io::wire::{
    self, CameraCounters, Event, Status, TakeAnswer, Topics, decode, encode,
};
use bundlemocap::research::synth::{Noise, bumped};

use crate::live::{START, Sent, World, at, performers};
use crate::slate::{assert_agrees, recorded, replayed, slate};

/// When the last of four cameras is bumped, seconds.
const BUMP: f64 = 40.0;

/// What the cameras send of that many performers up to the end, and the bumped camera.
fn studio(noise: &Noise, people: usize, end: f64) -> (Vec<Sent>, Camera) {
    let studio = performers(people, |one| {
        (one.fps, one.frames) = (30.0, (30.0 * end) as u64);
        (one.noise, one.start) = (noise.clone(), START + Nanos::from_ms(30));
        one.bump = Some(BUMP);
    });
    let camera = bumped(&studio.rig.cameras[3]);
    (studio.messages(), camera)
}

/// The counters of the bumped camera, by second.
fn counters(world: &World) -> Vec<(f64, CameraCounters)> {
    let all = world.heard.of::<Status>(&Topics::default().status());
    let of = |status: &Status| status.cameras.iter().find(|c| c.camera == "cam04").cloned();
    all.iter().map(|(time, status)| (time.seconds_since(START), of(status).unwrap())).collect()
}

/// The camera of the last calibration on the bus is where the bumped one is: within 0.2 degrees and 1 cm.
fn assert_mended(world: &World, truth: &Camera) {
    let rigs = world.heard.of::<wire::Rig>(&Topics::default().rig());
    let (time, rig) = rigs.last().unwrap();
    let rig = rig.to_core().unwrap();
    let now = &rig.cameras[3];
    let degrees = so3::angle_between(&now.rotation, &truth.rotation).to_degrees();
    let cm = 100.0 * (now.centre_in_world() - truth.centre_in_world()).norm();
    let seconds = time.seconds_since(START) - BUMP;
    println!("{seconds:.1} s after the bump, {degrees:.2} degrees and {cm:.2} cm off");
    assert!(degrees < 0.2 && cm < 1.0 && (0.0..60.0).contains(&seconds));
}

#[test]
fn a_bumped_camera_is_mended_when_asked_to() {
    let end = BUMP + 60.0;
    let (mut sent, truth) = studio(&Noise::studio(), 1, end);
    // Not before it is known where it is.
    sent.extend([slate("mend", "cam04", BUMP + 6.0), slate("mend", "cam04", BUMP + 55.0)]);
    sent.push(slate("mend", "cam9", BUMP + 1.0));
    let (world, recorded) = recorded(World::new(&Config::default()), sent, end);
    println!("{:#?}", world.heard.details("camera_moved"));
    assert_mended(&world, &truth);
    let answers = world.heard.of::<TakeAnswer>(&Topics::default().take_answers());
    let refused: Vec<bool> = answers.iter().map(|(_, answer)| answer.refused).collect();
    assert_eq!(refused, [true, true, false], "{answers:?}");
    let counters = counters(&world);
    let found = counters.iter().find(|(_, counters)| !counters.moved.is_empty()).unwrap();
    println!("{:.1} s: {}", found.0 - BUMP, found.1.moved);
    assert!(found.1.moved.starts_with("turned by "), "{}", found.1.moved);
    assert!(counters.last().unwrap().1.moved.is_empty());
    let residual = counters.last().unwrap().1.residual_px;
    assert!((0.5..15.0).contains(&residual), "it is used: {residual} px");
    let events = world.heard.of::<Event>(&Topics::default().stage_events());
    let red = events.iter().find(|(_, event)| event.kind == "camera_moved").unwrap();
    let red = red.0.seconds_since(START) - BUMP;
    println!("red {red:.1} s after the bump");
    assert!(red < 10.0);
    assert_agrees(&replayed(&recorded, None).unwrap());
}

#[test]
fn a_bumped_camera_is_mended_by_itself_if_set_so() {
    for people in [1, 3] {
        let end = BUMP + 40.0;
        let (sent, truth) = studio(&Noise::clean(), people, end);
        let mut config = Config::default();
        config.node.mend_cameras = true;
        config.stage.performers = if people == 1 { "1" } else { "auto" }.parse().unwrap();
        let (world, recorded) = recorded(World::new(&config), sent, end);
        println!("{:#?}", world.heard.details("camera_moved"));
        assert_mended(&world, &truth);
        assert_agrees(&replayed(&recorded, None).unwrap());
        // It is used again.
        let last = counters(&world).pop().unwrap().1;
        assert!((0.05..5.0).contains(&last.residual_px), "{people}: {} px", last.residual_px);
    }
}

#[test]
fn a_take_begins_without_a_camera_that_was_moved_before_until_its_calibration_changes() {
    let end = BUMP + 20.0;
    let (mut sent, truth) = studio(&Noise::clean(), 1, end);
    let rig = sent.iter().find(|sent| sent.topic == Topics::default().rig()).unwrap();
    let rig = decode::<wire::Rig>(&rig.payload).unwrap().to_core().unwrap();
    let published = |version, rig: &Rig, seconds| {
        let payload = encode(&wire::Rig { version, ..wire::Rig::from_core(rig) });
        Sent { arrival: at(seconds), topic: Topics::default().rig(), payload }
    };
    let mut mended = rig.clone();
    mended.cameras[3] = truth;
    sent.push(slate("start", "walk", BUMP + 7.0));
    sent.push(published(7, &rig, BUMP + 10.0));
    sent.push(published(8, &mended, BUMP + 15.0));
    let (world, recorded) = recorded(World::new(&Config::default()), sent, end);
    let take = replayed(&recorded, Some("walk")).unwrap();
    assert_eq!(take.start.left_out, [3]);
    assert_agrees(&take);
    let details = world.heard.details("camera_moved");
    assert!(details.last().unwrap().starts_with("moved before this take"), "{details:?}");
    let counters = counters(&world);
    let residual = |second: f64| {
        counters.iter().find(|(time, _)| *time >= BUMP + second).unwrap().1.residual_px
    };
    println!("{} {} {}", residual(9.0), residual(14.0), residual(19.0));
    assert_eq!([residual(9.0), residual(14.0)], [0.0, 0.0], "it is left out");
    assert!((0.1..10.0).contains(&residual(19.0)), "it is used");
}
