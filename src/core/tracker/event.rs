//! Events: every fault of the input or of a window is reported and counted.

use crate::core::time::Timestamp;

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum EventKind {
    /// Detections arrived after their window was closed; they are not used.
    Late,
    /// A frame arrived twice; the second is not used.
    Duplicate,
    /// A frame arrived after a later one of its camera; it is used.
    OutOfOrder,
    /// Frames are missing in a camera's count.
    Missing,
    /// Detections of a camera that the rig does not have, of another keypoint format, or with a capture
    /// time that cannot be right.
    Unusable,
    /// A camera was late: a window closed at its deadline without it.
    Deadline,
    /// The performer was found.
    Acquired,
    /// Nobody was found in a window while searching.
    NobodyFound,
    /// A window fitted badly; its poses are flagged and the search starts again.
    Lost,
    /// Too little of the performer was seen in a window; the motion was extrapolated.
    Coasted,
    /// The performer was not seen for too long; the search starts again.
    Left,
    /// The cameras agree on a point of the performer, but the solved body is more than 10 cm away.
    NotFollowed,
    /// Windows no longer wait for a camera.
    Silent,
    /// Windows wait again for a camera that was silent.
    Returned,
    /// A pose was due before its window was solved; an extrapolated one took its place.
    Overdue,
    /// A new calibration is in use.
    Calibrated,
    /// Another rig was taken, from the file or from the bus.
    RigChanged,
    /// A rig from the bus was refused: a file gives the rig.
    RigRefused,
    /// The node declared its latency, at first or anew.
    Latency,
    /// The solver's effort changed.
    Effort,
    /// A camera's clock differs from the others, or its frames are too late to wait for; or it agrees
    /// again.
    ClockOffset,
    /// A camera's capture times are shifted against the others', and are corrected: as the motion shows, or by order.
    TimeOffset,
    /// A camera was moved and is left out, or fits its calibration again.
    CameraMoved,
    /// The known body does not fit the performer; it is estimated anew.
    Body,
    /// The clock of most cameras has stepped, or single frames have a wrong time and are not used.
    ClockJump,
    /// A frame shows more people than are used.
    Crowd,
    /// Points far outside the image; they are not used.
    FarPoint,
    /// Two publishers seem to use one camera's name.
    Conflict,
    /// Another node of this performer started and stood back.
    SecondNode,
    /// Messages were dropped because there were too many, or frames waited for too long.
    Dropped,
    /// No camera sends frames, or nobody has been seen for a while; or that has ended.
    Idle,
    /// Which clock the cameras use, against the node's.
    Clock,
    /// A take began or ended, or the performer's body was forgotten, as asked.
    Take,
    /// A performer was seen for the first time, with several on the stage.
    Entered,
    /// A performer who was lost came back.
    Reentered,
    /// Two performers were one person.
    Merged,
    /// A performer was not seen for so long that somebody else may have the place, or was dropped.
    Vacated,
    /// Another node solves a performer from here on, or solvers came or left.
    Solver,
}

impl EventKind {
    /// Every kind.
    pub const ALL: [Self; 38] = [
        Self::Late,
        Self::Duplicate,
        Self::OutOfOrder,
        Self::Missing,
        Self::Unusable,
        Self::Deadline,
        Self::Acquired,
        Self::NobodyFound,
        Self::Lost,
        Self::Coasted,
        Self::Left,
        Self::NotFollowed,
        Self::Silent,
        Self::Returned,
        Self::Overdue,
        Self::Calibrated,
        Self::RigChanged,
        Self::RigRefused,
        Self::Latency,
        Self::Effort,
        Self::ClockOffset,
        Self::TimeOffset,
        Self::CameraMoved,
        Self::Body,
        Self::ClockJump,
        Self::Crowd,
        Self::FarPoint,
        Self::Conflict,
        Self::SecondNode,
        Self::Dropped,
        Self::Idle,
        Self::Clock,
        Self::Take,
        Self::Entered,
        Self::Reentered,
        Self::Merged,
        Self::Vacated,
        Self::Solver,
    ];

    /// A lower-case name, as used on the wire.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Late => "late",
            Self::Duplicate => "duplicate",
            Self::OutOfOrder => "out_of_order",
            Self::Missing => "missing",
            Self::Unusable => "unusable",
            Self::Deadline => "deadline",
            Self::Acquired => "acquired",
            Self::NobodyFound => "nobody_found",
            Self::Lost => "lost",
            Self::Coasted => "coasted",
            Self::Left => "left",
            Self::NotFollowed => "not_followed",
            Self::Silent => "silent",
            Self::Returned => "returned",
            Self::Overdue => "overdue",
            Self::Calibrated => "calibrated",
            Self::RigChanged => "rig_changed",
            Self::RigRefused => "rig_refused",
            Self::Latency => "latency",
            Self::Effort => "effort",
            Self::ClockOffset => "clock_offset",
            Self::TimeOffset => "time_offset",
            Self::CameraMoved => "camera_moved",
            Self::Body => "body",
            Self::ClockJump => "clock_jump",
            Self::Crowd => "crowd",
            Self::FarPoint => "far_point",
            Self::Conflict => "conflict",
            Self::SecondNode => "second_node",
            Self::Dropped => "dropped",
            Self::Idle => "idle",
            Self::Clock => "clock",
            Self::Take => "take",
            Self::Entered => "entered",
            Self::Reentered => "reentered",
            Self::Merged => "merged",
            Self::Vacated => "vacated",
            Self::Solver => "solver",
        }
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
