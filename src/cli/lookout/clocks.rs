//! Clocks of live cameras that a check finds wrong: the node is told to correct them.

use std::collections::BTreeMap;

use crate::core::camera::{Camera, Rig};
use crate::core::time::Nanos;
use crate::diagnose::Check;
use crate::io::wire::{CameraCounters, Take};
use crate::live::Monitor;

/// A check holds if meanwhile no clock was corrected by more.
const SAME_CLOCK: Nanos = Nanos::from_ms(10);
/// A correction must lower the error of a camera to this part.
const LOWERED: f64 = 0.9;
/// Most cameras that are corrected after one check: the node takes a limited number of orders a second.
const MOST_ORDERS: usize = 8;

/// What a node adds to the capture times of its cameras, by name.
pub(super) type Corrections = BTreeMap<String, Nanos>;

/// The corrections in use.
pub(super) fn corrections(node: &Monitor) -> Corrections {
    let of =
        |camera: CameraCounters| (camera.camera, Nanos::rounded(camera.time_correction_s * 1e9));
    node.status().into_iter().flat_map(|status| status.cameras).map(of).collect()
}

/// The cameras, with the corrections in their time offsets.
pub(super) fn corrected(rig: &Rig, corrections: &Corrections) -> Rig {
    let mut rig = rig.clone();
    let by = |camera: &Camera| corrections.get(&camera.name).copied().unwrap_or_default();
    let by: Vec<Nanos> = rig.cameras.iter().map(by).collect();
    rig.shift_times(&by);
    rig
}

/// Whether each correction has stayed about the same.
pub(super) fn are_same(before: &Corrections, now: &Corrections) -> bool {
    before
        .iter()
        .all(|(name, before)| now.get(name).is_some_and(|now| (*now - *before).abs() < SAME_CLOCK))
}

/// An order that is not confirmed.
#[derive(Clone, Copy)]
struct Trial {
    /// The camera's mean error before it.
    error_before: f64,
    /// By how much it changed the correction.
    by: Nanos,
}

/// What was tried with the clocks of the cameras of a calibration.
#[derive(Default)]
pub(super) struct Clocks {
    /// Orders that are not confirmed, by name.
    tried: BTreeMap<String, Trial>,
    /// Cameras of which a correction was of no use.
    not_to_correct: Vec<String>,
}

impl Clocks {
    /// Whether an order waits for its confirmation.
    pub(super) fn are_tried(&self) -> bool {
        !self.tried.is_empty()
    }

    /// A camera may have another clock now: what was tried is forgotten.
    pub(super) fn forget(&mut self, camera: &str) {
        self.tried.remove(camera);
        self.not_to_correct.retain(|name| name != camera);
    }

    /// What the node is to do after a check: correct capture times that are early or late, and take back corrections
    /// after which a camera fits no better.
    pub(super) fn orders(&mut self, check: &Check, corrections: &Corrections) -> Vec<Take> {
        let mut orders = Vec::new();
        for row in &check.cameras {
            // Otherwise it hardly sees anybody now.
            let Some(error) = row.mean_error else { continue };
            let tried = self.tried.remove(&row.camera);
            let is_of_no_use = |tried: &Trial| error > LOWERED * tried.error_before;
            let undo = tried.filter(is_of_no_use).map(|tried| -tried.by);
            self.not_to_correct.extend(undo.map(|_| row.camera.clone()));
            let late = row.times.and_then(|wrong| wrong.late());
            let is_open = orders.len() < MOST_ORDERS && !self.not_to_correct.contains(&row.camera);
            let new = late.filter(|_| is_open).map(|late| -late);
            let trial = new.map(|by| Trial { error_before: error, by });
            self.tried.extend(trial.map(|trial| (row.camera.clone(), trial)));
            let now = corrections.get(&row.camera).copied().unwrap_or_default();
            orders.extend(undo.or(new).map(|by| Take {
                action: "clock".to_owned(),
                name: row.camera.clone(),
                offset_ms: (now + by).ms(),
                ..Take::default()
            }));
        }
        orders
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::core::body::Skeleton;
    use crate::core::tracker::Config;
    use crate::diagnose::Evidence;
    use crate::research::synth::{Motion, MotionStyle, Recording, ring_rig};

    const LATE: Nanos = Nanos::from_ms(100);

    /// The check of four cameras, the second of which is late and has this correction.
    pub fn check(correction: Nanos) -> Check {
        let skeleton = Skeleton::default();
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let mut rig = ring_rig(4, 4.0, 1.6).unwrap();
        let mut recording = Recording::new(rig.clone(), skeleton, |seconds| motion.pose(seconds));
        (recording.fps, recording.frames) = (60.0, 480);
        rig.shift_time(1, correction);
        let mut evidence = Evidence::new(Arc::new(rig.clone()), Config::default(), None);
        for mut frame in recording.detections() {
            if frame.camera == 1 {
                frame.capture = frame.capture + LATE;
            }
            evidence.add(&frame, 0);
        }
        evidence.check(&rig)
    }

    /// The corrections that are ordered, milliseconds, while the node has one of the second camera.
    fn ordered(clocks: &mut Clocks, check: &Check, correction: Nanos) -> Vec<f64> {
        let now = BTreeMap::from([("cam02".to_owned(), correction)]);
        let orders = clocks.orders(check, &now);
        let sound = |order: &Take| order.name == "cam02" && order.action == "clock";
        assert!(orders.iter().all(sound), "{orders:?}");
        orders.iter().map(|order| order.offset_ms.round()).collect()
    }

    #[test]
    fn a_late_clock_is_corrected_and_a_correction_of_no_use_is_taken_back() {
        let (late, right) = (check(Nanos::ZERO), check(-LATE));
        let mut clocks = Clocks::default();
        assert_eq!(ordered(&mut clocks, &late, Nanos::ZERO), [-100.0]);
        assert!(right.is_clean());
        assert!(ordered(&mut clocks, &right, -LATE).is_empty());

        // It was of no use, and is not tried again.
        let before = Nanos::from_ms(7);
        assert_eq!(ordered(&mut clocks, &late, before), [-93.0]);
        // Meanwhile, all cameras were shifted by 3 ms.
        assert_eq!(ordered(&mut clocks, &late, before - LATE + Nanos::from_ms(3)), [10.0]);
        assert!(ordered(&mut clocks, &late, before).is_empty());
    }
}
