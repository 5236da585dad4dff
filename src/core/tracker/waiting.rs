//! Which cameras a window, or a frame set, waits for.

use super::event::{Event, EventKind};
use crate::core::time::{Nanos, Timestamp};

/// The cameras that are waited for: all except those that were absent the last `grace` times.
#[derive(Clone, Debug)]
pub(in crate::core) struct Waiting {
    /// How often in a row it closed without the camera.
    missed: Vec<usize>,
    grace: usize,
}

/// What closes although cameras are missing.
#[derive(Clone, Copy, Debug)]
pub(in crate::core) struct Closing {
    /// Its end.
    pub(in crate::core) end: Timestamp,
    /// How long it waited.
    pub(in crate::core) waited: Nanos,
    /// What it is, in a report: `window`.
    pub(in crate::core) what: &'static str,
}

impl Waiting {
    pub(super) fn new(cameras: usize, grace: usize) -> Self {
        Self { missed: vec![0; cameras], grace: grace.max(1) }
    }

    /// Whether a camera is waited for.
    pub(in crate::core) fn is_waited_for(&self, camera: usize) -> bool {
        self.missed.get(camera).is_some_and(|&missed| missed < self.grace)
    }

    /// Whether any camera is waited for.
    pub(in crate::core) fn any(&self) -> bool {
        (0..self.missed.len()).any(|camera| self.is_waited_for(camera))
    }

    /// Reports the cameras that something closes without, and stops waiting for those that stay silent.
    /// `is_late` tells whether a frame of a camera should have arrived.
    pub(in crate::core) fn close_without(
        &mut self,
        behind: &[usize],
        closing: Closing,
        is_late: impl Fn(usize) -> bool,
    ) -> Vec<Event> {
        let Closing { end, waited, what } = closing;
        let event = |kind, camera: usize, detail: String| Event {
            capture: end,
            kind,
            camera: Some(camera),
            window: None,
            count: 1,
            detail,
        };
        let late = behind.iter().filter(|&&camera| self.is_waited_for(camera) && is_late(camera));
        let waited = waited.ns() / 1_000_000;
        let detail = format!("late: the {what} closed {waited} ms after its end without it");
        let mut events: Vec<Event> =
            late.map(|&camera| event(EventKind::Deadline, camera, detail.clone())).collect();
        let grace = self.grace;
        let detail = format!("no frames in {grace} {what}s, no longer waited for");
        let silent = self.closed_without(behind).into_iter();
        events.extend(silent.map(|camera| event(EventKind::Silent, camera, detail.clone())));
        events
    }

    /// Something closed without the cameras `behind`. Returns those that are no longer waited for.
    fn closed_without(&mut self, behind: &[usize]) -> Vec<usize> {
        let mut silent = Vec::new();
        for camera in 0..self.missed.len() {
            let was_waited_for = self.is_waited_for(camera);
            match behind.contains(&camera) {
                true => self.missed[camera] = self.missed[camera].saturating_add(1),
                false => self.missed[camera] = 0,
            }
            if was_waited_for && !self.is_waited_for(camera) {
                silent.push(camera);
            }
        }
        silent
    }

    /// A camera is not waited for until it returns.
    pub(in crate::core) fn leave_out(&mut self, camera: usize) {
        if let Some(missed) = self.missed.get_mut(camera) {
            *missed = usize::MAX;
        }
    }

    /// A camera has sent a frame. Returns whether it was silent before.
    pub(in crate::core) fn returned(&mut self, camera: usize) -> bool {
        let was_silent = !self.is_waited_for(camera);
        if let Some(missed) = self.missed.get_mut(camera) {
            *missed = 0;
        }
        was_silent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_stop_waiting_for_a_silent_camera_until_it_returns() {
        let mut waiting = Waiting::new(2, 2);
        assert!(waiting.closed_without(&[1]).is_empty());
        assert!(waiting.closed_without(&[]).is_empty());
        assert!(waiting.closed_without(&[1]).is_empty());
        assert_eq!(waiting.closed_without(&[1]), [1]);
        assert!(waiting.closed_without(&[1]).is_empty());
        assert!(waiting.is_waited_for(0) && !waiting.is_waited_for(1) && waiting.any());
        assert!(waiting.returned(1) && !waiting.returned(0));
        assert!(waiting.is_waited_for(1));
    }
}
