//! Which cameras a window waits for.

/// The cameras that windows wait for: all except those that were absent from the last
/// `grace_windows` windows.
#[derive(Clone, Debug)]
pub(super) struct Waiting {
    /// Number of windows in a row that closed without the camera.
    missed: Vec<usize>,
    grace_windows: usize,
}

impl Waiting {
    pub(super) fn new(cameras: usize, grace_windows: usize) -> Self {
        Self { missed: vec![0; cameras], grace_windows }
    }

    /// Whether windows wait for a camera.
    pub(super) fn is_waited_for(&self, camera: usize) -> bool {
        self.missed.get(camera).is_some_and(|&missed| missed < self.grace_windows.max(1))
    }

    /// Whether windows wait for any camera.
    pub(super) fn any(&self) -> bool {
        (0..self.missed.len()).any(|camera| self.is_waited_for(camera))
    }

    /// A window closed without the cameras `behind`. Returns those that windows stop waiting for.
    pub(super) fn closed_without(&mut self, behind: &[usize]) -> Vec<usize> {
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

    /// Windows do not wait for a camera until it returns.
    pub(super) fn leave_out(&mut self, camera: usize) {
        if let Some(missed) = self.missed.get_mut(camera) {
            *missed = usize::MAX;
        }
    }

    /// A camera has sent a frame. Returns whether it was silent before.
    pub(super) fn returned(&mut self, camera: usize) -> bool {
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
