//! Which events are expected, and what to do about those that go on.

use crate::core::tracker::EventKind;

/// Whether events of that kind go on. What to do about unusable messages is in the events.
pub(crate) fn goes_on(kind: &str) -> bool {
    kind == EventKind::Unusable.name() || advice(kind).is_some()
}

/// Whether events of that kind belong to a good run. Of the kinds `clock` and `solver` not all do: see [`is_fine`].
pub(crate) fn is_expected(kind: &str) -> bool {
    use EventKind::*;
    let expected = [
        Abandoned, Acquired, Calibrated, Clock, Entered, Idle, Latency, Left, Reentered, Returned,
        RigChanged, Solver, Take, Vacated,
    ];
    EventKind::from_name(kind).is_some_and(|kind| expected.contains(&kind))
}

/// How the detail of an event begins when a camera that was moved or out of time is used again.
pub(crate) const USED_AGAIN: [&str; 4] =
    ["fits again", "mended", "in time again", "its frames agree"];

/// Whether an event belongs to a good run.
pub(crate) fn is_fine(kind: &str, detail: &str) -> bool {
    match kind {
        "clock" => detail.contains("the cameras use"),
        "solver" => !detail.contains("no solver is there"),
        kind => is_expected(kind) || USED_AGAIN.iter().any(|words| detail.starts_with(words)),
    }
}

/// What to do about what goes on; `None` for a kind that happens once.
pub(crate) fn advice(kind: &str) -> Option<&'static str> {
    Some(match EventKind::from_name(kind)? {
        EventKind::Late => {
            "frames come after their window; speed up the detector, or raise deadline_frames"
        }
        EventKind::Duplicate => "frames come twice; is a second publisher running?",
        EventKind::OutOfOrder => "frames come out of order; they are used",
        EventKind::Missing => "frames never come; check the cameras' network and detectors",
        EventKind::Deadline => {
            "windows close without a camera's frames; check its rate and its delay"
        }
        EventKind::Overdue => "poses are extrapolated; raise latency_ms, or use fewer cameras",
        EventKind::Dropped => {
            "messages were lost: the network is slow or was cut, or they come faster than they are read; use fewer \
             cameras, or a faster computer"
        }
        EventKind::NobodyFound => {
            "no two cameras see a person; check the volume, or the calibration"
        }
        EventKind::Coasted => "the cameras see too little of the performer",
        EventKind::NotFollowed => {
            "the solved body is not where the cameras see the performer; run `check` on a recording"
        }
        _ => return None,
    })
}
