//! Room on the disk of a recording.

use std::path::Path;

/// Recording stops when the disk has less room, bytes: enough for the end of the files.
const LEAST_ROOM: u64 = 64 << 20;
/// A warning is given when the disk has room for less than this time, or for fewer bytes.
const WARN_SECONDS: u64 = 600;
const WARN_ROOM: u64 = 256 << 20;

/// What was written in the last second, and whether little room was reported.
#[derive(Default)]
pub(super) struct Room {
    bytes: u64,
    is_said: bool,
    is_full: bool,
    free: Option<u64>,
}

impl Room {
    pub(super) fn wrote(&mut self, bytes: usize) {
        self.bytes += bytes as u64;
    }

    /// Bytes that were free at the last report, if known. An error: too few to begin.
    pub(super) fn free(&self) -> Result<Option<u64>, String> {
        match self.free {
            Some(free) if self.is_full => {
                Err(format!("only {} MB are free on the disk; free some space", free >> 20))
            }
            free => Ok(free),
        }
    }

    /// Once a second, with the `room` on the disk, bytes: a warning if it is little, and whether there
    /// is enough to go on.
    pub(super) fn report(&mut self, room: Option<u64>) -> (Option<String>, bool) {
        self.free = room;
        let rate = std::mem::take(&mut self.bytes);
        let Some(room) = room else { return (None, true) };
        let left = room.saturating_sub(LEAST_ROOM);
        let megabytes = room >> 20;
        let was_full = std::mem::replace(&mut self.is_full, left == 0);
        if left == 0 {
            let text = || format!("{megabytes} MB are free on the disk, recording stops");
            return ((!was_full).then(text), false);
        }
        let is_little = left < WARN_ROOM.max(rate * WARN_SECONDS);
        let is_new = is_little && !self.is_said;
        self.is_said = is_little;
        let minutes = left / rate.max(1) / 60;
        // If hardly anything comes, its rate tells nothing about a take.
        let enough = match minutes {
            0..1000 => format!(", enough for about {minutes} minutes"),
            _ => String::new(),
        };
        let text = || format!("{megabytes} MB are free on the disk{enough}; free some space");
        (is_new.then(text), true)
    }
}

/// Bytes that may still be written on the disk of that folder, if the system says so.
pub(crate) fn room(folder: &Path) -> Option<u64> {
    let stat = rustix::fs::statvfs(folder).ok()?;
    Some(stat.f_bavail.saturating_mul(stat.f_frsize))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn little_room_is_said_once_and_a_full_disk_stops() {
        let mut room = Room::default();
        let mut said = |bytes: usize, megabytes: u64| {
            room.wrote(bytes);
            let (said, goes_on) = room.report(Some(megabytes << 20));
            (said.is_some(), goes_on)
        };
        assert_eq!(said(1000, 5000), (false, true));
        assert_eq!(said(1000, 300), (true, true));
        assert_eq!(said(1000, 299), (false, true), "said before");
        assert_eq!(said(1000, 5000), (false, true));
        assert_eq!(said(10 << 20, 5000), (true, true), "not for ten minutes");
        assert_eq!(said(1000, 60), (true, false), "full");
        assert_eq!(said(1000, 60), (false, false), "said before");
        assert_eq!(room.report(None), (None, true));
    }
}
