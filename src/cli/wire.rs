//! Messages as lines of text.

use crate::core::time::{Nanos, Timestamp};
use crate::io::recording::Message;
use crate::io::wire::journal_entry::Input;
use crate::io::wire::{
    CameraCounters, Event, HandOver, Journal, JournalEntry, Keyframe, KeypointFrame, KeypointSet,
    Pose, RetargetedPose, StagePerformer, StageStatus, Status, Take, TakeAnswer, TrackingState,
};

/// The main fields of a message; `None` for an unknown schema. `arrival` is the time of arrival.
pub(super) fn text(message: &Message, arrival: Timestamp) -> Option<String> {
    Some(match message {
        Message::Keypoints(frame) => keypoints(frame, arrival),
        Message::KeypointSet(set) => keypoint_set(set, arrival),
        Message::HandOver(state) => hand_over(state),
        Message::Rig(rig) => {
            let names: Vec<&str> = rig.cameras.iter().map(|camera| camera.name.as_str()).collect();
            format!("version {}, {} cameras: {}", rig.version, names.len(), names.join(", "))
        }
        Message::Pose(pose) | Message::TruthPose(pose) => self::pose(pose, arrival),
        Message::Keyframe(keyframe) => self::keyframe(keyframe, arrival),
        Message::Skeleton(skeleton) | Message::TruthSkeleton(skeleton) => {
            format!("{} joints, shape {}", skeleton.joint_names.len(), list(&skeleton.shape, 2))
        }
        Message::Event(event) => self::event(event),
        Message::Status(status) => self::status(status),
        Message::StageStatus(status) => stage(status),
        Message::Journal(journal) => self::journal(journal),
        Message::Retargeted(pose) => retargeted(pose, arrival),
        Message::Take(Take { action, name, .. }) => format!("take {action} {name}"),
        Message::TakeAnswer(TakeAnswer { role, free_bytes: free @ 1.., .. }) => {
            format!("{role}: {:.1} GB free", *free as f64 / 1e9)
        }
        Message::TakeAnswer(TakeAnswer { role, text, .. }) => format!("{role}: {text}"),
        Message::Other { .. } => return None,
    })
}

fn latency(capture_ns: i64, arrival: Timestamp) -> String {
    format!("latency {}", arrival - Timestamp::from_ns(capture_ns))
}

fn list(numbers: &[f64], digits: usize) -> String {
    let numbers: Vec<String> = numbers.iter().map(|x| format!("{x:.digits$}")).collect();
    format!("[{}]", numbers.join(", "))
}

fn state(wire: i32) -> &'static str {
    match TrackingState::try_from(wire) {
        Ok(TrackingState::Tracking) => "tracking",
        Ok(TrackingState::Coasting) => "coasting",
        Ok(TrackingState::Lost) => "lost",
        Ok(TrackingState::Unspecified) | Err(_) => "no state",
    }
}

fn keypoint_set(set: &KeypointSet, arrival: Timestamp) -> String {
    let seen = set.frames.iter().filter(|frame| !frame.people.is_empty()).count();
    let begins = match (set.enters, set.returns) {
        (true, _) => ", enters",
        (_, true) => ", returns",
        _ => "",
    };
    let latency = latency(set.complete_ns, arrival);
    format!(
        "number {}, seen by {seen} of {} cameras{begins}, {latency}",
        set.performer,
        set.frames.len()
    )
}

fn hand_over(state: &HandOver) -> String {
    let HandOver { performer, solver, window, .. } = state;
    let does = if state.released { "released by" } else { "solved by" };
    let what = match state.past.is_empty() {
        true => "searched".to_owned(),
        false => format!("{} keyframes", state.past.len() + state.ahead.len()),
    };
    format!("number {performer}, {does} {solver}, next window {window}, {what}")
}

fn keypoints(frame: &KeypointFrame, arrival: Timestamp) -> String {
    let people = match frame.people.len() {
        1 => "1 person".to_owned(),
        n => format!("{n} people"),
    };
    let latency = latency(frame.capture_time_ns, arrival);
    format!("frame {}, {people} in {}, {latency}", frame.frame, frame.format)
}

fn pose(pose: &Pose, arrival: Timestamp) -> String {
    let kind = match (pose.provisional, pose.revision) {
        (true, revision) => format!("provisional {revision}, "),
        (false, 0) => String::new(),
        (false, revision) => format!("revision {revision}, "),
    };
    let punctuality = pose.due_time_ns.map_or_else(String::new, |due| {
        let declared = Nanos::new(i64::try_from(pose.declared_latency_ns).unwrap_or(i64::MAX));
        let late = arrival - Timestamp::from_ns(due);
        let word = if late < Nanos::ZERO { "early" } else { "late" };
        format!(", declared {declared}, {:.2} {word}", late.abs())
    });
    let root = list(&pose.root_position_m, 3);
    let (window, state) = (pose.window, state(pose.state));
    let latency = latency(pose.capture_time_ns, arrival);
    format!("{kind}window {window}, {state}, root {root} m, {latency}{punctuality}")
}

fn retargeted(pose: &RetargetedPose, arrival: Timestamp) -> String {
    let (joints, state) = (pose.joint_names.len(), state(pose.state));
    let hips = list(&pose.hips_position_m, 3);
    let latency = latency(pose.capture_time_ns, arrival);
    format!("{joints} joints, {state}, hips {hips} m, {latency}")
}

fn keyframe(keyframe: &Keyframe, arrival: Timestamp) -> String {
    let norm = keyframe.z.iter().map(|v| v * v).sum::<f64>().sqrt();
    let span = keyframe.capture_time_ns.saturating_sub(keyframe.start_time_ns);
    let (window, root) = (keyframe.window, list(&keyframe.root_position_m, 3));
    let from = match span {
        0 => "start of a path".to_owned(),
        span => format!("{} after the previous one", Nanos::new(span)),
    };
    let latency = latency(keyframe.capture_time_ns, arrival);
    format!("window {window}, {from}, |z| {norm:.2}, root {root} m, {latency}")
}

fn event(event: &Event) -> String {
    let camera = event.camera.as_ref().map_or_else(String::new, |camera| format!(" {camera}"));
    let window = event.window.map_or_else(String::new, |window| format!(", window {window}"));
    let count = if event.count > 1 { format!(" x {}", event.count) } else { String::new() };
    let detail = if event.detail.is_empty() { "" } else { ": " };
    format!("{}{camera}{count}{window}{detail}{}", event.kind, event.detail)
}

fn status(status: &Status) -> String {
    let camera = |camera: &CameraCounters| {
        let CameraCounters { camera: name, rate_hz, age_s, offset_s, residual_px, .. } = camera;
        if *rate_hz == 0.0 || camera.silent {
            let usable = if camera.unusable > 0 { "usable " } else { "" };
            return match *age_s > 0.0 {
                true => format!("{name} no {usable}frames for {age_s:.1} s"),
                false => format!("{name} no {usable}frames yet"),
            };
        }
        let lost = camera.late + camera.missing;
        let verdict = match &*camera.verdict {
            "" => String::new(),
            words => format!(", {words}"),
        };
        let corrected = match camera.time_correction_s {
            0.0 => String::new(),
            by => format!(", times corrected by {:+.1} ms", by * 1e3),
        };
        format!(
            "{name} {rate_hz:.1} Hz, offset {:+.1} ms{corrected}, {residual_px:.1} px, {lost} late or missing{verdict}",
            offset_s * 1e3
        )
    };
    let cameras: Vec<String> = status.cameras.iter().map(camera).collect();
    let windows = status.windows.clone().unwrap_or_default();
    let playout = status.playout.clone().unwrap_or_default();
    let effort = status.effort.unwrap_or_default();
    format!(
        "{}; windows {} tracked, {} coasted, {} lost, solve p50 {:.1} ms, p99 {:.1} ms; poses {}, \
         missed {}, provisional {}; declared {:.1} ms; clock {}; effort {}; queue dropped {}; cameras: {}",
        if status.tracker_state.is_empty() { "no state" } else { &status.tracker_state },
        windows.tracked,
        windows.coasted,
        windows.lost,
        windows.solve_p50_ms,
        windows.solve_p99_ms,
        playout.published,
        playout.missed,
        playout.provisional,
        status.declared_latency_ns as f64 * 1e-6,
        clock(status),
        if effort.level == 0 { "full".to_owned() } else { format!("-{}", effort.level) },
        status.queue_dropped,
        cameras.join("; ")
    )
}

fn stage(stage: &StageStatus) -> String {
    let one = |one: &StagePerformer| {
        let shown = one.label.as_ref().map_or("", |label| &label.display_name);
        let shown = if shown.is_empty() { String::new() } else { format!(" ({shown})") };
        let place = match *one.place_m {
            [x, z] => format!(" at {x:.2}, {z:.2} m"),
            _ => String::new(),
        };
        let seen = match one.life.as_str() {
            "confirmed" if one.residual_px > 0.0 => format!(", {:.1} px", one.residual_px),
            "confirmed" => String::new(),
            _ => format!(", not seen for {:.1} s", one.unseen_s),
        };
        let solver = match (&*one.solver, &*one.tracker_state) {
            ("", _) => ", not solved".to_owned(),
            (node, "") => format!(", by {node}"),
            (node, state) => format!(", {state} by {node}"),
        };
        format!("{}{shown} {}{place}{seen}{solver}", one.name, one.life)
    };
    let mut all: Vec<String> = stage.performers.iter().map(one).collect();
    if all.is_empty() {
        all.push("nobody".to_owned());
    }
    let more = [(stage.tentative, "just seen"), (stage.others, "seen, not solved")];
    all.extend(more.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} more {what}")));
    all.join("; ")
}

/// The cameras' clock, with its difference from the node's.
fn clock(status: &Status) -> String {
    match (&*status.clock, status.clock_offset_s) {
        ("", _) => "unknown".to_owned(),
        (kind, 0.0) => kind.to_owned(),
        (kind, offset) => format!("{kind} ({:+.3} s)", -offset),
    }
}

fn journal(journal: &Journal) -> String {
    let mut counts = std::collections::BTreeMap::<&str, u64>::new();
    for entry in &journal.entries {
        *counts.entry(input_name(entry)).or_default() += 1;
    }
    let counts: Vec<String> =
        counts.iter().map(|(name, count)| format!("{count} {name}")).collect();
    format!("number {}: {}", journal.sequence, counts.join(", "))
}

fn input_name(entry: &JournalEntry) -> &'static str {
    match &entry.input {
        Some(Input::Start(_)) => "start",
        Some(Input::Message(_)) => "message",
        Some(Input::Solved(_)) => "solved",
        Some(Input::Solvers(_)) => "solvers",
        Some(Input::Tick(_)) => "tick",
        Some(Input::Dropped(_)) => "dropped",
        Some(Input::Played(_)) => "played",
        Some(Input::End(_)) => "end",
        None => "unknown",
    }
}
