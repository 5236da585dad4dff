//! A camera that is bumped while the node runs, in simulated time.

use bundlemocap::config::Config;
use bundlemocap::core::body::Skeleton;
use bundlemocap::core::camera::{Camera, Rig};
use bundlemocap::core::so3;
use bundlemocap::io::wire::{self, CameraCounters, Event, Status, TakeAnswer, Topics};
use bundlemocap::research::synth::{Motion, MotionStyle, Noise, Recording, ring_rig};
use nalgebra::Vector3;

use crate::live::{START, Sent, Studio, World, at};
use crate::slate::{assert_agrees, recorded, replayed, slate};

/// When the third camera is bumped, and the end, seconds.
const BUMP: f64 = 40.0;
const END: f64 = 105.0;

/// Turned by 3 degrees and moved by 10 cm.
fn bumped(camera: &Camera) -> Camera {
    let mut camera = camera.clone();
    let centre = camera.centre_in_world() + Vector3::new(0.06, -0.04, 0.069_282);
    let axis = Vector3::new(0.6, 0.8, 0.0);
    camera.rotation = so3::exp(&(axis * 3f64.to_radians())) * camera.rotation;
    camera.translation = -(camera.rotation * centre);
    camera
}

/// What the cameras send, all of the calibration before the bump, and the cameras after it.
fn studio(noise: Noise) -> (Vec<Sent>, Rig) {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let rig = ring_rig(4, 4.0, 1.6).unwrap();
    let mut after = rig.clone();
    after.cameras[2] = bumped(&rig.cameras[2]);
    let frames = |rig: &Rig| {
        let mut recording =
            Recording::new(rig.clone(), skeleton.clone(), |seconds| motion.pose(seconds));
        (recording.frames, recording.start) = ((END * recording.fps) as u64, START);
        recording.noise = noise.clone();
        recording.detections().collect::<Vec<_>>()
    };
    let mut all = frames(&rig);
    all.retain(|frame| frame.capture < at(BUMP));
    all.extend(frames(&after).into_iter().filter(|frame| frame.capture >= at(BUMP)));
    (Studio { rig, frames: all }.messages(), after)
}

/// The counters of the bumped camera, by second.
fn counters(world: &World) -> Vec<(f64, CameraCounters)> {
    let all = world.heard.of::<Status>(&Topics::default().status());
    let of = |status: &Status| status.cameras.iter().find(|c| c.camera == "cam03").cloned();
    all.iter().map(|(time, status)| (time.seconds_since(START), of(status).unwrap())).collect()
}

/// The camera of the last calibration on the bus is where the bumped one is: within 0.2 degrees and 1 cm.
fn assert_mended(world: &World, truth: &Rig) {
    let rigs = world.heard.of::<wire::Rig>(&Topics::default().rig());
    let (time, rig) = rigs.last().unwrap();
    let rig = rig.to_core().unwrap();
    let [now, truth] = [&rig, truth].map(|rig| &rig.cameras[2]);
    let degrees = so3::angle_between(&now.rotation, &truth.rotation).to_degrees();
    let cm = 100.0 * (now.centre_in_world() - truth.centre_in_world()).norm();
    let seconds = time.seconds_since(START) - BUMP;
    println!("{seconds:.1} s after the bump, {degrees:.2} degrees and {cm:.2} cm off");
    assert!(degrees < 0.2 && cm < 1.0 && seconds < 60.0);
}

#[test]
fn a_bumped_camera_is_mended_when_asked_to() {
    let (mut sent, truth) = studio(Noise::studio());
    // Not before it is known where it is.
    sent.extend([slate("mend", "cam03", BUMP + 6.0), slate("mend", "cam03", BUMP + 55.0)]);
    sent.push(slate("mend", "cam9", BUMP + 1.0));
    let (world, recorded) = recorded(World::new(&Config::default()), sent, END);
    println!("{:#?}", world.heard.details("camera_moved"));
    assert_mended(&world, &truth);
    let answers = world.heard.of::<TakeAnswer>(&Topics::default().take_answers());
    let refused: Vec<bool> = answers.iter().map(|(_, answer)| answer.refused).collect();
    assert_eq!(refused, [true, true, false], "{answers:?}");
    let counters = counters(&world);
    let used = |from: f64, to: f64| {
        let at = |second: f64| counters.iter().find(|(time, _)| *time >= second).unwrap().1.used;
        at(to) - at(from)
    };
    let found = counters.iter().find(|(_, counters)| !counters.moved.is_empty()).unwrap();
    println!("{:.1} s: {}", found.0 - BUMP, found.1.moved);
    assert!(found.1.moved.starts_with("turned by 3.0"), "{}", found.1.moved);
    assert!(counters.last().unwrap().1.moved.is_empty());
    assert!(used(BUMP + 56.0, BUMP + 60.0) >= 200);
    let events = world.heard.of::<Event>(&Topics::default().stage_events());
    let red = events.iter().find(|(_, event)| event.kind == "camera_moved").unwrap();
    let red = red.0.seconds_since(START) - BUMP;
    println!("red {red:.1} s after the bump");
    assert!(red < 10.0);
    assert_agrees(&replayed(&recorded, None).unwrap());
}

#[test]
fn a_bumped_camera_is_mended_by_itself_if_set_so() {
    let (sent, truth) = studio(Noise::clean());
    let mut config = Config::default();
    config.node.mend_cameras = true;
    let (world, recorded) = recorded(World::new(&config), sent, END);
    println!("{:#?}", world.heard.details("camera_moved"));
    assert_mended(&world, &truth);
    assert_agrees(&replayed(&recorded, None).unwrap());
}
