//! Bad clocks, delays and pauses in simulated time: each case must be survived within three seconds,
//! with one event. Solutions are made by hand, so that only clocks and deadlines are judged.

use std::collections::BTreeMap;
use std::sync::Arc;

use bundlemocap::config::Config;
use bundlemocap::core::body::{Pose, Skeleton};
use bundlemocap::core::camera::Rig;
use bundlemocap::core::manifold::TimedKeyframe;
use bundlemocap::core::stage::PerformerId;
use bundlemocap::core::time::{Nanos, Timestamp};
use bundlemocap::core::tracker::{Job, Outcome, Solution, Task, Tracked, Verdict};
use bundlemocap::io::wire::{
    self, DetectedPerson, KeypointFrame, Status, Topics, TrackingState, encode,
};
use bundlemocap::live::{Carried, Content, Core, Input, Output, Settings};

use crate::solve::{keyframe, ring};

const START: Timestamp = Timestamp::from_ns(1_700_000_000_000_000_000);
const CAMERAS: usize = 4;
/// From exposure to arrival, seconds; another millisecond comes and goes.
const NETWORK: f64 = 0.003;
/// When most things happen, seconds.
const THEN: f64 = 8.0;
/// A longer pause between poses counts as an interruption, seconds.
const GAP: f64 = 0.15;
/// Every case must be survived within this time, seconds.
const SURVIVED: f64 = 3.0;

/// A frame on its way; times in seconds.
#[derive(Clone, Copy)]
struct Frame {
    camera: usize,
    number: u64,
    /// The true time of exposure.
    at: f64,
    /// Its capture time.
    capture: f64,
    arrival: f64,
    is_lost: bool,
    /// Whether it shows nobody.
    is_empty: bool,
}

/// A thing that happens to the frames.
struct Case {
    name: String,
    seconds: f64,
    /// From when on poses should come again.
    from: f64,
    rates: [f64; CAMERAS],
    change: Box<dyn Fn(&mut Frame)>,
    /// Kinds of events after the first second, without those of single frames.
    events: &'static [&'static str],
}

fn case(
    name: impl Into<String>,
    events: &'static [&'static str],
    change: impl Fn(&mut Frame) + 'static,
) -> Case {
    let (name, change) = (name.into(), Box::new(change));
    Case { name, seconds: 20.0, from: THEN, rates: [60.0; CAMERAS], change, events }
}

/// What the node did.
#[derive(Default)]
struct Outcomes {
    /// Publication, capture and declared latency of each pose, seconds, and whether it is tracked.
    poses: Vec<(f64, f64, f64, bool)>,
    events: Vec<(f64, String, String)>,
    status: Vec<Status>,
}

fn seconds(time: Timestamp) -> f64 {
    time.seconds_since(START)
}

fn at(seconds: f64) -> Timestamp {
    START + Nanos::rounded(seconds * 1e9)
}

/// A solution made by hand: the performer stands still, and is seen if two cameras see somebody.
fn solved(job: &Job) -> Solution {
    let still = |time: Timestamp| TimedKeyframe::new(time, keyframe(0.7, 0.25));
    let mut seen = [false; CAMERAS];
    let frames = || job.frames.iter().filter(|frame| !frame.people.is_empty());
    frames().for_each(|frame| seen[frame.camera] = true);
    let is_seen = seen.iter().filter(|seen| **seen).count() >= 2;
    let outcome = match &job.task {
        Task::Acquire { .. } if !is_seen => Outcome::NobodyFound,
        Task::Acquire { .. } => {
            let first = frames().map(|frame| frame.capture).min().unwrap_or(job.start);
            let grid = [job.start].into_iter().chain(job.keyframe_times.iter().copied());
            let first = grid.filter(|time| *time >= first).min().unwrap_or(job.start);
            Outcome::Acquired {
                first: Box::new(still(first)),
                skeleton: Arc::new(Skeleton::default()),
                pose: Box::new(Pose::rest()),
            }
        }
        Task::Track { coasted, .. } => Outcome::Tracked(Box::new(Tracked {
            keyframes: job.keyframe_times.iter().copied().map(still).collect(),
            between: Vec::new(),
            poses: vec![Pose::rest(); job.pose_times.len()],
            deviations: None,
            newest: Pose::rest(),
            summary: None,
            residuals: Vec::new(),
            unfollowed: Vec::new(),
            verdict: match is_seen {
                true => Verdict::Tracked,
                false if *coasted < 6 => Verdict::Coasted("hidden".to_owned()),
                false => Verdict::Lost("hidden".to_owned()),
            },
            estimator: None,
        })),
        Task::Provisional { .. } => unreachable!("provisional poses are off"),
        Task::Mend { .. } => Outcome::Mended(None),
    };
    Solution { number: job.number, outcome }
}

/// A node in simulated time.
struct Node {
    core: Core,
    rig: Rig,
    now: Timestamp,
    wake: Option<Timestamp>,
    answer: Option<(Timestamp, Solution)>,
    heard: Outcomes,
}

impl Node {
    fn new() -> Self {
        let mut config = Config::default();
        config.node.provisional = false;
        let mut core = Core::new(Settings {
            tracker: config.tracker,
            stage: config.stage.clone(),
            node: config.node.clone(),
            toml: config.to_toml(),
            weights: String::new(),
            body: None,
            carried: Carried::default(),
            timecode: None,
        });
        let rig = ring();
        let (topic, payload) =
            (Topics::default().rig().into(), encode(&wire::Rig::from_core(&rig)));
        core.handle(at(-1.0), Input::Message { topic, payload });
        let heard = Outcomes::default();
        Self { core, rig, now: at(-1.0), wake: None, answer: None, heard }
    }

    /// The inputs until `until`: solutions and ticks.
    fn run_until(&mut self, until: Timestamp) {
        loop {
            let answer = self.answer.as_ref().map(|(at, _)| *at);
            let next = answer.into_iter().chain(self.wake).min();
            let Some(next) = next.filter(|next| *next <= until) else { break };
            self.now = self.now.max(next);
            let input = if answer == Some(next) {
                let (_, solution) = self.answer.take().unwrap();
                let (performer, took) = (PerformerId(0), Nanos::from_ms(5));
                Input::Solved { performer, solution: Box::new(solution), took }
            } else {
                self.wake = None;
                Input::Tick
            };
            self.tell(input);
        }
        self.now = until;
    }

    fn frame(&mut self, frame: &Frame) {
        self.run_until(at(frame.arrival).max(self.now));
        let camera = &self.rig.cameras[frame.camera];
        let points = (0..25).flat_map(|i| [500.0 + 10.0 * i as f32, 300.0, 1.0]).collect();
        let message = KeypointFrame {
            camera: camera.name.clone(),
            frame: frame.number,
            capture_time_ns: at(frame.capture).ns(),
            image_width: camera.width,
            image_height: camera.height,
            format: "body_25".to_owned(),
            people: match frame.is_empty {
                true => Vec::new(),
                false => vec![DetectedPerson { points, ..DetectedPerson::default() }],
            },
        };
        let topic = Topics::default().keypoints(&camera.name).into();
        self.tell(Input::Message { topic, payload: encode(&message) });
    }

    fn tell(&mut self, input: Input) {
        self.core.handle(self.now, input);
        while let Some(output) = self.core.poll() {
            match output {
                Output::Mended { .. } | Output::Body { .. } => {}
                Output::Wake(at) => self.wake = Some(at.max(self.now + Nanos::new(1))),
                Output::Solve { job, .. } => {
                    self.answer = Some((self.now + Nanos::from_ms(5), solved(&job)));
                }
                Output::Publish(publication) => match publication.content {
                    Content::Pose(pose) => {
                        let time = publication.due.unwrap_or(self.now).max(self.now);
                        let latency = pose.declared_latency_ns as f64 * 1e-9;
                        let is_tracked = pose.state() == TrackingState::Tracking;
                        let capture = seconds(Timestamp::from_ns(pose.capture_time_ns));
                        self.heard.poses.push((seconds(time), capture, latency, is_tracked));
                    }
                    Content::Event(event) => {
                        let name = event.camera.unwrap_or_default();
                        let detail = format!("{name} {}", event.detail);
                        self.heard.events.push((seconds(self.now), event.kind, detail));
                    }
                    Content::Status(status) => self.heard.status.push(*status),
                    _ => {}
                },
            }
        }
    }
}

/// All frames of a case, in order of arrival: those of a camera do not overtake each other.
fn frames(case: &Case) -> Vec<Frame> {
    let mut all = Vec::new();
    for camera in 0..CAMERAS {
        let mut last = f64::MIN;
        for number in 0..(case.seconds * case.rates[camera]) as u64 {
            let at = number as f64 / case.rates[camera];
            let jitter = 1e-3 * ((number * 7 + camera as u64 * 3) % 11) as f64 / 11.0;
            let arrival = at + NETWORK + jitter;
            let mut frame =
                Frame { camera, number, at, capture: at, arrival, is_lost: false, is_empty: false };
            (case.change)(&mut frame);
            frame.arrival = frame.arrival.max(last);
            last = frame.arrival;
            all.push(frame);
        }
    }
    all.retain(|frame| !frame.is_lost && frame.arrival < case.seconds);
    all.sort_by(|a, b| a.arrival.total_cmp(&b.arrival));
    all
}

fn run(case: &Case) -> Outcomes {
    let mut node = Node::new();
    frames(case).iter().for_each(|frame| node.frame(frame));
    node.heard
}

/// Runs a case, prints a line, and returns what is wrong with it.
fn judge(case: &Case) -> Option<String> {
    let heard = run(case);
    let poses = &heard.poses;
    // The last moment at which a pose was not tracked, or none came.
    let (mut worst, mut last_bad) = (0.0_f64, case.from);
    for pair in poses.windows(2).filter(|pair| pair[1].0 > 2.0) {
        let gap = pair[1].0 - pair[0].0;
        worst = worst.max(gap);
        if gap > GAP || !pair[1].3 {
            last_bad = last_bad.max(pair[1].0);
        }
    }
    let end = poses.last().map_or(f64::MIN, |pose| pose.0);
    let recovery = if end < case.seconds - GAP { f64::INFINITY } else { last_bad - case.from };
    let mut kinds: BTreeMap<&str, u64> = BTreeMap::new();
    heard.events.iter().for_each(|(_, kind, _)| *kinds.entry(kind).or_default() += 1);
    // Said by each node: the calibration, its latency, the kind of the clock, and the performer.
    for kind in ["calibrated", "rig_changed", "latency", "clock", "acquired"] {
        kinds.entry(kind).and_modify(|count| *count -= 1);
    }
    kinds.retain(|_, count| *count > 0);
    let latencies: Vec<i64> = {
        let mut all: Vec<i64> = poses.iter().map(|pose| (pose.2 * 1e3).round() as i64).collect();
        all.dedup();
        all
    };
    println!(
        "{:44} {:6} poses, gap {:5.2} s, recovery {:5.2} s, latency {latencies:?}, {kinds:?}",
        case.name,
        poses.len(),
        worst,
        recovery
    );
    let details = || -> Vec<String> {
        heard.events.iter().map(|(t, kind, detail)| format!("{t:.2} {kind}{detail}")).collect()
    };
    // What single frames and windows were, and that the performer was found again, is no news.
    let of_frames = ["late", "abandoned", "out_of_order", "duplicate", "missing"];
    let small = [&of_frames[..], &["acquired", "coasted", "lost", "deadline"]].concat();
    let mut main: Vec<&str> = Vec::new();
    for (kind, count) in kinds {
        if !small.contains(&kind) {
            main.extend(std::iter::repeat_n(kind, count as usize));
        }
    }
    // The governor and the counters take no pause for a fault, and the status says what it is.
    let status = heard.status.last().unwrap();
    let missed = status.playout.as_ref().map_or(0, |playout| playout.missed);
    let degraded = status.effort.as_ref().map_or(0, |effort| effort.degradation_steps);
    let is_idle = heard.status.iter().any(|status| status.tracker_state == "idle");
    let is_pause = case.name.starts_with("pause");
    let is_overtaken = poses.windows(2).any(|pair| pair[1].0 < pair[0].0);
    let is_wrong = recovery > SURVIVED
        || is_overtaken
        || main != case.events
        || (is_pause && (missed > 0 || recovery > 1.0 || (worst > 1.0 && !is_idle)))
        || degraded > 0;
    is_wrong.then(|| {
        format!(
            "{}: {main:?}, missed {missed}, degraded {degraded}, overtaken {is_overtaken}\n    {}",
            case.name,
            details().join("\n    ")
        )
    })
}

#[test]
fn every_storm_is_survived_within_three_seconds() {
    let mut cases = Vec::new();
    for step in [0.2, 0.5, 1.0, 2.0, 5.0, 60.0, 3600.0].into_iter().flat_map(|s| [s, -s]) {
        cases.push(case(format!("common clock steps {step:+} s"), &["clock_jump"], move |f| {
            f.capture += if f.at >= THEN { step } else { 0.0 };
        }));
    }
    for delay in [0.05, 0.2, 0.5, 1.0] {
        // A camera that is far too late is left out.
        let one: &[&str] = match delay {
            0.05 => &["latency"],
            0.2 => &["latency", "returned", "silent"],
            _ => &["clock_offset", "silent"],
        };
        let all: &[&str] = if delay > 0.25 { &["idle", "idle", "latency"] } else { &["latency"] };
        let back: &[&str] = match delay {
            0.05 | 0.2 => &["clock_offset", "clock_offset"],
            0.5 => &["clock_offset", "clock_offset", "clock_offset", "returned"],
            _ => &["clock_offset", "clock_offset", "returned", "silent"],
        };
        cases.push(case(format!("delay of one camera rises {delay} s"), one, move |f| {
            f.arrival += if f.camera == 1 && f.at >= THEN { delay } else { 0.0 };
        }));
        cases.push(case(format!("delay of all rises {delay} s"), all, move |f| {
            f.arrival += if f.at >= THEN { delay } else { 0.0 };
        }));
        cases.push(case(format!("delay of one camera falls {delay} s"), back, move |f| {
            f.arrival += if f.camera == 1 && f.at < THEN { delay } else { 0.0 };
        }));
        cases.push(case(format!("delay of all falls {delay} s"), &[], move |f| {
            f.arrival += if f.at < THEN { delay } else { 0.0 };
        }));
    }
    for ppm in [100.0, -100.0] {
        // Without motion nothing tells a slow clock from a slow detector.
        let events: &[&str] = match ppm > 0.0 {
            true => &["clock_offset"],
            false => &["clock_offset", "latency"],
        };
        let one = case(format!("clock of one camera drifts {ppm:+} ppm"), events, move |f| {
            f.capture += if f.camera == 1 { 1e-6 * ppm * f.at } else { 0.0 };
        });
        let all = case(format!("clock of all drifts {ppm:+} ppm"), &["clock"], move |f| {
            f.capture += 1e-6 * ppm * f.at;
        });
        cases.extend([one, all].map(|case| Case { seconds: 600.0, ..case }));
    }
    for (name, until, events) in [
        ("that drift, one never sends", 0.0, &["clock", "silent"][..]),
        ("that drift, one stops", 300.0, &["clock", "silent"][..]),
    ] {
        let all = case(format!("cameras {name}"), events, move |f| {
            f.capture -= 100e-6 * f.at;
            f.is_lost = f.camera == 3 && f.at >= until;
        });
        cases.push(Case { seconds: 600.0, ..all });
    }
    cases.push(case("detectors slow down to half the rate", &["latency"], |f| {
        f.is_lost = f.at >= THEN && f.number % 2 == 1;
    }));
    for pause in [0.5, 2.0, 6.0] {
        let is_in = move |f: &Frame| (THEN - pause..THEN).contains(&f.at);
        cases.push(case(format!("pause of {pause} s"), &["idle", "idle"], move |f| {
            f.is_lost = is_in(f);
        }));
        cases.push(case(
            format!("pause of {pause} s, frames had queued"),
            &["idle", "idle"],
            move |f| {
                f.arrival = if is_in(f) { THEN } else { f.arrival };
            },
        ));
    }
    const EPOCH: f64 = -1.6e9;
    for camera in [0, 2] {
        cases.push(case(
            format!("camera {camera} has another epoch"),
            &["clock_offset"],
            move |f| {
                f.capture += if f.camera == camera { EPOCH } else { 0.0 };
            },
        ));
    }
    cases.push(case("a camera gets another epoch", &["clock_offset"], |f| {
        f.capture += if f.camera == 2 && f.at >= THEN { EPOCH } else { 0.0 };
    }));
    for (name, offset) in [
        ("all have another epoch", EPOCH),
        ("TAI", 37.0),
        ("all 0.4 s ahead", 0.4),
        ("all 30 s behind", -30.0),
    ] {
        cases.push(case(name, &[], move |f| f.capture += offset));
    }
    cases.push(case("an outlier of 400 ms in the first second", &[], |f| {
        f.arrival += if f.camera == 1 && f.number == 30 { 0.4 } else { 0.0 };
    }));
    cases.push(case("a stall of 400 ms in the first second", &["idle", "idle"], |f| {
        f.arrival = if (0.4..0.8).contains(&f.at) { 0.8 } else { f.arrival };
    }));
    cases.push(case("late frames of one camera for 1.8 s", &["returned", "silent"], |f| {
        let is_late = f.camera == 1 && (THEN - 1.8..THEN).contains(&f.at);
        f.arrival = if is_late { THEN } else { f.arrival };
    }));
    for (name, epoch, events) in [
        ("a camera restarts its counter", 0.0, &["returned", "silent"][..]),
        ("a camera restarts its counter and clock", EPOCH, &["clock_offset", "silent"][..]),
    ] {
        cases.push(case(name, events, move |f| {
            if f.camera == 1 {
                f.is_lost = (THEN - 2.0..THEN).contains(&f.at);
                if f.at >= THEN {
                    f.number -= (60.0 * THEN) as u64;
                    f.capture += epoch;
                }
            }
        }));
    }
    let events = &["idle", "idle", "latency", "latency"];
    let back = case("delay of all rises 0.5 s, for 8 s", events, |f| {
        f.arrival += if (THEN..2.0 * THEN).contains(&f.at) { 0.5 } else { 0.0 };
    });
    // The latency falls after half a minute.
    cases.push(Case { seconds: 60.0, from: 46.0, ..back });
    let events = &["latency", "returned", "silent"];
    cases.push(case("delay of one camera rises 0.2 s, for 5 s", events, |f| {
        let is_late = f.camera == 1 && (THEN - 5.0..THEN).contains(&f.at);
        f.arrival += if is_late { 0.2 } else { 0.0 };
    }));
    cases.push(case(
        "pause: nobody is there for 6 s",
        &["idle", "idle", "left", "nobody_found"],
        |f| {
            f.is_empty = (THEN - 6.0..THEN).contains(&f.at);
        },
    ));
    let wrong: Vec<String> = cases.iter().filter_map(judge).collect();
    assert!(wrong.is_empty(), "{} of {}:\n{}", wrong.len(), cases.len(), wrong.join("\n"));
}

/// Cameras of any rates that run free: no window closes without frames that come in time.
#[test]
fn free_running_cameras_raise_no_alarm() {
    // The phases drift through whole frames. An hour takes a minute: BUNDLEMOCAP_LONG=1.
    let seconds = if std::env::var_os("BUNDLEMOCAP_LONG").is_some() { 3600.0 } else { 250.0 };
    let quiet = |name: &str, rates: [f64; CAMERAS], phase: fn(usize) -> f64| {
        let change = move |frame: &mut Frame| {
            let moved = phase(frame.camera) / rates[frame.camera];
            frame.capture += moved;
            frame.arrival += moved;
        };
        Case { seconds, rates, ..case(name, &[], change) }
    };
    let drifting = |rates: [f64; CAMERAS]| -> [f64; CAMERAS] {
        std::array::from_fn(|camera| rates[camera] * (1.0 + 50e-6 * camera as f64))
    };
    let cases = [
        quiet("two of four half a frame later", [60.0; CAMERAS], |c| (c / 2) as f64 * 0.5),
        quiet("60 fps, phases drift by 50 ppm", drifting([60.0; CAMERAS]), |_| 0.0),
        quiet("60, 60, 30 and 50 fps, drifting", drifting([60.0, 60.0, 30.0, 50.0]), |_| 0.1),
    ];
    for case in &cases {
        let heard = run(case);
        let mut kinds: BTreeMap<&str, u64> = BTreeMap::new();
        heard.events.iter().for_each(|(_, kind, _)| *kinds.entry(kind).or_default() += 1);
        let status = heard.status.last().unwrap();
        let tracked = heard.poses.iter().filter(|pose| pose.3).count();
        let latency = status.declared_latency_ns / 1_000_000;
        println!("{:34} {tracked} poses, latency {latency} ms, {kinds:?}", case.name);
        assert!(kinds.into_values().all(|count| count == 1), "{:?}", heard.events);
        assert_eq!(tracked, heard.poses.len());
        for (camera, rate) in status.cameras.iter().zip(case.rates) {
            // All but those of the first window and of the last one, which is open.
            let sent = (rate * (seconds - 1.0)) as u64;
            assert!(camera.used + (rate as u64) > sent, "{} of {sent}", camera.used);
        }
    }
}
