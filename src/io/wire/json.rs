//! JSON of messages, for people and scripts.
//!
//! The types generated from the schemas implement `serde::Serialize`: field names are those of the
//! schemas, and all fields are written; an optional field that is not set is `null`. `build.rs`
//! attaches the functions below to fields whose JSON is not the plain number:
//!
//! | field | JSON |
//! |---|---|
//! | `state`, `lens` | the name in snake case, such as `"tracking"` or `"brown_conrady"` |
//! | `run_id`, `hash`, `rig_hash` | 16 hexadecimal digits: JSON numbers have 53 bits |
//! | `rig`, `body` and `payload` of a journal | the number of bytes |
//! | `events` of a status | an object, the count by kind |
//! | an input of a journal | a field named by its kind, such as `"solved": {...}` |

use serde::{Serialize, Serializer};

use super::{EventCount, LensKind, TrackingState};

pub(super) fn tracking_state<S: Serializer>(state: &i32, to: S) -> Result<S::Ok, S::Error> {
    TrackingState::try_from(*state).unwrap_or_default().serialize(to)
}

pub(super) fn lens_kind<S: Serializer>(lens: &i32, to: S) -> Result<S::Ok, S::Error> {
    LensKind::try_from(*lens).unwrap_or_default().serialize(to)
}

pub(super) fn event_counts<S: Serializer>(events: &[EventCount], to: S) -> Result<S::Ok, S::Error> {
    to.collect_map(events.iter().map(|event| (&event.kind, event.count)))
}

pub(super) fn hexadecimal<S: Serializer>(number: &u64, to: S) -> Result<S::Ok, S::Error> {
    to.collect_str(&format_args!("{number:016x}"))
}

pub(super) fn length<S: Serializer>(bytes: &Option<Vec<u8>>, to: S) -> Result<S::Ok, S::Error> {
    bytes.as_ref().map(Vec::len).serialize(to)
}

#[cfg(test)]
mod tests {
    use serde_json::{json, to_value};

    use crate::io::wire::journal_entry::Input;
    use crate::io::wire::{
        CalibratedCamera, EventCount, JournalEntry, JournalMessage, JournalStart, LensKind, Pose,
        Status, TrackingState,
    };

    #[test]
    fn enums_are_names_and_ids_are_hexadecimal() {
        let pose = Pose {
            state: TrackingState::Coasting.into(),
            run_id: u64::MAX,
            local_rotations: vec![0.5, f32::NAN],
            ..Pose::default()
        };
        let pose = to_value(pose).unwrap();
        assert_eq!((&pose["state"], &pose["run_id"]), (&json!("coasting"), &json!("f".repeat(16))));
        assert_eq!((&pose["due_time_ns"], &pose["window"]), (&json!(null), &json!(0)));
        assert_eq!(pose["local_rotations"], json!([0.5, null]));
        let unknown = Pose { state: 99, ..Pose::default() };
        assert_eq!(to_value(unknown).unwrap()["state"], "unspecified");
        let lens = LensKind::BrownConrady.into();
        let camera = to_value(CalibratedCamera { lens, ..CalibratedCamera::default() }).unwrap();
        assert_eq!(camera["lens"], "brown_conrady");
    }

    #[test]
    fn counts_are_an_object_and_inputs_are_named() {
        let events = vec![EventCount { kind: "late".into(), count: 3 }];
        let status = to_value(Status { events, ..Status::default() }).unwrap();
        assert_eq!((&status["events"], &status["windows"]), (&json!({"late": 3}), &json!(null)));
        let entry = |input| to_value(JournalEntry { time_ns: 7, input }).unwrap();
        let ended = entry(Some(Input::End(true)));
        assert_eq!(ended, json!({"time_ns": 7, "end": true}));
        assert_eq!(entry(None), json!({"time_ns": 7}));
        let message = JournalMessage { topic: "t".into(), hash: 16, payload: Some(vec![1; 5]) };
        let expected = json!({"topic": "t", "hash": "0000000000000010", "payload": 5});
        assert_eq!(entry(Some(Input::Message(message)))["message"], expected);
        let start = entry(Some(Input::Start(JournalStart::default())));
        assert_eq!(start["start"]["rig"], json!(null));
    }
}
