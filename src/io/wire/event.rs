//! `Event` from [`tracker::Event`](crate::core::tracker::Event), and its checks.

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
        }
    }

    /// What happened; `None` for a kind that this version does not know.
    pub fn event_kind(&self) -> Option<EventKind> {
        EventKind::ALL.into_iter().find(|kind| kind.name() == self.kind)
    }

    /// Checks what came from outside.
    ///
    /// # Errors
    /// No kind, or a count of zero.
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

/// Whether events of that kind concern the performer, his windows or the node that solves them;
/// else they concern cameras, clocks or queues, which all performers of a stage share.
pub(super) const fn concerns_performer(kind: EventKind) -> bool {
    match kind {
        EventKind::Deadline
        | EventKind::Acquired
        | EventKind::NobodyFound
        | EventKind::Lost
        | EventKind::Coasted
        | EventKind::Left
        | EventKind::Overdue
        | EventKind::Latency
        | EventKind::Effort => true,
        EventKind::Late
        | EventKind::Duplicate
        | EventKind::OutOfOrder
        | EventKind::Missing
        | EventKind::Unusable
        | EventKind::Silent
        | EventKind::Returned
        | EventKind::Calibrated
        | EventKind::ClockOffset
        | EventKind::ClockJump
        | EventKind::Crowd
        | EventKind::Conflict
        | EventKind::Dropped => false,
    }
}
