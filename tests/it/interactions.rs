//! The node's core under any order of inputs, faults and commands, in simulated time. A case that fails is
//! made as short as it can be. `PROPTEST_CASES=100 PROPTEST_RNG_SEED=7` tries others.

use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};

use bundlemocap::core::detections::Detections;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::io::wire::{self, Journal, KeypointFrame, Pose, Topics, encode};
use proptest::collection::vec;
use proptest::prelude::{Just, Strategy, prop_oneof};
use proptest::test_runner::{Config, RngSeed, TestCaseError, TestRunner};

use crate::live::{Sent, World, at};
use crate::several::Stage;
use crate::slate::{recorded, replayed, slate};

const CAMERAS: usize = 4;
const SECONDS: u64 = 6;

/// What happens to the frames of a camera.
#[derive(Clone, Copy, Debug)]
enum Fault {
    Lost,
    Broken,
    HalfSize,
    Twice,
    NobodySeen,
    /// Milliseconds.
    Late(i64),
    /// Its clock is off, milliseconds.
    Shifted(i64),
}

#[derive(Clone, Copy, Debug)]
enum Happening {
    /// A fault of a camera, or of all, between these tenths of a second.
    Fault {
        fault: Fault,
        camera: Option<usize>,
        from: u64,
        to: u64,
    },
    Slate(&'static str, u64),
    /// Another calibration; of fewer cameras.
    Rig {
        version: u64,
        cameras: usize,
        at: u64,
    },
}

fn happening() -> impl Strategy<Value = Happening> {
    let fault = prop_oneof![
        Just(Fault::Lost),
        Just(Fault::Broken),
        Just(Fault::HalfSize),
        Just(Fault::Twice),
        Just(Fault::NobodySeen),
        (1..400_i64).prop_map(Fault::Late),
        (-3000..3000_i64).prop_map(Fault::Shifted),
    ];
    let tenths = 0..SECONDS * 10;
    let camera = prop_oneof![Just(None), (0..CAMERAS).prop_map(Some)];
    let faults = (fault, camera, tenths.clone(), 1..20_u64);
    let action = prop_oneof![Just("start"), Just("stop"), Just("reset")];
    prop_oneof![
        4 => faults.prop_map(|(fault, camera, from, long)| {
            Happening::Fault { fault, camera, from, to: from + long }
        }),
        1 => (action, tenths.clone()).prop_map(|(action, at)| Happening::Slate(action, at)),
        1 => (2..5_u64, 2..=CAMERAS, tenths)
            .prop_map(|(version, cameras, at)| Happening::Rig { version, cameras, at }),
    ]
}

fn tenths(count: u64) -> Timestamp {
    at(count as f64 / 10.0)
}

/// The messages of a frame after these faults.
fn messages(stage: &Stage, frame: &Detections, faults: &[Fault]) -> Vec<Sent> {
    let (mut sent, mut copies) = (frame.clone(), 1);
    let (mut late, mut scale, mut is_broken) = (Nanos::ZERO, 1, false);
    for fault in faults {
        match fault {
            Fault::Lost => copies = 0,
            Fault::Twice => copies *= 2,
            Fault::Broken => is_broken = true,
            Fault::HalfSize => scale = 2,
            Fault::NobodySeen => sent.people.clear(),
            Fault::Late(ms) => late = late + Nanos::from_ms(*ms),
            Fault::Shifted(ms) => sent.capture = sent.capture + Nanos::from_ms(*ms),
        }
    }
    let camera = &stage.studio.rig.cameras[frame.camera];
    let size = [camera.width / scale, camera.height / scale];
    let mut payload = encode(&KeypointFrame::from_core(&sent, &camera.name, size));
    if is_broken {
        payload.truncate(payload.len() / 2);
    }
    let message = stage.studio.message(frame);
    let arrival = message.arrival + late;
    vec![Sent { arrival, payload, ..message }; copies]
}

fn all(stage: &Stage, happenings: &[Happening]) -> Vec<Sent> {
    let mut all = vec![stage.studio.rig()];
    for frame in &stage.studio.frames {
        let faults = happenings.iter().filter_map(|happening| match *happening {
            Happening::Fault { fault, camera, from, to } => {
                let is_now = (tenths(from)..tenths(to)).contains(&frame.capture);
                (is_now && camera.is_none_or(|camera| camera == frame.camera)).then_some(fault)
            }
            _ => None,
        });
        all.extend(messages(stage, frame, &faults.collect::<Vec<_>>()));
    }
    for happening in happenings {
        match *happening {
            Happening::Fault { .. } => {}
            Happening::Slate(action, at) => {
                let name = if action == "start" { format!("take{at}") } else { String::new() };
                all.push(slate(action, &name, at as f64 / 10.0));
            }
            Happening::Rig { version, cameras, at } => {
                let mut rig = stage.studio.rig.clone();
                rig.version = version;
                rig.cameras.truncate(cameras);
                let payload = encode(&wire::Rig::from_core(&rig));
                all.push(Sent { arrival: tenths(at), topic: Topics::default().rig(), payload });
            }
        }
    }
    all
}

/// Whether the cameras' common clock may go back.
fn goes_back(happenings: &[Happening]) -> bool {
    let shifted = |happening: &Happening| {
        matches!(happening, Happening::Fault { fault: Fault::Shifted(_), .. })
    };
    happenings.iter().any(shifted)
}

fn holds(stage: &Stage, happenings: &[Happening]) {
    let messages = all(stage, happenings);
    let (world, recorded) = recorded(World::new(&stage.config), messages, SECONDS as f64 + 1.0);
    let topics = world.heard.messages.iter().map(|message| &message.topic);
    let of_poses: BTreeSet<_> = topics.filter(|topic| topic.ends_with("/pose")).collect();
    for topic in of_poses {
        for pair in world.heard.of::<Pose>(topic).windows(2) {
            let [(earlier, before), (later, pose)] = pair else { unreachable!() };
            assert!(earlier <= later, "{topic}: published out of order");
            let is_next = pose.capture_time_ns > before.capture_time_ns;
            let is_run = pose.run_id == before.run_id;
            assert!(is_next || !is_run || goes_back(happenings), "{topic}: {pair:?}");
        }
    }
    let journals = world.heard.of::<Journal>(&Topics::default().journal());
    let runs: BTreeSet<u64> = journals.iter().map(|(_, journal)| journal.run_id).collect();
    assert!(!runs.is_empty());
    for run in runs {
        let replayed = replayed(&recorded, Some(&format!("{run:016x}"))).unwrap();
        for (topic, compared) in &replayed.topics {
            assert!(compared.agrees(), "run {run:016x}, {topic}: {compared:?}");
        }
        assert!(replayed.is_whole && replayed.gap.is_none(), "run {run:016x}");
    }
}

fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).ok().map_or(default, |text| text.parse().unwrap())
}

/// No panic, poses in order and once, and each run replays to the same bytes.
fn whatever_happens(people: usize) {
    let stage = Stage::new(people, CAMERAS, SECONDS);
    let config = Config {
        cases: number("PROPTEST_CASES", 5) as u32,
        rng_seed: RngSeed::Fixed(number("PROPTEST_RNG_SEED", 1)),
        failure_persistence: None,
        max_shrink_iters: 60,
        ..Config::default()
    };
    let happenings = vec(happening(), 0..6);
    let ran = TestRunner::new(config).run(&happenings, |happenings| {
        // Without its feature `std`, which changes the program's dependencies, proptest catches no panic.
        let held = catch_unwind(AssertUnwindSafe(|| holds(&stage, &happenings)));
        held.map_err(|_| TestCaseError::fail("see the panic above"))
    });
    ran.unwrap_or_else(|error| panic!("{error}"));
}

#[test]
fn whatever_happens_to_one_performer_poses_are_in_order_and_replayed() {
    whatever_happens(1);
}

#[test]
fn whatever_happens_to_several_performers_poses_are_in_order_and_replayed() {
    whatever_happens(2);
}

/// A calibration waits for the next window; one of other cameras comes before that.
#[test]
fn a_calibration_of_other_cameras_replaces_one_that_waits() {
    let calibrations = [CAMERAS, 2].map(|cameras| Happening::Rig { version: 2, cameras, at: 37 });
    holds(&Stage::new(2, CAMERAS, SECONDS), &calibrations);
}
