//! Cameras that were silent and send again.

use std::collections::{BTreeMap, BTreeSet};

use crate::io::wire::{CameraCounters, Status};

/// A camera that was silent for longer, seconds, may be another one, or in another place.
const SILENT_S: f64 = 2.0;

/// Which cameras are silent while others send.
#[derive(Default)]
pub(super) struct Silence {
    /// By name, the correction of its capture times when it fell silent.
    silent: BTreeMap<String, f64>,
    /// The cameras that sent at the last look.
    heard: BTreeSet<String>,
}

impl Silence {
    /// The cameras that send again. Not those that the node had left out for their correction, nor any after all were
    /// silent: the detectors may be stopped between takes.
    pub(super) fn returned(&mut self, status: &Status) -> Vec<String> {
        let all: Vec<_> = status.cameras.iter().filter(|camera| camera.age_s > 0.0).collect();
        let (silent, heard): (Vec<_>, Vec<_>) =
            all.into_iter().partition(|camera| camera.age_s > SILENT_S);
        let mut before = std::mem::take(&mut self.silent);
        for camera in silent.iter().filter(|_| !heard.is_empty()) {
            let known = before.remove(&camera.camera);
            let is_new = self.heard.contains(&camera.camera).then_some(camera.time_correction_s);
            self.silent.extend(known.or(is_new).map(|by| (camera.camera.clone(), by)));
        }
        self.heard = heard.iter().map(|camera| camera.camera.clone()).collect();
        let is_same = |camera: &&&CameraCounters| {
            before.get(&camera.camera) == Some(&camera.time_correction_s)
        };
        heard.iter().filter(is_same).map(|camera| camera.camera.clone()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_returns_alone_is_judged_again() {
        let mut silence = Silence::default();
        let mut returned = |ages: [f64; 3], time_correction_s: f64| {
            let names = ["one", "two", "three"];
            let camera = |(name, age_s): (&str, f64)| {
                let counters = CameraCounters { time_correction_s, ..CameraCounters::default() };
                CameraCounters { camera: name.into(), age_s, ..counters }
            };
            let cameras = names.into_iter().zip(ages).map(camera).collect();
            silence.returned(&Status { cameras, ..Status::default() })
        };
        let sends = [0.01; 3];
        // The third one has not begun.
        assert!(returned([0.01, 0.01, 0.0], 0.0).is_empty());
        assert!(returned([0.01, 3.0, 0.01], 0.0).is_empty());
        assert!(returned([0.01, 4.0, 0.01], 0.0).is_empty());
        assert_eq!(returned(sends, 0.0), ["two"]);
        assert!(returned(sends, 0.0).is_empty());
        // All stop and go on, one after the other.
        for ages in [[3.0, 0.01, 0.01], [4.0, 3.0, 0.01], [5.0; 3], [0.01, 6.0, 6.0], sends] {
            assert!(returned(ages, 0.0).is_empty());
        }
        // The node left it out because of a correction.
        assert!(returned([0.01, 3.0, 0.01], -1.0).is_empty());
        assert!(returned(sends, 0.0).is_empty());
    }
}
