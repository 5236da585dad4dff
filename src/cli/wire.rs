//! Messages as a line for people, and as JSON with all fields.

use serde_json::{Map, Value, json};

use crate::core::time::Timestamp;
use crate::io::recording::Message;
use crate::io::wire::journal_entry::Input;
use crate::io::wire::{
    CameraCounters, Event, Journal, JournalEntry, Keyframe, KeypointFrame, LensKind, Pose,
    RetargetedPose, Rig, Status, TrackingState,
};

/// What a message says, in short; `None` for one that is not ours.
pub(super) fn text(message: &Message, arrival: Timestamp) -> Option<String> {
    Some(match message {
        Message::Keypoints(frame) => keypoints(frame, arrival),
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
        Message::Journal(journal) => self::journal(journal),
        Message::Retargeted(pose) => retargeted(pose, arrival),
        Message::Other { .. } => return None,
    })
}

/// All fields of a message.
pub(super) fn json(message: &Message) -> Value {
    match message {
        Message::Keypoints(frame) => keypoints_json(frame),
        Message::Rig(rig) => rig_json(rig),
        Message::Pose(pose) | Message::TruthPose(pose) => pose_json(pose),
        Message::Keyframe(keyframe) => keyframe_json(keyframe),
        Message::Skeleton(skeleton) | Message::TruthSkeleton(skeleton) => json!({
            "joint_names": skeleton.joint_names,
            "parents": skeleton.parents,
            "rest_offsets_m": skeleton.rest_offsets_m,
            "shape": skeleton.shape,
        }),
        Message::Event(event) => json!({
            "capture_time_ns": event.capture_time_ns,
            "kind": event.kind,
            "camera": event.camera,
            "window": event.window,
            "count": event.count,
            "detail": event.detail,
        }),
        Message::Status(status) => status_json(status),
        Message::Retargeted(pose) => json!({
            "capture_time_ns": pose.capture_time_ns,
            "publish_time_ns": pose.publish_time_ns,
            "state": state(pose.state),
            "hips": pose.hips,
            "hips_position_m": pose.hips_position_m,
            "local_rotations": pose.local_rotations,
            "joint_names": pose.joint_names,
        }),
        Message::Journal(journal) => json!({
            "sequence": journal.sequence,
            "entries": journal.entries.iter().map(entry_json).collect::<Vec<_>>(),
        }),
        Message::Other { .. } => Value::Null,
    }
}

fn ms(ns: i64) -> f64 {
    ns as f64 * 1e-6
}

fn latency(capture_ns: i64, arrival: Timestamp) -> String {
    format!("latency {:.1} ms", ms(arrival - Timestamp::from_ns(capture_ns)))
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
    let kept = pose.publish_time_ns.map_or_else(String::new, |published| {
        let after = published.saturating_sub(pose.capture_time_ns);
        let declared = i64::try_from(pose.declared_latency_ns).unwrap_or(i64::MAX);
        match declared {
            0 => format!(", sent after {:.1} ms", ms(after)),
            _ => format!(
                ", declared {:.1} ms, sent {:+.2} ms off it",
                ms(declared),
                ms(after.saturating_sub(declared))
            ),
        }
    });
    let root = list(&pose.root_position_m, 3);
    let (window, state) = (pose.window, state(pose.state));
    let latency = latency(pose.capture_time_ns, arrival);
    format!("{kind}window {window}, {state}, root {root} m, {latency}{kept}")
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
        0 => "begins a path".to_owned(),
        span => format!("{:.1} ms from the one before", ms(span)),
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
        let CameraCounters { camera: name, rate_hz, offset_s, residual_px, .. } = camera;
        let lost = camera.late + camera.missing;
        format!(
            "{name} {rate_hz:.1} Hz, offset {:+.1} ms, {residual_px:.1} px, {lost} late or missing",
            offset_s * 1e3
        )
    };
    let cameras: Vec<String> = status.cameras.iter().map(camera).collect();
    let windows = status.windows.clone().unwrap_or_default();
    let playout = status.playout.clone().unwrap_or_default();
    let effort = status.effort.unwrap_or_default();
    format!(
        "{}; windows {} tracked, {} coasted, {} lost, solve p50 {:.1} ms, p99 {:.1} ms; poses {}, \
         missed {}, live {}; declared {:.1} ms; effort -{}; queue dropped {}; cameras: {}",
        if status.performer.is_empty() { "no performer" } else { &status.performer },
        windows.tracked,
        windows.coasted,
        windows.lost,
        windows.solve_p50_ms,
        windows.solve_p99_ms,
        playout.published,
        playout.missed,
        playout.provisional,
        status.declared_latency_ns as f64 * 1e-6,
        effort.level,
        status.queue_dropped,
        cameras.join("; ")
    )
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
        Some(Input::Tick(_)) => "tick",
        Some(Input::Dropped(_)) => "dropped",
        Some(Input::Played(_)) => "played",
        Some(Input::End(_)) => "end",
        None => "unknown",
    }
}

fn keypoints_json(frame: &KeypointFrame) -> Value {
    let people = frame.people.iter();
    let people = people.map(|person| json!({ "id": person.id, "points": person.points }));
    json!({
        "camera": frame.camera,
        "frame": frame.frame,
        "capture_time_ns": frame.capture_time_ns,
        "image_width": frame.image_width,
        "image_height": frame.image_height,
        "format": frame.format,
        "people": people.collect::<Vec<_>>(),
    })
}

fn rig_json(rig: &Rig) -> Value {
    let cameras = rig.cameras.iter().map(|camera| {
        let lens = match LensKind::try_from(camera.lens) {
            Ok(LensKind::BrownConrady) => "brown_conrady",
            Ok(LensKind::Fisheye) => "fisheye",
            Ok(LensKind::Unspecified) | Err(_) => "unknown",
        };
        json!({
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "focal_px": camera.focal_px,
            "centre_px": camera.centre_px,
            "skew_px": camera.skew_px,
            "lens": lens,
            "lens_coefficients": camera.lens_coefficients,
            "camera_from_world_rotation": camera.camera_from_world_rotation,
            "camera_from_world_translation_m": camera.camera_from_world_translation_m,
        })
    });
    json!({ "version": rig.version, "cameras": cameras.collect::<Vec<_>>() })
}

fn pose_json(pose: &Pose) -> Value {
    json!({
        "capture_time_ns": pose.capture_time_ns,
        "publish_time_ns": pose.publish_time_ns,
        "declared_latency_ns": pose.declared_latency_ns,
        "state": state(pose.state),
        "root_position_m": pose.root_position_m,
        "root_rotation": pose.root_rotation,
        "local_rotations": pose.local_rotations,
        "joint_positions_m": pose.joint_positions_m,
        "rig_version": pose.rig_version,
        "window": pose.window,
        "provisional": pose.provisional,
        "revision": pose.revision,
    })
}

fn keyframe_json(keyframe: &Keyframe) -> Value {
    json!({
        "capture_time_ns": keyframe.capture_time_ns,
        "window": keyframe.window,
        "z": keyframe.z,
        "root_rotation": keyframe.root_rotation,
        "root_position_m": keyframe.root_position_m,
        "shape": keyframe.shape,
        "start_time_ns": keyframe.start_time_ns,
        "interpolation": keyframe.interpolation,
        "weights": keyframe.weights,
        "grid_origin_ns": keyframe.grid_origin_ns,
        "grid_period_ns": keyframe.grid_period_ns,
        "state": state(keyframe.state),
        "rig_version": keyframe.rig_version,
    })
}

fn status_json(status: &Status) -> Value {
    let windows = status.windows.as_ref().map(|windows| {
        json!({
            "tracked": windows.tracked,
            "coasted": windows.coasted,
            "lost": windows.lost,
            "incomplete": windows.incomplete,
            "iterations": windows.iterations,
            "solve_p50_ms": windows.solve_p50_ms,
            "solve_p99_ms": windows.solve_p99_ms,
            "termination": windows.termination,
        })
    });
    let playout = status.playout.as_ref().map(|playout| {
        json!({
            "published": playout.published,
            "coasted": playout.coasted,
            "missed": playout.missed,
            "deviation_bins_us": playout.deviation_bins_us,
            "deviation_counts": playout.deviation_counts,
            "provisional": playout.provisional,
            "provisional_bins_us": playout.provisional_bins_us,
            "provisional_counts": playout.provisional_counts,
        })
    });
    let effort = status.effort.as_ref().map(|effort| {
        json!({
            "level": effort.level,
            "iterations": effort.iterations,
            "stride": effort.stride,
            "degradation_steps": effort.degradation_steps,
        })
    });
    let events = status.events.iter().map(|event| (event.kind.clone(), json!(event.count)));
    json!({
        "capture_time_ns": status.capture_time_ns,
        "node_time_ns": status.node_time_ns,
        "inputs": status.inputs,
        "performer": status.performer,
        "declared_latency_ns": status.declared_latency_ns,
        "cameras": status.cameras.iter().map(camera_json).collect::<Vec<_>>(),
        "windows": windows,
        "playout": playout,
        "effort": effort,
        "events": events.collect::<Map<_, _>>(),
        "queue_dropped": status.queue_dropped,
    })
}

fn camera_json(camera: &CameraCounters) -> Value {
    json!({
        "camera": camera.camera,
        "used": camera.used,
        "late": camera.late,
        "duplicate": camera.duplicate,
        "out_of_order": camera.out_of_order,
        "missing": camera.missing,
        "unusable": camera.unusable,
        "rate_hz": camera.rate_hz,
        "age_s": camera.age_s,
        "offset_s": camera.offset_s,
        "drift_ppm": camera.drift_ppm,
        "residual_px": camera.residual_px,
        "waited_for": camera.waited_for,
    })
}

fn entry_json(entry: &JournalEntry) -> Value {
    let input = match &entry.input {
        Some(Input::Start(start)) => json!({
            "version": start.version,
            "config": start.config,
            "weights": start.weights,
            "platform": start.platform,
            "rig_bytes": start.rig.as_ref().map(Vec::len),
        }),
        Some(Input::Message(message)) => json!({
            "topic": message.topic,
            "hash": format!("{:016x}", message.hash),
            "payload_bytes": message.payload.as_ref().map(Vec::len),
        }),
        Some(Input::Solved(solved)) => json!({ "job": solved.job, "took_ns": solved.took_ns }),
        Some(Input::Tick(_) | Input::End(_)) | None => Value::Null,
        Some(Input::Dropped(count)) => json!(count),
        Some(Input::Played(played)) => json!({ "deviation_us": played.deviation_us }),
    };
    json!({ "time_ns": entry.time_ns, "kind": input_name(entry), "input": input })
}
