//! The live node inside a program of your own: keypoints go in and poses come out through a bus in memory. The cameras
//! of a recording are played in real time.
//!
//! ```text
//! cargo run --release --example embedded_node
//! ```

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::error::Error;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bundlemocap::config::Config;
use bundlemocap::io::bus::{Bus, Memory, Sample};
use bundlemocap::io::recording::{Message, Reader};
use bundlemocap::io::wire::{KeypointFrame, Pose, Rig, Schema, Topics, decode, encode, media_type};
use bundlemocap::live::{Core, Node, Presence, WallClock};
use bundlemocap::{Decoder, Nanos, Solver, Timestamp};

const LATENCY_MS: f64 = 200.0;

fn main() -> Result<(), Box<dyn Error>> {
    let mut config = Config::default();
    config.node.latency_ms = LATENCY_MS;
    config.validate()?;

    // The node, alone on a bus. It publishes on the topics of this stage and this performer.
    let bus: Arc<dyn Bus> = Arc::new(Memory::new());
    let topics = Topics::new(&config.node.stage, &config.node.actor)?;
    let clock = WallClock::start();
    let several = config.stage.several();
    let presence = Presence::announce(Arc::clone(&bus), topics.clone(), several, clock.now())?;
    let decoder = Decoder::embedded()?;
    let core = Core::new(config.core_settings(&decoder)?);
    let solvers = vec![Solver::new(decoder, config.tracker)];
    let node = Node::start(Arc::clone(&bus), presence.alone()?, core, solvers, &config.node, None)?;

    // Each pose is published this long after its capture. The subscription lasts as long as its guard.
    let poses = Arc::new(AtomicUsize::new(0));
    let (seen, own_clock) = (Arc::clone(&poses), WallClock::start());
    let sink = move |sample: Sample| {
        let Ok(pose) = decode::<Pose>(&sample.payload) else { return };
        if seen.fetch_add(1, Ordering::Relaxed).is_multiple_of(30) {
            let age = own_clock.now() - Timestamp::from_ns(pose.capture_time_ns);
            let [x, y, z] = pose.root_position_m[..] else { return };
            println!("pelvis at {x:.3} {y:.3} {z:.3} m, {:.0} ms after its capture", age.ms());
        }
    };
    let subscription = bus.subscribe(&topics.pose(), Box::new(sink))?;

    // In place of detectors: the messages of a recording, with the times of now.
    let start = clock.now() + Nanos::from_ms(100);
    // What was published as a state is kept as long as its publisher.
    let rigs = bus.publisher(&topics.rig())?;
    let mut cameras = BTreeMap::new();
    for entry in Reader::open(Path::new("recordings/walk.mcap"))? {
        match entry?.message {
            Message::Rig(rig) => {
                rigs.put(clock.now(), &media_type(Rig::FULL_NAME), &encode(&rig))?;
            }
            Message::Keypoints(frame) => {
                let capture = start + Nanos::new(frame.capture_time_ns);
                clock.wait_until(capture);
                let camera = match cameras.entry(frame.camera.clone()) {
                    Entry::Occupied(known) => known.into_mut(),
                    Entry::Vacant(new) => {
                        new.insert(bus.publisher(&topics.keypoints(&frame.camera))?)
                    }
                };
                let frame = KeypointFrame { capture_time_ns: capture.ns(), ..frame };
                camera.put(capture, &media_type(KeypointFrame::FULL_NAME), &encode(&frame))?;
            }
            _ => {}
        }
    }
    clock.wait_until(clock.now() + Nanos::from_ms(LATENCY_MS as i64));
    drop(subscription);
    node.stop()?;
    println!("{} poses", poses.load(Ordering::Relaxed));
    Ok(())
}
