//! Converts [`tracker::Event`](crate::core::tracker::Event) to `Event`, and checks `Event`.

use super::check::field;
use super::{DecodeError, Event};
use crate::core::tracker::{self, EventKind};

impl Event {
    /// The event; `camera` is the name of the camera that it concerns.
    pub fn from_core(event: &tracker::Event, camera: Option<&str>) -> Self {
        Self {
            capture_time_ns: event.capture.ns(),
            kind: event.kind.name().to_owned(),
            camera: camera.map(str::to_owned),
            window: event.window,
            count: event.count.max(1),
            detail: event.detail.clone(),
            run_id: 0,
        }
    }

    /// The kind; `None` if this version does not know it.
    pub fn event_kind(&self) -> Option<EventKind> {
        EventKind::from_name(&self.kind)
    }

    /// Checks a message from outside.
    ///
    /// # Errors
    /// The kind is empty, or the count is zero.
    pub fn validated(self) -> Result<Self, DecodeError> {
        if self.kind.is_empty() {
            return Err(field("Event", "kind").invalid("is empty"));
        }
        if self.count == 0 {
            return Err(field("Event", "count").invalid("is 0, must be at least 1"));
        }
        Ok(self)
    }
}

/// Whether events of that kind concern the performer, the performer's windows or the node that
/// solves them. Other events concern cameras, clocks or queues, which all performers of a stage
/// share.
pub(super) const fn concerns_performer(kind: EventKind) -> bool {
    match kind {
        EventKind::Deadline
        | EventKind::Acquired
        | EventKind::NobodyFound
        | EventKind::Lost
        | EventKind::Coasted
        | EventKind::Left
        | EventKind::NotFollowed
        | EventKind::Overdue
        | EventKind::Latency
        | EventKind::Effort
        | EventKind::Body
        | EventKind::Idle
        | EventKind::Take
        | EventKind::Entered
        | EventKind::Reentered
        | EventKind::Merged
        | EventKind::Vacated
        | EventKind::Solver
        | EventKind::SecondNode => true,
        EventKind::Late
        | EventKind::Abandoned
        | EventKind::Duplicate
        | EventKind::OutOfOrder
        | EventKind::Missing
        | EventKind::Unusable
        | EventKind::Silent
        | EventKind::Returned
        | EventKind::Calibrated
        | EventKind::RigChanged
        | EventKind::RigRefused
        | EventKind::ClockOffset
        | EventKind::TimeOffset
        | EventKind::CameraMoved
        | EventKind::ClockJump
        | EventKind::Crowd
        | EventKind::FarPoint
        | EventKind::Conflict
        | EventKind::Dropped
        | EventKind::Clock => false,
    }
}
