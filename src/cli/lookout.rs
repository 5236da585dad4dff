//! What `run` says about its cameras: where they send if the node hears none, and whether they fit. Wrong clocks are
//! corrected.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::clock::ATTENTION;
use crate::cli::tools::inbox::Inbox;
use crate::cli::tools::survey::{other_stages, survey};
use crate::core::camera::{Camera, Rig};
use crate::core::time::Nanos;
use crate::core::tracker::Config;
use crate::diagnose::{Check, Evidence};
use crate::io::bus::{Bus, BusError};
use crate::io::wire::{self, CameraCounters, KeypointFrame, Status, Take, Topics, decode};
use crate::live::Monitor;

/// If no camera was heard for this long, others are looked for, for so long, and again after a while.
const PATIENCE: Duration = Duration::from_secs(5);
const SURVEY: Duration = Duration::from_secs(1);
const AGAIN: Duration = Duration::from_secs(60);
/// Cameras are judged when each has seen somebody in this many frames, and not before this time. If
/// only two or more of them have, the others get some time to do so.
const FRAMES: usize = 300;
const LEAST: Duration = Duration::from_secs(5);
const CHANCE: Duration = Duration::from_secs(30);

/// A camera that was silent for longer, seconds, may be another one, or in another place.
const SILENT_S: f64 = 2.0;
/// A check holds if meanwhile no clock was corrected by more.
const SAME_CLOCK: Nanos = Nanos::from_ms(10);
/// A correction must lower the error of a camera to this part.
const LOWERED: f64 = 0.9;

/// Looks after the cameras of a node until it is over, and corrects their clocks if `corrects`. Its thread gives way to all others. It ends soon
/// after: a running check, which may take seconds, has a thread of its own that nothing waits for.
///
/// # Errors
/// The bus refuses a subscription.
pub(super) fn look(
    bus: &dyn Bus,
    topics: &Topics,
    node: &Monitor,
    corrects: bool,
    is_over: impl Fn() -> bool,
) -> Result<(), BusError> {
    #[cfg(target_os = "linux")]
    let _ = rustix::process::nice(19);
    let mut at = Instant::now() + PATIENCE;
    let mut judged = None;
    let mut clocks = Clocks::default();
    let mut silence = Silence::default();
    while !is_over() {
        std::thread::sleep(ATTENTION);
        let status = node.status().unwrap_or_default();
        for camera in silence.returned(&status) {
            judged = None;
            clocks.forget(&camera);
        }
        if status.cameras.iter().all(|camera| camera.age_s == 0.0) {
            if Instant::now() >= at {
                search(bus, &topics.stage, &is_over)?;
                at = Instant::now() + AGAIN;
            }
            continue;
        }
        let Some(bytes) = node.rig().filter(|rig| Some(rig) != judged.as_ref()) else { continue };
        let rig = decode::<wire::Rig>(&bytes).and_then(|rig| rig.to_core());
        let Ok(rig) = rig else { continue };
        if clocks.rig != bytes {
            clocks = Clocks { rig: bytes.clone(), ..Clocks::default() };
        }
        let goes_on = || !is_over() && node.rig().as_ref() == Some(&bytes);
        let rig_now = corrected(&rig, &corrections(node));
        if let Some(evidence) = watch(bus, topics, &rig_now, goes_on)? {
            let before = corrections(node);
            let rig = corrected(&rig, &before);
            let check = std::thread::spawn(move || evidence.check(&rig));
            while !check.is_finished() {
                if is_over() {
                    return Ok(());
                }
                std::thread::sleep(ATTENTION);
            }
            let now = corrections(node);
            let is_same = |(name, before): (&String, &Nanos)| {
                now.get(name).is_some_and(|now| (*now - *before).abs() < SAME_CLOCK)
            };
            if !before.iter().all(is_same) {
                // Motion, or somebody, has corrected the clocks meanwhile.
                continue;
            }
            let mut orders = Vec::new();
            if let Ok(check) = check.join() {
                say(&check);
                if corrects {
                    orders = clocks.orders(&check, &now);
                }
            }
            // Corrected clocks are judged again.
            judged = (orders.is_empty() && clocks.tried.is_empty()).then_some(bytes);
            orders.iter().for_each(|order| node.order(order));
        }
    }
    Ok(())
}

/// What the node adds to the capture times of its cameras, by name.
fn corrections(node: &Monitor) -> BTreeMap<String, Nanos> {
    let of =
        |camera: CameraCounters| (camera.camera, Nanos::rounded(camera.time_correction_s * 1e9));
    node.status().into_iter().flat_map(|status| status.cameras).map(of).collect()
}

/// The cameras, with the corrections in their time offsets.
fn corrected(rig: &Rig, corrections: &BTreeMap<String, Nanos>) -> Rig {
    let mut rig = rig.clone();
    let by = |camera: &Camera| corrections.get(&camera.name).copied().unwrap_or_default();
    let by: Vec<Nanos> = rig.cameras.iter().map(by).collect();
    rig.shift_times(&by);
    rig
}

/// The clocks of the cameras of a calibration: what was tried.
#[derive(Default)]
struct Clocks {
    rig: Vec<u8>,
    /// By name: the error before the order, and by how much it changed the correction.
    tried: BTreeMap<String, (f64, Nanos)>,
    /// Cameras of which a correction was of no use.
    not_to_correct: Vec<String>,
}

impl Clocks {
    /// A camera may have another clock.
    fn forget(&mut self, camera: &String) {
        self.tried.remove(camera);
        self.not_to_correct.retain(|name| name != camera);
    }

    /// What the node is to do after a check: it corrects capture times that are early or late, and takes back corrections
    /// after which a camera fits no better.
    fn orders(&mut self, check: &Check, corrections: &BTreeMap<String, Nanos>) -> Vec<Take> {
        let mut orders = Vec::new();
        for row in &check.cameras {
            // Otherwise it hardly sees anybody now.
            let Some(error) = row.mean_error else { continue };
            let tried = self.tried.remove(&row.camera);
            let undone = tried.filter(|(before, _)| error > LOWERED * before).map(|(_, by)| -by);
            self.not_to_correct.extend(undone.map(|_| row.camera.clone()));
            let late = row.times.and_then(|wrong| wrong.late());
            let late = late.filter(|_| !self.not_to_correct.contains(&row.camera));
            self.tried.extend(late.map(|late| (row.camera.clone(), (error, -late))));
            let now = corrections.get(&row.camera).copied().unwrap_or_default();
            orders.extend(undone.or(late.map(|late| -late)).map(|by| Take {
                action: "clock".to_owned(),
                name: row.camera.clone(),
                offset_ms: (now + by).ms(),
                ..Take::default()
            }));
        }
        orders
    }
}

/// Which cameras are silent while others send.
#[derive(Default)]
struct Silence {
    /// By name, the correction of its capture times when it fell silent.
    silent: BTreeMap<String, f64>,
    /// The cameras that sent at the last look.
    heard: BTreeSet<String>,
}

impl Silence {
    /// The cameras that send again. Not those that the node had left out for their correction, nor any after all were
    /// silent: the detectors may be stopped between takes.
    fn returned(&mut self, status: &Status) -> Vec<String> {
        let all: Vec<_> = status.cameras.iter().filter(|camera| camera.age_s > 0.0).collect();
        let (silent, heard): (Vec<_>, Vec<_>) =
            all.into_iter().partition(|camera| camera.age_s > SILENT_S);
        let mut before = std::mem::take(&mut self.silent);
        for camera in silent.iter().filter(|_| !heard.is_empty()) {
            let known = before.remove(&camera.camera);
            let is_new = self.heard.contains(&camera.camera).then_some(camera.time_correction_s);
            self.silent.extend(known.or(is_new).map(|by| (camera.camera.clone(), by)));
        }
        self.heard = heard.iter().map(|camera| camera.camera.clone()).collect();
        let is_same = |camera: &&&CameraCounters| {
            before.get(&camera.camera) == Some(&camera.time_correction_s)
        };
        heard.iter().filter(is_same).map(|camera| camera.camera.clone()).collect()
    }
}

/// Says what is on the bus while no camera sends on this stage.
fn search(bus: &dyn Bus, stage: &str, is_over: impl Fn() -> bool) -> Result<(), BusError> {
    let seen = survey(bus, SURVEY, || !is_over())?;
    if is_over() || seen.keys().any(|(of, _)| of == stage) {
        return Ok(());
    }
    match &*other_stages(&seen, stage) {
        [] => tracing::warn!(
            "no camera sends keypoints; start the detectors, and connect them to this address"
        ),
        others => tracing::warn!(
            "no camera sends on stage {stage}, but on {}; set [node] stage here or theirs",
            others.join(", ")
        ),
    }
    Ok(())
}

/// What the cameras send, enough to judge them; `None` if it does not go on for long enough.
fn watch(
    bus: &dyn Bus,
    topics: &Topics,
    rig: &Rig,
    goes_on: impl Fn() -> bool,
) -> Result<Option<Evidence>, BusError> {
    let inbox = Inbox::open(bus, &topics.keypoints("*"))?;
    let begin = Instant::now();
    let mut evidence = Evidence::new(Arc::new(rig.clone()), Config::default(), None);
    let mut since = None;
    while goes_on() {
        let Some(received) = inbox.next(ATTENTION) else { continue };
        let frame = decode::<KeypointFrame>(&received.sample.payload).ok();
        let frame = frame.and_then(|frame| frame.to_core(|name| rig.index_of(name)).ok());
        let Some(frame) = frame else { continue };
        evidence.add(&frame, 0);
        let now = begin.elapsed();
        let Some(patience) = patience(evidence.with_people()) else { continue };
        if now - *since.get_or_insert(now) >= patience && now >= LEAST {
            return Ok(Some(evidence));
        }
    }
    Ok(None)
}

/// How long to wait before cameras are judged that have seen somebody in that many frames each; `None`:
/// not yet known.
fn patience(with_people: &[usize]) -> Option<Duration> {
    match with_people.iter().filter(|count| **count >= FRAMES).count() {
        all if all == with_people.len() => Some(Duration::ZERO),
        2.. => Some(CHANCE),
        _ => None,
    }
}

fn say(check: &Check) {
    for warning in check.warnings() {
        tracing::warn!("{warning}");
    }
    if check.is_clean() {
        let height = check
            .performer_height_m
            .map_or(String::new(), |height| format!(", the performer is {height:.2} m high"));
        tracing::info!("the cameras fit each other{height}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::Skeleton;
    use crate::research::synth::{Motion, MotionStyle, Recording, ring_rig};

    const LATE: Nanos = Nanos::from_ms(100);

    /// The check of four cameras, the second of which is late and has this correction.
    fn check(correction: Nanos) -> Check {
        let skeleton = Skeleton::default();
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let mut rig = ring_rig(4, 4.0, 1.6).unwrap();
        let mut recording = Recording::new(rig.clone(), skeleton, |seconds| motion.pose(seconds));
        (recording.fps, recording.frames) = (60.0, 480);
        rig.shift_time(1, correction);
        let mut evidence = Evidence::new(Arc::new(rig.clone()), Config::default(), None);
        for mut frame in recording.detections() {
            if frame.camera == 1 {
                frame.capture = frame.capture + LATE;
            }
            evidence.add(&frame, 0);
        }
        evidence.check(&rig)
    }

    /// The corrections that are ordered, milliseconds, while the node has one of the second camera.
    fn ordered(clocks: &mut Clocks, check: &Check, correction: Nanos) -> Vec<f64> {
        let now = BTreeMap::from([("cam02".to_owned(), correction)]);
        let orders = clocks.orders(check, &now);
        let sound = |order: &Take| order.name == "cam02" && order.action == "clock";
        assert!(orders.iter().all(sound), "{orders:?}");
        orders.iter().map(|order| order.offset_ms.round()).collect()
    }

    #[test]
    fn a_late_clock_is_corrected_and_a_correction_of_no_use_is_taken_back() {
        let (late, right) = (check(Nanos::ZERO), check(-LATE));
        let mut clocks = Clocks::default();
        assert_eq!(ordered(&mut clocks, &late, Nanos::ZERO), [-100.0]);
        assert!(right.is_clean());
        assert!(ordered(&mut clocks, &right, -LATE).is_empty());

        // It was of no use, and is not tried again.
        let before = Nanos::from_ms(7);
        assert_eq!(ordered(&mut clocks, &late, before), [-93.0]);
        // Meanwhile, all cameras were shifted by 3 ms.
        assert_eq!(ordered(&mut clocks, &late, before - LATE + Nanos::from_ms(3)), [10.0]);
        assert!(ordered(&mut clocks, &late, before).is_empty());
    }

    #[test]
    fn a_camera_that_returns_alone_is_judged_again() {
        let mut silence = Silence::default();
        let mut returned = |ages: [f64; 3], time_correction_s: f64| {
            let names = ["one", "two", "three"];
            let camera = |(name, age_s): (&str, f64)| {
                let counters = CameraCounters { time_correction_s, ..CameraCounters::default() };
                CameraCounters { camera: name.into(), age_s, ..counters }
            };
            let cameras = names.into_iter().zip(ages).map(camera).collect();
            silence.returned(&Status { cameras, ..Status::default() })
        };
        let sends = [0.01; 3];
        // The third one has not begun.
        assert!(returned([0.01, 0.01, 0.0], 0.0).is_empty());
        assert!(returned([0.01, 3.0, 0.01], 0.0).is_empty());
        assert!(returned([0.01, 4.0, 0.01], 0.0).is_empty());
        assert_eq!(returned(sends, 0.0), ["two"]);
        assert!(returned(sends, 0.0).is_empty());
        // All stop and go on, one after the other.
        for ages in [[3.0, 0.01, 0.01], [4.0, 3.0, 0.01], [5.0; 3], [0.01, 6.0, 6.0], sends] {
            assert!(returned(ages, 0.0).is_empty());
        }
        // The node left it out because of a correction.
        assert!(returned([0.01, 3.0, 0.01], -1.0).is_empty());
        assert!(returned(sends, 0.0).is_empty());
    }

    #[test]
    fn cameras_that_just_begin_are_not_judged_yet() {
        assert_eq!(patience(&[FRAMES, FRAMES - 1, 0]), None);
        assert_eq!(patience(&[FRAMES, 0, FRAMES]), Some(CHANCE));
        assert_eq!(patience(&[FRAMES; 3]), Some(Duration::ZERO));
    }
}
