//! Events: every fault of the input or of a window is reported and counted.

use crate::core::named;
use crate::core::time::Timestamp;

named! {
    /// What happened.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
    #[non_exhaustive]
    pub enum EventKind {
        /// Detections arrived after their window was closed; they are not used.
        Late = "late",
        /// Detections waited for a window when tracking began anew; they are not used.
        Abandoned = "abandoned",
        /// A frame arrived twice; the second is not used.
        Duplicate = "duplicate",
        /// A frame arrived after a later one of its camera; it is used.
        OutOfOrder = "out_of_order",
        /// Frames are missing in a camera's count.
        Missing = "missing",
        /// Detections of a camera that the rig does not have, of another keypoint format, or with a capture
        /// time that cannot be right.
        Unusable = "unusable",
        /// A camera was late: a window closed at its deadline without it.
        Deadline = "deadline",
        /// The performer was found.
        Acquired = "acquired",
        /// Nobody was found in a window while searching.
        NobodyFound = "nobody_found",
        /// A window fitted badly; its poses are flagged and the search starts again.
        Lost = "lost",
        /// Too little of the performer was seen in a window; the motion was extrapolated.
        Coasted = "coasted",
        /// The performer was not seen for too long; the search starts again.
        Left = "left",
        /// The cameras agree on a point of the performer, but the solved body is more than 10 cm away.
        NotFollowed = "not_followed",
        /// Windows no longer wait for a camera.
        Silent = "silent",
        /// Windows wait again for a camera that was silent.
        Returned = "returned",
        /// A pose was due before its window was solved; an extrapolated one took its place.
        Overdue = "overdue",
        /// A new calibration is in use.
        Calibrated = "calibrated",
        /// Another rig is in use: from the file, from the bus, that of the front, or after mending.
        RigChanged = "rig_changed",
        /// A rig from the bus was refused: a file gives the rig.
        RigRefused = "rig_refused",
        /// The node declared its latency, at first or anew.
        Latency = "latency",
        /// The solver's effort changed.
        Effort = "effort",
        /// A camera's clock differs from the others, or its frames are too late to wait for; or it agrees
        /// again.
        ClockOffset = "clock_offset",
        /// A camera's capture times are shifted against the others', and are corrected: as the motion shows, or by order.
        TimeOffset = "time_offset",
        /// A camera was moved and is left out, or fits its calibration again.
        CameraMoved = "camera_moved",
        /// The known body does not fit the performer; it is estimated anew.
        Body = "body",
        /// The clock of most cameras has stepped, or single frames have a wrong time and are not used.
        ClockJump = "clock_jump",
        /// A frame shows more people than are used.
        Crowd = "crowd",
        /// Points far outside the image; they are not used.
        FarPoint = "far_point",
        /// Two publishers seem to use one camera's name.
        Conflict = "conflict",
        /// Another node of this performer started and stood back.
        SecondNode = "second_node",
        /// Messages were dropped because there were too many, or frames waited for too long.
        Dropped = "dropped",
        /// No camera sends frames, or nobody has been seen for a while; or that has ended.
        Idle = "idle",
        /// Which clock the cameras use, against the node's.
        Clock = "clock",
        /// A command was executed: a take began, was joined or ended, a body was forgotten, a performer was named, and so on.
        Take = "take",
        /// A performer was seen for the first time, with several on the stage.
        Entered = "entered",
        /// A performer who was lost came back.
        Reentered = "reentered",
        /// Two performers were one person.
        Merged = "merged",
        /// A performer was not seen for so long that somebody else may have the place, or was dropped.
        Vacated = "vacated",
        /// Another node solves a performer from here on, or solvers came or left.
        Solver = "solver",
    }
}

/// An event with its evidence.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// The capture time of the event.
    pub capture: Timestamp,
    /// The kind.
    pub kind: EventKind,
    /// Index of the camera, if one is concerned.
    pub camera: Option<usize>,
    /// The window, where one is concerned.
    pub window: Option<u64>,
    /// Number of occurrences; for `Missing`, number of frames.
    pub count: u64,
    /// The measured values and thresholds.
    pub detail: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_of_event_is_in_the_docs() {
        let docs = include_str!("../../../docs/monitoring.md");
        for kind in EventKind::ALL {
            assert!(docs.contains(&format!("| `{}` | ", kind.name())), "{}", kind.name());
        }
        let (_, events) = docs.split_once("## Events").unwrap();
        let (events, _) = events.split_once("## The log").unwrap();
        assert_eq!(events.matches("\n| `").count(), EventKind::ALL.len());
    }
}
