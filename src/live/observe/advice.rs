//! Which events are expected, and what to do about those that go on.

/// Whether events of that kind go on. What to do about unusable messages is in the events.
pub(crate) fn goes_on(kind: &str) -> bool {
    kind == "unusable" || advice(kind).is_some()
}

/// Whether events of that kind belong to a good run. Of the kinds `clock` and `solver` not all do: see [`is_fine`].
pub(crate) fn is_expected(kind: &str) -> bool {
    let of_performers = ["acquired", "left", "entered", "reentered", "vacated"];
    let of_cameras = ["returned", "calibrated", "rig_changed", "clock"];
    let of_node = ["latency", "idle", "take", "solver", "abandoned"];
    [&of_performers[..], &of_cameras, &of_node].concat().contains(&kind)
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
    Some(match kind {
        "late" => "frames come after their window; speed up the detector, or raise deadline_frames",
        "duplicate" => "frames come twice; is a second publisher running?",
        "out_of_order" => "frames overtake each other and are used all the same",
        "missing" => "frames never come; check the cameras' network and detectors",
        "deadline" => "windows close without a camera's frames; check its rate and its delay",
        "overdue" => "poses are extrapolated; raise latency_ms, or use fewer cameras",
        "dropped" => {
            "messages were lost: the network is slow or was cut, or they come faster than they are read; use fewer \
             cameras, or a faster computer"
        }
        "nobody_found" => "no two cameras see a person; check the volume, or the calibration",
        "coasted" => "too little of the performer is seen",
        "not_followed" => {
            "the solved body is not where the cameras see the performer; run `check` on a recording"
        }
        _ => return None,
    })
}
