//! What `run` says about its cameras: where they send if the node hears none, and whether they fit. Wrong clocks are
//! corrected.

mod clocks;
mod silence;

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::clock::ATTENTION;
use crate::cli::tools::inbox::Inbox;
use crate::cli::tools::survey::{other_stages, survey};
use crate::core::camera::Rig;
use crate::core::points::median;
use crate::core::time::Timestamp;
use crate::core::tracker::Config;
use crate::diagnose::{CameraCheck, Check, Evidence};
use crate::io::bus::{Bus, BusError};
use crate::io::wire::{self, KeypointFrame, Topics, decode};
use crate::live::Monitor;
use clocks::{Clocks, are_same, corrected, corrections};
use silence::Silence;

/// If no camera was heard for this long, others are looked for, for so long, and again after a while.
const PATIENCE: Duration = Duration::from_secs(5);
const SURVEY: Duration = Duration::from_secs(1);
const AGAIN: Duration = Duration::from_secs(60);
/// Cameras are judged when each has seen somebody in this many frames, and not before this time. If
/// only two or more of them have, the others get some time to do so.
const FRAMES: usize = 300;
const LEAST: Duration = Duration::from_secs(5);
const CHANCE: Duration = Duration::from_secs(30);
/// Most arrivals of a camera that are kept while nobody is in view.
const MOST_ARRIVALS: usize = 32_768;
/// A camera's clock has the right rate if it agrees with the arrival of its frames within this part.
const RIGHT_RATE: f64 = 0.01;
/// Cameras are judged again after this time; after the second one if something is wrong, or a camera is not in use. A
/// performer who stands still shows no wrong clock, and a camera may be restarted.
const REST: Duration = Duration::from_secs(60);
const SHORT_REST: Duration = Duration::from_secs(15);
/// Most verdicts that the node is told after one check.
const MOST_VERDICTS: usize = 8;

/// Looks after the cameras of a node until it is over, and corrects their clocks if `corrects`. Its thread gives way to
/// all others. It ends soon after: a running check, which may take seconds, has a thread of its own that nothing waits
/// for.
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
    // A calibration that was judged, and until when that holds.
    let mut judged: Option<(Vec<u8>, Instant)> = None;
    // What was found then.
    let mut said = None;
    let (mut rig_of_clocks, mut clocks) = (Vec::new(), Clocks::default());
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
        let holds = |rig: &Vec<u8>| {
            judged.as_ref().is_some_and(|(of, until)| of == rig && Instant::now() < *until)
        };
        let Some(bytes) = node.rig().filter(|rig| !holds(rig)) else { continue };
        let rig = decode::<wire::Rig>(&bytes).and_then(|rig| rig.to_core());
        let Ok(rig) = rig else { continue };
        if rig_of_clocks != bytes {
            (rig_of_clocks, clocks) = (bytes.clone(), Clocks::default());
        }
        let goes_on = || !is_over() && node.rig().as_ref() == Some(&bytes);
        let corrected_rig = corrected(&rig, &corrections(node));
        if let Some(evidence) = watch(bus, topics, &corrected_rig, goes_on)? {
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
            if !are_same(&before, &now) || node.rig().as_ref() != Some(&bytes) {
                // Motion, or somebody, has corrected the clocks meanwhile; or there is another calibration.
                continue;
            }
            let (mut orders, mut rest, mut told) = (Vec::new(), SHORT_REST, Vec::new());
            if let Ok(check) = check.join() {
                let status = node.status().unwrap_or_default();
                let unused = not_in_use(&status);
                if check.is_clean() && unused.is_empty() {
                    rest = REST;
                }
                let causes = Some(causes(&check, &unused));
                if causes != said {
                    say(&check, &unused);
                    said = causes;
                }
                told = verdicts(&check, &status);
                if corrects {
                    orders = clocks.orders(&check, &now);
                }
            }
            // Corrected clocks are judged again at once.
            let is_final = orders.is_empty() && !clocks.are_tried();
            judged = is_final.then(|| (bytes, Instant::now() + rest));
            let told = told.iter().filter(|_| is_final);
            orders.iter().chain(told).for_each(|order| node.order(order));
        }
    }
    Ok(())
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
    let mut arrivals = vec![Arrivals::default(); rig.cameras.len()];
    let mut since = None;
    while goes_on() {
        let Some(received) = inbox.next(ATTENTION) else { continue };
        let frame = decode::<KeypointFrame>(&received.sample.payload).ok();
        let frame = frame.and_then(|frame| frame.to_core(|name| rig.index_of(name)).ok());
        let Some(frame) = frame else { continue };
        evidence.add(&frame, 0);
        arrivals[frame.camera].add(frame.capture, received.arrival);
        let now = begin.elapsed();
        let Some(patience) = patience(evidence.with_people()) else { continue };
        if now - *since.get_or_insert(now) >= patience && now >= LEAST {
            let mut drifts = arrivals.iter().filter_map(Arrivals::drift);
            if drifts.all(|drift| drift.abs() < RIGHT_RATE) {
                evidence.rates_are_right();
            }
            return Ok(Some(evidence));
        }
    }
    Ok(None)
}

/// The capture times of a camera's frames, and how long after them the frames arrived, seconds.
#[derive(Clone, Default)]
struct Arrivals(Vec<(Timestamp, f64)>);

impl Arrivals {
    fn add(&mut self, capture: Timestamp, arrival: Timestamp) {
        if self.0.len() >= MOST_ARRIVALS {
            self.0.drain(..MOST_ARRIVALS / 2);
        }
        self.0.push((capture, arrival.seconds_since(capture)));
    }

    /// How much slower its clock is than this computer's, as a part of time; `None`: too few frames have come.
    fn drift(&self) -> Option<f64> {
        let quarter = self.0.len() / 4;
        let part = |from: usize| {
            let part = &self.0[from..from + quarter];
            let late = median(&mut part.iter().map(|(_, late)| *late).collect::<Vec<_>>())?;
            Some((part.get(quarter / 2)?.0, late))
        };
        let ((begin, first), (end, last)) = (part(0)?, part(self.0.len() - quarter)?);
        let seconds = end.seconds_since(begin);
        (self.0.len() >= FRAMES / 2 && seconds > 0.0).then(|| (last - first) / seconds)
    }
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

/// The cameras that send nothing that can be used.
fn not_in_use(status: &wire::Status) -> Vec<&str> {
    let cameras = status.cameras.iter().filter(|camera| camera.rate_hz == 0.0);
    cameras.map(|camera| camera.camera.as_str()).collect()
}

/// The causes of all faults, with their cameras, and the cameras that are not in use. They are said when they change.
fn causes(check: &Check, unused: &[&str]) -> Vec<String> {
    let of_camera = |camera: &CameraCheck| {
        let findings = camera.findings.iter();
        findings.map(|found| format!("{} {}", camera.camera, found.cause)).collect::<Vec<_>>()
    };
    let all = check.findings.iter().map(|found| found.cause.to_owned());
    let unused = unused.iter().map(|camera| (*camera).to_owned());
    check.cameras.iter().flat_map(of_camera).chain(all).chain(unused).collect()
}

/// What the node is to tell of its cameras: the verdicts that are not in its status. There are so many at a time, for
/// the node takes a limited number of orders a second.
fn verdicts(check: &Check, status: &wire::Status) -> Vec<wire::Take> {
    let order = |name: &str, before: &str, note: String| {
        let (action, name) = ("verdict".to_owned(), name.to_owned());
        (note != before).then(|| wire::Take { action, name, note, ..wire::Take::default() })
    };
    let of_camera = |counters: &wire::CameraCounters| {
        let mut cameras = check.cameras.iter();
        let camera = cameras.find(|camera| camera.camera == counters.camera)?;
        // Who saw nobody this time is not judged anew.
        let is_judged = camera.agreeing_percent.is_some() || !camera.findings.is_empty();
        order(&counters.camera, &counters.verdict, camera.fault()).filter(|_| is_judged)
    };
    let of_all = order("", &status.verdict, check.fault());
    of_all
        .into_iter()
        .chain(status.cameras.iter().filter_map(of_camera))
        .take(MOST_VERDICTS)
        .collect()
}

fn say(check: &Check, unused: &[&str]) {
    for warning in check.warnings() {
        tracing::warn!("{warning}");
    }
    if check.is_clean() {
        let others = match unused {
            [] => String::new(),
            names => format!(", without {}", names.join(", ")),
        };
        let height = check
            .performer_height_m
            .map_or(String::new(), |height| format!(", the performer is {height:.2} m high"));
        tracing::info!("the cameras fit each other{others}{height}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::time::Nanos;

    #[test]
    fn a_clock_that_runs_with_the_arrival_of_its_frames_has_the_right_rate() {
        let drift = |rate: f64| {
            let mut arrivals = Arrivals::default();
            for frame in 0..300_u64 {
                // Now and then the network is slow.
                let late = if frame % 7 == 0 { 0.08 } else { 0.02 };
                let arrival = Timestamp::of_frame(frame, 60.0) + Nanos::rounded(late * 1e9);
                arrivals.add(Timestamp::of_frame(frame, 60.0 * rate), arrival);
            }
            arrivals.drift().unwrap()
        };
        assert!(drift(1.0).abs() < 1e-6);
        assert!((drift(0.96) + 0.04).abs() < 0.001, "{}", drift(0.96));
        assert_eq!(Arrivals::default().drift(), None);
    }

    #[test]
    fn the_node_is_told_what_its_status_does_not_have() {
        let check = clocks::tests::check(Nanos::ZERO);
        let camera = |name: &str| wire::CameraCounters {
            camera: name.to_owned(),
            verdict: if name == "cam03" { "mirrored".into() } else { String::new() },
            ..wire::CameraCounters::default()
        };
        let cameras = ["cam01", "cam02", "cam03", "cam04"].map(camera).to_vec();
        let mut status = wire::Status { cameras, ..wire::Status::default() };
        let told = verdicts(&check, &status);
        assert!(told.iter().all(|order| order.action == "verdict"), "{told:?}");
        let [late, fine] = &told[..] else { panic!("{told:?}") };
        assert!(late.name == "cam02" && late.note.contains("late"), "{late:?}");
        assert_eq!((&*fine.name, &*fine.note), ("cam03", ""));
        late.note.clone_into(&mut status.cameras[1].verdict);
        status.cameras[2].verdict.clear();
        status.verdict = "in millimetres".into();
        let told = verdicts(&check, &status);
        assert!(
            matches!(&told[..], [all] if all.name.is_empty() && all.note.is_empty()),
            "{told:?}"
        );
        // Who saw nobody this time keeps the verdict.
        let mut check = check;
        (check.cameras[1].agreeing_percent, check.cameras[1].findings) = (None, Vec::new());
        status.verdict.clear();
        assert_eq!(verdicts(&check, &status), Vec::new());
    }

    #[test]
    fn cameras_that_just_begin_are_not_judged_yet() {
        assert_eq!(patience(&[FRAMES, FRAMES - 1, 0]), None);
        assert_eq!(patience(&[FRAMES, 0, FRAMES]), Some(CHANCE));
        assert_eq!(patience(&[FRAMES; 3]), Some(Duration::ZERO));
    }
}
